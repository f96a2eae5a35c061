"""Damaged files of MegaDepth's own formats; COLMAP's and photos are in the folder's tests."""

import shutil
import time

import cv2
import numpy as np
import pytest

from data_prep.converters.megadepth import read
from data_prep.problems import Problems
from l3r.errors import DataError
from tests.data_prep.folder.test_corruption import check_camera, check_message, check_pixels
from tests.data_prep.megadepth.writers import (
    info_arrays,
    write_depth,
    write_info,
    write_merged,
)
from tests.data_prep.mutations import NUM_ALL, NUM_QUICK, mutate, seeds

LONGEST = 5.0

FORMATS = {
    "depth.h5": "model/0001/dense0/depths/1_photo_o.h5",
    "info.npz": "info/0001_0.1_0.3.npz",
    "bare.npz": "bare/0001_0.1_0.3.npz",
}


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    """Small scenes of every format, their images reduced to thumbnails to be quick."""
    root = tmp_path_factory.mktemp("pristine")
    names, pinholes, _ = write_merged(root / "model", "0001", count=2)
    dense = root / "model" / "0001" / "dense0"
    for name, pinhole in zip(names, pinholes, strict=True):
        image = cv2.imread(str(dense / "imgs" / name))
        small = cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
        # MegaDepth's images are JPEG; the decoder looks at the content, the name stays.
        done, data = cv2.imencode(".jpg", small)
        assert done
        (dense / "imgs" / name).write_bytes(data.tobytes())
        write_depth(dense / "depths" / name.replace(".png", ".h5"), np.full(small.shape[:2], 2.5))
        scale_x, scale_y = np.divide(small.shape[1::-1], (pinhole.width, pinhole.height))
        pinhole.rescale(*small.shape[1::-1])
        assert abs(scale_x / scale_y - 1) < 0.02
    for kind in ("info", "bare"):
        shutil.copytree(dense, root / kind / "0001" / "dense0")
        image, depth = "0001/dense0/imgs/{}", "0001/dense0/depths/{}"
        arrays = info_arrays(names, pinholes, image=image, depth=depth)
        write_info(root / kind / "0001_0.1_0.3.npz", arrays, bare=kind == "bare")
    return root


def read_soundly(root):
    found, problems = {}, Problems(quiet=True)
    try:
        for scene in read(root, problems=problems):
            for frame in scene.frames:
                check_camera(frame)
                found[frame.name] = check_pixels(frame)
            if scene.read_overlap is not None:
                overlap = scene.read_overlap().toarray()
                assert (overlap.diagonal() == 1).all()
                assert ((overlap >= 0) & (overlap <= 1)).all()
    except DataError as error:
        check_message(error)
        problems.add("nothing_left", root, str(error))
    return found, problems


def damage(pristine, tmp_path, name, count):
    where = FORMATS[name]
    top = where.split("/")[0]
    root = tmp_path / top
    shutil.copytree(pristine / top, root)
    whole, problems = read_soundly(root)
    assert (len(whole), problems.summary()) == (2, "none")
    data = (pristine / where).read_bytes()
    noticed = 0
    for seed in seeds(count):
        (tmp_path / where).write_bytes(mutate(data, seed))
        start = time.process_time()
        found, problems = read_soundly(root)
        assert time.process_time() - start < LONGEST, seed
        noticed += bool(problems.counts) or None in found.values()
    return noticed


@pytest.mark.parametrize("name", FORMATS)
def test_damage_is_counted_and_never_crashes(pristine, tmp_path, name):
    assert damage(pristine, tmp_path, name, NUM_QUICK) > NUM_QUICK // 5


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_a_thousand_damages_never_crash(pristine, tmp_path, name):
    damage(pristine, tmp_path, name, NUM_ALL)
