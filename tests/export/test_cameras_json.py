import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l3r.errors import DataError
from l3r.export.cameras_json import read_cameras, write_cameras
from l3r.geometry.rigid import rigid_from_parts
from l3r.types import Cameras

REAL = Path(__file__).parents[2] / ".." / "shared" / "data" / "scenes"


def assert_equal_cameras(a, b):
    assert a.file == b.file
    assert a.image_size == b.image_size
    assert torch.equal(a.registered, b.registered)
    assert torch.equal(a.component, b.component)
    torch.testing.assert_close(a.cam_from_world, b.cam_from_world, rtol=0, atol=0, equal_nan=True)
    known = a.K.isfinite().flatten(1).all(1)
    assert torch.equal(a.K[known], b.K[known])


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.lists(
        st.text(st.characters(exclude_categories=["Cs"]), min_size=1), unique=True, max_size=5
    ),
    st.integers(0, 999),
)
def test_what_is_written_is_read_back_exactly(tmp_path, files, seed):
    rng = np.random.default_rng(seed)
    n = len(files)
    registered = torch.from_numpy(rng.random(n) < 0.7)
    R = torch.from_numpy(Rotation.random(n, rng=rng).as_matrix().reshape(n, 3, 3))
    cam_from_world = rigid_from_parts(R, torch.from_numpy(rng.normal(size=(n, 3)) * 1e3))
    cam_from_world[~registered] = torch.nan
    K = torch.eye(3).double().repeat(n, 1, 1)
    K[:, 0, 0] = torch.from_numpy(rng.uniform(1, 5000, n))
    cameras = Cameras(
        file=files,
        image_size=[(int(h), int(w)) for h, w in rng.integers(1, 9000, (n, 2))],
        K=K,
        cam_from_world=cam_from_world,
        registered=registered,
        component=torch.from_numpy(rng.integers(0, 3, n)),
    )
    write_cameras(tmp_path / "cameras.json", cameras)
    assert_equal_cameras(read_cameras(tmp_path / "cameras.json"), cameras)


def test_the_file_holds_what_the_documentation_says(tmp_path, scene_with_a_loss):
    write_cameras(tmp_path / "c.json", scene_with_a_loss.cameras)
    loaded = json.loads((tmp_path / "c.json").read_text())
    assert (loaded["version"], loaded["pixel_center"]) == (1, 0.5)
    first, lost = loaded["images"][0], loaded["images"][2]
    assert (first["width"], first["height"]) == (160, 120)
    assert first["K"][0][2] == 80.0
    assert np.shape(first["cam_from_world"]) == (3, 4)
    assert lost["cam_from_world"] is lost["K"] is None
    assert lost["registered"] is False
    assert_equal_cameras(read_cameras(tmp_path / "c.json"), scene_with_a_loss.cameras)


def test_a_registered_camera_that_is_nan_is_not_written(tmp_path, scene_with_a_loss):
    cameras = scene_with_a_loss.cameras
    lying = replace(cameras, registered=torch.ones_like(cameras.registered))
    with pytest.raises(DataError, match=r"ring_002.jpg.*not finite"):
        write_cameras(tmp_path / "c.json", lying)
    assert not list(tmp_path.iterdir())


OLDER = {
    "file": "images/a.jpg",
    "width": 8,
    "height": 6,
    "K": [[5, 0, 3.5], [0, 5, 2.5], [0, 0, 1]],
    "T_world_to_cam": np.eye(4).tolist(),
    "source": "somewhere",
}


def test_the_older_form_gets_half_a_pixel(tmp_path):
    (tmp_path / "c.json").write_text(json.dumps([OLDER]))
    cameras = read_cameras(tmp_path / "c.json")
    assert cameras.K[0, :2, 2].tolist() == [4.0, 3.0]
    assert cameras.image_size == [(6, 8)]
    assert cameras.registered.all()


def valid():
    image = {k: OLDER[k] for k in ("file", "width", "height", "K")}
    image |= {"cam_from_world": np.eye(4)[:3].tolist(), "registered": True, "component": 0}
    return {"version": 1, "pixel_center": 0.5, "images": [image]}


def broken(key, value):
    loaded = valid()
    loaded["images"][0][key] = value
    return json.dumps(loaded)


MIRROR = np.diag([1.0, 1, -1, 1])[:3].tolist()
SCALED = np.diag([2.0, 2, 2, 1])[:3].tolist()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not valid JSON"),
        (json.dumps(valid())[:-20], "not valid JSON"),
        ("[" * 100_000, "not valid JSON"),
        ("{}", "no 'version'"),
        ("3", "no 'version'"),
        (json.dumps(valid() | {"version": 2}), "version 2, expected 1"),
        (json.dumps(valid() | {"pixel_center": 0.0}), "pixel_center is 0.0"),
        (json.dumps(valid() | {"images": None}), "'images' is not a list"),
        (json.dumps(valid() | {"images": [7]}), "not an object"),
        (json.dumps(valid() | {"images": valid()["images"] * 2}), "appears twice"),
        (broken("file", 3), "'file' is 3"),
        (broken("width", 0), "'width' is 0"),
        (broken("height", 2.5), "'height' is 2.5"),
        (broken("K", [[1, 2], [3, 4]]), "'K' is 2x2, expected 3x3"),
        (broken("K", [[1], [3, 4]]), "'K' is not a matrix"),
        (broken("K", None), "'K' is not a matrix"),
        (broken("K", [[0, 0, 0], [0, 1, 0], [0, 0, 1]]), "fx, fy > 0"),
        (broken("cam_from_world", np.eye(3).tolist()), "is 3x3, expected 3x4 or 4x4"),
        (broken("cam_from_world", [[float("nan")] * 4] * 3), "NaN or infinity"),
        (broken("cam_from_world", MIRROR), "not a rigid transform"),
        (broken("cam_from_world", SCALED), "not a rigid transform"),
        (broken("cam_from_world", (2 * np.eye(4) - np.eye(4) + np.eye(4, k=-3)).tolist()), "rigid"),
        (broken("cam_from_world", None), "'cam_from_world' is not a matrix"),
        (broken("registered", "yes"), "'registered' is 'yes'"),
        (broken("registered", False), "not registered, yet"),
        (broken("component", None), "'component' is None"),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path, text, message):
    path = tmp_path / "cameras.json"
    path.write_text(text)
    with pytest.raises(DataError) as caught:
        read_cameras(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(DataError, match="No such file"):
        read_cameras(tmp_path / "cameras.json")


@pytest.mark.skipif(not REAL.is_dir(), reason="real scenes not at ../shared/data/scenes")
def test_real_scenes_are_read():
    files = sorted(REAL.glob("*/cameras.json"))
    for file in files:
        cameras = read_cameras(file)
        assert len(cameras.file) > 1
        height, width = cameras.image_size[0]
        # Within the photo, and after the shift at least half a pixel from its corner.
        assert 0.5 < cameras.K[0, 0, 2] < width
        assert 0.5 < cameras.K[0, 1, 2] < height
