import shutil
from dataclasses import fields

import numpy as np
import pytest

from data_prep.converters.co3d import read
from data_prep.converters.co3d.annotations import Viewpoint
from data_prep.converters.co3d.cameras import K_from_viewpoint, is_corrupt, world_from_viewpoint
from data_prep.problems import Problems
from l3r.errors import DataError
from tests.data_prep.co3d import mistakes
from tests.data_prep.co3d.writer import Recipe, orbit, viewpoint, write_category, write_sequence

GENUINE = Viewpoint(
    R=(
        (-0.9983327388763428, -0.007844997569918633, -0.05718603357672691),
        (0.007174402941018343, -0.9999032020568848, 0.011922439560294151),
        (-0.05727402865886688, 0.011492285877466202, 0.9982923269271851),
    ),
    T=(-0.880431592464447, 5.909038543701172, 10.833968162536621),
    focal_length=(2.300013542175293, 2.300013542175293),
    principal_point=(-0.002087682718411088, -0.002087682718411088),
    intrinsics_format="ndc_isotropic",
)
"""Frame 1 of apple/110_13051_23361, 640 high and 479 wide."""


def as_dict(viewpoint):
    return {field.name: getattr(viewpoint, field.name) for field in fields(Viewpoint)}


def parsed(raw):
    tuples = {key: tuple(raw[key]) for key in ("T", "focal_length", "principal_point")}
    return Viewpoint(**{**raw, **tuples, "R": tuple(map(tuple, raw["R"]))})


@pytest.fixture(scope="module")
def scaled(tmp_path_factory, agreement):
    """Root, annotations and clean disagreement of depth of a sequence with a scale of 1.7."""
    root = tmp_path_factory.mktemp("scaled")
    records = write_sequence(root, Recipe(scale=1.7))
    write_category(root, records)
    (scene,) = read(root, problems=Problems())
    return root, records, agreement(scene)[1]


@pytest.mark.parametrize("unit", ["ndc_isotropic", "ndc_norm_image_bounds"])
@pytest.mark.parametrize("image_size", [(128, 96), (96, 128)])
def test_frames_agree_in_both_units_upright_and_lying(
    tmp_path, scene_of, agreement, unit, image_size
):
    recipe = Recipe(unit=unit, image_size=image_size, count=3)
    write_category(tmp_path, write_sequence(tmp_path, recipe))
    pixels, depth, share = agreement(scene_of(tmp_path))
    assert pixels < 0.05
    assert depth < 0.0004
    assert share > 0.5


PLANTED = {
    "half a pixel": (mistakes.half_a_pixel, 4),
    "image bounds for isotropic": (mistakes.other_unit, 15),
    "no unit for isotropic": (mistakes.no_unit, 15),
    "column vectors": (mistakes.column_vectors, 50),
    "a flip too many": (mistakes.opencv_axes, 50),
    "principal point mirrored": (mistakes.mirrored_principal_point, 20),
    "unit of the longer side": (mistakes.width_before_height, 40),
    "scale forgotten": (mistakes.scale_forgotten, 50),
}
"""Change of every record, and how many times more depth then disagrees at least."""


@pytest.mark.parametrize("name", list(PLANTED))
def test_a_planted_mistake_is_seen_by_reprojection(scaled, scene_of, agreement, name, tmp_path):
    root, records, clean = scaled
    change, times = PLANTED[name]
    shutil.copytree(root, tmp_path / "root")
    mistakes.plant(tmp_path / "root", records, change)
    _, depth, _ = agreement(scene_of(tmp_path / "root"))
    assert depth > times * clean


def test_frames_written_in_bounds_but_read_as_isotropic_disagree(tmp_path, scene_of, agreement):
    records = write_sequence(tmp_path, Recipe(unit="ndc_norm_image_bounds", count=3))
    write_category(tmp_path, records)
    assert agreement(scene_of(tmp_path))[1] < 0.0004
    mistakes.plant(tmp_path, records, mistakes.isotropic)
    assert agreement(scene_of(tmp_path))[1] > 0.003


def test_depth_is_wrong_where_its_mask_is_ignored(root, written, scene_of, agreement):
    _, _, clean = agreement(scene_of(root))
    mistakes.plant(root, written[1], lambda record: record["depth"].update(mask_path=None))
    _, _, share = agreement(scene_of(root))
    assert clean > 0.6
    assert share < 0.85 * clean


def test_a_genuine_camera_becomes_pixels():
    K = K_from_viewpoint(GENUINE, (640, 479))
    # 2.300013542 half sides of 239.5 pixels; half a pixel right of and below the middle, where it
    # lies in an image of 641x480 that lost its last row and column.
    np.testing.assert_allclose(K, [[550.853, 0, 240], [0, 550.853, 320.5], [0, 0, 1]], atol=1e-3)
    bounds = Viewpoint(**{**as_dict(GENUINE), "intrinsics_format": "ndc_norm_image_bounds"})
    np.testing.assert_allclose(
        np.diag(K_from_viewpoint(bounds, (640, 479)))[:2], [550.853, 736.004], atol=1e-3
    )


def test_the_genuine_camera_sees_what_the_formula_says():
    world_from_cam = world_from_viewpoint(GENUINE)
    np.testing.assert_allclose(
        world_from_cam[:3, :3] @ world_from_cam[:3, :3].T, np.eye(3), atol=1e-14
    )
    assert np.linalg.det(world_from_cam[:3, :3]) == pytest.approx(1)
    point = np.array([0.3, -0.7, 1.9])
    left, up, forward = point @ np.array(GENUINE.R) + GENUINE.T
    right, down, ahead = (np.linalg.inv(world_from_cam) @ [*point, 1])[:3]
    np.testing.assert_allclose([right, down, ahead], [-left, -up, forward], atol=1e-6)


@pytest.mark.parametrize("image_size", [(128, 96), (96, 128)])
def test_what_was_written_in_pixels_is_read_in_pixels(image_size):
    (camera,) = orbit(1, image_size)
    for unit in ("ndc_isotropic", "ndc_norm_image_bounds"):
        K = K_from_viewpoint(parsed(viewpoint(camera, image_size, unit)), image_size)
        np.testing.assert_allclose([K[0, 0], K[1, 1]], camera.focal)
        np.testing.assert_allclose(K[:2, 2], camera.principal)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"intrinsics_format": "pixels"}, "expected ndc_isotropic"),
        ({"focal_length": (2.3, 0.0)}, "fx, fy > 0"),
        ({"focal_length": (-2.3, 2.3)}, "fx, fy > 0"),
        ({"principal_point": (1.01, 0.0)}, "outside an image"),
    ],
)
def test_intrinsics_no_camera_has_are_refused(change, message):
    with pytest.raises(DataError, match=message):
        K_from_viewpoint(Viewpoint(**{**as_dict(GENUINE), **change}), (640, 479))


@pytest.mark.parametrize(
    "R",
    [
        np.eye(3) * 1.01,
        np.diag([1.0, 1.0, -1.0]),
        np.zeros((3, 3)),
        np.eye(3) * 1e300,
        np.array([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]),
    ],
)
def test_what_is_no_rotation_is_refused(R):
    rows = tuple(map(tuple, R.tolist()))
    with pytest.raises(DataError, match="not rigid"):
        world_from_viewpoint(Viewpoint(**{**as_dict(GENUINE), "R": rows}))


def test_a_translation_beyond_belief_marks_a_corrupt_reconstruction():
    assert not is_corrupt(GENUINE)
    assert is_corrupt(Viewpoint(**{**as_dict(GENUINE), "T": (0.0, -9e4, 2e4)}))
