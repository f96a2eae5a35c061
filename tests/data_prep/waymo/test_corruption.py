"""Damaged copies of every kind of file: an error in one line, a counted problem, or a right sample.

Where the format has checksums (TFRecord), what is given is what the whole file gives.
"""

import io
import random
import shutil
import time
import zlib
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from PIL import Image

from data_prep.converters.waymo import read, survey, v1
from data_prep.problems import Problems
from l3r.errors import DataError
from tests.data_prep.mutations import NUM_ALL, NUM_QUICK, mutate, seeds
from tests.data_prep.waymo import drive
from tests.data_prep.waymo.parquet_writer import write_v2
from tests.data_prep.waymo.wire_writer import (
    block,
    frame_message,
    get,
    number,
    payloads,
    split,
    tfrecord,
    write_v1,
)

QUICK = pytest.param(seeds(NUM_QUICK), id="quick")
ALL = pytest.param(seeds(NUM_ALL), id="all", marks=pytest.mark.slow)
LONGEST = 10.0
"""No damaged file may take longer to refuse [s of this process]; sound ones take milliseconds."""
MOST_MEMORY = 2**30


@pytest.fixture(scope="module")
def short(light):
    """Two frames of two cameras and two lasers: a thousand of them are read."""

    def keep(entries, *numbers):
        return {number: entries[number] for number in numbers}

    frames = [
        replace(frame, images=keep(frame.images, 1, 4), lasers=keep(frame.lasers, 1, 2))
        for frame in light.frames[:2]
    ]
    cameras, lasers = keep(light.cameras, 1, 4), keep(light.lasers, 1, 2)
    return replace(light, cameras=cameras, lasers=lasers, frames=frames)


def check_message(error):
    assert "\n" not in str(error)


def read_frames(root, **options):
    """All frames that can be read, their cameras checked; errors are those a user may see."""
    started = time.process_time()
    frames = []
    try:
        for scene in read(root, problems=Problems(), **options):
            frames += scene.frames
    except DataError as error:
        check_message(error)
    for frame in frames:
        R = frame.world_from_cam[:3, :3]
        assert np.isfinite(frame.world_from_cam).all()
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
        assert np.isfinite(frame.K).all()
        assert min(frame.K[0, 0], frame.K[1, 1]) > 0
    assert time.process_time() - started < LONGEST
    return frames


def pixels(frame):
    """Image and depth, or None where they cannot be read; those read are checked."""
    found = []
    for call in (frame.read_image, frame.read_depth):
        try:
            found.append(call())
        except DataError as error:
            check_message(error)
            found.append(None)
    image, depth = found
    if image is not None:
        assert image.shape == (*frame.image_size, 3)
        assert image.dtype == np.uint8
    if depth is not None:
        assert depth.shape == frame.image_size
        assert np.isfinite(depth).all()
        assert (depth >= 0).all()
    return image, depth


@pytest.mark.parametrize("chosen", [QUICK, ALL])
def test_a_damaged_tfrecord_gives_what_the_whole_one_gives_or_nothing(short, tmp_path, chosen):
    path = write_v1(tmp_path / "training", short)
    data = path.read_bytes()
    whole = {frame.name: frame for frame in read_frames(tmp_path)}
    pristine = {name: pixels(frame) for name, frame in whole.items()}
    num_kept = 0
    for seed in chosen:
        path.write_bytes(mutate(data, seed))
        v1.read_sweep.cache_clear()
        frames = read_frames(tmp_path)
        assert seed % 10 or len(list(survey(tmp_path))) == 1
        num_kept += len(frames)
        for frame in frames:
            np.testing.assert_array_equal(frame.K, whole[frame.name].K)
            np.testing.assert_array_equal(frame.world_from_cam, whole[frame.name].world_from_cam)
        for frame in random.Random(seed).sample(frames, min(1, len(frames))):
            image, depth = pixels(frame)
            np.testing.assert_array_equal(image, pristine[frame.name][0])
            np.testing.assert_array_equal(depth, pristine[frame.name][1])
    # One frame of two is lost by nearly every damage, and not much more.
    assert 0.2 < num_kept / (len(chosen) * len(whole)) < 0.9


@pytest.mark.parametrize("chosen", [QUICK, ALL])
def test_a_damaged_frame_under_a_right_checksum_does_no_harm(short, tmp_path, chosen):
    folder = tmp_path / "training"
    folder.mkdir()
    # Pixels and ranges are most of a frame and are damaged elsewhere: leave little of them here.
    slim = [replace(frame, images=grey_images(frame), lasers={}) for frame in short.frames]
    one, two = (frame_message(short, frame) for frame in slim)
    num_kept = 0
    for seed in chosen:
        (folder / "x.tfrecord").write_bytes(tfrecord([mutate(one, seed), two]))
        frames = read_frames(tmp_path, require_depth=False)
        names = {frame.name.split("_")[0] for frame in frames}
        assert str(slim[1].timestamp) in names
        num_kept += len(names) == 2
        if seed % 10 == 0:
            pixels(frames[0])
    assert num_kept > len(chosen) / 4


def grey_images(frame):
    """Images of the right sizes in 1 kB each."""
    found = {}
    for name, (_, pose) in frame.images.items():
        stream = io.BytesIO()
        height, width = drive.SIZES[name]
        Image.new("RGB", (width, height), (90, 90, 90)).save(stream, "JPEG")
        found[name] = (stream.getvalue(), pose)
    return found


@pytest.mark.parametrize("chosen", [QUICK, ALL])
def test_a_damaged_range_image_does_no_harm(short, tmp_path, chosen):
    folder = tmp_path / "training"
    folder.mkdir()
    whole = frame_message(short, short.frames[0])
    lasers = [value for tag, _, value in split(whole) if tag == 5]
    rest = b"".join(number(t, v) if k == 0 else block(t, v) for t, k, v in split(whole) if t != 5)
    num_read = 0
    for seed in chosen:
        laser = lasers[seed % 2]
        parts = {tag: value for tag, _, value in split(get(laser, 2))}
        victim = sorted(parts)[seed // 2 % len(parts)]
        # Damaged before it is packed, so that unpacking goes well.
        parts[victim] = zlib.compress(mutate(zlib.decompress(parts[victim]), seed))
        image = b"".join(block(tag, value) for tag, value in parts.items())
        message = rest + block(5, number(1, get(laser, 1)) + block(2, image))
        (folder / "x.tfrecord").write_bytes(tfrecord([message]))
        v1.read_sweep.cache_clear()
        frames = read_frames(tmp_path)
        num_read += bool(frames) and pixels(frames[seed % len(frames)])[1] is not None
    assert num_read > len(chosen) / 10


@pytest.mark.parametrize("chosen", [QUICK, ALL])
def test_a_damaged_table_does_no_harm(short, tmp_path, chosen):
    source = write_v2(tmp_path / "whole", short, compression="snappy")
    whole = {path.relative_to(source): path.read_bytes() for path in source.rglob("*.parquet")}
    num_read = 0
    for seed in chosen:
        # A folder of its own for each, since files are kept open.
        root = tmp_path / f"{seed}"
        victim = sorted(whole)[seed % len(whole)]
        for path, data in whole.items():
            (root / "training" / path).parent.mkdir(parents=True)
            (root / "training" / path).write_bytes(mutate(data, seed) if path == victim else data)
        assert seed % 10 or len(list(survey(root))) == 1
        for frame in read_frames(root)[1:3]:
            image, depth = pixels(frame)
            num_read += image is not None and depth is not None
        shutil.rmtree(root)
    assert num_read > len(chosen) / 4
    assert pa.default_memory_pool().max_memory() < MOST_MEMORY


def test_payloads_are_split_as_they_were_joined(short):
    messages = [frame_message(short, frame) for frame in short.frames]
    assert list(payloads(tfrecord(messages))) == messages
