"""MegaDepth's files, written by COLMAP's own undistortion, h5py and pickle."""

import pickle

import cv2
import h5py
import numpy as np
import pycolmap

from tests.data_prep.folder.analytic import Camera, photograph, photograph_pinhole, ring
from tests.data_prep.folder.writers import write_model

RAW = (150, 200)
"""(height, width) of the photos as uploaded."""
LONGEST = 160
"""Longest side of the undistorted images; MegaDepth's is 1600."""
LENS = (190.0, 100.0, 75.0, -0.1)
"""SIMPLE_RADIAL: f, cx, cy, k. The principal point is the middle, as in MegaDepth."""


def raw_cameras(count):
    return [Camera("SIMPLE_RADIAL", RAW, LENS, world) for world in ring(count)]


def undistort_by_colmap(image, camera):
    """Give the image and the pinhole that ``colmap image_undistorter`` makes of a photo."""
    height, width = camera.size
    lens = pycolmap.Camera(model=camera.model, width=width, height=height, params=camera.params)
    options = pycolmap.UndistortCameraOptions(max_image_size=LONGEST)
    bitmap, pinhole = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(image), lens)
    return np.ascontiguousarray(bitmap.to_array()), pinhole


def write_depth(path, depth):
    """Write float32, gzip, chunks of 64, as MegaDepth does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        chunks = tuple(min(64, side) for side in depth.shape)
        values = depth.astype(np.float32)
        file.create_dataset("depth", data=values, chunks=chunks, compression="gzip")


def write_scene(dense, model, *, count=3, form="bin"):
    """Write images, depth and SfM model of one reconstruction.

    Returns:
        ``(names, pinholes, tracks)``: COLMAP's own undistorted cameras are the truth.
    """
    cameras = raw_cameras(count)
    names = [f"{number}_photo_o.png" for number in range(count)]
    pinholes = []
    for camera, name in zip(cameras, names, strict=True):
        image, pinhole = undistort_by_colmap(photograph(camera)[0], camera)
        (dense / "imgs").mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(dense / "imgs" / name), image[..., ::-1])
        K = pinhole.calibration_matrix()
        _, depth = photograph_pinhole(K, camera.world_from_cam, image.shape[:2])
        depth[:4] = 0
        write_depth(dense / "depths" / name.replace(".png", ".h5"), depth)
        pinholes.append(pinhole)
    _, tracks = write_model(model, cameras, names, form=form, num_points=90)
    return names, pinholes, tracks


def write_merged(root, scene_id, part=0, **options):
    """Write one reconstruction in the merged layout."""
    folder = root / scene_id
    model = folder / "sparse" / "manhattan" / str(part)
    return write_scene(folder / f"dense{part}", model, **options)


def info_arrays(names, pinholes, *, image="{}", depth="{}", gaps=2):
    """The arrays of a scene index, with empty slots between the images as genuine ones have."""
    worlds = ring(len(names))
    rows = []
    for name, pinhole, world in zip(names, pinholes, worlds, strict=True):
        h5 = name.replace(".png", ".h5")
        cam_from_world = np.linalg.inv(world)
        rows.append(
            (image.format(name), depth.format(h5), pinhole.calibration_matrix(), cam_from_world)
        )
        rows += [(None,) * 4] * gaps
    arrays = {}
    for key, column in zip(
        ("image_paths", "depth_paths", "intrinsics", "poses"), zip(*rows, strict=True), strict=True
    ):
        arrays[key] = np.empty(len(rows), dtype=object)
        for number, value in enumerate(column):
            arrays[key][number] = value
    return arrays


def pair_infos():
    """What indices hold beside: pairs with their overlap, as a list of tuples."""
    return [(np.array([0, 3]), np.float64(0.5), np.array([1.0, 2.0, 3.0, 4.0]))]


def write_info(path, arrays, *, bare=False):
    """Write a scene index as an archive, or as a bare pickle under the same name."""
    if bare:
        path.write_bytes(pickle.dumps({**arrays, "pair_infos": pair_infos()}, protocol=4))
    else:
        np.savez(path, pair_infos=np.array(pair_infos(), dtype=object), **arrays)
