"""MegaDepth, version 1: photos of landmarks with multi-view stereo depth and SfM models.

``SCENE/dense<k>/{imgs, depths}`` beside ``SCENE/sparse/manhattan/<k>``, or these with the scene
indices of D2-Net and LoFTR in place of the models. A scene is one reconstruction, named
``0001/dense0``; two of the same landmark share no frame. docs/datasets/megadepth.md says what is
translated, left out and held out.
"""

from collections.abc import Collection, Iterator
from contextlib import suppress
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path

from data_prep.converters.colmap_model import shared_point_overlap
from data_prep.converters.megadepth.frames import build_frames
from data_prep.converters.megadepth.layout import DensePart, find_parts
from data_prep.converters.megadepth.sources import Source, find_sources, list_files
from data_prep.converters.megadepth.splits import HELD_OUT, Split, excluded_because, is_in
from data_prep.converters.photos import photo_size
from data_prep.problems import Problems
from data_prep.scene import Scene
from data_prep.survey import SceneSurvey
from l3r.errors import DataError


def read(
    root: Path,
    split: Split = "train",
    *,
    scenes: str = "*",
    frame_step: int = 1,
    problems: Problems,
    names: Collection[str] | None = None,
    include_excluded: bool = False,
) -> Iterator[Scene]:
    """Find reconstructions and their cameras; pixels follow when asked for.

    Args:
        root: Folder that holds the scenes, or the unpacked archives side by side.
        split: ``train`` leaves 0015 and 0022 out, ``test`` is these two, ``all`` is both.
        scenes: Pattern on ``0001/dense0``.
        frame_step: Take every so many images, by name.
        problems: Told about what cannot be used.
        names: Only scenes of these names; where given, that none of them can be read is no error.
        include_excluded: Also take scenes that hold evaluation sets; see
            :func:`~data_prep.converters.megadepth.splits.excluded_because`.

    Yields:
        One scene per reconstruction, sorted by name. Not metric. Where the SfM model is there,
        overlap is that of its points.

    Raises:
        DataError: There is nothing to read, or nothing of it can be used.
    """
    number = 0
    for source in _choose(root, split, scenes, problems, include_excluded=include_excluded):
        if names is not None and source.name not in names:
            continue
        with problems.about(source.name):
            scene = _build_scene(source, frame_step, problems)
        if scene is not None:
            number += 1
            yield scene
    if not number and names is None:
        raise DataError(
            f"{root}: no scene in split '{split}' that matches '{scenes}' can be used (problems:"
            f" {problems.summary()}); change --split or --scenes, or unpack both archives"
        )


def list_names(
    root: Path, split: Split, *, scenes: str, problems: Problems, include_excluded: bool = False
) -> list[str]:
    """List the names of what :func:`read` reads, in its order; arguments and errors are its own."""
    chosen = _choose(root, split, scenes, problems, include_excluded=include_excluded)
    return [source.name for source in chosen]


def _choose(
    root: Path, split: Split, scenes: str, problems: Problems, *, include_excluded: bool
) -> Iterator[Source]:
    for source in find_sources(root, problems):
        if not (is_in(source.scene_id, split) and fnmatchcase(source.name, scenes)):
            continue
        reason = excluded_because(source.scene_id)
        if reason and not include_excluded:
            problems.add("excluded_scene", source.name, reason)
        else:
            yield source


def _build_scene(source: Source, frame_step: int, problems: Problems) -> Scene | None:
    named = list(build_frames(source.collect(problems)[::frame_step], problems))
    if not named:
        problems.add("empty_scene", source.name, "no image is left")
        return None
    names = tuple(name for name, _ in named)
    return Scene(
        dataset="megadepth",
        name=source.name,
        is_metric=False,
        frames=[frame for _, frame in named],
        read_overlap=partial(shared_point_overlap, source.model, names) if source.model else None,
    )


def survey(root: Path) -> Iterator[SceneSurvey]:
    """List the reconstructions by their files, without reading SfM models and depth.

    An image counts if its depth map lies beside it; whether it is registered, and whether the map
    is ordinal, only ``read`` finds out.

    Args:
        root: As for :func:`read`.

    Yields:
        One line per reconstruction; ``excluded`` says why ``read`` leaves it out of ``train``.

    Raises:
        DataError: There is nothing to read.
    """
    problems = Problems(quiet=True)
    indexed = set()
    for source in find_sources(root, problems):
        if source.model is None:
            indexed.add(source.name)
            yield _survey_source(source)
    for part in find_parts(root):
        if part.name not in indexed:
            yield _survey_part(part)


def _excluded(scene_id: str) -> str:
    reason = excluded_because(scene_id)
    return "held out for testing: MegaDepth-1500" if scene_id in HELD_OUT else reason


def _survey_source(source: Source) -> SceneSurvey:
    problems = Problems(quiet=True)
    photos = [candidate.photo for candidate in source.collect(problems)]
    return SceneSurvey(
        name=source.name,
        num_images=len(photos),
        image_size=_size_of(photos),
        num_missing=problems.counts.total(),
        excluded=_excluded(source.scene_id),
    )


def _survey_part(part: DensePart) -> SceneSurvey:
    depths = {Path(name).stem for name in list_files(part.folder / "depths")}
    photos = sorted(list_files(part.folder / "imgs"))
    whole = [part.folder / "imgs" / name for name in photos if Path(name).stem in depths]
    return SceneSurvey(
        name=part.name,
        num_images=len(whole),
        image_size=_size_of(whole),
        num_missing=len(photos) - len(whole),
        excluded=_excluded(part.scene_id) or ("" if part.model else "no SfM model"),
    )


def _size_of(photos: list[Path]) -> tuple[int, int] | None:
    with suppress(DataError):
        return photo_size(photos[0]) if photos else None
    return None
