"""On an accelerator: ``pytest -m gpu``."""

from collections import Counter
from pathlib import Path

import pytest
import torch

from benchmarks.train_step import measure, prepared


@pytest.mark.gpu
@pytest.mark.parametrize("checkpointing", ["false", "true"])
def test_a_full_size_step_is_finite_fits_in_80_gb_and_waits_for_the_device_twice(
    monkeypatch, checkpointing
):
    if not torch.cuda.is_available():
        pytest.skip("torch finds no GPU")
    monkeypatch.chdir(Path(__file__).parents[2])
    with prepared([f"train.gradient_checkpointing={checkpointing}"]) as config:
        assert config.model.image_size == [384, 512]
        assert config.train.precision == "bf16"
        assert (config.data.graphs_per_step, config.data.num_views) == (1, 8)
        measured = measure(config, 3, warmup=2)
    assert measured.num_bad == 0
    waits = Counter()
    for place, number in measured.waits.items():
        waits[place.rsplit(":", 1)[0]] += number
    # The scores, for the tree; whether loss and gradient are finite.
    assert waits == {"l3r/graph/trees.py": 1, "l3r/train/guard.py": 1}
    assert measured.peak_gib * 2**30 < 80e9
