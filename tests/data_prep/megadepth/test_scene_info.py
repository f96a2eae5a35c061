"""Scene indices of D2-Net and LoFTR, and pickles that mean harm."""

import io
import pickle
import pickletools
import shutil
import struct
import zipfile

import numpy as np
import pytest

from data_prep.converters.megadepth import read, survey
from data_prep.converters.megadepth.object_arrays import read_pickle
from data_prep.converters.megadepth.scene_info import read_scene_info
from data_prep.problems import Problems
from l3r.errors import DataError
from tests.data_prep.megadepth.writers import info_arrays, write_info


@pytest.fixture
def indexed(merged, tmp_path):
    """The same without its SfM model."""
    shutil.copytree(merged[0] / "0001" / "dense0", tmp_path / "0001" / "dense0")
    return tmp_path


def read_one(root, **options):
    problems = Problems()
    (scene,) = read(root, problems=problems, **options)
    return scene, problems


V1 = "phoenix/S6/zl548/MegaDepth_v1/0001/dense0"
PATHS = [
    ("Undistorted_SfM/0001/images/{}", V1 + "/depths/{}"),
    (V1 + "/imgs/{}", V1 + "/depths/{}"),
    ("0001/dense0/imgs/{}", "0001/dense0/depths/{}"),
]


@pytest.mark.parametrize("bare", [False, True])
@pytest.mark.parametrize("paths", PATHS)
def test_an_index_stands_in_for_the_model(merged, indexed, bare, paths):
    image, depth = paths
    names, pinholes, _ = merged[1]
    (indexed / "index").mkdir()
    for overlap in ("0.1_0.3", "0.3_0.5"):
        arrays = info_arrays(names, pinholes, image=image, depth=depth)
        write_info(indexed / "index" / f"0001_{overlap}.npz", arrays, bare=bare)
    scene, problems = read_one(indexed)
    assert (scene.name, problems.summary(), scene.read_overlap) == ("0001/dense0", "none", None)
    (by_model,) = read(merged[0], problems=problems)
    for frame, other in zip(scene.frames, by_model.frames, strict=True):
        assert (frame.name, frame.image_size) == (other.name, other.image_size)
        np.testing.assert_allclose(frame.K, other.K, rtol=1e-3)
        np.testing.assert_allclose(frame.world_from_cam, other.world_from_cam, atol=1e-9)
        np.testing.assert_array_equal(frame.read_image(), other.read_image())
    (row,) = survey(indexed)
    assert (row.name, row.num_images, row.num_missing) == ("0001/dense0", 3, 0)


def test_a_model_wins_over_an_index(merged, tmp_path):
    shutil.copytree(merged[0] / "0001", tmp_path / "0001")
    arrays = info_arrays(*merged[1][:2], image=PATHS[2][0], depth=PATHS[2][1])
    write_info(tmp_path / "0001_0.1_0.3.npz", arrays)
    scene, _ = read_one(tmp_path)
    assert scene.read_overlap is not None
    assert [row.name for row in survey(tmp_path)] == ["0001/dense0"]


@pytest.mark.parametrize(
    ("key", "value", "kind"),
    [
        ("image_paths", "../secret.png", "unsafe_path"),
        ("image_paths", "/etc/passwd", "unsafe_path"),
        ("image_paths", "0001/dense0/imgs/none.png", "missing_photo"),
        ("depth_paths", "0001/dense0/depths/none.h5", "missing_depth"),
        ("image_paths", 7, "bad_scene_info"),
        ("poses", np.eye(3), "bad_scene_info"),
        ("poses", "text", "bad_scene_info"),
        ("poses", np.full((4, 4), np.nan), "bad_pose"),
        ("poses", np.diag([1.0, 1.0, -1.0, 1.0]), "bad_pose"),
        ("poses", 2 * np.eye(4), "bad_pose"),
        ("intrinsics", np.diag([np.inf, 1.0, 1.0]), "bad_camera"),
        ("intrinsics", np.array([[9.0, 0, 900], [0, 9, 40], [0, 0, 1]]), "bad_camera"),
    ],
)
def test_an_image_that_cannot_be_used_is_counted_and_the_rest_kept(
    merged, indexed, key, value, kind
):
    arrays = info_arrays(*merged[1][:2], image=PATHS[2][0], depth=PATHS[2][1])
    arrays[key][3] = value
    write_info(indexed / "0001.npz", arrays)
    scene, problems = read_one(indexed)
    assert [frame.name for frame in scene.frames] == ["0_photo_o.png", "2_photo_o.png"]
    assert problems.summary() == f"1 {kind}"


def test_arrays_of_every_kind_of_number_come_back():
    for dtype in ("f2", "f4", ">f8", "i1", "i4", ">i8", "u1", "u2", "?"):
        for shape in ((), (3,), (2, 3), (0, 4)):
            array = np.arange(int(np.prod(shape))).reshape(shape).astype(dtype)
            # NumPy writes 3 or 4; bytes of 2 are text that calls a codec.
            for protocol in (3, 4):
                found = read_pickle(pickle.dumps([array, {"a": 1.5, "b": None}], protocol))
                np.testing.assert_array_equal(found[0], array)
                assert found[0].dtype == array.dtype
                assert found[1] == {"a": 1.5, "b": None}


def test_columns_in_fortran_order_and_shared_arrays_come_back():
    array = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    objects = np.empty((2, 2), dtype=object)
    objects[:] = [[array, array], ["text", (1, np.float64(2.5))]]
    found = read_pickle(pickle.dumps(objects, 4))
    assert (found.shape, found[1, 0], found[1, 1]) == ((2, 2), "text", (1, 2.5))
    np.testing.assert_array_equal(found[0, 1], array)


class Touch:
    """Unpickled, it writes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (type(self.path).touch, (self.path,))


class Evaluate:
    """Unpickled, it runs a line of Python."""

    def __init__(self, path):
        self.line = f"open({str(path)!r}, 'w').close()"

    def __reduce__(self):
        return (eval, (self.line,))


@pytest.mark.parametrize("hostile", [Touch, Evaluate])
@pytest.mark.parametrize("protocol", range(6))
def test_a_hostile_pickle_runs_nothing(tmp_path, hostile, protocol):
    marker = tmp_path / "marker"
    empty = np.array([None, None])
    arrays = dict.fromkeys(("depth_paths", "intrinsics", "poses"), empty)
    arrays["image_paths"] = np.array([hostile(marker), None], dtype=object)
    table = pickle.dumps(arrays, protocol)
    (tmp_path / "bare.npz").write_bytes(table)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "|O", "fortran_order": False, "shape": (2,)}
    )
    with zipfile.ZipFile(tmp_path / "archive.npz", "w") as archive:
        body = pickle.dumps(arrays["image_paths"], protocol)
        archive.writestr("image_paths.npy", header.getvalue() + body)
    for name in ("bare.npz", "archive.npz"):
        with pytest.raises(DataError, match="scene index"):
            read_scene_info(tmp_path / name, Problems())
    assert not marker.exists()
    # The pickle is able to do harm: unpickled it does.
    pickle.loads(table)
    assert marker.exists()


GLOBALS = {
    "eval": b"cbuiltins\neval\n(S'1'\ntR.",
    "system": b"cos\nsystem\n(X\x04\x00\x00\x00truetR.",
    "numpy load": b"\x80\x04\x8c\x05numpy\x8c\x04load\x93.",
    "numpy f2py": b"\x80\x04cnumpy.testing._private.utils\nrunstring\n.",
    "attribute": b"\x80\x04\x8c\x05numpy\x8c\x0fndarray.__class__\x93.",
    "instance": b"(inumpy\nndarray\n.",
    "object": b"(cnumpy\nndarray\no.",
    "new object": b"\x80\x04cnumpy\nndarray\n)\x81.",
    "persistent": b"P1\n.",
    "extension": b"\x80\x02\x82\x01.",
    "class alone": b"\x80\x04cnumpy\nndarray\n.",
    "array of a class": b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\ndtype\ntR.",
    "type by name": b"\x80\x04cnumpy\ndtype\n\x8c\x05ctype\x85R.",
    "unset array": b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85C\x01btR.",
    "state of a list": b"\x80\x04]}b.",
    "key of a list": b"\x80\x04}K\x01K\x02s.",
    "mark out of place": b"\x80\x04K\x01(.",
    "empty": b".",
    "no end": b"\x80\x04K\x01",
    "nothing": b"",
}


@pytest.mark.parametrize("name", GLOBALS)
def test_whatever_is_not_plain_is_refused(name):
    with pytest.raises(DataError):
        read_pickle(GLOBALS[name])


def test_a_pickle_cannot_ask_for_memory_or_time():
    # A memo index of four thousand million makes the interpreter's own reader allocate 32 GB.
    assert read_pickle(b"\x80\x04K\x01r\xff\xff\xff\xff.") == 1
    # A string longer than the file.
    with pytest.raises(DataError):
        read_pickle(b"\x80\x04\x8e" + struct.pack("<Q", 2**40) + b"abc.")
    # An array larger than its content.
    huge = pickle.dumps(np.zeros(3), 4).replace(b"K\x03\x85", b"J\xff\xff\xff\x7f\x85")
    assert "BININT" in [op.name for op, _, _ in pickletools.genops(huge)]
    with pytest.raises(DataError, match="another amount of content"):
        read_pickle(huge)
    # Lists of lists of the same list: ten to the twelfth entries where each is copied.
    nested = b"\x80\x04]\x94"
    for level in range(12):
        nested += b"](" + b"h" + bytes([level]) + (b"h" + bytes([level])) * 9 + b"e\x94"
    assert len(read_pickle(nested + b".")) == 10
    # A list that holds itself, and a tuple in a tuple without end.
    for deep in (b"\x80\x04]\x94h\x00a.", b"\x80\x04)" + b"\x85" * 20_000 + b"."):
        with pytest.raises(DataError, match="deep"):
            read_pickle(deep)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda arrays: arrays.pop("poses"),
        lambda arrays: arrays.update(poses=arrays["poses"][:-1]),
        lambda arrays: arrays.update(poses=np.array(3.0)),
    ],
)
@pytest.mark.parametrize("bare", [False, True])
def test_an_index_of_another_form_is_counted(merged, indexed, spoil, bare):
    arrays = info_arrays(*merged[1][:2], image=PATHS[2][0], depth=PATHS[2][1])
    write_info(indexed / "0001_good.npz", arrays)
    spoil(arrays)
    write_info(indexed / "0001_bad.npz", arrays, bare=bare)
    scene, problems = read_one(indexed)
    assert (len(scene.frames), problems.summary()) == (3, "1 bad_scene_info")


def test_an_archive_that_unpacks_to_gigabytes_is_refused(tmp_path):
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, image_paths=np.zeros(2**16))
    data = bytearray(path.read_bytes())
    entry = data.index(b"PK\x01\x02")
    data[entry + 24 : entry + 28] = struct.pack("<I", 2**31)
    path.write_bytes(data)
    with pytest.raises(DataError, match="unpacks to 2,147,483,648 bytes"):
        read_scene_info(path, Problems())
