"""The images of a scene with their files and cameras: from SfM models, or from scene indices."""

import os
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

from data_prep.converters.colmap_model import read_model
from data_prep.converters.megadepth.frames import Candidate
from data_prep.converters.megadepth.layout import BASES, DensePart, find_parts, find_scene_infos
from data_prep.converters.megadepth.scene_info import InfoImage, read_scene_info
from data_prep.converters.paths import join_inside
from data_prep.problems import Problems
from l3r.errors import DataError

_SCENE_PATH = re.compile(r"(?:^|/)(\d{4}/.*)")
_NAME_END = re.compile(r"[_.]")


@dataclass(frozen=True, kw_only=True)
class Source:
    """One reconstruction and where its cameras come from."""

    name: str
    """``0001/dense0``."""
    model: Path | None
    """SfM model that the cameras come from; None: they come from scene indices."""
    collect: Callable[[Problems], list[Candidate]]
    """Give the images that have image, depth and camera, by file name."""

    @property
    def scene_id(self) -> str:
        """``0001``."""
        return self.name.partition("/")[0]


def find_sources(root: Path, problems: Problems) -> Iterator[Source]:
    """Find reconstructions with cameras: those of SfM models, then those of scene indices alone.

    Args:
        root: Folder that holds the scenes, the unpacked archives, or indices.
        problems: Told about reconstructions without cameras, and damaged indices.

    Raises:
        DataError: There is neither.
    """
    parts, groups = find_parts(root), group_infos(find_scene_infos(root))
    if not (parts or groups):
        raise DataError(
            f"{root}: no SCENE/dense0/imgs and no scene index (.npz) below it, expected MegaDepth's"
            " archives unpacked; check the folder"
        )
    modelled = {part.name for part in parts if part.model}
    for part in parts:
        if part.model:
            yield Source(name=part.name, model=part.model, collect=partial(from_model, part))
    indexed: set[str] = set()
    for group, paths in groups.items():
        bases = list(dict.fromkeys([root, *(path.parent for path in paths)]))
        for name, images in read_group(group, paths, problems).items():
            if name not in modelled | indexed:
                indexed.add(name)
                yield Source(name=name, model=None, collect=partial(from_infos, images, bases))
    for part in parts:
        if part.name not in modelled | indexed:
            problems.add("missing_model", part.folder, "no sparse/manhattan and no scene index")


def from_model(part: DensePart, problems: Problems) -> list[Candidate]:
    """Give the registered images of a reconstruction that have image and depth, by file name.

    Args:
        part: With its SfM model.
        problems: Told about images that lack something.
    """
    assert part.model is not None
    photos, depths = list_files(part.folder / "imgs"), list_files(part.folder / "depths")
    found: dict[str, Candidate] = {}
    for image in read_model(part.model, problems):
        photo = PurePosixPath(image.name).name
        depth = f"{PurePosixPath(photo).stem}.h5"
        if photo not in photos:
            problems.add("missing_photo", part.folder / "imgs" / photo, "registered, not there")
        elif depth not in depths:
            problems.add("missing_depth", part.folder / "depths" / depth, "no such file")
        elif photo in found:
            problems.add("duplicate_name", part.folder / "imgs" / photo, "registered twice")
        else:
            found[photo] = Candidate(
                photo=part.folder / "imgs" / photo,
                depth=part.folder / "depths" / depth,
                camera=image.lens,
                cam_from_world=image.cam_from_world,
                name=image.name,
            )
    return [found[name] for name in sorted(found)]


def list_files(folder: Path) -> set[str]:
    """Names in a folder, none where it is missing; one look instead of one for each file."""
    with suppress(OSError), os.scandir(folder) as entries:
        return {entry.name for entry in entries if not entry.name.startswith("._")}
    return set()


def group_infos(paths: list[Path]) -> dict[str, list[Path]]:
    """Group indices by what their names begin with: a scene has one for each range of overlap."""
    groups: dict[str, list[Path]] = {}
    for path in paths:
        groups.setdefault(_NAME_END.split(path.stem)[0] or path.stem, []).append(path)
    return groups


def read_group(name: str, paths: list[Path], problems: Problems) -> dict[str, list[InfoImage]]:
    """Read the indices of a scene.

    Args:
        name: What their names begin with.
        paths: The indices.
        problems: Told about damaged ones.

    Returns:
        Images by reconstruction, ``0001/dense0``, or ``name`` where their paths do not say; each
        image once.
    """
    parts: dict[str, dict[str, InfoImage]] = {}
    for path in paths:
        try:
            for image in read_scene_info(path, problems):
                parts.setdefault(image.part or name, {}).setdefault(image.image_path, image)
        except DataError as error:
            problems.add("bad_scene_info", path, str(error).removeprefix(f"{path}: "))
    return {part: list(images.values()) for part, images in sorted(parts.items())}


def from_infos(images: list[InfoImage], bases: list[Path], problems: Problems) -> list[Candidate]:
    """Give the images of indices that are there with their depth, by file name.

    Args:
        images: Of one reconstruction.
        bases: Folders that paths may be relative to.
        problems: Told about images that lack something.
    """
    found: dict[str, Candidate] = {}
    for image in images:
        try:
            depth = locate(bases, image.depth_path)
            photo = locate(bases, image.image_path) or _beside(depth, image.image_path)
        except DataError as error:
            problems.add("unsafe_path", image.image_path[:80], str(error))
            continue
        if photo is None:
            problems.add("missing_photo", image.image_path, "no such file")
        elif depth is None:
            problems.add("missing_depth", image.depth_path, "no such file")
        elif photo.name in found:
            problems.add("duplicate_name", photo, "listed twice")
        else:
            found[photo.name] = Candidate(
                photo=photo,
                depth=depth,
                camera=image.K,
                cam_from_world=image.cam_from_world,
                name=photo.name,
            )
    return [found[name] for name in sorted(found)]


def locate(bases: list[Path], name: str) -> Path | None:
    """Find a file of an index; what stands before the scene's number may be missing.

    Raises:
        DataError: The name leads out of the folders.
    """
    tried = (path for base in bases for path in _places(base, name))
    return next((path for path in tried if path.is_file()), None)


def _places(base: Path, name: str) -> Iterator[Path]:
    yield join_inside(base, name)
    if found := _SCENE_PATH.search(name):
        for below in BASES:
            yield join_inside(base / below, found.group(1))


def _beside(depth: Path | None, name: str) -> Path | None:
    """Find the image in MegaDepth's own folder: its copy in ``Undistorted_SfM`` is the same."""
    if depth is None:
        return None
    photo = join_inside(depth.parent.parent / "imgs", PurePosixPath(name).name)
    return photo if photo.is_file() else None
