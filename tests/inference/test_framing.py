import importlib.util
import logging

import numpy as np
import PIL
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from l3r.config import EncoderConfig, ModelConfig
from l3r.errors import DataError
from l3r.geometry.camera import window_centers
from l3r.inference.framing import choose_framing, frame_photo
from l3r.inference.photos import find_photos, load_photos
from l3r.types import Window

SQUARE = ModelConfig(image_size=[224, 224])
WIDE = ModelConfig(image_size=[384, 512])
SMALL = ModelConfig(
    encoder=EncoderConfig(patch_size=8, width=16, depth=1, num_heads=1), image_size=[48, 64]
)
SIDES = st.integers(40, 5000)


@pytest.mark.parametrize(("mode", "config"), [("224", SQUARE), ("512", WIDE)])
def test_official_framing_gives_the_released_loaders_pixels(tmp_path, shared, mode, config):
    path = shared / "model" / "recipe.py"
    spec = importlib.util.spec_from_file_location("recipe", path)
    recipe = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(recipe)
    with np.load(shared / "model" / "fixtures" / "load_images.npz") as arrays:
        recorded = dict(arrays)
    expected = {
        key.split("_")[1]: pixels for key, pixels in recorded.items() if f"out{mode}_" in key
    }
    assert len(expected) == 3
    for size in expected:
        width, height = map(int, size.split("x"))
        pixels = recipe.image_u8(1, height, width, int(recorded["image_seed"]))[0]
        Image.fromarray(pixels).save(tmp_path / f"{size}.png")
    photos = load_photos(find_photos(tmp_path), config, crop="official").photos
    # Other versions of Pillow may round otherwise.
    tolerance = 0 if PIL.__version__ == str(recorded["pillow"]) else 1
    for file, image in zip(photos.file, photos.image, strict=True):
        found = (image * 255).round().numpy().astype(int)
        target = expected[file.removesuffix(".png")].astype(int)
        assert found.shape == target.shape
        assert np.abs(found - target).max() <= tolerance


@given(SIDES, SIDES)
def test_the_network_sees_whole_photos_at_its_long_side(height, width):
    framing = choose_framing(height, width, SQUARE, "whole")
    assert framing.size == framing.scaled
    assert all(side % 16 == 0 and side >= 16 for side in framing.size)
    assert max(framing.size) == 224
    scale = 224 / max(height, width)
    for side, original in zip(framing.size, (height, width), strict=True):
        assert side == 16 or abs(side - original * scale) <= 8 + 1e-9
    assert framing.window(height, width) == (0, 0, width, height)


@given(SIDES, SIDES, st.sampled_from([SQUARE, WIDE, SMALL]))
def test_official_framing_cuts_the_middle_out_of_a_photo_scaled_as_it_is(height, width, config):
    patch = config.encoder.patch_size
    try:
        framing = choose_framing(height, width, config, "official")
    except DataError:
        assert round(min(height, width) * max(config.image_size) / max(height, width)) < patch
        return
    assert all(side % patch == 0 and side >= patch for side in framing.size)
    window = framing.window(height, width)
    left, top = framing.left, framing.top
    assert left >= 0
    assert top >= 0
    for whole, start, kept in zip(framing.scaled, (top, left), framing.size, strict=True):
        assert start + kept <= whole
        assert abs(start + kept / 2 - whole / 2) <= 1  # the middle, to a pixel
    # One scale for both sides, but for rounding to whole pixels.
    scales = window.width / framing.size[1], window.height / framing.size[0]
    assert scales[0] == pytest.approx(scales[1], rel=0.6 / min(framing.scaled))
    if config is SQUARE:
        assert framing.size == (224, 224)
        assert min(framing.scaled) == 224
    elif framing.scaled[0] != framing.scaled[1]:
        lost = (s - k for s, k in zip(framing.scaled, framing.size, strict=True))
        assert all(0 <= rest < patch for rest in lost)
        assert max(framing.size) == max(config.image_size)


def test_square_photos_are_cut_to_four_by_three():
    framing = choose_framing(1000, 1000, WIDE, "official")
    assert framing.size == (384, 512)
    assert framing.window(1000, 1000) == (0, 125, 1000, 750)
    assert choose_framing(90, 90, SMALL, "official").size == (48, 64)
    # Square after scaling is what counts.
    assert choose_framing(2000, 2001, WIDE, "official").size == (384, 512)


@pytest.mark.parametrize("crop", ["whole", "official"])
@pytest.mark.parametrize("config", [SQUARE, WIDE])
@pytest.mark.parametrize(("height", "width"), [(150, 250), (250, 190), (250, 250), (900, 1500)])
def test_the_window_says_where_every_pixel_of_the_network_comes_from(height, width, config, crop):
    """Red tells the column of the photo and green the row."""
    ramps = np.zeros((height, width, 3), np.uint8)
    ramps[..., 0] = np.rint(255 * (np.arange(width) + 0.5) / width)[None]
    ramps[..., 1] = np.rint(255 * (np.arange(height) + 0.5) / height)[:, None]
    image, window = frame_photo(ramps, config, crop)
    shape = image.shape[1:]
    centers = window_centers(*shape, window, torch.zeros(0).double()).reshape(*shape, 2)
    seen = image[:2].double().permute(1, 2, 0) * torch.tensor([width, height])
    # Filters have no full support at the edges of the photo. Colours are rounded twice, which the
    # means of quarters smooth out.
    scale = shape[1] / window.width
    error = (seen - centers)[6:-6, 6:-6] * scale
    quarters = [part for rows in error.chunk(2) for part in rows.chunk(2, 1)]
    assert max(float(part.mean((0, 1)).abs().max()) for part in quarters) < 0.2
    assert float(error.mean((0, 1)).abs().max()) < 0.01
    assert float(error.abs().max()) < max(height, width) / 255 * scale + 0.2


def test_a_photo_too_narrow_for_the_crop_is_named_and_skipped(tmp_path, caplog):
    for name, size in (("a", (80, 60)), ("b", (60, 80)), ("strip", (2000, 20))):
        Image.new("RGB", size).save(tmp_path / f"{name}.png")
    assert len(load_photos(find_photos(tmp_path), WIDE).photos.file) == 3
    with caplog.at_level(logging.WARNING):
        loaded = load_photos(find_photos(tmp_path), WIDE, crop="official")
    assert loaded.photos.file == ["a.png", "b.png"]
    ((file, reason),) = loaded.skipped
    assert file == "strip.png"
    assert "2000 x 20 px is too narrow for inference.crop=official" in reason
    assert reason in caplog.text


def test_photos_are_not_cropped_unless_asked(tmp_path):
    Image.new("RGB", (90, 60)).save(tmp_path / "a.png")
    Image.new("RGB", (60, 90)).save(tmp_path / "b.png")
    whole = load_photos(find_photos(tmp_path), SQUARE).photos
    assert whole.window == [Window.whole(60, 90), Window.whole(90, 60)]
    assert whole.network_size == [(144, 224), (224, 144)]
    cut = load_photos(find_photos(tmp_path), SQUARE, crop="official").photos
    assert cut.window == [(15, 0, 60, 60), (0, 15, 60, 60)]
    assert cut.network_size == [(224, 224)] * 2
    assert cut.original_size == whole.original_size == [(60, 90), (90, 60)]
