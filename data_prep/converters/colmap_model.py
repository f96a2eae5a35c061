"""COLMAP models, binary or text: cameras, images, the points each image sees, the points.

Written for models of any size and for damaged ones: :mod:`data_prep.converters.colmap_files` reads
the files record by record, and what cannot be used is reported and left out. pycolmap loads every
keypoint into memory and does not come back from some damaged ``points3D.bin`` and ``frames.bin``;
here it computes with cameras alone.
"""

import math
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64
from scipy.sparse import csr_array, eye_array
from scipy.spatial.transform import Rotation

from data_prep.converters.colmap_files import read_cameras, read_images, read_positions
from data_prep.converters.lens import Lens, build_lens
from data_prep.problems import Problems
from l3r.errors import DataError

MAX_DISTANCE = 1e9
"""Cameras and points farther from the origin are damage, in the model's unit."""

_UNIT = 1e-2
"""Largest deviation of a quaternion's length from 1; text files round."""


@dataclass(frozen=True, kw_only=True)
class ModelImage:
    """A registered image."""

    name: str
    """As the model has it, usually relative to the folder of images."""
    lens: Lens
    """Its camera."""
    cam_from_world: Float64[np.ndarray, "4 4"]
    """Rigid; OpenCV axes."""


@dataclass(frozen=True, kw_only=True)
class ModelPoints:
    """The points of a model."""

    ids: Int64[np.ndarray, " p"]
    """COLMAP's numbers, ascending, each once."""
    pts3d_world: Float64[np.ndarray, "p 3"]
    """Where they are."""


def find_ending(folder: Path) -> str:
    """Tell which form of a model a folder holds: ``.bin``, which is preferred, ``.txt``, or ''."""
    for ending in (".bin", ".txt"):
        if all((folder / f"{part}{ending}").is_file() for part in ("cameras", "images")):
            return ending
    return ""


def read_model(folder: Path, problems: Problems) -> list[ModelImage]:
    """Read the registered images of a model.

    Args:
        folder: Holds ``cameras`` and ``images``, .bin or .txt.
        problems: Told about damaged cameras, images and files.

    Returns:
        Images in the order of the file, each name once.

    Raises:
        DataError: The folder holds no model.
    """
    ending = _require(folder)
    lenses = _read_lenses(folder / f"cameras{ending}", problems)
    path = folder / f"images{ending}"
    images: dict[str, ModelImage] = {}
    for record in read_images(path, lambda detail: problems.add("damaged_model", path, detail)):
        where = f"{path}: {record.name!r}"
        try:
            cam_from_world = _rigid(record.numbers)
        except DataError as error:
            problems.add("bad_pose", where, str(error))
            continue
        if record.camera_id not in lenses:
            problems.add("bad_camera", where, f"camera {record.camera_id} is damaged or not there")
        elif record.name in images:
            problems.add("duplicate_name", where, "the model has two images of this name")
        else:
            images[record.name] = ModelImage(
                name=record.name, lens=lenses[record.camera_id], cam_from_world=cam_from_world
            )
    return list(images.values())


def read_observed(folder: Path) -> Iterator[tuple[str, Int64[np.ndarray, " _k"]]]:
    """Give each image's name and the numbers of the points it sees, ascending, each once.

    Damage is reported by :func:`read_model` alone.

    Raises:
        DataError: The folder holds no model.
    """
    for record in read_images(folder / f"images{_require(folder)}", lambda detail: None):
        yield record.name, record.point_ids


def read_points(folder: Path, problems: Problems) -> ModelPoints:
    """Read the positions of a model's points.

    Args:
        folder: Holds ``points3D``, .bin or .txt.
        problems: Told about damage.

    Raises:
        DataError: The folder holds no model.
    """
    path = folder / f"points3D{_require(folder)}"
    ids, positions = array("q"), array("d")
    if not path.is_file():
        problems.add("damaged_model", path, "no such file")
    else:
        report = lambda detail: problems.add("damaged_model", path, detail)  # noqa: E731
        for number, position in read_positions(path, report):
            ids.append(number)
            positions.extend(position)
    pts3d_world = np.array(positions, dtype=np.float64).reshape(-1, 3)
    good = (np.abs(pts3d_world) < MAX_DISTANCE).all(-1)
    if not good.all():
        problems.add("bad_point", path, f"{(~good).sum()} points are not finite or far away")
    numbers, first = np.unique(np.array(ids, dtype=np.int64)[good], return_index=True)
    return ModelPoints(ids=numbers, pts3d_world=pts3d_world[good][first])


def shared_point_overlap(folder: Path, names: tuple[str, ...]) -> csr_array:
    """Give the overlap of images: points both see over points either sees.

    Args:
        folder: The model.
        names: Images of the model, each once.

    Returns:
        n x n, symmetric, with an entry for each pair that shares a point, and 1 on the diagonal.

    Raises:
        DataError: The model lacks one of the images.
    """
    rows = {name: row for row, name in enumerate(names)}
    seen: dict[int, Int64[np.ndarray, " _k"]] = {}
    for name, ids in read_observed(folder):
        if name in rows:
            seen.setdefault(rows[name], ids)
    if len(seen) < len(names):
        raise DataError(f"{folder}: {len(names) - len(seen)} images are gone; read the scene again")
    row = np.repeat(list(seen), [len(ids) for ids in seen.values()])
    points, column = np.unique(np.concatenate(list(seen.values())), return_inverse=True)
    # Not a sum of booleans, which would saturate at one.
    table = csr_array((np.ones(len(row)), (row, column)), shape=(len(names), len(points)))
    count: Float64[np.ndarray, " n"] = np.asarray(table.sum(axis=1))
    # The diagonal gets an entry for images without points, too.
    both = (table @ table.T + eye_array(len(names))).tocoo()
    same = both.row == both.col
    either = count[both.row] + count[both.col] - both.data
    overlap = np.where(same, 1, both.data / np.where(same, 1, either))
    return csr_array((overlap, (both.row, both.col)), shape=both.shape)


def _require(folder: Path) -> str:
    ending = find_ending(folder)
    if not ending:
        raise DataError(
            f"{folder}: no cameras and images (.bin or .txt), expected a COLMAP model; check the"
            " folder"
        )
    return ending


def _rigid(numbers: tuple[float, ...]) -> Float64[np.ndarray, "4 4"]:
    """Make a transform of a quaternion w x y z and a shift."""
    w, x, y, z, *shift = numbers
    length = math.hypot(w, x, y, z)
    # NaN passes no comparison.
    if not (abs(length - 1) <= _UNIT and np.abs(shift).max() < MAX_DISTANCE):
        raise DataError(f"rotation and shift {list(numbers)}, expected a unit quaternion")
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = Rotation.from_quat((x, y, z, w)).as_matrix()
    cam_from_world[:3, 3] = shift
    return cam_from_world


def _read_lenses(path: Path, problems: Problems) -> dict[int, Lens]:
    lenses: dict[int, Lens] = {}
    for record in read_cameras(path, lambda detail: problems.add("damaged_model", path, detail)):
        try:
            lens = build_lens(record.model, record.image_size, record.params)
        except DataError as error:
            problems.add("bad_camera", f"{path}: camera {record.camera_id}", str(error))
        else:
            lenses[record.camera_id] = lens
    return lenses
