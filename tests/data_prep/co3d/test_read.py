import copy
import pickle
import shutil
import struct

import numpy as np
import pytest

from data_prep.converters.co3d import Options, find_categories, read, survey
from data_prep.converters.co3d.frames import Needs
from data_prep.problems import Problems
from l3r.errors import DataError
from tests.data_prep.co3d.writer import (
    Recipe,
    half_png,
    jpeg,
    png,
    put,
    write_category,
    write_lists,
    write_sequence,
)
from tests.data_prep.naming import assert_scenes_are_named_before_they_are_read

BASE = "apple/110_13051_23361"
IMAGE, DEPTH = f"{BASE}/images/frame000004.jpg", f"{BASE}/depths/frame000004.jpg.geometric.png"
VALID, MASK = f"{BASE}/depth_masks/frame000004.png", f"{BASE}/masks/frame000004.png"


def test_a_sequence_is_a_scene_whose_pixels_are_read_when_asked_for(root, scene_of):
    scene = scene_of(root)
    assert (scene.dataset, scene.name, scene.is_metric) == ("co3d", BASE, False)
    assert scene.slug == "apple-110_13051_23361"
    assert [frame.name for frame in scene.frames] == [f"frame{n:06d}.jpg" for n in (1, 4, 7, 10)]
    shutil.rmtree(root / BASE / "images")
    with pytest.raises(DataError, match=r"frame000001\.jpg"):
        scene.frames[0].read_image()
    frame = pickle.loads(pickle.dumps(scene.frames[1]))
    assert frame.read_depth().shape == frame.image_size == (128, 96)
    assert frame.world_from_cam.dtype == frame.K.dtype == np.float64


def replace_by_folder(path):
    path.unlink()
    path.mkdir()


def inflate(path):
    """Write a size into a JPEG's header that nobody could unpack."""
    data = bytearray(path.read_bytes())
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", 9000, 9000)
    path.write_bytes(data)


def redact(root):
    put(root, IMAGE, jpeg(np.zeros((128, 96, 3), np.uint8)))
    (root / DEPTH).unlink()


HTML = b"<html>not found</html>"
SPOILED = {
    "image missing": ("missing_image", lambda root: (root / IMAGE).unlink()),
    "depth missing": ("missing_depth", lambda root: (root / DEPTH).unlink()),
    "depth mask missing": ("missing_mask", lambda root: (root / VALID).unlink()),
    "a folder for an image": ("missing_image", lambda root: replace_by_folder(root / IMAGE)),
    "image empty": ("bad_image", lambda root: put(root, IMAGE, b"")),
    "image no JPEG": ("bad_image", lambda root: put(root, IMAGE, HTML)),
    "depth no PNG": ("bad_depth", lambda root: put(root, DEPTH, HTML)),
    "image of another size": (
        "size_mismatch",
        lambda root: put(root, IMAGE, jpeg(np.full((96, 128, 3), 90, np.uint8))),
    ),
    "depth of another size": (
        "size_mismatch",
        lambda root: put(root, DEPTH, half_png(np.ones((64, 48)))),
    ),
    "depth mask of another size": (
        "size_mismatch",
        lambda root: put(root, VALID, png(np.ones((64, 48)), 8)),
    ),
    "image that claims to be huge": ("size_mismatch", lambda root: inflate(root / IMAGE)),
    "redacted": ("redacted", redact),
    "no depth at all": (
        "empty_depth",
        lambda root: put(root, DEPTH, half_png(np.zeros((128, 96)))),
    ),
}
"""What happened to the second frame: name of the problem, and the deed."""


@pytest.mark.parametrize("name", list(SPOILED))
def test_a_frame_that_lacks_something_is_counted_and_the_rest_kept(root, scene_of, problems, name):
    kind, deed = SPOILED[name]
    deed(root)
    assert len(scene_of(root).frames) == 3
    assert problems.counts == {kind: 1}
    assert "frame000004" in problems.first[kind].where


def repeat_scans(path):
    data = jpeg(np.full((128, 96, 3), 90, np.uint8), progressive=True)
    at = data.rindex(b"\xff\xda")
    path.write_bytes(data[:at] + 200 * data[at:-2] + data[-2:])


LATE = {
    "cut off": lambda path: path.write_bytes(path.read_bytes()[:-100]),
    "of endless scans": repeat_scans,
    "swapped for a larger one": inflate,
    "gone": lambda path: path.unlink(),
}
"""What happens to an image after its header was found good."""


@pytest.mark.parametrize("name", list(LATE))
def test_images_found_broken_late_are_refused_in_one_line(root, scene_of, name):
    frame = scene_of(root).frames[1]
    LATE[name](root / IMAGE)
    with pytest.raises(DataError, match=r"frame000004\.jpg: ") as error:
        frame.read_image()
    assert "\n" not in str(error.value)


def test_a_tag_that_asks_for_rotation_is_ignored_since_cameras_refer_to_what_is_stored(
    root, scene_of
):
    tones = np.full((128, 96, 3), (250, 120, 10), np.uint8)
    tones[64:] = 0
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    put(root, IMAGE, jpeg(tones, exif=exif))
    image = scene_of(root).frames[1].read_image()
    np.testing.assert_allclose(image[30, 48], [250, 120, 10], atol=3)
    assert image[80:].max() < 20


def change(records, number, **parts):
    records = copy.deepcopy(records)
    for key, value in parts.items():
        if isinstance(value, dict):
            records[number][key] |= value
        else:
            records[number][key] = value
    return records


@pytest.mark.parametrize(
    ("parts", "kind"),
    [
        ({"depth": None}, "missing_depth"),
        ({"viewpoint": None}, "no_camera"),
        ({"viewpoint": {"R": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}}, "bad_pose"),
        ({"viewpoint": {"R": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}}, "bad_pose"),
        ({"viewpoint": {"T": [float("nan"), 0, 0]}}, "bad_pose"),
        ({"viewpoint": {"T": [float("inf"), 0, 0]}}, "bad_pose"),
        ({"viewpoint": {"T": [10**400, 0, 0]}}, "bad_pose"),
        ({"viewpoint": {"intrinsics_format": "pixels"}}, "bad_camera"),
        ({"viewpoint": {"focal_length": [float("nan"), 2]}}, "bad_camera"),
        ({"viewpoint": {"principal_point": [9, 0]}}, "bad_camera"),
        ({"image": {"path": "../secret.jpg"}}, "unsafe_path"),
        ({"image": {"path": "/etc/hostname"}}, "unsafe_path"),
        ({"depth": {"path": "apple/../../secret.png"}}, "unsafe_path"),
        ({"depth": {"mask_path": "apple\\..\\..\\secret.png"}}, "unsafe_path"),
        ({"mask": {"path": "../secret.png"}}, "unsafe_path"),
        ({"image": {"path": 7}}, "bad_record"),
        ({"image": {"size": [128]}}, "bad_record"),
        ({"frame_number": 0}, "duplicate_frame"),
        ({"image": {"path": f"{BASE}/images/frame000001.jpg"}}, "duplicate_frame"),
    ],
)
def test_an_annotation_that_lacks_something_is_counted_and_the_rest_kept(
    root, written, scene_of, problems, parts, kind
):
    records = change(written[1], 1, **parts)
    write_category(root, records, lists=False)
    assert len(scene_of(root, "all").frames) == 3
    assert problems.counts == {kind: 1}


def test_a_sequence_gone_astray_is_left_out_whole(root, written):
    other = write_sequence(root, Recipe(sequence="other", image_size=(16, 16)))
    records = change(written[1], 2, viewpoint={"T": [8e16, 0, 0]})
    write_category(root, records + other)
    problems = Problems()
    assert [scene.name for scene in read(root, problems=problems)] == ["apple/other"]
    assert problems.counts == {"corrupt_sequence": 1}


def test_depth_and_masks_may_be_asked_for_or_not(root, written, problems):
    records = change(written[1], 1, depth=None)
    records = change(records, 2, mask=None)
    write_category(root, records)

    def scene(**needs):
        (found,) = read(root, problems=problems, options=Options(needs=Needs(**needs)))
        return {frame.name[-6:-4]: frame.read_depth() for frame in found.frames}

    assert set(scene()) == {"01", "07", "10"}
    assert set(scene(min_foreground=0.5)) == {"01", "10"}
    (root / BASE / "depths" / "frame000010.jpg.geometric.png").unlink()
    free = scene(depth=False)
    assert set(free) == {"01", "04", "07", "10"}
    assert not free["04"].any()
    assert not free["10"].any()
    assert free["01"].any()
    # The foreground grows from the left to the right, and depth is valid but for the first quarter.
    columns = [np.flatnonzero(scene(min_foreground=m)["01"].any(0))[0] for m in (0.0, 0.5, 0.9)]
    assert columns[0] == 24
    assert columns[1:] == [pytest.approx(0.5 * 95, abs=1), pytest.approx(0.9 * 95, abs=1)]


def test_categories_that_match_nothing_are_not_parsed(root, written, problems):
    pear = write_sequence(root, Recipe(category="pear", sequence="x", image_size=(16, 16)))
    write_category(root, pear, category="pear")
    (root / "pear" / "frame_annotations.jgz").write_bytes(b"damaged")
    for split in ("train", "all"):
        (scene,) = read(root, split, scenes="apple/*", problems=problems)
        assert scene.name == BASE
    assert not problems.counts


def test_a_damaged_category_is_counted_and_the_others_read(root, problems):
    pear = write_sequence(root, Recipe(category="pear", sequence="x", image_size=(16, 16)))
    write_category(root, pear, category="pear")
    path = root / "apple" / "frame_annotations.jgz"
    path.write_bytes(path.read_bytes()[:-3])
    assert [scene.name for scene in read(root, problems=problems)] == ["pear/x"]
    assert problems.counts == {"bad_annotations": 1}
    assert problems.first["bad_annotations"].detail.startswith("no whole gzip file")


def test_frames_go_by_number_whatever_their_order_in_the_file(root, written, problems):
    write_category(root, [written[1][n] for n in (2, 0, 3, 1)])
    (scene,) = read(root, frame_step=2, problems=problems)
    assert [frame.name for frame in scene.frames] == ["frame000001.jpg", "frame000007.jpg"]


def test_a_folder_without_categories_is_refused_and_the_parent_named(root, tmp_path):
    for folder, hint in ((root / "apple", f"name {root}"), (tmp_path, "check the folder")):
        with pytest.raises(DataError, match="no CATEGORY/frame_annotations") as error:
            list(read(folder, problems=Problems()))
        assert hint in str(error.value)
    with pytest.raises(DataError, match="no such folder"):
        list(survey(tmp_path / "absent"))


def test_a_pattern_that_matches_nothing_is_refused(root):
    with pytest.raises(DataError, match=r"no sequence of 1 categories \(apple, \.\.\.\)"):
        list(read(root, scenes="pear/*", problems=Problems()))


def test_companions_a_mac_leaves_are_ignored(root, scene_of):
    put(root, "._apple/frame_annotations.jgz", b"\0\5\26\7")
    put(root, "apple/set_lists/._set_lists_fewview_dev.json", b"\0\5\26\7")
    put(root, f"{BASE}/images/._frame000001.jpg", b"\0\5\26\7")
    assert [path.name for path in find_categories(root)] == ["apple"]
    assert len(scene_of(root).frames) == 4
    (line,) = survey(root)
    assert (line.num_images, line.num_missing) == (4, 0)


def test_missing_files_show_in_the_survey(root, written):
    (root / DEPTH).unlink()
    (root / VALID).unlink()
    write_lists(root, "fewview_dev", test=written[1][:1])
    (line,) = survey(root)
    assert (line.num_images, line.num_missing, line.image_size) == (3, 1, (128, 96))
    assert line.excluded == "held out for testing"


@pytest.mark.parametrize("split", ["train", "all"])
def test_sequences_are_named_before_they_are_read(root, written, split):
    records = [*written[1], *write_sequence(root, Recipe(sequence="111_1_1"))]
    write_category(root, records)
    (root / f"{BASE}/images/frame000004.jpg").unlink()
    names = assert_scenes_are_named_before_they_are_read("co3d", root, split)
    assert names == [BASE, "apple/111_1_1"]
