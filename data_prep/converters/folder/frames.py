"""One view of a folder becomes one frame, its depth a map or the points of a COLMAP model."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float32, Float64, Int64

from data_prep.converters.colmap_model import ModelPoints, read_observed, read_points
from data_prep.converters.depth_files import SUFFIXES, depth_size, read_depth_file
from data_prep.converters.folder.options import SceneOptions
from data_prep.converters.folder.sources import Views
from data_prep.converters.folder.views import View
from data_prep.converters.lens import (
    Lens,
    read_undistorted_depth,
    read_undistorted_photo,
    undistort_lens,
)
from data_prep.converters.matrices import check_K
from data_prep.converters.paths import join_inside
from data_prep.converters.photos import photo_size, read_photo
from data_prep.converters.rejects import RejectedError, reject_as
from data_prep.problems import Problems
from data_prep.scene import Frame
from l3r.errors import DataError

_NO_IDS = np.zeros(0, dtype=np.int64)
MIN_TRACK = 2
"""Points seen by fewer images have no depth: nothing was triangulated."""


@dataclass(frozen=True, kw_only=True)
class SparseDepth:
    """The points of a COLMAP model, and who sees them."""

    points: ModelPoints
    """Those that two or more images see."""
    seen: dict[str, Int64[np.ndarray, " _k"]]
    """Numbers of the points each image sees, by its name; ascending."""

    def of(self, view: View) -> Float32[np.ndarray, "_k 3"]:
        """Give the points a view sees, in its camera's frame."""
        ids = self.seen.get(view.name, _NO_IDS)
        at = np.searchsorted(self.points.ids, ids)
        at = at[at < len(self.points.ids)]
        at = at[np.isin(self.points.ids[at], ids, assume_unique=True)]
        R, t = view.world_from_cam[:3, :3], view.world_from_cam[:3, 3]
        pts3d_cam: Float64[np.ndarray, "_k 3"] = (self.points.pts3d_world[at] - t) @ R
        return pts3d_cam.astype(np.float32)


def read_sparse_depth(model: Path, problems: Problems) -> SparseDepth:
    """Read a model's points.

    Args:
        model: Folder of the COLMAP model.
        problems: Told about damage.

    Raises:
        DataError: The model is gone.
    """
    seen: dict[str, Int64[np.ndarray, " _k"]] = {}
    for name, ids in read_observed(model):
        seen.setdefault(name, ids)
    ids, count = np.unique(np.concatenate([_NO_IDS, *seen.values()]), return_counts=True)
    points = read_points(model, problems)
    good = np.isin(points.ids, ids[count >= MIN_TRACK], assume_unique=True)
    kept = ModelPoints(ids=points.ids[good], pts3d_world=points.pts3d_world[good])
    return SparseDepth(points=kept, seen=seen)


def splat_points(
    pts3d_cam: Float32[np.ndarray, "k 3"],
    K: Float64[np.ndarray, "3 3"],
    image_size: tuple[int, int],
) -> Float32[np.ndarray, "_h _w"]:
    """Give z at the pixels that points fall into, the nearest's where several do, 0 elsewhere.

    Args:
        pts3d_cam: In the camera's frame.
        K: Intrinsics in pixels.
        image_size: (height, width).
    """
    depth = np.zeros(image_size, dtype=np.float32)
    front = pts3d_cam[pts3d_cam[:, 2] > 0].astype(np.float64)
    pixels = front @ K.T
    column, row = np.floor(pixels[:, :2] / pixels[:, 2:]).T
    inside = (column >= 0) & (column < image_size[1]) & (row >= 0) & (row < image_size[0])
    far_first = np.argsort(-front[inside, 2], kind="stable")
    place = row[inside].astype(int)[far_first], column[inside].astype(int)[far_first]
    depth[place] = front[inside, 2][far_first]
    return depth


def _find_depth(folder: Path, view: View, options: SceneOptions) -> Path | None:
    """Find a view's depth map: the one its source names, or the one named as the photo is.

    Raises:
        DataError: The name leads out of the scene.
    """
    if view.depth_name:
        path = join_inside(folder, view.depth_name)
        return path if path.is_file() and path.suffix in SUFFIXES else None
    parts = PurePosixPath(view.name).parts
    inside = PurePosixPath(*parts[parts[:1] == (options.image_folder,) :])
    place = join_inside(join_inside(folder, options.depth_folder), str(inside))
    return next((p for s in SUFFIXES if (p := place.with_suffix(s)).is_file()), None)


def build_frames(
    folder: Path, views: Views, options: SceneOptions, step: int, problems: Problems
) -> tuple[list[Frame], bool]:
    """Build the frames of a scene.

    Args:
        folder: The scene's folder.
        views: Its images and cameras.
        options: What its ``scene.json`` says.
        step: Take every so many of the views that have depth.
        problems: Told about views that cannot be used.

    Returns:
        ``(frames, is_sparse)``: depth comes from the COLMAP model's points if there is no map.

    Raises:
        DataError: There is neither.
    """
    depths = pair_depth(folder, views, options, problems)
    sparse = None
    if views.model is not None and not any(depths.values()):
        sparse = read_sparse_depth(views.model, problems)
    usable = []
    for view in views.views:
        depth = depths.get(view.name) or sparse
        if depth is not None:
            usable.append((view, depth))
        elif view.name in depths:
            problems.add("missing_depth", view.photo, "no depth map of its name")
    frames = []
    for view, depth in usable[::step]:
        try:
            frames.append(_build_frame(view, depth, options))
        except RejectedError as error:
            problems.add(*error.problem)
    return frames, sparse is not None


def pair_depth(
    folder: Path, views: Views, options: SceneOptions, problems: Problems
) -> dict[str, Path | None]:
    """Find the depth maps of a scene.

    Args:
        folder: The scene's folder.
        views: Its images.
        options: What its ``scene.json`` says.
        problems: Told about names that lead out of the scene; these views are left out.

    Returns:
        Depth map of each view by its name, None where there is none.

    Raises:
        DataError: There is no map at all, and no COLMAP model to take points from.
    """
    depths = {}
    for view in views.views:
        try:
            depths[view.name] = _find_depth(folder, view, options)
        except DataError as error:
            problems.add("unsafe_path", view.photo, str(error))
    if not any(depths.values()) and views.model is None:
        raise DataError(
            f"{folder}: no depth maps in '{options.depth_folder}' and no COLMAP points, expected"
            " either; add depth, or a model with points"
        )
    return depths


def _build_frame(view: View, depth: Path | SparseDepth, options: SceneOptions) -> Frame:
    _check_photo(view)
    target = None
    if view.lens is not None:
        with reject_as("bad_camera", view.photo):
            target = undistort_lens(view.lens)
    size, K = (view.image_size, view.K) if target is None else (target.image_size, target.K)
    with reject_as("bad_camera", view.photo):
        check_K(K, size)
    read_image = partial(read_photo, view.photo, size)
    if view.lens is not None and target is not None:
        read_image = partial(read_undistorted_photo, view.photo, view.lens, target)
    return Frame(
        name=view.name,
        image_size=size,
        K=K,
        world_from_cam=view.world_from_cam,
        read_image=read_image,
        read_depth=_depth_reader(view, depth, options, target),
    )


def _check_photo(view: View) -> None:
    with reject_as("bad_photo", view.photo):
        size = photo_size(view.photo)
    if size != view.image_size:
        turned = "; it may be stored turned" if size == view.image_size[::-1] else ""
        raise RejectedError(
            "size_mismatch",
            view.photo,
            f"(height, width) {size}, its camera is for {view.image_size}{turned}",
        )


def _depth_reader(
    view: View, depth: Path | SparseDepth, options: SceneOptions, target: Lens | None
) -> Callable[[], Float32[np.ndarray, "_h _w"]]:
    if isinstance(depth, SparseDepth):
        pts3d_cam = depth.of(view)
        if not len(pts3d_cam):
            raise RejectedError("no_points", view.photo, "sees no point of the model")
        size, K = (view.image_size, view.K) if target is None else (target.image_size, target.K)
        return partial(splat_points, pts3d_cam, K, size)
    with reject_as("bad_depth", depth):
        size = depth_size(depth)
    if size != view.image_size:
        detail = f"(height, width) {size}, its photo has {view.image_size}"
        raise RejectedError("size_mismatch", depth, detail)
    scale = options.scale_of(depth)
    if view.lens is not None and target is not None:
        return partial(read_undistorted_depth, depth, scale, view.lens, target)
    return partial(read_depth_file, depth, scale, view.image_size)
