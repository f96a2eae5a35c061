import cv2
import numpy as np
import pytest

from data_prep.converters.waymo.lens import distort, undistort_image, undistorted_K
from l3r.errors import DataError
from tests.data_prep.waymo import drive

GENUINE = (2044.508, 2044.508, 949.575, 633.242, 0.04036, -0.33002, 0.00104, -0.00157, 0.0)
SIZE = (1280, 1920)
BULGING = (900.0, 900.0, 960.0, 640.0, 0.12, -0.02, 0.0, 0.0, 0.0)


def grid(step=20):
    x, y = np.meshgrid(np.linspace(-0.45, 0.45, step), np.linspace(-0.3, 0.3, step))
    return np.stack([x, y], -1)


def test_distortion_is_that_of_opencv_with_pixels_counted_from_the_corner():
    lens = (*GENUINE[:8], 0.05)
    K = np.array([[lens[0], 0, lens[2] - 0.5], [0, lens[1], lens[3] - 0.5], [0, 0, 1]])
    rays = np.dstack([grid(), np.ones((20, 20))]).reshape(-1, 1, 3)
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(lens[4:]))
    pts2d, valid = distort(grid(), lens)
    np.testing.assert_allclose(pts2d.reshape(-1, 2), expected[:, 0] + 0.5, atol=1e-9)
    assert valid.all()


def test_the_model_ends_where_waymos_own_does():
    _, valid = distort(np.array([[0.0, 0.0], [0.9, 0.9]]), GENUINE)
    assert valid.tolist() == [True, False]


@pytest.mark.parametrize("lens", [GENUINE, BULGING])
def test_every_undistorted_pixel_has_a_source_and_a_lesser_zoom_would_leave_some_empty(lens):
    K = undistorted_K(lens, SIZE)
    # Every seventh row and column, and the outermost ones.
    rows, columns = (np.append(np.arange(0, side, 7), side - 1) + 0.5 for side in SIZE)
    y, x = np.meshgrid(rows, columns, indexing="ij")

    def sources(zoom):
        rays = np.stack([(x - K[0, 2]) / (zoom * K[0, 0]), (y - K[1, 2]) / (zoom * K[1, 1])], -1)
        return distort(rays, lens)[0]

    def all_inside(pts2d):
        return bool(((pts2d > 0.499) & (pts2d < [SIZE[1] - 0.499, SIZE[0] - 0.499])).all())

    assert all_inside(sources(1.0))
    assert not all_inside(sources(0.999))
    assert K[0, 0] / K[1, 1] == lens[0] / lens[1]
    np.testing.assert_array_equal(K[:2, 2], lens[2:4])


def test_an_image_without_distortion_stays_as_it_is():
    lens = (100.0, 100.0, 96.0, 64.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    K = undistorted_K(lens, (128, 192))
    np.testing.assert_allclose(K, [[100, 0, 96], [0, 100, 64], [0, 0, 1]], rtol=1e-9)
    image = np.random.default_rng(0).integers(0, 256, (128, 192, 3), dtype=np.uint8)
    np.testing.assert_array_equal(undistort_image(image, lens, K), image)


def test_straight_lines_become_straight():
    lens = (*drive.LENS[:4], 0.1, -0.5, 0.004, -0.003, 0.0)
    K = undistorted_K(lens, (128, 192))
    v, u = np.mgrid[:128, :192] + 0.5
    x, y = drive.lens_backward(u, v, lens)
    ramp = 128 + 200 * x + 100 * y
    image = np.repeat(np.round(ramp)[..., None], 3, axis=2).clip(0, 255).astype(np.uint8)
    found = undistort_image(image, lens, K)[..., 0]
    expected = 128 + 200 * (u - K[0, 2]) / K[0, 0] + 100 * (v - K[1, 2]) / K[1, 1]
    error = found - expected
    # One pixel is 1 grey level: the bend of the stored lines is 5 of them at the corners.
    assert np.abs(error).max() < 1.2
    assert np.abs(image[..., 0] - expected).max() > 2.5


@pytest.mark.parametrize(
    "change",
    [{0: 0.0}, {1: -5.0}, {2: -1.0}, {2: 1e5}, {3: 2000.0}, {4: 30.0}, {5: -40.0}, {8: 1e9}],
)
def test_wild_lenses_are_refused(change):
    lens = list(GENUINE)
    for place, value in change.items():
        lens[place] = value
    with pytest.raises(DataError, match=r"no zoom of 0\.5 to 2\.0 undistorts it"):
        undistorted_K(tuple(lens), SIZE)
