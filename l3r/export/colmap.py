"""``sparse/0``: the reconstruction as a COLMAP model, in pixels of the photos at their own size."""

from pathlib import Path

import numpy as np
import pycolmap
import torch

from l3r.export.points import PointSample, PointSelection, sample_points
from l3r.types import Cameras, Reconstruction


def write_colmap(
    folder: Path, scene: Reconstruction, selection: PointSelection | None = None
) -> int:
    """Write a binary COLMAP model: PINHOLE cameras, registered images, confident points.

    Every image has a camera of its own. Every point has one observation, the pixel it comes from,
    so the points serve viewing and Gaussian splatting but hold no tracks for bundle adjustment.

    Args:
        folder: Usually ``OUT/sparse/0``; made if absent.
        scene: Images that are not registered are left out.
        selection: Which points; by default up to 100,000 above the rule of each image.

    Returns:
        Number of points written.
    """
    sample = sample_points(scene, selection or PointSelection())
    model = pycolmap.Reconstruction()
    counts = torch.bincount(sample.view, minlength=len(scene.cameras.file)).tolist()
    # The sample holds one image after the other.
    keypoints = torch.split(sample.pts2d.cpu(), counts)
    registered = scene.cameras.registered.tolist()
    for view, K in enumerate(scene.cameras.K):
        if K.isfinite().all():
            _add_camera(model, scene.cameras, view)
        if registered[view]:
            _add_image(model, scene.cameras, view, keypoints[view].numpy())
    _add_points(model, sample)
    model.update_point_3d_errors()
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
    return len(sample.view)


def _add_camera(model: pycolmap.Reconstruction, cameras: Cameras, view: int) -> None:
    """Add the camera of an image, registered or not; COLMAP counts from 1."""
    height, width = cameras.image_size[view]
    K = cameras.K[view].double().cpu().numpy()
    camera = pycolmap.Camera(
        model="PINHOLE",
        width=width,
        height=height,
        params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
        camera_id=view + 1,
    )
    model.add_camera_with_trivial_rig(camera)


def _add_image(
    model: pycolmap.Reconstruction, cameras: Cameras, view: int, keypoints: np.ndarray
) -> None:
    """Add a registered image; its camera is there."""
    image = pycolmap.Image(
        name=cameras.file[view], keypoints=keypoints, camera_id=view + 1, image_id=view + 1
    )
    cam_from_world = cameras.cam_from_world[view, :3].double().cpu().numpy()
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cam_from_world))


def _add_points(model: pycolmap.Reconstruction, sample: PointSample) -> None:
    """Add every point with its one observation; keypoints are in the sample's order."""
    positions = sample.pts3d_world.double().cpu().numpy()
    colors = sample.color.cpu().numpy()
    next_keypoint: dict[int, int] = {}
    for view, position, color in zip(sample.view.tolist(), positions, colors, strict=True):
        keypoint = next_keypoint.get(view, 0)
        next_keypoint[view] = keypoint + 1
        track = pycolmap.Track()
        track.add_element(view + 1, keypoint)
        model.add_point3D(position, track, color)
