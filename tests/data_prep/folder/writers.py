"""Scenes on the disk, written by pycolmap, json and numpy alone."""

import json

import cv2
import h5py
import numpy as np
import pycolmap

from tests.data_prep.folder.analytic import Camera, photograph, ring, surface_points

SIZE = (96, 128)
PARAMS = {
    "PINHOLE": (120.0, 118.0, 65.3, 46.9),
    "SIMPLE_RADIAL": (120.0, 64.0, 48.0, -0.12),
    "OPENCV": (120.0, 118.0, 63.2, 49.1, -0.15, 0.02, 0.003, -0.002),
    "OPENCV_FISHEYE": (95.0, 96.0, 63.0, 48.5, 0.02, -0.01, 0.002, 0.0),
}


def cameras_of(model, count=5, size=SIZE):
    """Cameras in a ring, all with one lens."""
    return [Camera(model, size, PARAMS[model], world) for world in ring(count)]


def write_photos(folder, cameras, names):
    """Write what the cameras see; give the depth of each."""
    depths = []
    for camera, name in zip(cameras, names, strict=True):
        image, depth = photograph(camera)
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), image[..., ::-1])
        depths.append(depth)
    return depths


def write_model(folder, cameras, names, *, form="bin", num_points=80):
    """Write a COLMAP model; give points and tracks."""
    model = pycolmap.Reconstruction()
    lens = cameras[0]
    height, width = lens.size
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            model=lens.model, width=width, height=height, params=lens.params, camera_id=1
        )
    )
    points, tracks = surface_points(cameras, num_points)
    keypoints = [[] for _ in cameras]
    elements = []
    for track in tracks:
        elements.append([(view, len(keypoints[view])) for view, _ in track])
        for view, pixel in track:
            keypoints[view].append(pixel)
    for view, (camera, name) in enumerate(zip(cameras, names, strict=True)):
        # Two keypoints more, which belong to no point.
        found = np.array([*keypoints[view], [1.0, 2.0], [3.0, 4.0]])
        image = pycolmap.Image(name=name, keypoints=found, camera_id=1, image_id=view + 1)
        cam_from_world = np.linalg.inv(camera.world_from_cam)[:3]
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cam_from_world))
    for point, track in zip(points, elements, strict=True):
        built = pycolmap.Track()
        for view, keypoint in track:
            built.add_element(view + 1, keypoint)
        model.add_point3D(point, built, np.array([9, 9, 9], np.uint8))
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_binary if form == "bin" else model.write_text)(folder)
    return points, tracks


def write_colmap_scene(folder, model, *, form="bin", count=5, at="sparse/0"):
    """Write photos and a COLMAP model; give cameras, names, points, tracks."""
    cameras = cameras_of(model, count)
    names = [f"im {number}.png" for number in range(count)]
    write_photos(folder / "images", cameras, names)
    points, tracks = write_model(folder / at, cameras, names, form=form)
    return cameras, names, points, tracks


GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])


def intrinsics(camera):
    """A camera's values under nerfstudio's names."""
    keys = {
        "PINHOLE": "fl_x fl_y cx cy",
        "OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2",
        "OPENCV_FISHEYE": "fl_x fl_y cx cy k1 k2 k3 k4",
    }[camera.model].split()
    height, width = camera.size
    values = dict(zip(keys, camera.params, strict=True))
    return {"w": width, "h": height, "camera_model": camera.model, **values}


def write_transforms(folder, cameras, *, shared=True, depth="", **extra):
    """Write photos and a transforms.json as nerfstudio does; give the depth of each."""
    names = [f"images/frame_{number:05d}.png" for number in range(len(cameras))]
    depths = write_photos(folder, cameras, names)
    frames = []
    for number, (camera, name) in enumerate(zip(cameras, names, strict=True)):
        frame = {
            "file_path": f"./{name}",
            "transform_matrix": (camera.world_from_cam @ GL_FROM_CV).tolist(),
        }
        if depth:
            frame["depth_file_path"] = f"depths/{number}{depth}"
            write_depth(folder / frame["depth_file_path"], depths[number])
        frames.append(frame | ({} if shared else intrinsics(camera)))
    table = {"frames": frames, **(intrinsics(cameras[0]) if shared else {}), **extra}
    (folder / "transforms.json").write_text(json.dumps(table))
    return depths


def write_depth(path, depth):
    """Write z: millimetres in 16-bit PNG, or numbers as they are."""
    path.parent.mkdir(parents=True, exist_ok=True)
    match path.suffix:
        case ".png":
            assert cv2.imwrite(str(path), np.rint(1000 * depth).astype(np.uint16))
        case ".npy":
            np.save(path, depth.astype(np.float32))
        case ".h5":
            with h5py.File(path, "w") as file:
                chunks = tuple(min(64, side) for side in depth.shape)
                values = depth.astype(np.float32)
                file.create_dataset("depth", data=values, chunks=chunks, compression="gzip")
