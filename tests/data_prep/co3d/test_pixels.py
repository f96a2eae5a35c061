import math
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from data_prep.converters.co3d import pixels
from l3r.errors import DataError
from tests.data_prep.co3d.writer import half_png, jpeg, png, put

SIZE = (6, 4)
NUMBERS = np.array(
    [
        [2.2, 143.0, 0.0, -1.0],
        [math.inf, -math.inf, math.nan, 65504.0],
        [6.1e-5, 0.5, 1.0, 2.0],
        [3.0, 4.0, 5.0, 6.0],
        [7.0, 8.0, 9.0, 10.0],
        [11.0, 12.0, 13.0, 14.0],
    ]
)


@pytest.fixture
def depth(tmp_path):
    return put(tmp_path, "depth.png", half_png(NUMBERS))


def test_sixteen_bits_are_a_half_float_times_the_scale(depth):
    for scale in (1.0, 0.25, 3.5):
        z = pixels.read_depth(depth, SIZE, scale=scale, valid_path=None)
        good = np.isfinite(NUMBERS) & (NUMBERS > 0)
        np.testing.assert_array_equal(z > 0, good)
        np.testing.assert_allclose(z[good], scale * NUMBERS[good], rtol=2**-10)
        assert z.dtype == np.float32


def test_the_bits_of_a_genuine_depth_map_mean_what_they_should(tmp_path):
    # Grey levels reported for car/106_12650_23736, frame 1: a plausible range as half floats.
    path = put(tmp_path, "d.png", png(np.array([[16490, 22649]])))
    z = pixels.read_depth(path, (1, 2), scale=1.0, valid_path=None)
    np.testing.assert_allclose(z, [[2.207, 143.125]], rtol=1e-3)


def test_a_scale_that_overflows_leaves_depth_unknown(depth):
    z = pixels.read_depth(depth, SIZE, scale=1e300, valid_path=None)
    assert not z.any()


@pytest.mark.parametrize("bits", [1, 8])
def test_depth_counts_only_where_its_mask_is_above_zero(depth, tmp_path, bits):
    valid = np.zeros(SIZE, int)
    valid[3, 1] = valid[5, 3] = 1
    mask = put(tmp_path, "valid.png", png(valid, bits))
    z = pixels.read_depth(depth, SIZE, scale=1.0, valid_path=mask)
    assert np.flatnonzero(z).tolist() == [13, 23]


def test_foreground_is_a_probability(depth, tmp_path):
    grey = np.array([[0, 25, 26, 255]] * 6)
    mask = put(tmp_path, "mask.png", png(grey, 8))
    z = pixels.read_depth(depth, SIZE, scale=1.0, valid_path=None, foreground=(mask, 0.1))
    assert (z[3:] > 0).tolist() == [[False, False, True, True]] * 3


def test_another_size_or_number_of_bits_is_refused(depth, tmp_path):
    mask = put(tmp_path, "mask.png", png(np.ones(SIZE), 8))
    for path, size in ((depth, (4, 6)), (mask, SIZE)):
        with pytest.raises(DataError, match=r"annotation says 6x4|one channel of 16 bits"):
            pixels.read_depth(path, size, scale=1.0, valid_path=None)
    with pytest.raises(DataError, match="one channel of 8 bits"):
        pixels.read_mask(depth, SIZE, 0.0)


def test_one_flipped_byte_of_a_png_is_found_or_changes_nothing(depth, tmp_path):
    data = depth.read_bytes()
    whole = pixels.read_depth(depth, SIZE, scale=1.0, valid_path=None)
    refused = 0
    for at in range(8, len(data)):
        flipped = data[:at] + bytes([data[at] ^ 0x40]) + data[at + 1 :]
        path = put(tmp_path, "flipped.png", flipped)
        try:
            found = pixels.read_depth(path, SIZE, scale=1.0, valid_path=None)
        except DataError:
            refused += 1
        else:
            np.testing.assert_array_equal(found, whole)
    # All but the checksum of the last, empty chunk.
    assert refused >= len(data) - 8 - 4


def test_a_png_that_claims_to_be_huge_is_refused_before_it_is_decoded(tmp_path):
    header = struct.pack(">IIBBBBB", 9000, 9000, 16, 0, 0, 0, 0)
    chunks = b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in (
            (b"IHDR", header),
            (b"IDAT", zlib.compress(bytes(10**6))),
            (b"IEND", b""),
        )
    )
    path = put(tmp_path, "bomb.png", b"\x89PNG\r\n\x1a\n" + chunks)
    with pytest.raises(DataError, match="9000x9000, its annotation says 4x6"):
        pixels.read_depth(path, SIZE, scale=1.0, valid_path=None)


def test_black_images_are_told_from_dark_ones(tmp_path):
    noise = np.random.default_rng(0).integers(0, 12, (400, 300, 3)).astype(np.uint8)
    dark = np.full((400, 300, 3), 4, np.uint8)
    dark[100:200, 100:200] = 60
    black = put(tmp_path, "black.jpg", jpeg(np.zeros((400, 300, 3), np.uint8)))
    assert pixels.is_black(black, (400, 300))
    assert not pixels.is_black(put(tmp_path, "noise.jpg", jpeg(noise)), (400, 300))
    assert not pixels.is_black(put(tmp_path, "dark.jpg", jpeg(dark)), (400, 300))


def test_depth_of_nothing_but_zeros_is_told_from_depth_of_one_pixel(tmp_path):
    values = np.zeros((400, 300))
    assert pixels.is_empty(put(tmp_path, "none.png", half_png(values)), (400, 300))
    values[200, 100] = 1.0
    assert not pixels.is_empty(put(tmp_path, "one.png", half_png(values)), (400, 300))
    assert not pixels.no_depth((3, 2)).any()


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_a_png_cut_off_is_named(tmp_path, share):
    data = half_png(np.ones((64, 48)))
    path = put(tmp_path, "cut.png", data[: int(share * len(data))])
    with pytest.raises(DataError, match=r"cut\.png: "):
        pixels.read_depth(path, (64, 48), scale=1.0, valid_path=None)


def test_a_missing_png_is_named(tmp_path):
    with pytest.raises(DataError, match=r"absent\.png"):
        pixels.read_depth(tmp_path / "absent.png", SIZE, scale=1.0, valid_path=None)


def test_depth_of_three_channels_is_refused(tmp_path):
    image = Image.fromarray(np.ones((*SIZE, 3), np.uint8))
    image.save(tmp_path / "rgb.png")
    with pytest.raises(DataError, match="one channel of 16 bits"):
        pixels.read_depth(tmp_path / "rgb.png", SIZE, scale=1.0, valid_path=None)
