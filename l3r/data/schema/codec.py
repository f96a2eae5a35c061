"""A graph to the members of a webdataset sample, and back."""

import io
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8

from l3r.data.schema.graph import SCHEMA_VERSION, GraphSample, PairTable, check_cameras
from l3r.data.schema.headers import depth_pixels, jpeg_size
from l3r.errors import DataError

_JPEG = [
    cv2.IMWRITE_JPEG_QUALITY,
    95,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
]
_SMALLEST = float(np.finfo(np.float16).smallest_normal)
_LARGEST = float(np.finfo(np.float16).max)


def encode_graph(sample: GraphSample, key: str) -> dict[str, Any]:
    """Turn a graph into the members of one webdataset sample.

    Args:
        sample: The graph.
        key: Its name within the data set; letters, digits, ``-`` and ``_``.

    Returns:
        ``__key__`` (a string), then bytes under ``json``, ``00.jpg``, ``00.depth.npy``, ... in
        the order in which they stand in a shard.

    Raises:
        DataError: The key holds a dot or a slash, a camera is unusable, or a depth is negative,
            not finite or beyond what float16 holds.
    """
    if not key or any(letter in key for letter in "./\\"):
        raise DataError(f"key '{key}': expected a name without dots and slashes; rename the scene")
    check_cameras(sample.K, sample.cam_from_world, key)
    members: dict[str, Any] = {"__key__": key, "json": _encode_meta(sample)}
    for view, (image, depth) in enumerate(zip(sample.image, sample.depth, strict=True)):
        members[f"{view:02d}.jpg"] = _encode_image(image)
        members[f"{view:02d}.depth.npy"] = _encode_depth(depth, f"{key}.{view:02d}.depth.npy")
    return members


def decode_graph(members: Mapping[str, Any], num_views: int) -> GraphSample:
    """Read the first images of a stored graph.

    Args:
        members: What :func:`encode_graph` gave; members of later images may be missing.
        num_views: Images to decode, from the first.

    Raises:
        DataError: A member is missing, cut off or of another size than the meta says, the schema
            is of another version, the graph has fewer images, or a camera is unusable.
    """
    key = str(members.get("__key__", "?"))
    meta = _decode_meta(_member(members, key, "json"), f"{key}.json", num_views)
    image, depth = [], []
    for view, size in enumerate(meta.pop("image_size")):
        jpg, npy = f"{view:02d}.jpg", f"{view:02d}.depth.npy"
        image.append(_decode_image(_member(members, key, jpg), size, f"{key}.{jpg}"))
        depth.append(_decode_depth(_member(members, key, npy), size, f"{key}.{npy}"))
    return GraphSample(image=image, depth=depth, **meta)


def _member(members: Mapping[str, Any], key: str, name: str) -> bytes:
    if name not in members:
        raise DataError(f"{key}.{name}: missing from the shard; rebuild it with l3r-prep")
    return bytes(members[name])


def _encode_meta(sample: GraphSample) -> bytes:
    meta = {
        "schema_version": SCHEMA_VERSION,
        "dataset": sample.dataset,
        "scene": sample.scene,
        "is_metric": sample.is_metric,
        "file": sample.file,
        "image_size": [list(size) for size in sample.image_size],
        "K": sample.K.tolist(),
        "cam_from_world": sample.cam_from_world.tolist(),
        "pairs": {f.name: _plain_table(getattr(sample.pairs, f.name)) for f in fields(PairTable)},
    }
    return json.dumps(meta, allow_nan=False, separators=(",", ":")).encode()


def _plain_table(table: Float64[np.ndarray, "n n"]) -> list[list[float | None]]:
    """Six digits say all there is to say; JSON has no NaN."""
    return [[None if np.isnan(x) else round(float(x), 6) for x in row] for row in table]


def _decode_meta(data: bytes, where: str, num_views: int) -> dict[str, Any]:
    """Give the fields of :class:`GraphSample` but the pixels, and ``image_size``."""
    try:
        meta = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{where}: no JSON ({error}); rebuild the shard with l3r-prep") from error
    version = meta.get("schema_version") if isinstance(meta, dict) else None
    if version != SCHEMA_VERSION:
        raise DataError(
            f"{where}: schema version {version!r:.40}, expected {SCHEMA_VERSION};"
            " rebuild the shard with l3r-prep of this version"
        )
    try:
        return _parse_meta(meta, where, num_views)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(
            f"{where}: field missing or of a wrong shape ({error!r:.200}); rebuild it with l3r-prep"
        ) from error


def _parse_meta(meta: dict[str, Any], where: str, num_views: int) -> dict[str, Any]:
    file, image_size = _parse_names(meta["file"]), _parse_sizes(meta["image_size"])
    total = len(file)
    if len(image_size) != total:
        raise ValueError(f"image_size has {len(image_size)} entries, expected {total}")
    if total < num_views:
        raise DataError(
            f"{where}: {total} images, {num_views} asked;"
            " lower data.num_views or build the shards with a larger --min-views"
        )
    first = slice(num_views)
    K = np.array(meta["K"], dtype=np.float64).reshape(total, 3, 3)[first]
    cam_from_world = np.array(meta["cam_from_world"], dtype=np.float64).reshape(total, 4, 4)[first]
    check_cameras(K, cam_from_world, where)
    pairs = {
        f.name: np.array(meta["pairs"][f.name], dtype=np.float64).reshape(total, total)
        for f in fields(PairTable)
    }
    if type(meta["is_metric"]) is not bool:
        raise TypeError("is_metric is neither true nor false")
    dataset, scene = _parse_names([meta["dataset"], meta["scene"]])
    return {
        "dataset": dataset,
        "scene": scene,
        "is_metric": meta["is_metric"],
        "file": file[first],
        "image_size": image_size[first],
        "K": K,
        "cam_from_world": cam_from_world,
        "pairs": PairTable(**pairs)[first],
    }


def _parse_names(value: Any) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise TypeError("dataset, scene or file is no text")
    return value


def _parse_sizes(value: Any) -> list[tuple[int, int]]:
    if any(
        type(side) is not int or side < 1 for height, width in value for side in (height, width)
    ):
        raise ValueError("image_size holds other than positive whole numbers")
    return [(height, width) for height, width in value]


def _encode_image(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    done, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _JPEG)
    assert done
    return bytes(data.tobytes())


def _decode_image(data: bytes, size: tuple[int, int], where: str) -> UInt8[np.ndarray, "h w 3"]:
    # Before any pixel is decoded: a damaged header may ask for gigabytes.
    found = jpeg_size(data)
    if found is not None and found != size:
        raise DataError(
            f"{where}: (height, width) {found}, the meta says {size};"
            " rebuild the shard with l3r-prep"
        )
    image = None
    # The decoder fills a JPEG that is cut off with grey and only warns, so look for its end mark.
    if found is not None and data.endswith(b"\xff\xd9"):
        with suppress(cv2.error):
            image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    if image is None or image.shape[:2] != size:
        raise DataError(f"{where}: no whole JPEG ({len(data)} bytes); rebuild it with l3r-prep")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def _encode_depth(depth: Float32[np.ndarray, "h w"], where: str) -> bytes:
    good = (depth == 0) | ((depth >= _SMALLEST) & (depth <= _LARGEST))
    if not good.all():
        raise DataError(
            f"{where}: depth {depth[~good][0]}, expected 0 for unknown or {_SMALLEST:.1e} to"
            f" {_LARGEST:.0f}; mark it unknown, or scale a scene that has no metres"
        )
    stream = io.BytesIO()
    np.save(stream, depth.astype(np.float16, order="C"), allow_pickle=False)
    return stream.getvalue()


def _decode_depth(data: bytes, size: tuple[int, int], where: str) -> Float32[np.ndarray, "h w"]:
    depth = depth_pixels(data, size)
    if depth is None:
        raise DataError(
            f"{where}: no whole array ({len(data)} bytes), expected what numpy.save writes of"
            f" float16 {size}; rebuild it with l3r-prep"
        )
    # Twenty times as fast as numpy's own conversion; a NaN makes both comparisons false.
    z: Float32[np.ndarray, "h w"] = torch.from_numpy(depth).float().numpy()
    if z.size and not (z.min() >= 0 and z.max() <= _LARGEST):
        raise DataError(
            f"{where}: negative or not finite, expected z or 0; rebuild it with l3r-prep"
        )
    return z
