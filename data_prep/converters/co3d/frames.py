"""One annotation becomes one frame, if all it needs is there."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from data_prep.converters.co3d import pixels
from data_prep.converters.co3d.annotations import FrameRecord
from data_prep.converters.co3d.cameras import K_from_viewpoint, world_from_viewpoint
from data_prep.converters.paths import join_inside
from data_prep.converters.photos import photo_size, read_photo
from data_prep.converters.rejects import RejectedError, reject_as
from data_prep.problems import Problems
from data_prep.scene import Frame


@dataclass(frozen=True, kw_only=True)
class Needs:
    """What a frame must have."""

    depth: bool = True
    """Leave frames without depth out; else their depth is unknown everywhere."""
    min_foreground: float = 0.0
    """Keep depth only where the foreground probability is above this; 0: masks are not read."""


@dataclass(frozen=True, kw_only=True)
class _Files:
    """Files of a frame; None where the annotation has none or it is not asked for."""

    image: Path
    depth: Path | None
    valid: Path | None
    mask: Path | None


def build_frame(root: Path, record: FrameRecord, needs: Needs, problems: Problems) -> Frame | None:
    """Check a frame's camera and the headers of its files.

    Args:
        root: The data set's root.
        record: The annotation.
        needs: What the frame must have.
        problems: Told why it cannot be used.

    Returns:
        The frame, its pixels unread; None where it cannot be used.
    """
    try:
        return _build(root, record, needs)
    except RejectedError as rejected:
        problems.add(*rejected.problem)
        return None


def _build(root: Path, record: FrameRecord, needs: Needs) -> Frame:
    size, where = record.image_size, root / record.image_path
    if record.viewpoint is None:
        raise RejectedError("no_camera", where, "viewpoint is null, expected a camera")
    with reject_as("bad_camera", where):
        K = K_from_viewpoint(record.viewpoint, size)
    with reject_as("bad_pose", where):
        world_from_cam = world_from_viewpoint(record.viewpoint)
    files = _find_files(root, record, needs)
    _check(files, size, needs)
    read_depth = partial(pixels.no_depth, size)
    if files.depth is not None:
        read_depth = partial(
            pixels.read_depth,
            files.depth,
            size,
            scale=record.scale_adjustment,
            valid_path=files.valid,
            foreground=None if files.mask is None else (files.mask, needs.min_foreground),
        )
    return Frame(
        name=files.image.name,
        image_size=size,
        K=K,
        world_from_cam=world_from_cam,
        read_image=partial(read_photo, files.image, size),
        read_depth=read_depth,
    )


def _find_files(root: Path, record: FrameRecord, needs: Needs) -> _Files:
    """Join the annotation's paths to the root; files need not be there."""
    where = f"{record.sequence} frame {record.number}"
    with reject_as("unsafe_path", where):
        image = join_inside(root, record.image_path)
        depth = join_inside(root, record.depth_path) if record.depth_path else None
        valid = join_inside(root, record.depth_mask_path) if record.depth_mask_path else None
        mask = join_inside(root, record.mask_path) if record.mask_path else None
    if not needs.depth and depth is not None and not depth.is_file():
        depth = valid = None
    return _Files(
        image=image, depth=depth, valid=valid, mask=mask if needs.min_foreground > 0 else None
    )


def _check(files: _Files, image_size: tuple[int, int], needs: Needs) -> None:
    """Look at headers, and at the pixels of files so small that they may hold none."""
    _check_header("image", files.image, image_size)
    if pixels.is_black(files.image, image_size):
        raise RejectedError("redacted", files.image, "the image is black: a hidden test frame")
    if needs.depth and files.depth is None:
        raise RejectedError("missing_depth", files.image, "depth is null, expected a depth map")
    if needs.min_foreground > 0 and files.mask is None:
        raise RejectedError("missing_mask", files.image, "mask is null, expected a mask")
    for kind, path in (("mask", files.mask), ("depth", files.depth), ("mask", files.valid)):
        if path is not None:
            _check_header(kind, path, image_size)
    if files.depth is not None:
        with reject_as("bad_depth", files.depth):
            is_empty = pixels.is_empty(files.depth, image_size)
        if is_empty:
            raise RejectedError("empty_depth", files.depth, "no pixel has depth")


def _check_header(kind: str, path: Path, image_size: tuple[int, int]) -> None:
    if not path.is_file():
        raise RejectedError(f"missing_{kind}", path, "no such file; redacted or not unpacked")
    with reject_as(f"bad_{kind}", path):
        found = photo_size(path)
    if found != image_size:
        sizes = f"{found[1]}x{found[0]}, its annotation says {image_size[1]}x{image_size[0]}"
        raise RejectedError("size_mismatch", path, sizes)
