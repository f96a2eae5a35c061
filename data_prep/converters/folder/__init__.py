"""Anybody's own scenes: a folder each, with photos, cameras, and depth maps or a COLMAP model.

Cameras are read from a COLMAP model, from nerfstudio's ``transforms.json`` or from this project's
``cameras.json``; a small ``scene.json`` says what these cannot. docs/datasets/folder.md shows how
to lay a scene out.
"""

from collections.abc import Collection, Iterator
from contextlib import suppress
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Literal

from data_prep.converters.colmap_model import shared_point_overlap
from data_prep.converters.folder.frames import build_frames, pair_depth
from data_prep.converters.folder.options import SceneOptions, read_options
from data_prep.converters.folder.sources import Views, find_source, read_views
from data_prep.converters.photos import photo_size
from data_prep.problems import Problems
from data_prep.scene import Scene
from data_prep.survey import SceneSurvey
from l3r.errors import DataError

Split = Literal["train", "test", "all"]


def read(
    root: Path,
    split: Split = "train",
    *,
    scenes: str = "*",
    frame_step: int = 1,
    problems: Problems,
    names: Collection[str] | None = None,
) -> Iterator[Scene]:
    """Find scenes and read their cameras; pixels follow when asked for.

    Args:
        root: Folder that holds one folder for each scene.
        split: ``train`` or ``all``; nothing is held out.
        scenes: Pattern on the names of the folders.
        frame_step: Take every so many images, by name.
        problems: Told about what cannot be used.
        names: Only scenes of these names; where given, that none of them can be read is no error.

    Yields:
        One scene per folder, sorted by name. Metric where its ``scene.json`` says so. Where depth
        is a COLMAP model's points, overlap is theirs as well.

    Raises:
        DataError: There is no scene, none is asked for, or none can be used.
    """
    folders = _choose(root, split, scenes)
    number = 0
    for folder in folders:
        if names is not None and folder.name not in names:
            continue
        with problems.about(folder.name):
            scene = _read_if_whole(folder, frame_step, problems)
        if scene is not None:
            number += 1
            yield scene
    if not number and names is None:
        raise DataError(
            f"{root}: none of {len(folders)} scenes can be used (problems: {problems.summary()});"
            " docs/datasets/folder.md says what a scene needs"
        )


def list_names(root: Path, split: Split, *, scenes: str, problems: Problems) -> list[str]:
    """List the names of what :func:`read` reads, in its order; arguments and errors are its own."""
    del problems  # none comes up before a scene is read
    return [folder.name for folder in _choose(root, split, scenes)]


def _choose(root: Path, split: Split, scenes: str) -> list[Path]:
    folders = [folder for folder in find_scenes(root) if fnmatchcase(folder.name, scenes)]
    if split == "test" or not folders:
        raise DataError(
            f"{root}: no scene in split '{split}' that matches '{scenes}'; change --scenes, or hold"
            " frames out by --held-out, since a folder has no split"
        )
    return folders


def _read_if_whole(folder: Path, frame_step: int, problems: Problems) -> Scene | None:
    try:
        return _read_scene(folder, frame_step, problems)
    except DataError as error:
        problems.add("bad_scene", folder, str(error).removeprefix(f"{folder}: "))
        return None


def find_scenes(root: Path) -> list[Path]:
    """List the folders below a root, sorted by name.

    Raises:
        DataError: There is none, or the root is a scene itself.
    """
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; name the folder that holds the scenes")
    if find_source(root, read_options(root)):
        raise DataError(
            f"{root}: is a scene itself, expected folders of scenes; name {root.parent}"
        )
    found = [path for path in sorted(root.iterdir()) if path.is_dir() and path.name[0] != "."]
    if not found:
        raise DataError(f"{root}: no folder below it, expected one for each scene")
    return found


def _read_views(folder: Path, options: SceneOptions, problems: Problems) -> Views:
    source = find_source(folder, options)
    if source is None:
        raise DataError(
            f"{folder}: no cameras, expected a COLMAP model (sparse/0, ...), transforms.json or"
            " cameras.json"
        )
    return read_views(folder, source, options, problems)


def _read_scene(folder: Path, frame_step: int, problems: Problems) -> Scene | None:
    options = read_options(folder)
    views = _read_views(folder, options, problems)
    frames, is_sparse = build_frames(folder, views, options, frame_step, problems)
    if not frames:
        problems.add("empty_scene", folder, "no image is left")
        return None
    overlap = None
    if is_sparse and views.model is not None:
        names = tuple(frame.name for frame in frames)
        overlap = partial(shared_point_overlap, views.model, names)
    return Scene(
        dataset="folder",
        name=folder.name,
        is_metric=options.metric,
        frames=frames,
        has_sparse_depth=is_sparse,
        read_overlap=overlap,
    )


def survey(root: Path) -> Iterator[SceneSurvey]:
    """List the scenes, without opening photos and depth maps.

    Args:
        root: Folder that holds one folder for each scene.

    Yields:
        One line per folder: images with camera and file, and with a depth map where the scene has
        any; ``excluded`` says why it cannot be used.

    Raises:
        DataError: There is no scene.
    """
    for folder in find_scenes(root):
        problems = Problems(quiet=True)
        size, photos, excluded = None, [], ""
        try:
            photos = _list_usable(folder, problems)
            with suppress(DataError):
                size = photo_size(photos[0]) if photos else None
        except DataError as error:
            excluded = str(error).removeprefix(f"{folder}: ")
        yield SceneSurvey(
            name=folder.name,
            num_images=len(photos),
            image_size=size,
            num_missing=problems.counts.total(),
            excluded=excluded,
        )


def _list_usable(folder: Path, problems: Problems) -> list[Path]:
    options = read_options(folder)
    views = _read_views(folder, options, problems)
    depths = pair_depth(folder, views, options, problems)
    usable = [
        view.photo
        for view in views.views
        if view.name in depths and (depths[view.name] or not any(depths.values()))
    ]
    problems.counts["missing_depth"] += len(views.views) - len(usable)
    return usable
