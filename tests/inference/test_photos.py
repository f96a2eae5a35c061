import logging

import numpy as np
import pytest
import torch
from PIL import Image

from l3r.config import EncoderConfig, ModelConfig
from l3r.errors import DataError
from l3r.inference.photos import find_photos, load_photos, require_two
from l3r.types import Photos, Window

MODEL = ModelConfig(
    encoder=EncoderConfig(patch_size=16, width=64, depth=1, num_heads=1), image_size=[224, 224]
)


def save(path, height=60, width=80, exif=None, **options):
    """Left half red, right half blue."""
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[:, : width // 2, 0] = 255
    pixels[:, width // 2 :, 2] = 255
    extra = {}
    if exif is not None:
        extra["exif"] = Image.Exif()
        extra["exif"][274] = exif
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **extra, **options)
    return path


def test_photos_of_any_shape_keep_order_size_and_orientation(tmp_path):
    save(tmp_path / "b.png", 60, 80)
    save(tmp_path / "a.jpg", 80, 60)
    save(tmp_path / "c.webp", 50, 50)
    loaded = load_photos(find_photos(tmp_path), MODEL, tmp_path)
    photos = loaded.photos
    assert photos.file == ["a.jpg", "b.png", "c.webp"]
    assert photos.original_size == [(80, 60), (60, 80), (50, 50)]
    assert [tuple(i.shape) for i in photos.image] == [(3, 224, 176), (3, 176, 224), (3, 224, 224)]
    assert not loaded.skipped
    assert not loaded.upright
    assert photos.image[1][0, 5, 5] > 0.95
    assert photos.image[1][2, 5, -5] > 0.95


@pytest.mark.parametrize("orientation", [2, 3, 4, 5, 6, 7, 8])
def test_exif_orientation_is_applied_and_the_upright_photo_kept(tmp_path, orientation):
    save(tmp_path / "a.jpg", 60, 80, exif=orientation, quality=95)
    save(tmp_path / "b.jpg", 60, 80)
    loaded = load_photos(find_photos(tmp_path), MODEL, tmp_path)
    turned = orientation >= 5
    assert loaded.photos.original_size[0] == ((80, 60) if turned else (60, 80))
    assert set(loaded.upright) == {"a.jpg"}
    path = tmp_path / "upright.jpg"
    path.write_bytes(loaded.upright["a.jpg"])
    with Image.open(path) as image:
        assert image.size == ((60, 80) if turned else (80, 60))
        assert image.getexif().get(274, 1) == 1


def test_unreadable_photos_are_named_and_skipped(tmp_path, caplog):
    save(tmp_path / "a.jpg")
    save(tmp_path / "b.jpg")
    (tmp_path / "junk.jpg").write_bytes(b"no image")
    whole = save(tmp_path / "cut.jpg", 200, 200).read_bytes()
    (tmp_path / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty.png").write_bytes(b"")
    with caplog.at_level(logging.WARNING):
        loaded = load_photos(find_photos(tmp_path), MODEL, tmp_path)
    assert loaded.photos.file == ["a.jpg", "b.jpg"]
    assert sorted(name for name, _ in loaded.skipped) == ["cut.jpg", "empty.png", "junk.jpg"]
    assert all(name in caplog.text for name, _ in loaded.skipped)


def test_a_decompression_bomb_is_skipped(tmp_path, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 5000)
    save(tmp_path / "a.png", 50, 50)
    save(tmp_path / "b.png", 50, 50)
    save(tmp_path / "large.png", 100, 80)  # Pillow only warns up to twice the limit
    save(tmp_path / "huge.png", 200, 200)
    loaded = load_photos(find_photos(tmp_path), MODEL, tmp_path)
    assert loaded.photos.file == ["a.png", "b.png"]


def test_sixteen_bit_grey_keeps_its_range(tmp_path):
    grey = np.linspace(0, 65535, 64 * 64).reshape(64, 64).astype(np.uint16)
    Image.fromarray(grey).save(tmp_path / "a.png")
    save(tmp_path / "b.png")
    image = load_photos(find_photos(tmp_path), MODEL, tmp_path).photos.image[0]
    assert float(image.mean()) == pytest.approx(0.5, abs=0.02)


def test_alpha_and_palettes_are_read(tmp_path):
    Image.new("RGBA", (40, 40), (255, 0, 0, 128)).save(tmp_path / "a.png")
    Image.new("P", (40, 40), 3).save(tmp_path / "b.gif")
    Image.new("LA", (40, 40), (100, 255)).save(tmp_path / "c.png")
    assert len(load_photos(find_photos(tmp_path), MODEL, tmp_path).photos.image) == 2


def test_hidden_files_are_left_out_and_folders_searched(tmp_path):
    save(tmp_path / "one" / "a.jpg")
    save(tmp_path / "two" / "a.jpg")
    save(tmp_path / ".trash" / "b.jpg")
    save(tmp_path / "one" / "._a.jpg")
    (tmp_path / "notes.txt").write_text("x")
    loaded = load_photos(find_photos(tmp_path), MODEL, tmp_path)
    assert loaded.photos.file == ["one/a.jpg", "two/a.jpg"]


def test_too_few_photos_and_equal_names_are_clear_errors(tmp_path):
    with pytest.raises(DataError, match=r"no such folder"):
        find_photos(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"0 usable photo\(s\) of 0 found, expected 2"):
        load_photos(find_photos(tmp_path), MODEL, tmp_path)
    one = save(tmp_path / "x" / "a.jpg")
    with pytest.raises(DataError, match=r"1 usable photo\(s\) of 1"):
        load_photos([one], MODEL)
    with pytest.raises(DataError, match=r"two photos are named a\.jpg"):
        load_photos([one, save(tmp_path / "y" / "a.jpg")], MODEL)
    photos = Photos(
        image=[torch.zeros(3, 4, 4)] * 2,
        original_size=[(4, 4)] * 2,
        window=[Window.whole(4, 4)] * 2,
        file=["a", "b"],
    )
    require_two(photos, 2)


def test_a_photo_that_shrinks_in_one_direction_only_is_averaged(tmp_path):
    """A checkerboard of columns: cubic sampling would alias, averaging gives grey."""
    pixels = np.zeros((20, 2000, 3), np.uint8)
    pixels[:, ::2] = 255
    Image.fromarray(pixels).save(tmp_path / "a.png")
    save(tmp_path / "b.png")
    image = load_photos(find_photos(tmp_path), MODEL, tmp_path).photos.image[0]
    assert image.shape[1] == 16
    assert float((image - 0.5).abs().max()) < 0.1
