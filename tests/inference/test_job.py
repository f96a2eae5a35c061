import json

import pytest

import l3r
from l3r.cli.main import main
from l3r.config import InferenceConfig
from l3r.inference.checkpoint import build_untrained, write_model
from l3r.inference.photos import find_photos
from tests.inference.test_photos import save
from tests.train.runs import TINY


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A fresh network of 16 x 16 pixels."""
    model, config = build_untrained(TINY)
    path = tmp_path_factory.mktemp("weights") / "model.ckpt"
    write_model(path, model, config)
    return path


@pytest.fixture
def photos(tmp_path):
    for number, (height, width) in enumerate([(64, 80), (96, 64), (64, 64)]):
        save(tmp_path / "photos" / f"{number}.png", height, width)
    return tmp_path / "photos"


def test_a_crop_is_asked_for_by_a_setting_and_its_loss_is_told(
    tmp_path, checkpoint, photos, capsys
):
    out = tmp_path / "out"
    words = ["reconstruct", str(photos), "--checkpoint", str(checkpoint), "--out", str(out)]
    assert main([*words, "inference.crop=official"]) == 0
    told = "inference.crop=official cut off up to 33.3% of a photo (1.png)"
    assert capsys.readouterr().out.count(told) == 1
    assert told in json.loads((out / "run.json").read_text())["warnings"]
    images = json.loads((out / "cameras.json").read_text())["images"]
    assert [(i["height"], i["width"]) for i in images] == [(64, 80), (96, 64), (64, 64)]
    assert main(words) == 0
    assert "cut off" not in capsys.readouterr().out


def test_the_python_call_crops_when_its_configuration_says_so(checkpoint, photos):
    model = l3r.load_model(checkpoint)
    files = find_photos(photos)
    whole = l3r.reconstruct(model, files)
    cut = l3r.reconstruct(model, files, InferenceConfig(crop="official"))
    assert whole.window == [(0, 0, 80, 64), (0, 0, 64, 96), (0, 0, 64, 64)]
    assert cut.window == [(8, 0, 64, 64), (0, 16, 64, 64), (0, 0, 64, 64)]
    assert cut.cameras.image_size == whole.cameras.image_size
    assert cut.cameras.K[:, :2, 2].tolist() == [[40, 32], [32, 48], [32, 32]]
