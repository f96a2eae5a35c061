"""Shards with one mistake planted in every graph."""

import hashlib
from dataclasses import replace

import numpy as np
import webdataset

from l3r.data.schema import (
    decode_graph,
    encode_graph,
    index_shard,
    load_index,
    read_manifest,
    read_members,
    write_index,
    write_manifest,
)


def plant(folder, out, mistake, num_shards=None):
    """Copy the first shards of a folder, every graph changed by ``mistake``."""
    manifest = read_manifest(folder)
    entries = []
    for shard in manifest.shards[:num_shards]:
        path = out / shard.name
        with webdataset.TarWriter(str(path), encoder=False, mtime=0) as writer:
            for entry in load_index(folder / shard.name).graphs:
                sample = decode_graph(read_members(folder / shard.name, entry), entry.num_views)
                for name, data in list(encode_graph(mistake(sample), entry.key).items())[1:]:
                    writer.write({"__key__": entry.key, name: data})
        write_index(path, index_shard(path))
        data = path.read_bytes()
        digest = hashlib.sha256(data).hexdigest()
        entries.append(replace(shard, bytes=len(data), sha256=digest))
    write_manifest(out, replace(manifest, shards=entries))
    return out


def none(sample):
    return sample


def noise(sample):
    """No mistake: half a percent of noise, and lengths of no unit, as stereo leaves them."""
    draw = np.random.default_rng(0)
    depths = [
        d * (1 + 0.005 * draw.standard_normal(d.shape)).astype(np.float32) for d in sample.depth
    ]
    return replace(sample, depth=depths, is_metric=False)


def half_a_pixel(sample):
    K = sample.K.copy()
    K[:, :2, 2] -= 0.5
    return replace(sample, K=K)


def long_focal(sample):
    K = sample.K.copy()
    K[:, 0, 0] *= 1.02
    K[:, 1, 1] *= 1.02
    return replace(sample, K=K)


def swapped_axes(sample):
    """Cameras with y up and z backwards: a rotation still."""
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    return replace(sample, cam_from_world=flip @ sample.cam_from_world @ flip)


def body_axes(sample):
    """Cameras whose axes were never turned from x forward, y right, z down."""
    turn = np.eye(4)[[1, 2, 0, 3]]
    return replace(sample, cam_from_world=turn.T @ sample.cam_from_world @ turn)


def inverted(sample):
    return replace(sample, cam_from_world=np.linalg.inv(sample.cam_from_world))


def ranges(sample):
    """Distance along the ray in place of z."""
    depths = []
    for depth, K in zip(sample.depth, sample.K, strict=True):
        y, x = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
        x, y = (x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]
        depths.append((depth * np.sqrt(1 + x * x + y * y)).astype(np.float32))
    return replace(sample, depth=depths)


def wrong_cameras(sample):
    """Each image with the camera of the next."""
    cameras = np.roll(sample.cam_from_world, -1, axis=0)
    cameras = cameras @ np.linalg.inv(cameras[0])
    cameras[0] = np.eye(4)
    return replace(sample, cam_from_world=cameras)


def forgotten_scale(sample):
    """Depth without the factor that its source keeps beside it."""
    return replace(sample, depth=[depth / np.float32(1.1) for depth in sample.depth])


def distorted_K(sample):
    """Intrinsics of the image before it was undistorted: another focal length and centre."""
    K = sample.K.copy()
    K[:, :2, :2] *= 1.015
    K[:, :2, 2] += np.array([0.006, -0.004]) * K[:, 0, 2][:, None]
    return replace(sample, K=K)


def left_distorted(sample):
    """Image and depth as a lens with k1 = -0.1 shows them, with the pinhole's intrinsics."""
    images, depths = [], []
    for image, depth, K in zip(sample.image, sample.depth, sample.K, strict=True):
        y, x = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
        x, y = (x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]
        bent = 1 + 0.1 * (x * x + y * y)
        column = (x * bent * K[0, 0] + K[0, 2]).clip(0, depth.shape[1] - 1).astype(int)
        row = (y * bent * K[1, 1] + K[1, 2]).clip(0, depth.shape[0] - 1).astype(int)
        images.append(image[row, column])
        depths.append(depth[row, column])
    return replace(sample, image=images, depth=depths)


def vehicle_frame(sample):
    """Lidar taken from where the vehicle's origin is: 25 cm behind the camera, 20 cm below."""
    depths = []
    for depth, K in zip(sample.depth, sample.K, strict=True):
        row, column = np.nonzero(depth)
        rays = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], axis=-1) @ np.linalg.inv(K).T
        points = rays * depth[row, column, None] + np.array([0, -0.2, 0.25])
        there = points @ K.T
        column, row = np.floor(there[:, :2] / there[:, 2:]).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < depth.shape[1]) & (row < depth.shape[0])
        wrong = np.full(depth.shape, np.inf, np.float32)
        np.minimum.at(wrong, (row[inside], column[inside]), points[inside, 2].astype(np.float32))
        depths.append(np.where(np.isfinite(wrong), wrong, np.float32(0)))
    return replace(sample, depth=depths)


def millimetres(sample):
    """A thousand times the metres it claims."""
    cameras = sample.cam_from_world.copy()
    cameras[:, :3, 3] *= 1000
    return replace(sample, cam_from_world=cameras, depth=[1000 * depth for depth in sample.depth])


def inverse_depth(sample):
    inverse = [np.where(depth > 0, 1 / depth.clip(1e-3), 0) for depth in sample.depth]
    return replace(sample, depth=inverse)


def shuffled_images(sample):
    return replace(sample, image=sample.image[1:] + sample.image[:1])


MISTAKES = {
    "half a pixel": half_a_pixel,
    "long focal": long_focal,
    "swapped axes": swapped_axes,
    "body axes": body_axes,
    "inverted": inverted,
    "wrong cameras": wrong_cameras,
    "ranges": ranges,
    "forgotten scale": forgotten_scale,
    "distorted K": distorted_K,
    "left distorted": left_distorted,
    "vehicle frame": vehicle_frame,
    "millimetres": millimetres,
    "inverse depth": inverse_depth,
    "shuffled images": shuffled_images,
}
"""Every mistake by name."""
