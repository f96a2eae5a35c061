"""Photos from disk, upright, in the form the network takes."""

import io
import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageOps

from l3r.config import ModelConfig
from l3r.config.inference import Crop
from l3r.errors import DataError
from l3r.inference.framing import frame_photo
from l3r.types import Photos

log = logging.getLogger(__name__)

SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"}
_EXIF_ORIENTATION = 274
_UPRIGHT_QUALITY = 95


@dataclass(kw_only=True)
class LoadedPhotos:
    """Photos, and what became of the others."""

    photos: Photos
    """Those that can be used."""
    skipped: list[tuple[str, str]] = field(default_factory=list)
    """(file, reason) of those that cannot."""
    upright: dict[str, bytes] = field(default_factory=dict)
    """JPEGs of photos that an EXIF flag turns, as they are shown, by file."""


def find_photos(folder: Path, besides: Path | None = None) -> list[Path]:
    """List the images of a folder and its sub-folders by name; hidden files are left out.

    Args:
        folder: Where to look.
        besides: A folder to leave out, such as where a reconstruction is written.

    Raises:
        DataError: The folder does not exist.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; expected a folder of photos")
    skipped = besides.resolve() if besides else None
    return sorted(
        path
        for path in folder.rglob("*")
        if skipped not in path.resolve().parents
        and path.suffix.lower() in SUFFIXES
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )


def load_photos(
    files: Sequence[Path], config: ModelConfig, root: Path | None = None, *, crop: Crop = "whole"
) -> LoadedPhotos:
    """Read photos upright; those that cannot be used are named, warned of and left out.

    Args:
        files: Image files.
        config: ``image_size`` and the patch.
        root: What names are relative to; by default the files' names alone.
        crop: How they are brought to the network's size, see
            :class:`~l3r.config.InferenceConfig`.

    Raises:
        DataError: Fewer than two photos can be used, or two have the same name.
    """
    names = [str(path.relative_to(root)) if root else path.name for path in files]
    if len(set(names)) < len(names):
        raise DataError(f"two photos are named {_first_repeated(names)}; rename one of them")
    loaded = LoadedPhotos(photos=Photos(image=[], original_size=[], window=[], file=[]))
    for path, name in zip(files, names, strict=True):
        try:
            pixels, upright = _read_upright(path)
            image, window = frame_photo(pixels, config, crop)
        except _UNUSABLE as error:
            reason = f"{type(error).__name__}: {error}".split("\n")[0]
            log.warning("%s: skipped, it cannot be used (%s)", path, reason)
            loaded.skipped.append((name, reason))
            continue
        if upright is not None:
            loaded.upright[name] = upright
        loaded.photos.image.append(image)
        loaded.photos.original_size.append((pixels.shape[0], pixels.shape[1]))
        loaded.photos.window.append(window)
        loaded.photos.file.append(name)
    require_two(loaded.photos, len(files))
    return loaded


def require_two(photos: Photos, num_found: int) -> None:
    """Refuse to reconstruct from fewer than two photos.

    Raises:
        DataError: There are fewer.
    """
    usable = len(photos.file)
    if usable < 2:
        raise DataError(
            f"{usable} usable photo(s) of {num_found} found, expected 2 or more; "
            f"add photos ({', '.join(sorted(SUFFIXES))})"
        )


_UNUSABLE = (OSError, ValueError, SyntaxError, Image.DecompressionBombError, DataError)


def _read_upright(path: Path) -> tuple[UInt8[np.ndarray, "h w 3"], bytes | None]:
    with _bombs_refused(), Image.open(path) as opened:
        turned = opened.getexif().get(_EXIF_ORIENTATION, 1) != 1
        image = ImageOps.exif_transpose(opened)
        pixels = _to_rgb(image)
        if min(pixels.shape[:2]) < 1:
            raise ValueError("empty image")
        if not turned:
            return pixels, None
        stream = io.BytesIO()
        Image.fromarray(pixels).save(stream, "JPEG", quality=_UPRIGHT_QUALITY)
        return pixels, stream.getvalue()


@contextmanager
def _bombs_refused() -> Iterator[None]:
    """Turn Pillow's warning about absurdly large images into its error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        try:
            yield
        except Image.DecompressionBombWarning as warning:
            raise Image.DecompressionBombError(str(warning)) from warning


def _to_rgb(image: Image.Image) -> UInt8[np.ndarray, "h w 3"]:
    if image.mode.startswith(("I;16", "I")):
        # Pillow's own conversion saturates 16-bit greys at 255.
        grey = np.asarray(image, dtype=np.float64) / 257
        return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    return np.array(image.convert("RGB"))


def _first_repeated(names: Sequence[str]) -> str:
    return next(name for i, name in enumerate(names) if name in names[:i])
