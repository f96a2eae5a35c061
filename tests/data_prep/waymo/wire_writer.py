"""Writes version 1's files: protocol-buffer fields, zlib matrices, TFRecord with its CRCs."""

import struct
import zlib
from functools import lru_cache

import numpy as np


def varint(value):
    value &= 2**64 - 1
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    out.append(value)
    return bytes(out)


def number(tag, value):
    return varint(tag << 3) + varint(value)


def double(tag, value):
    return varint(tag << 3 | 1) + struct.pack("<d", value)


def block(tag, content):
    return varint(tag << 3 | 2) + varint(len(content)) + content


def doubles(tag, values):
    """Repeated doubles the way proto2 writes them: not packed."""
    return b"".join(double(tag, value) for value in values)


def transform(tag, matrix):
    return block(tag, doubles(1, np.asarray(matrix).ravel()))


def shape(array):
    return block(2, b"".join(number(1, side) for side in array.shape))


def float_matrix(array):
    data = array.astype("<f4").tobytes()
    return zlib.compress(block(1, data) + shape(array))


_SMALL = [varint(value) for value in range(2048)]


def int_matrix(array):
    data = b"".join(map(_SMALL.__getitem__, array.ravel().tolist()))
    return zlib.compress(block(1, data) + shape(array))


def frame_message(segment, frame):
    """Serialise a Frame, repeated entries in no particular order."""
    context = block(1, segment.context.encode())
    for name in sorted(segment.cameras, key=lambda n: (n * 7) % 5):
        camera = segment.cameras[name]
        content = number(1, name) + doubles(2, camera["lens"]) + transform(3, camera["mount"])
        content += number(4, camera["size"][1]) + number(5, camera["size"][0]) + number(6, 2)
        context += block(2, content)
    for name in sorted(segment.lasers, key=lambda n: (n * 3) % 5):
        laser = segment.lasers[name]
        content = number(1, name) + doubles(2, laser["inclinations"])
        content += double(3, laser["low"]) + double(4, laser["high"])
        context += block(3, content + transform(5, laser["mount"]))
    context += block(4, block(2, b"Day"))
    out = block(1, context) + number(2, frame.timestamp) + transform(3, frame.pose)
    for name in sorted(frame.images, key=lambda n: (n * 2) % 5):
        jpeg, pose = frame.images[name]
        content = number(1, name) + block(2, jpeg) + transform(3, pose)
        out += block(4, content + double(5, frame.timestamp / 1e6))
    for name in sorted(frame.lasers, reverse=True):
        ranges, projection, poses = frame.lasers[name]
        image = block(2, float_matrix(ranges)) + block(3, int_matrix(projection))
        if poses is not None:
            image += block(4, float_matrix(poses))
        out += block(5, number(1, name) + block(2, image))
    for label in frame.labels:
        x, y, z = label["center"]
        length, width, height = label["size"]
        box = [x, y, z, width, length, height, label["heading"]]
        content = block(1, b"".join(double(tag, v) for tag, v in enumerate(box, start=1)))
        if label["speed"] is not None:
            content += block(2, double(1, label["speed"][0]) + double(2, label["speed"][1]))
        out += block(6, content + number(3, label["type"]) + block(4, b"id"))
    return out


_TABLE = []
for _byte in range(256):
    for _ in range(8):
        _byte = _byte >> 1 ^ 0x82F63B78 if _byte & 1 else _byte >> 1
    _TABLE.append(_byte)


@lru_cache(maxsize=64)
def masked_crc(data):
    crc = 0xFFFFFFFF
    for byte in data:
        crc = _TABLE[(crc ^ byte) & 255] ^ (crc >> 8)
    crc ^= 0xFFFFFFFF
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) % 2**32


def tfrecord(payloads):
    out = b""
    for payload in payloads:
        head = struct.pack("<Q", len(payload))
        out += head + struct.pack("<I", masked_crc(head))
        out += payload + struct.pack("<I", masked_crc(payload))
    return out


def write_v1(folder, segment):
    """Write ``segment-CONTEXT_with_camera_labels.tfrecord``; give its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"segment-{segment.context}_with_camera_labels.tfrecord"
    path.write_bytes(tfrecord([frame_message(segment, frame) for frame in segment.frames]))
    return path


def split(message):
    """Fields of a message in order: (number, wire type, value); for genuine files."""
    fields, at = [], 0

    def take():
        nonlocal at
        value = shift = 0
        while True:
            byte = message[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    while at < len(message):
        key = take()
        kind = key & 7
        if kind == 0:
            fields.append((key >> 3, kind, take()))
            continue
        size = {1: 8, 5: 4}.get(kind) or take()
        fields.append((key >> 3, kind, message[at : at + size]))
        at += size
    return fields


def get(message, *path):
    """Value at a path of field numbers; the last of repeated ones."""
    for number_ in path:
        message = [value for tag, _, value in split(message) if tag == number_][-1]
    return message


def matrix(message):
    """4x4 of a Transform."""
    values = [struct.unpack("<d", value)[0] for _, kind, value in split(message) if kind == 1]
    return np.array(values).reshape(4, 4)


def payloads(data):
    """Payloads of a TFRecord, its checksums not looked at."""
    while data:
        (size,) = struct.unpack("<Q", data[:8])
        yield data[12 : 12 + size]
        data = data[16 + size :]
