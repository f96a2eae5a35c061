"""Photos and depth maps in files."""

import io
import struct
from zlib import crc32

import cv2
import h5py
import numpy as np
import pytest
from PIL import Image

from data_prep.converters.depth_files import depth_size, read_depth_file
from data_prep.converters.paths import join_inside
from data_prep.converters.photos import photo_size, read_photo
from l3r.errors import DataError
from tests.data_prep.folder.writers import write_depth

SIZE = (40, 56)


def smooth():
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    return np.stack([4 * x, 5 * y, 2 * (x + y)], axis=-1).astype(np.uint8)


@pytest.mark.parametrize(("ending", "error"), [("png", 0), ("jpg", 3), ("webp", 6)])
def test_photos_come_as_rgb(tmp_path, ending, error):
    path = tmp_path / f"a.{ending}"
    Image.fromarray(smooth()).save(path, quality=98)
    assert photo_size(path) == SIZE
    found = read_photo(path, SIZE).astype(int)
    assert np.abs(found - smooth()).mean() <= error


@pytest.mark.parametrize("mode", ["L", "RGBA", "CMYK", "P"])
def test_photos_of_other_kinds_become_rgb(tmp_path, mode):
    path = tmp_path / ("a.jpg" if mode == "CMYK" else "a.png")
    Image.fromarray(smooth()).convert(mode).save(path, quality=98)
    found = read_photo(path, SIZE)
    expected = np.asarray(Image.fromarray(smooth()).convert(mode).convert("RGB"))
    assert (found.shape, found.dtype) == ((*SIZE, 3), np.uint8)
    assert np.abs(found.astype(int) - expected).mean() < 3


def test_sixteen_bits_are_scaled_and_not_cut(tmp_path):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), smooth()[..., ::-1].astype(np.uint16) * 257)
    assert np.abs(read_photo(path, SIZE).astype(int) - smooth()).max() <= 1


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_noted_orientation_turns_nothing(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(smooth()).save(path, quality=98, exif=exif)
    assert photo_size(path) == SIZE
    assert np.abs(read_photo(path, SIZE).astype(int) - smooth()).mean() < 3


@pytest.mark.parametrize("ending", ["png", "jpg"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.97])
def test_photos_cut_off_are_refused(tmp_path, ending, share):
    path = tmp_path / f"a.{ending}"
    noise = np.random.default_rng(0).integers(0, 255, (*SIZE, 3)).astype(np.uint8)
    Image.fromarray(noise).save(path)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(DataError, match="no whole photo"):
        read_photo(path, SIZE)


def test_a_flipped_bit_in_a_png_is_found(tmp_path):
    path = tmp_path / "a.png"
    Image.fromarray(smooth()).save(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    with pytest.raises(DataError, match="no whole photo"):
        read_photo(path, SIZE)


@pytest.mark.parametrize("side", [12_000, 20_000, 2**31 - 1])
def test_a_bomb_is_refused_by_its_header(tmp_path, side):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", crc32(kind + data))

    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    data = (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"x") + chunk(b"IEND", b"")
    )
    (tmp_path / "a.png").write_bytes(data)
    for read in (photo_size, lambda path: read_photo(path, (side, side)), depth_size):
        with pytest.raises(DataError, match=r"expected 134|exceeds limit"):
            read(tmp_path / "a.png")


def test_a_jpeg_of_countless_scans_is_refused(tmp_path):
    path = tmp_path / "a.jpg"
    Image.fromarray(smooth()).save(path, progressive=True)
    data = path.read_bytes()
    path.write_bytes(data[:-2] + b"\xff\xda\x00\x08\x01\x01\x00\x00\x3f\x00" * 200 + data[-2:])
    with pytest.raises(DataError, match="more than 100 scans"):
        read_photo(path, SIZE)


def test_other_files_are_no_photos(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(b"GIF89a" + bytes(100))
    for read in (photo_size, lambda path: read_photo(path, SIZE)):
        with pytest.raises(DataError, match="no whole photo"):
            read(path)
        with pytest.raises(DataError, match="no whole photo"):
            read(tmp_path / "none.jpg")


def test_a_photo_of_another_size_is_refused(tmp_path):
    Image.fromarray(smooth()).save(tmp_path / "a.png")
    with pytest.raises(DataError, match="56x40 pixels, its camera says 40x56"):
        read_photo(tmp_path / "a.png", SIZE[::-1])


@pytest.mark.parametrize(("ending", "scale"), [(".png", 0.001), (".npy", 1.0), (".h5", 1.0)])
def test_depth_is_read_back(tmp_path, ending, scale):
    depth = np.random.default_rng(0).uniform(0.5, 9, SIZE)
    depth[3, 4] = 0
    write_depth(tmp_path / f"a{ending}", depth)
    assert depth_size(tmp_path / f"a{ending}") == SIZE
    found = read_depth_file(tmp_path / f"a{ending}", scale, SIZE)
    assert found.dtype == np.float32
    assert found[3, 4] == 0
    assert np.abs(found - depth).max() < (6e-4 if ending == ".png" else 1e-6)


def test_what_is_no_depth_becomes_zero(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[np.nan, np.inf, -np.inf], [-1.0, 0.0, 2.0]]))
    found = read_depth_file(tmp_path / "a.npy", 1.0, (2, 3))
    np.testing.assert_array_equal(found, [[0, 0, 0], [0, 0, 2]])


@pytest.mark.parametrize("dtype", [np.float16, ">f8", np.uint16, np.int32])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_of_any_number_and_order_are_read(tmp_path, dtype, order):
    depth = np.arange(1, 7).reshape(2, 3)
    np.save(tmp_path / "a.npy", np.asarray(depth.astype(dtype), order=order))
    np.testing.assert_array_equal(read_depth_file(tmp_path / "a.npy", 0.5, (2, 3)), depth / 2)


@pytest.mark.parametrize("ending", [".png", ".npy", ".h5"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.97])
def test_depth_cut_off_is_refused(tmp_path, ending, share):
    path = tmp_path / f"a{ending}"
    write_depth(path, np.random.default_rng(0).uniform(0.5, 9, SIZE))
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(DataError, match="no whole depth map"):
        read_depth_file(path, 1.0, SIZE)


@pytest.mark.parametrize("ending", [".png", ".npy", ".h5"])
def test_depth_of_another_size_is_refused_before_it_is_unpacked(tmp_path, ending):
    write_depth(tmp_path / f"a{ending}", np.ones((30, 30)))
    with pytest.raises(DataError, match=r"\(30, 30\), its image has \(40, 56\)"):
        read_depth_file(tmp_path / f"a{ending}", 1.0, SIZE)


def test_an_array_that_would_have_to_be_unpickled_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[{}, {}]], dtype=object), allow_pickle=True)
    with pytest.raises(DataError, match="expected numbers in two axes"):
        read_depth_file(tmp_path / "a.npy", 1.0, (1, 2))


def test_a_header_that_claims_more_than_the_file_holds_is_refused(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**6)}
    )
    (tmp_path / "a.npy").write_bytes(header.getvalue() + bytes(64))
    with pytest.raises(DataError, match="expected 134,217,728 pixels or fewer"):
        depth_size(tmp_path / "a.npy")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("depth", shape=(10**6, 10**6), dtype="f4", chunks=(64, 64))
    with pytest.raises(DataError, match="pixels or fewer"):
        depth_size(tmp_path / "a.h5")


@pytest.mark.parametrize("kind", ["link", "external", "virtual", "group", "text", "cube", "chunk"])
def test_hdf5_that_leads_elsewhere_is_refused(tmp_path, kind):
    secret = tmp_path / "secret.h5"
    write_depth(secret, np.ones(SIZE))
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        match kind:
            case "link":
                file["depth"] = h5py.ExternalLink(str(secret), "/depth")
            case "external":
                raw = [(str(tmp_path / "secret.h5"), 0, 4 * 40 * 56)]
                file.create_dataset("depth", SIZE, "f4", external=raw)
            case "virtual":
                layout = h5py.VirtualLayout(SIZE, "f4")
                layout[:] = h5py.VirtualSource(str(secret), "depth", SIZE)
                file.create_virtual_dataset("depth", layout)
            case "group":
                file.create_group("depth")
            case "text":
                file["depth"] = np.array([[b"a", b"b"]])
            case "cube":
                file["depth"] = np.ones((2, 3, 4))
            case "chunk":
                file.create_dataset(
                    "depth", SIZE, "f4", chunks=(20_000, 20_000), maxshape=(None, None)
                )
    with pytest.raises(DataError, match="'depth'"):
        read_depth_file(path, 1.0, SIZE)


@pytest.mark.parametrize("name", ["", ".", "/a", "../a", "a/../../b", "a\0b", "a\\b", "x" * 2000])
def test_names_that_leave_their_folder_are_refused(tmp_path, name):
    with pytest.raises(DataError, match="expected a path below"):
        join_inside(tmp_path, name)


def test_usual_names_are_joined(tmp_path):
    assert join_inside(tmp_path, "./images/a b.jpg") == tmp_path / "images" / "a b.jpg"
