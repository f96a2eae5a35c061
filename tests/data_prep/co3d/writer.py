"""CO3D files of a scene that is known by formula, written from the format's description.

Nothing here is shared with the reader: cameras are laid out in PyTorch3D's terms (row vectors,
x left, y up), half floats go through ``struct``, PNG and gzip through ``zlib``.
"""

import io
import json
import struct
import zlib
from dataclasses import dataclass

import numpy as np
from PIL import Image

ROOM, BLOCK = 6.0, np.array([1.0, 0.8, 0.6])
"""Half sides of the room around the origin and of the block in its middle."""


@dataclass(kw_only=True)
class Camera:
    """``X_cam = X_world @ R + T``; focal and principal point in pixels, the latter (x, y)."""

    R: np.ndarray
    T: np.ndarray
    focal: np.ndarray
    principal: np.ndarray


def orbit(count, image_size, step_deg=12.0):
    """Cameras on an arc that look at the block from a little above."""
    height, width = image_size
    cameras = []
    for number in range(count):
        angle = np.radians(20 + step_deg * number)
        center = np.array([4 * np.sin(angle), 1.5 + 0.1 * number, 4 * np.cos(angle)])
        forward = -center / np.linalg.norm(center)
        left = np.cross([0.0, 1.0, 0.0], forward)
        left /= np.linalg.norm(left)
        R = np.stack([left, np.cross(forward, left), forward], axis=1)
        cameras.append(
            Camera(
                R=R,
                T=-center @ R,
                focal=np.array([1.1, 1.15]) * width,
                principal=np.array([width / 2 + 3.1, height / 2 - 4.7]),
            )
        )
    return cameras


def render(camera, image_size):
    """Give RGB and z of the room and the block at pixel centres."""
    height, width = image_size
    v, u = np.mgrid[:height, :width] + 0.5
    # x points left and y up, pixels count rightwards and downwards.
    x = -(u - camera.principal[0]) / camera.focal[0]
    y = -(v - camera.principal[1]) / camera.focal[1]
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ camera.R.T
    center = -camera.T @ camera.R.T
    walls = ((np.sign(rays) * ROOM - center) / rays).min(-1)
    near = ((-np.sign(rays) * BLOCK - center) / rays).max(-1)
    far = ((np.sign(rays) * BLOCK - center) / rays).min(-1)
    z = np.where((near < far) & (near > 0), near, walls)
    points = center + rays * z[..., None]
    tones = [np.sin(points @ k) for k in ([1.1, 0.7, 0.4], [0.3, 1.3, -0.9], [-0.8, 0.5, 1.2])]
    return (127 + 100 * np.stack(tones, axis=-1)).astype(np.uint8), z


def viewpoint(camera, image_size, unit="ndc_isotropic"):
    """Write a camera as an annotation has it."""
    height, width = image_size
    half = np.array([width, height]) / 2
    scale = half if unit == "ndc_norm_image_bounds" else np.full(2, half.min())
    return {
        "R": camera.R.tolist(),
        "T": camera.T.tolist(),
        "focal_length": (camera.focal / scale).tolist(),
        "principal_point": (-(camera.principal - half) / scale).tolist(),
        "intrinsics_format": unit,
    }


def png(values, bits=16):
    """Encode one channel of 1, 8 or 16 bits."""
    height, width = np.shape(values)
    if bits == 1:
        packed = np.packbits(np.asarray(values, bool), axis=1)
    else:
        packed = np.asarray(values, ">u2" if bits == 16 else np.uint8)
    rows = b"".join(b"\0" + row.tobytes() for row in packed)

    def chunk(kind, body):
        return (
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        )

    header = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows, 6))
        + chunk(b"IEND", b"")
    )


def half_png(values):
    """Encode numbers as half floats whose bits are 16-bit grey levels."""
    numbers = np.asarray(values, np.float64)
    packed = struct.pack(f"<{numbers.size}e", *numbers.ravel())
    levels = struct.unpack(f"<{numbers.size}H", packed)
    return png(np.reshape(levels, numbers.shape))


def jpeg(image, **options):
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "JPEG", quality=92, **options)
    return stream.getvalue()


def gzipped(data):
    packer = zlib.compressobj(6, zlib.DEFLATED, 31)
    return packer.compress(data) + packer.flush()


def write_jgz(path, records):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzipped(json.dumps(records).encode()))


def put(root, name, data):
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


@dataclass(kw_only=True)
class Recipe:
    """How a sequence is written."""

    category: str = "apple"
    sequence: str = "110_13051_23361"
    count: int = 4
    image_size: tuple[int, int] = (128, 96)
    unit: str = "ndc_isotropic"
    scale: float = 1.0
    first_number: int = 0
    """``frame_number`` of the first frame; files count from 1 in steps of 3."""


def write_sequence(root, recipe):
    """Write the files of a sequence and give its frame annotations.

    Where the depth mask is 0 the depth is wrong: twice what it should be.
    """
    records = []
    base = f"{recipe.category}/{recipe.sequence}"
    for number, camera in enumerate(orbit(recipe.count, recipe.image_size)):
        stem = f"frame{1 + 3 * number:06d}"
        image, z = render(camera, recipe.image_size)
        valid = np.ones(recipe.image_size, np.uint8)
        valid[:, : recipe.image_size[1] // 4] = 0
        stored = np.where(valid > 0, z, 2 * z) / recipe.scale
        soft = np.linspace(0, 255, recipe.image_size[1]).round() * np.ones_like(z)
        names = {
            "image": f"{base}/images/{stem}.jpg",
            "depth": f"{base}/depths/{stem}.jpg.geometric.png",
            "valid": f"{base}/depth_masks/{stem}.png",
            "mask": f"{base}/masks/{stem}.png",
        }
        put(root, names["image"], jpeg(image))
        put(root, names["depth"], half_png(stored))
        put(root, names["valid"], png(valid, bits=1))
        put(root, names["mask"], png(soft, bits=8))
        records.append(
            {
                "sequence_name": recipe.sequence,
                "frame_number": recipe.first_number + number,
                "frame_timestamp": 0.1 * number,
                "image": {"path": names["image"], "size": list(recipe.image_size)},
                "depth": {
                    "path": names["depth"],
                    "scale_adjustment": recipe.scale,
                    "mask_path": names["valid"],
                },
                "mask": {"path": names["mask"], "mass": float(soft.sum() / 255)},
                "viewpoint": viewpoint(camera, recipe.image_size, recipe.unit),
                "meta": {"frame_type": "train_known"},
            }
        )
    return records


def sequence_annotation(name, category="apple", quality=1.5, cloud=0.8):
    return {
        "sequence_name": name,
        "category": category,
        "video": None,
        "point_cloud": {"path": f"{category}/{name}/pointcloud.ply", "quality_score": cloud},
        "viewpoint_quality_score": quality,
    }


def entries(records):
    """Entries of a set list."""
    return [[r["sequence_name"], r["frame_number"], r["image"]["path"]] for r in records]


def write_lists(root, subset, category="apple", **parts):
    """Write one set list; parts not given are empty."""
    lists = {part: entries(parts.get(part, [])) for part in ("train", "val", "test")}
    put(root, f"{category}/set_lists/set_lists_{subset}.json", json.dumps(lists).encode())


def write_category(root, records, sequences=None, category="apple", lists=True):
    """Write a category's annotations, all frames in the training list of ``fewview_train``."""
    names = sorted({record["sequence_name"] for record in records})
    write_jgz(root / category / "frame_annotations.jgz", records)
    write_jgz(
        root / category / "sequence_annotations.jgz",
        [sequence_annotation(name, category) for name in names] if sequences is None else sequences,
    )
    if lists:
        write_lists(root, "fewview_train", category, train=records)
    return root
