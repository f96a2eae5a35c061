import shutil
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
import torch

from l3r.errors import DataError
from l3r.export.colmap import write_colmap
from l3r.export.colmap_read import read_colmap
from l3r.export.points import PointSelection
from l3r.types import Window
from tests.export.conftest import ring_scene

FEW = PointSelection(max_points=300)


@pytest.fixture
def model(tmp_path, scene_with_a_loss):
    folder = tmp_path / "sparse" / "0"
    write_colmap(folder, scene_with_a_loss, FEW)
    return folder


def test_pycolmap_reads_sizes_cameras_and_transforms(model, scene_with_a_loss):
    cameras = scene_with_a_loss.cameras
    read = pycolmap.Reconstruction(model)
    assert read.num_reg_images() == 5
    assert read.num_points3D() == 300
    for view in (0, 1, 3, 4, 5):
        image = read.find_image_with_name(cameras.file[view])
        camera = read.camera(image.camera_id)
        assert camera.model_name == "PINHOLE"
        assert (camera.height, camera.width) == cameras.image_size[view]
        np.testing.assert_allclose(camera.calibration_matrix(), cameras.K[view])
        np.testing.assert_allclose(
            image.cam_from_world().matrix(), cameras.cam_from_world[view, :3], atol=1e-12
        )
    assert read.find_image_with_name(cameras.file[2]) is None


def test_points_reproject_onto_their_observations(model, scene_with_a_loss):
    read = pycolmap.Reconstruction(model)
    worst = 0.0
    for image in read.images.values():
        assert image.num_points3D == 60
        for observation in image.points2D:
            point = read.point3D(observation.point3D_id)
            assert [e.image_id for e in point.track.elements] == [image.image_id]
            projected = image.camera.img_from_cam(image.cam_from_world() * point.xyz)
            worst = max(worst, float(np.abs(projected - observation.xy).max()))
    # The point maps are exact but for single precision.
    assert worst < 1e-3
    assert read.compute_mean_reprojection_error() < 1e-3


def test_points_have_the_colour_of_their_pixel(model, scene_with_a_loss):
    read = pycolmap.Reconstruction(model)
    image = read.image(1)
    for observation in image.points2D[:20]:
        x, y = observation.xy * [64 / 160, 48 / 120] - 0.5
        color = scene_with_a_loss.image[0][:, round(y), round(x)] * 255
        np.testing.assert_allclose(read.point3D(observation.point3D_id).color, color, atol=0.51)


def test_points_of_cut_photos_stay_on_the_pixels_of_the_whole_ones(tmp_path):
    """The network saw 80 x 60 px of 160 x 120, well off the middle."""
    scene = ring_scene(window=Window(left=50.5, top=8.0, width=80.0, height=60.0))
    write_colmap(tmp_path / "0", scene, FEW)
    read = pycolmap.Reconstruction(tmp_path / "0")
    assert read.num_points3D() == 300
    for view, image in read.images.items():
        for observation in image.points2D:
            point = read.point3D(observation.point3D_id)
            projected = image.camera.img_from_cam(image.cam_from_world() * point.xyz)
            np.testing.assert_allclose(projected, observation.xy, atol=1e-3)
            x, y = (observation.xy - [50.5, 8.0]) * [64 / 80, 48 / 60] - 0.5
            color = scene.image[view - 1][:, round(y), round(x)] * 255
            np.testing.assert_allclose(point.color, color, atol=0.51)
        assert (image.camera.width, image.camera.height) == (160, 120)


def test_the_same_reconstruction_gives_the_same_bytes(tmp_path, scene):
    for name in ("a", "b"):
        write_colmap(tmp_path / name, scene, FEW)
    for file in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_a_model_without_images_can_be_written(tmp_path, scene):
    cameras = replace(scene.cameras, registered=torch.zeros(6, dtype=torch.bool))
    assert write_colmap(tmp_path / "0", replace(scene, cameras=cameras)) == 0
    assert read_colmap(tmp_path / "0").file == []


@pytest.mark.parametrize("form", ["binary", "text"])
def test_read_colmap_gives_back_what_was_written(model, tmp_path, scene_with_a_loss, form):
    folder = model
    if form == "text":
        folder = tmp_path / "text"
        folder.mkdir()
        pycolmap.Reconstruction(model).write_text(folder)
    cameras, kept = scene_with_a_loss.cameras, [0, 1, 3, 4, 5]
    read = read_colmap(folder)
    order = [read.file.index(cameras.file[view]) for view in kept]
    assert [read.image_size[i] for i in order] == [cameras.image_size[view] for view in kept]
    torch.testing.assert_close(read.K[order], cameras.K[kept])
    torch.testing.assert_close(
        read.cam_from_world[order], cameras.cam_from_world[kept], rtol=0, atol=1e-9
    )
    assert read.registered.all()


def other_model(folder, model, params, text=False):
    scene = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=model, width=40, height=30, params=params, camera_id=7)
    scene.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image(name="a b.jpg", camera_id=7, image_id=3)
    scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.eye(4)[:3]))
    folder.mkdir()
    (scene.write_text if text else scene.write_binary)(folder)
    return folder


@pytest.mark.parametrize("text", [False, True])
def test_distortion_is_ignored_with_a_warning(tmp_path, text):
    folder = other_model(tmp_path / "m", "OPENCV", [50, 51, 20, 15, 0.1, 0, 0, 0], text)
    with pytest.warns(UserWarning, match="OPENCV is ignored"):
        cameras = read_colmap(folder)
    assert cameras.K[0].tolist() == [[50, 0, 20], [0, 51, 15], [0, 0, 1]]
    assert cameras.file == ["a b.jpg"]


def test_one_focal_length_needs_no_warning(tmp_path, recwarn):
    cameras = read_colmap(other_model(tmp_path / "m", "SIMPLE_PINHOLE", [50, 20, 15]))
    assert cameras.K[0, 0, 0] == cameras.K[0, 1, 1] == 50
    assert not recwarn.list


def test_a_panorama_is_refused(tmp_path):
    folder = other_model(tmp_path / "m", "EQUIRECTANGULAR", [40, 30])
    with pytest.raises(DataError, match="EQUIRECTANGULAR has no K"):
        read_colmap(folder)


def test_no_model_is_said(tmp_path):
    with pytest.raises(DataError, match="expected a COLMAP model"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin"])
def test_a_file_truncated_anywhere_is_refused(model, file):
    data = (model / file).read_bytes()
    for length in {*range(0, len(data), 97), len(data) - 1}:
        (model / file).write_bytes(data[:length])
        with pytest.raises(DataError, match="truncated") as caught:
            read_colmap(model)
        assert "\n" not in str(caught.value)


def test_a_truncated_points_file_does_no_harm(model):
    # pycolmap itself never returns from this.
    (model / "points3D.bin").write_bytes((model / "points3D.bin").read_bytes()[:100])
    assert len(read_colmap(model).file) == 5


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("cameras.txt", "1 CANON 40 30 50 50 20 15", "unknown camera model 'CANON'"),
        ("cameras.txt", "1 PINHOLE 40 30 50 50 20", "PINHOLE has"),
        ("cameras.txt", "1 PINHOLE 40 30 50 nan 20 15", "PINHOLE has"),
        ("cameras.txt", "1 PINHOLE 40 -30 50 50 20 15", "size 40x-30"),
        ("cameras.txt", "1 PINHOLE 40", "expected ID MODEL"),
        ("cameras.txt", "2 PINHOLE 40 30 50 50 20 15", "has camera 1, which"),
        ("images.txt", "1 1 0 0 0 0 0 0 1", "expected ID QW"),
        ("images.txt", "1 0 0 0 0 0 0 0 1 a.jpg", "expected finite numbers"),
        ("images.txt", "1 1 0 0 0 0 0 inf 1 a.jpg", "expected finite numbers"),
    ],
)
def test_impossible_text_models_are_refused(tmp_path, file, text, message):
    (tmp_path / "cameras.txt").write_text("# c\n1 PINHOLE 40 30 50 50 20 15\n")
    (tmp_path / "images.txt").write_text("# c\n1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    assert read_colmap(tmp_path).file == ["a.jpg"]
    (tmp_path / file).write_text(text + "\n\n")
    with pytest.raises(DataError, match=message):
        read_colmap(tmp_path)


def test_an_unknown_number_of_a_camera_model_is_refused(tmp_path, model):
    folder = tmp_path / "copy"
    shutil.copytree(model, folder)
    data = bytearray((folder / "cameras.bin").read_bytes())
    data[12] = 99
    (folder / "cameras.bin").write_bytes(data)
    with pytest.raises(DataError, match="unknown camera model 99"):
        read_colmap(folder)
