"""``cameras.json``: the cameras of a reconstruction, for people and for other programs.

::

    {"version": 1, "pixel_center": 0.5, "images": [
    {"file": "a.jpg", "width": 640, "height": 480, "K": [[...], [...], [...]],
     "cam_from_world": [[...], [...], [...]], "registered": true, "component": 0}]}

``cam_from_world`` is 3x4, row by row, null where the image is not registered; ``K`` is in pixels of
the image at its own size, the centre of the top-left pixel at (0.5, 0.5).
"""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from l3r.errors import DataError
from l3r.files import write_atomic
from l3r.types import Cameras

VERSION = 1
_ORTHONORMAL = 1e-3
"""Largest deviation of R R^T from the identity; data sets round to four or more digits."""


def write_cameras(path: Path, cameras: Cameras) -> None:
    """Write cameras, one image a line.

    Raises:
        DataError: A registered camera is not finite.
    """
    images = [_image_entry(path, cameras, index) for index in range(len(cameras.file))]
    lines = ",\n".join(json.dumps(image, ensure_ascii=False, allow_nan=False) for image in images)
    head = f'{{"version": {VERSION}, "pixel_center": 0.5, "images": [\n'
    write_atomic(path, f"{head}{lines}\n]}}\n")


def read_cameras(path: Path) -> Cameras:
    """Read cameras.

    The older form is read too: a list of images with ``T_world_to_cam`` (which is
    ``cam_from_world``) and pixel centres at integers, so that half a pixel is added to cx and cy.

    Raises:
        DataError: The file is missing, damaged, of another version, or holds impossible cameras.
    """
    loaded = _load(path)
    older = isinstance(loaded, list)
    entries = loaded if older else _entries(path, loaded)
    images = [_read_image(f"{path}: image {i}", entry, older) for i, entry in enumerate(entries)]
    files = [image["file"] for image in images]
    if repeated := [file for file, count in Counter(files).items() if count > 1]:
        raise DataError(f"{path}: file {repeated[0]!r} appears twice; keep one entry a file")
    K = _stack([image["K"] for image in images], 3)
    return Cameras(
        file=files,
        image_size=[image["size"] for image in images],
        K=K,
        cam_from_world=_stack([image["cam_from_world"] for image in images], 4),
        registered=torch.tensor([image["registered"] for image in images], dtype=torch.bool),
        component=torch.tensor([image["component"] for image in images], dtype=torch.int64),
    )


def _image_entry(path: Path, cameras: Cameras, index: int) -> dict[str, Any]:
    height, width = cameras.image_size[index]
    registered = bool(cameras.registered[index])
    K = cameras.K[index].double()
    cam_from_world = cameras.cam_from_world[index, :3].double()
    if registered and not (K.isfinite().all() and cam_from_world.isfinite().all()):
        raise DataError(
            f"{path}: image {cameras.file[index]!r} is registered, but its camera is not finite; "
            "mark it as not registered"
        )
    return {
        "file": cameras.file[index],
        "width": width,
        "height": height,
        "K": K.tolist() if K.isfinite().all() else None,
        "cam_from_world": cam_from_world.tolist() if registered else None,
        "registered": registered,
        "component": int(cameras.component[index]),
    }


def _load(path: Path) -> Any:  # whatever the file holds; checked by the caller
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; expected a cameras.json") from error
    except (ValueError, RecursionError) as error:
        reason = str(error).split("\n")[0]
        raise DataError(f"{path}: not valid JSON ({reason}); write it again") from error


def _entries(path: Path, loaded: Any) -> list[Any]:
    if not isinstance(loaded, dict) or "version" not in loaded:
        raise DataError(f"{path}: no 'version'; expected a cameras.json as l3r writes it")
    if loaded["version"] != VERSION:
        raise DataError(
            f"{path}: version {loaded['version']!r}, expected {VERSION}; read it with its own l3r"
        )
    if loaded.get("pixel_center") != 0.5:
        raise DataError(
            f"{path}: pixel_center is {loaded.get('pixel_center')!r}, expected 0.5; "
            "shift cx and cy to that convention"
        )
    if not isinstance(loaded.get("images"), list):
        raise DataError(f"{path}: 'images' is not a list; expected one entry an image")
    return list(loaded["images"])


def _read_image(where: str, entry: Any, older: bool) -> dict[str, Any]:
    if not isinstance(entry, dict):
        raise DataError(f"{where}: not an object; expected file, width, height, K, ...")
    file = entry.get("file")
    if not isinstance(file, str) or not file:
        raise DataError(f"{where}: 'file' is {file!r}, expected a name")
    where = f"{where} ({file!r})"
    registered = entry.get("registered", True) if older else entry.get("registered")
    if not isinstance(registered, bool):
        raise DataError(f"{where}: 'registered' is {registered!r}, expected true or false")
    component = entry.get("component", 0)
    if type(component) is not int:
        raise DataError(f"{where}: 'component' is {component!r}, expected a whole number")
    K, cam_from_world = _read_camera(where, entry, registered, older)
    size = (_length(where, entry, "height"), _length(where, entry, "width"))
    return {
        "file": file,
        "size": size,
        "K": K,
        "cam_from_world": cam_from_world,
        "registered": registered,
        "component": component,
    }


def _read_camera(
    where: str, entry: dict[str, Any], registered: bool, older: bool
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "4 4"]]:
    """Intrinsics and transform of one image; NaN where it is not registered."""
    nan = torch.full((4, 4), torch.nan, dtype=torch.float64)
    has_K = registered or entry.get("K") is not None
    K = _read_intrinsics(where, entry.get("K")) if has_K else nan[:3, :3]
    if older:
        K = K + torch.tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], dtype=torch.float64)
    key = "T_world_to_cam" if older else "cam_from_world"
    if registered:
        return K, _read_rigid(where, key, entry.get(key))
    if entry.get(key) is not None:
        raise DataError(f"{where}: not registered, yet {key!r} is given; expected null")
    return K, nan


def _read_intrinsics(where: str, value: object) -> Float[Tensor, "3 3"]:
    K = _matrix(where, "K", value, [(3, 3)])
    bottom = torch.tensor([0, 0, 1], dtype=torch.float64)
    if not (torch.equal(K[2], bottom) and K[0, 0] > 0 and K[1, 1] > 0):
        raise DataError(f"{where}: 'K' is {K.tolist()}, expected fx, fy > 0 and a last row 0 0 1")
    return K


def _read_rigid(where: str, key: str, value: object) -> Float[Tensor, "4 4"]:
    """Check that the matrix turns and shifts, and does nothing else."""
    matrix = _matrix(where, key, value, [(3, 4), (4, 4)])
    rigid = torch.eye(4, dtype=torch.float64)
    rigid[: len(matrix)] = matrix
    R, bottom = rigid[:3, :3], rigid[3].tolist()
    error = float((R @ R.mT - torch.eye(3, dtype=torch.float64)).abs().max())
    if error > _ORTHONORMAL or torch.linalg.det(R) < 0 or bottom != [0, 0, 0, 1]:
        raise DataError(
            f"{where}: {key!r} is not a rigid transform (R R^T is off by {error:.2g}); "
            "expected a rotation without scale or mirror, and a shift"
        )
    return rigid


def _matrix(
    where: str, key: str, value: object, shapes: list[tuple[int, int]]
) -> Float[Tensor, "_r _c"]:
    expected = " or ".join(f"{rows}x{columns}" for rows, columns in shapes)
    try:
        matrix = torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise DataError(f"{where}: {key!r} is not a matrix; expected {expected} numbers") from error
    if tuple(matrix.shape) not in shapes:
        found = "x".join(map(str, matrix.shape)) or "a single number"
        raise DataError(f"{where}: {key!r} is {found}, expected {expected}")
    if not matrix.isfinite().all():
        raise DataError(f"{where}: {key!r} holds NaN or infinity; mark the image not registered")
    return matrix


def _length(where: str, entry: dict[str, Any], key: str) -> int:
    value = entry.get(key)
    if type(value) is not int or value <= 0:
        raise DataError(f"{where}: {key!r} is {value!r}, expected a whole number of pixels")
    return value


def _stack(matrices: list[Tensor], side: int) -> Tensor:
    if not matrices:
        return torch.zeros(0, side, side, dtype=torch.float64)
    return torch.stack(matrices)
