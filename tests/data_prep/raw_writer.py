"""TartanAir files written from the format's description, sharing nothing with the reader.

PNG through zlib and struct, npy by its header's text, quaternions from the axes' own components.
"""

import struct
import zlib

import numpy as np


def png_bytes(pixels):
    """8-bit RGB or RGBA, every row unfiltered, the data in two chunks."""
    height, width, channels = pixels.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), pixels.reshape(height, -1)], axis=1)
    packed = zlib.compress(rows.tobytes(), 1)
    header = struct.pack(">IIBBBBB", width, height, 8, {3: 2, 4: 6}[channels], 0, 0, 0)
    half = len(packed) // 2
    chunks = [(b"IHDR", header), (b"IDAT", packed[:half]), (b"IDAT", packed[half:]), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*each) for each in chunks)


def chunk(kind, data):
    """Length, kind, data, checksum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def npy_bytes(depth):
    """Version 1.0 of the format, float32."""
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {depth.shape}, }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    head = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()
    return head + depth.astype("<f4").tobytes()


def depth_png_bytes(depth):
    """V2: the bytes of a little-endian float32, lowest first, as blue, green, red and alpha."""
    blue, green, red, alpha = np.moveaxis(
        np.frombuffer(depth.astype("<f4").tobytes(), np.uint8).reshape(*depth.shape, 4), -1, 0
    )
    return png_bytes(np.ascontiguousarray(np.stack([red, green, blue, alpha], axis=-1)))


def pose_line(camera):
    """Position, then the quaternion of the body: its x is the camera's z, its y the camera's x."""
    right, down, forward = camera[:3, 0], camera[:3, 1], camera[:3, 2]
    R = np.stack([forward, right, down], axis=1)
    # Each component by its own formula; the largest fixes the signs.
    squares = np.array(
        [
            1 + R[0, 0] - R[1, 1] - R[2, 2],
            1 - R[0, 0] + R[1, 1] - R[2, 2],
            1 - R[0, 0] - R[1, 1] + R[2, 2],
            1 + np.trace(R),
        ]
    )
    largest = int(squares.argmax())
    products = np.array(
        [
            [squares[0], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[2, 1] - R[1, 2]],
            [R[0, 1] + R[1, 0], squares[1], R[1, 2] + R[2, 1], R[0, 2] - R[2, 0]],
            [R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], squares[2], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], squares[3]],
        ]
    )
    quaternion = products[largest] / (2 * np.sqrt(squares[largest]))
    return " ".join(f"{x:.12e}" for x in [*camera[:3, 3], *quaternion]) + "\n"


def write_v1(folder, frames):
    """A trajectory of TartanAir V1 made of frames of a scene."""
    write(folder, frames, names("left", "npy"), npy_bytes)


def write_v2(folder, frames):
    """A trajectory of TartanAir V2 made of frames of a scene."""
    write(folder, frames, names("lcam_front", "png"), depth_png_bytes)


def names(camera, ending):
    return (
        f"image_{camera}",
        f"{{:06d}}_{camera}.png",
        f"depth_{camera}",
        f"{{:06d}}_{camera}_depth.{ending}",
        f"pose_{camera}.txt",
    )


def write(folder, frames, names, encode_depth):
    images, image, depths, depth, poses = names
    (folder / images).mkdir(parents=True)
    (folder / depths).mkdir()
    for number, frame in enumerate(frames):
        (folder / images / image.format(number)).write_bytes(png_bytes(frame.read_image()))
        (folder / depths / depth.format(number)).write_bytes(encode_depth(frame.read_depth()))
    (folder / poses).write_text("".join(pose_line(frame.world_from_cam) for frame in frames))
