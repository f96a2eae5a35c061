"""The benchmark of a training step, on networks too small to be worth measuring."""

from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.data_wait import measure_wait
from benchmarks.step_clock import PARTS
from benchmarks.train_step import describe, find_sheet_rate, measure, prepared, step_flops
from tests.train.runs import TINY

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)


@pytest.mark.parametrize("accumulate", [1, 2])
def test_the_parts_of_a_step_follow_each_other_without_gap_or_overlap(monkeypatch, accumulate):
    """With a clock that moves by one at every mark, a part lasts as long as it has pieces."""
    ticks = count()
    clock = SimpleNamespace(perf_counter=lambda: next(ticks))
    monkeypatch.setattr("benchmarks.step_clock.time", clock)
    with prepared([*TINY, f"train.accumulate={accumulate}"]) as config:
        measured = measure(config, 2, warmup=1)
    rooms = dict.fromkeys(("encoder", "scores, tree", "alignment", "decoder", "accumulation"), 1)
    # Two heads, the activations of two maps; between nine calls of rooms lies the rest.
    of_batch = {"data": 2, **rooms, "heads": 4, "forward, rest": 10, "loss": 1, "backward": 1}
    expected = {part: accumulate * pieces for part, pieces in of_batch.items()}
    for step in measured.steps:
        assert {part: step[part] for part in expected} == expected
        # Around the closure, which runs the passes.
        assert step["optimiser"] == 2
        assert set(step) == set(PARTS)
    assert len(measured.steps) == 2
    assert measured.num_bad == 0
    assert not list(Path(config.train.output_dir).parent.glob("*/last.ckpt"))


def test_the_rows_name_every_part_and_what_the_machine_gave(monkeypatch):
    monkeypatch.setattr("benchmarks.train_step.matmul_rate", lambda precision: 1e9)
    with prepared(TINY) as config:
        measured = measure(config, 1, warmup=0)
        rows = dict(describe(config, measured))
    assert [*rows][: len(PARTS)] == [*PARTS]
    seconds = sum(measured.steps[0].values())
    assert measured.step_seconds == pytest.approx(seconds)
    assert float(rows["graphs/s"]) == pytest.approx(config.data.graphs_per_step / seconds, rel=0.1)
    shares = [float(rows[part].split()[2].rstrip("%")) for part in PARTS]
    assert sum(shares) == pytest.approx(100, abs=1)
    assert rows["MFU by the data sheet (CPU)"] == "-"
    used = step_flops(config) / seconds / 1e9
    assert rows["MFU by the matmul rate, 0.001 TFLOP/s here"] == f"{used:.1%}"


def test_one_device_of_a_run_on_many_is_prepared():
    layers = ["configs/base.yaml", "configs/model/tiny.yaml", "configs/train/paper_512.yaml"]
    with prepared([*layers, "data.num_views=2"]) as config:
        assert sorted(config.data.sources) == ["co3d", "megadepth", "tartanair", "waymo"]
        (folder,) = {source.shards for source in config.data.sources.values()}
        assert (Path(folder) / "manifest.json").exists()
        assert (config.data.graphs_per_step, config.train.devices) == (1, 1)
    with prepared(["train.seed=3"]) as config:
        assert (config.train.seed, config.model.encoder.width) == (3, 128)


@pytest.mark.slow
def test_the_wait_for_data_is_that_of_a_real_run():
    with prepared(TINY) as config:
        shares = measure_wait(config, 30)
    assert all(0 < share < 1 for share in shares)


@pytest.mark.parametrize(
    ("name", "rate"),
    [
        ("NVIDIA H200", 989e12),
        ("NVIDIA H100 80GB HBM3", 989e12),
        ("NVIDIA H100 PCIe", 756e12),
        ("NVIDIA A100-SXM4-80GB", 312e12),
        ("NVIDIA A40", 150e12),
        ("NVIDIA RTX A4000", None),
        ("NVIDIA A100X", None),
        ("CPU", None),
    ],
)
def test_a_data_sheet_is_that_of_the_very_gpu(name, rate):
    assert find_sheet_rate(name) == rate
