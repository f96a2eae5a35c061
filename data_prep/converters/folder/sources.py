"""Where the cameras of a scene come from."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_prep.converters.colmap_model import find_ending, read_model
from data_prep.converters.folder.options import MAX_BYTES, SceneOptions
from data_prep.converters.folder.transforms import read_transforms
from data_prep.converters.folder.views import PhotoFinder, View
from data_prep.converters.matrices import rigid_from_matrix
from data_prep.converters.paths import join_inside
from data_prep.problems import Problems
from l3r.errors import DataError
from l3r.export.cameras_json import read_cameras

MODELS = (
    "sparse/0",
    "sparse",
    "colmap/sparse/0",
    "colmap/sparse",
    "colmap/0",
    "colmap",
    "dense/sparse",
    "dense/sparse/0",
    ".",
)
"""Where tools leave COLMAP models, in the order they are looked for."""
TRANSFORMS, CAMERAS = "transforms.json", "cameras.json"

_DIGITS = re.compile(r"(\d+)")


@dataclass(frozen=True, kw_only=True)
class Views:
    """The views of a scene."""

    source: Path
    """File or folder that the cameras come from."""
    views: list[View]
    """By name, numbers by their value."""
    model: Path | None = None
    """The COLMAP model, where the cameras come from one."""


def find_source(folder: Path, options: SceneOptions) -> Path | None:
    """Find what holds a scene's cameras: a COLMAP model, which has points, before other files.

    Args:
        folder: The scene's folder.
        options: What its ``scene.json`` says.

    Raises:
        DataError: ``scene.json`` names something else.
    """
    if options.cameras:
        path = join_inside(folder, options.cameras)
        if path.is_file() or find_ending(path):
            return path
        raise DataError(
            f"{path}: named under 'cameras' in scene.json, expected a COLMAP model or a .json file"
        )
    for name in MODELS:
        if find_ending(folder / name):
            return folder / name
    return next((folder / n for n in (TRANSFORMS, CAMERAS) if (folder / n).is_file()), None)


def read_views(folder: Path, source: Path, options: SceneOptions, problems: Problems) -> Views:
    """Read the cameras of a scene and find its photos.

    Args:
        folder: The scene's folder.
        source: What :func:`find_source` found.
        options: What its ``scene.json`` says.
        problems: Told about images that lack something.

    Raises:
        DataError: The source is damaged as a whole.
    """
    find = PhotoFinder(folder, source, options)
    if source.is_dir():
        found = _from_colmap(source, find, problems)
    elif source.name.startswith("transforms"):
        found = read_transforms(source, find, problems)
    else:
        found = _from_cameras_json(source, find, problems)
    views: dict[str, View] = {}
    for view in found:
        if views.setdefault(view.name, view) is not view:
            problems.add("duplicate_name", source, f"{view.name!r} appears twice")
    ordered = sorted(views.values(), key=lambda view: _natural(view.name))
    return Views(source=source, views=ordered, model=source if source.is_dir() else None)


def _natural(name: str) -> list[tuple[int, int | str]]:
    """Order 2.jpg before 10.jpg, so that a share held out is the end of the recording."""
    parts = _DIGITS.split(name)
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in parts]


def _from_colmap(source: Path, find: PhotoFinder, problems: Problems) -> Iterator[View]:
    for other in sorted(source.parent.glob("[0-9]*")):
        if source.name.isdecimal() and other != source and find_ending(other):
            problems.add(
                "unread_model", other, f"{source.name} is read; name it under 'cameras' to read it"
            )
    for image in read_model(source, problems):
        photo = find.find(image.name, problems)
        if photo is not None:
            yield View(
                name=image.name,
                photo=photo,
                image_size=image.lens.image_size,
                K=image.lens.K,
                lens=image.lens if image.lens.is_distorted else None,
                world_from_cam=np.linalg.inv(image.cam_from_world),
            )


def _from_cameras_json(path: Path, find: PhotoFinder, problems: Problems) -> Iterator[View]:
    if (size := path.stat().st_size) > MAX_BYTES:
        raise DataError(f"{path}: {size:,} bytes, expected {MAX_BYTES:,} or less")
    cameras = read_cameras(path)
    for index, name in enumerate(cameras.file):
        if not cameras.registered[index]:
            problems.add("not_registered", path, f"{name!r} has no camera")
            continue
        photo = find.find(name, problems)
        if photo is not None:
            cam_from_world = rigid_from_matrix(cameras.cam_from_world[index].numpy())
            yield View(
                name=name,
                photo=photo,
                image_size=cameras.image_size[index],
                K=cameras.K[index].numpy(),
                lens=None,
                world_from_cam=np.linalg.inv(cam_from_world),
            )
