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


def plant(folder, out, mistake):
    """Copy a folder of shards, every graph changed by ``mistake``."""
    manifest = read_manifest(folder)
    entries = []
    for shard in manifest.shards:
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


def inverse_depth(sample):
    return replace(sample, depth=[1 / depth for depth in sample.depth])


def shuffled_images(sample):
    return replace(sample, image=sample.image[1:] + sample.image[:1])


MISTAKES = {
    "half a pixel": half_a_pixel,
    "long focal": long_focal,
    "swapped axes": swapped_axes,
    "body axes": body_axes,
    "inverted": inverted,
    "ranges": ranges,
    "inverse depth": inverse_depth,
    "shuffled images": shuffled_images,
}
"""Every mistake by name."""
