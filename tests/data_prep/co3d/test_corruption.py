"""Damaged files of every format: an error in one line, a counted problem, or a right sample."""

import time

import numpy as np
import pytest

from data_prep.converters.co3d import Options, read, survey
from data_prep.converters.co3d.frames import Needs
from data_prep.problems import Problems
from l3r.errors import DataError
from tests.data_prep.co3d.writer import Recipe, write_category, write_lists, write_sequence
from tests.data_prep.mutations import NUM_ALL, NUM_QUICK, mutate, seeds

SIZE = (32, 24)
FILES = {
    "frame annotations": "apple/frame_annotations.jgz",
    "sequence annotations": "apple/sequence_annotations.jgz",
    "set lists": "apple/set_lists/set_lists_fewview_train.json",
    "held-out lists": "apple/set_lists/set_lists_fewview_dev.json",
    "image": "apple/a/images/frame000004.jpg",
    "depth": "apple/a/depths/frame000004.jpg.geometric.png",
    "depth mask": "apple/a/depth_masks/frame000004.png",
    "mask": "apple/a/masks/frame000004.png",
}
CHECKED = {"frame annotations", "sequence annotations", "depth", "depth mask", "mask"}
"""Formats with checksums: what is read of them at all equals what was written."""
WITH_MASKS = Options(needs=Needs(min_foreground=0.1))
MAX_SECONDS = 10.0


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("damage")
    records = write_sequence(root, Recipe(sequence="a", image_size=SIZE, count=2))
    held = write_sequence(root, Recipe(sequence="h", image_size=(16, 16), count=2))
    write_category(root, records + held)
    # Only the other list keeps the second sequence from being trained on.
    write_lists(root, "fewview_train", train=records + held)
    write_lists(root, "fewview_dev", test=held)
    return root


def samples(root):
    """Read all there is: scene and frame -> (K, world_from_cam, image, depth), or the error."""
    found, message = {}, ""
    try:
        for scene in read(root, problems=Problems(quiet=True), options=WITH_MASKS):
            for frame in scene.frames:
                try:
                    pixels = frame.read_image(), frame.read_depth()
                except DataError as error:
                    pixels = str(error)
                found[scene.name, frame.name] = frame, pixels
    except DataError as error:
        message = str(error)
    assert "\n" not in message
    return found


def check_sample(frame, pixels, pristine, *, exact):
    """Check that a sample is one, and the very one where checksums vouch for it."""
    rotation = frame.world_from_cam[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.isfinite(frame.K).all()
    if isinstance(pixels, str):
        assert "\n" not in pixels
        return
    image, depth = pixels
    assert image.shape == (*frame.image_size, 3)
    assert depth.shape == frame.image_size
    assert np.isfinite(depth).all()
    assert depth.min() >= 0
    if exact:
        original, (original_image, original_depth) = pristine
        np.testing.assert_array_equal(frame.K, original.K)
        np.testing.assert_array_equal(frame.world_from_cam, original.world_from_cam)
        np.testing.assert_array_equal(depth, original_depth)
        np.testing.assert_array_equal(image, original_image)


def try_damages(root, name, count):
    pristine = samples(root)
    assert len(pristine) == 2
    path = root / FILES[name]
    data = path.read_bytes()
    outcomes = {"lost": 0, "refused late": 0, "read": 0}
    try:
        for seed in seeds(count):
            path.write_bytes(mutate(data, seed))
            start = time.perf_counter()
            found = samples(root)
            list(survey(root))
            assert time.perf_counter() - start < MAX_SECONDS, seed
            assert set(found) <= set(pristine), "held-out frames, or frames of nothing"
            for key, (frame, pixels) in found.items():
                check_sample(frame, pixels, pristine[key], exact=name in CHECKED)
            late = any(isinstance(pixels, str) for _, pixels in found.values())
            whole = len(found) == len(pristine)
            outcomes["refused late" if late else "read" if whole else "lost"] += 1
    finally:
        path.write_bytes(data)
    assert outcomes["read"] < count, "no damage was ever noticed"
    assert len(samples(root)) == 2


@pytest.mark.parametrize("name", list(FILES))
def test_a_damaged_file_never_gives_a_wrong_sample(root, name):
    try_damages(root, name, NUM_QUICK)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(FILES))
def test_a_thousand_damages_never_give_a_wrong_sample(root, name):
    try_damages(root, name, NUM_ALL)
