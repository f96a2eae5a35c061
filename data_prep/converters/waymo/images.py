"""Camera images: a JPEG of known size becomes undistorted RGB."""

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from data_prep.converters.waymo.calibration import Camera
from data_prep.converters.waymo.lens import undistort_image
from l3r.errors import DataError

_END = b"\xff\xd9"
_START_OF_SCAN = b"\xff\xda"
_MAX_SCANS = 100
"""Progressive JPEGs have about ten; thousands would keep the decoder busy for minutes."""


def read_image(
    read_jpeg: Callable[[], bytes], camera: Camera, where: str
) -> UInt8[np.ndarray, "h w 3"]:
    """Read, decode and undistort an image.

    Args:
        read_jpeg: Gives the stored bytes.
        camera: What took it.
        where: Named in errors.

    Raises:
        DataError: The bytes are no whole JPEG of the calibrated size.
    """
    image = decode_jpeg(read_jpeg(), camera.image_size, where)
    return undistort_image(image, camera.lens, camera.K)


def check_jpeg(data: bytes, image_size: tuple[int, int], where: str) -> None:
    """Look at a JPEG's head and end without decoding it.

    Args:
        data: The stored bytes.
        image_size: (height, width) of the camera.
        where: Named in errors.

    Raises:
        DataError: It is no whole colour JPEG of that size.
    """
    with _open_jpeg(data, image_size, where):
        pass


def decode_jpeg(data: bytes, image_size: tuple[int, int], where: str) -> UInt8[np.ndarray, "h w 3"]:
    """Decode a JPEG whose size is known beforehand, so that nothing larger is ever unpacked.

    Raises:
        DataError: It is no whole colour JPEG of that size.
    """
    with _open_jpeg(data, image_size, where) as image:
        return np.array(image)


@contextmanager
def _open_jpeg(data: bytes, image_size: tuple[int, int], where: str) -> Iterator[Image.Image]:
    try:
        # The decoder fills what a cut-off file lacks with grey, so look for the end. Within
        # coded pixels no marker can occur.
        if data.rfind(_END) < data.rfind(_START_OF_SCAN):
            raise OSError("it has no end")
        if data.count(_START_OF_SCAN) > _MAX_SCANS:
            raise OSError(f"it has more than {_MAX_SCANS} scans")
        with Image.open(io.BytesIO(data), formats=("JPEG",)) as image:
            found = (image.height, image.width)
            if found != image_size or image.mode != "RGB":
                raise OSError(f"it has (height, width) {found}, mode {image.mode}")
            yield image
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise DataError(
            f"{where}: no whole colour JPEG of (height, width) {image_size} ({error}); download"
            " the file again"
        ) from error
