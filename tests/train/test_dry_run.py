"""A dry run says yes or no, and leaves nothing behind."""

import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from l3r.cli.main import main
from l3r.config import load_config
from l3r.errors import CheckpointError, ConfigError, DataError, LaunchError
from l3r.train.dry_run import rehearse
from l3r.train.first_reads import BatchRead
from l3r.train.module import TrainModule
from l3r.train.ranks import Agreement, Ranks
from l3r.train.rehearsal import MemoryFacts, Rehearsal, StepFacts
from l3r.train.run import train
from l3r.train.signals import StopSignals
from l3r.train.watch import StepWatch
from tests.train.runs import layers

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)


@pytest.fixture(autouse=True)
def temporary(monkeypatch):
    """The folder for temporary files, of a short name for sockets; who leaves one fails."""
    folder = Path(tempfile.mkdtemp(prefix="l3r-", dir="/tmp"))
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", None)
    yield folder
    left = [*folder.iterdir()]
    shutil.rmtree(folder)
    assert not left


def command(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "l3r", "train", *arguments, "--dry-run"],
        capture_output=True,
        text=True,
        timeout=240,
    )


def snapshot(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_run_that_can_start_is_ready_and_its_folder_untouched(hand_shards, tmp_path, capsys):
    out = tmp_path / "out"
    sizes = "data.image_sizes=[[8,16],[16,32],[16,16]]"
    arguments = [*layers(hand_shards, out, max_steps=12), sizes]
    assert main(["train", *arguments, "--dry-run"]) == 0
    shown = capsys.readouterr()
    *table, verdict = shown.out.splitlines()
    assert verdict.startswith("ready: 12 steps to take, ")
    assert max(map(len, table)) <= 80
    assert "hand: 8 graphs of 3 images; 100.0% of those drawn, a pass lasts 4 steps" in " ".join(
        shown.out.split()
    )
    assert "3 shapes tried" in shown.out
    assert shown.err.count("dry run: step") == 9, "three of each shape"
    assert "step 1 at 16x32" in shown.err, "the largest first"
    assert not out.exists()


def test_its_checkpoint_is_as_large_as_the_real_one(hand_shards, tmp_path):
    config = load_config(layers(hand_shards, tmp_path / "out", max_steps=3, validate_every=3))
    found = rehearse(config)
    assert config.train.output_dir == str(tmp_path / "out")
    assert [step.image_size for step in found.steps] == 3 * [(16, 16)]
    first = found.steps[0]
    weights = train(config)
    size = (tmp_path / "out" / "last.ckpt").stat().st_size
    # Times and losses are stored as well, in a few bytes more or less.
    assert found.checkpoint_bytes == pytest.approx(size, rel=0.02)
    assert found.memory.optimizer == pytest.approx(2 * found.memory.weights, rel=0.01)
    rows = (tmp_path / "out" / "metrics.csv").read_text().splitlines()
    header, row = (line.split(",") for line in rows[:2])
    assert float(row[header.index("loss")]) == pytest.approx(first.loss, rel=1e-6)
    assert weights.exists()


@pytest.mark.slow
def test_a_run_that_was_stopped_goes_on_from_its_step_and_its_folder_stays(hand_shards, tmp_path):
    arguments = layers(hand_shards, tmp_path / "out")
    train(load_config([*arguments, "train.max_steps=5"]))
    before = snapshot(tmp_path)
    found = rehearse(load_config([*arguments, "train.max_steps=7"]))
    assert found.first_step == 5
    assert len(found.steps) == 2, "no step past the last"
    assert "goes on after step 5" in found.to_table()
    assert snapshot(tmp_path) == before
    with pytest.raises(ConfigError, match=r"finished at step 5 of train\.max_steps=5"):
        rehearse(load_config([*arguments, "train.max_steps=5"]))
    with pytest.raises(ConfigError, match=r"train\.seed=0, this run has 1"):
        rehearse(load_config([*arguments, "train.max_steps=7", "train.seed=1"]))


@pytest.mark.parametrize(
    ("setting", "error", "message"),
    [
        ("data.validation.hand.shards=/nowhere", DataError, "/nowhere/manifest.json: no such"),
        ("train.init=/nowhere.ckpt", CheckpointError, "no such file"),
        ("train.output_dir=README.md/run", ConfigError, "README.md is a file, expected a folder"),
        ("data.graphs_per_step=0", ConfigError, "data.graphs_per_step"),
    ],
)
def test_what_would_end_the_run_ends_the_dry_run(hand_shards, tmp_path, setting, error, message):
    with pytest.raises(error, match=message):
        rehearse(load_config([*layers(hand_shards, tmp_path / "out"), setting]))
    assert not (tmp_path / "out").exists()


def test_a_source_that_no_early_batch_draws_is_read(hand_shards, tmp_path):
    """Its graphs cannot be read, and it is drawn once in a million."""
    broken = tmp_path / "broken"
    broken.mkdir()
    for path in Path(hand_shards).iterdir():
        jpeg = b"\xff\xd8\xff"
        (broken / path.name).write_bytes(path.read_bytes().replace(jpeg, bytes(3)))
    rare = tmp_path / "rare.yaml"
    rare.write_text(f"data: {{sources: {{rare: {{shards: {broken}, weight: 1.0e-6}}}}}}\n")
    with pytest.raises(DataError, match=r"broken: none of 8 graphs can be read; last: .*check"):
        rehearse(load_config([*layers(hand_shards, tmp_path / "out"), str(rare)]))


def test_a_step_that_is_not_finite_ends_the_dry_run_and_names_its_graphs(
    hand_shards, tmp_path, monkeypatch
):
    step = TrainModule.training_step

    def spoilt(self, batch, batch_idx):
        outputs = step(self, batch, batch_idx)
        return {**outputs, "loss": outputs["loss"] * torch.nan}

    monkeypatch.setattr(TrainModule, "training_step", spoilt)
    with pytest.raises(LaunchError, match=r"gradient norm nan, expected finite ones; .*hand-"):
        rehearse(load_config(layers(hand_shards, tmp_path / "out")))


def test_memory_that_runs_out_is_one_line_of_what_to_do(hand_shards, tmp_path, monkeypatch):
    said = "CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has 79 GiB in all. Of these"

    def fail(self, batch, batch_idx):
        raise torch.OutOfMemoryError(said)

    monkeypatch.setattr(TrainModule, "training_step", fail)
    expected = r"of 1: CUDA .* 79 GiB in all; raise train\.accumulate .*gradient_checkpointing"
    with pytest.raises(LaunchError, match=expected):
        rehearse(load_config(layers(hand_shards, tmp_path / "out")))


def test_a_network_that_this_machine_cannot_hold_is_not_tried(hand_shards, tmp_path, monkeypatch):
    read_text = Path.read_text

    def poor(self, *args, **kwargs):
        is_ours = self == Path("/proc/meminfo")
        return "MemAvailable: 64 kB\n" if is_ours else read_text(self, *args, **kwargs)

    monkeypatch.setattr(Path, "read_text", poor)
    with pytest.raises(LaunchError, match=r"a step takes about .*, 0\.1 MiB is free here"):
        rehearse(load_config(layers(hand_shards, tmp_path / "out")))


def test_checkpoints_that_do_not_fit_on_the_disk_are_refused(hand_shards, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)._replace(free=2**17)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    with pytest.raises(LaunchError, match=r"0\.1 MiB free, expected room for 3 checkpoints of"):
        rehearse(load_config(layers(hand_shards, tmp_path / "out")))


def test_one_process_takes_the_share_of_one_where_devices_are_absent(hand_shards, tmp_path):
    arguments = [
        *layers(hand_shards, tmp_path / "out", devices=4, num_nodes=2, accelerator="auto"),
        "data.graphs_per_step=16",
    ]
    found = rehearse(load_config(arguments))
    assert (found.num_processes, found.ranks.world_size) == (1, 8)
    assert {read.num_graphs for read in found.reads} == {2}
    assert "one process in place of 8, with the share of one" in found.to_table()


def test_what_a_checkpoint_holds_beside_weights_and_optimiser_is_counted():
    """A moving average, as large as the weights; shared out over four processes."""
    weights = 2**30
    whole = MemoryFacts(weights=weights, gradients=weights, optimizer=2 * weights, activations=7)
    config = load_config([])
    watch = StepWatch(config, 1, StopSignals(), Agreement())
    found = watch.add_measured(whole, 4 * weights + 1000)
    assert found.others == weights + 1000
    assert watch.add_measured(whole, 3 * weights + 1000).others == 0
    assert found.shared_out(4).counted == 5 * weights // 4 + 250 + 7


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["ddp", "fsdp"])
def test_two_processes_take_the_steps_and_one_tells(hand_shards, tmp_path, strategy):
    arguments = layers(hand_shards, tmp_path / "out", devices=2, strategy=strategy, ema_decay=0.9)
    done = command(*arguments, "data.num_workers=1")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("ready: ") == 1
    assert "CPU, 2 processes" in done.stdout
    assert done.stderr.count("dry run: step 1 ") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.gpu
def test_memory_is_measured_on_a_gpu(hand_shards, tmp_path):
    found = rehearse(load_config(layers(hand_shards, tmp_path / "out", accelerator="gpu")))
    memory = found.memory
    assert memory.weights < memory.peak <= memory.reserved < memory.capacity
    assert "GPU-hours" in found.to_table()


def rehearsal(seconds, **changes):
    steps = [
        StepFacts(image_size=size, seconds=value, waited=0.0, loss=1.0, grad_norm=1.0)
        for size, values in seconds.items()
        for value in values
    ]
    config = load_config(["train.max_steps=3600", "data.num_workers=4", "train.accumulate=2"])
    return Rehearsal(
        config=config,
        ranks=Ranks(rank=0, devices=8, num_nodes=2, is_srun=False),
        num_processes=16,
        first_step=0,
        image_sizes=((32, 32), (16, 32)),
        free_bytes=0,
        steps=tuple(steps),
        reads=(BatchRead(image_size=(16, 32), num_graphs=1, seconds=2.0),),
        **changes,
    )


def test_time_is_the_mean_over_shapes_of_steps_that_are_warm():
    found = rehearsal({(32, 32): [9.0, 3.0, 3.0], (16, 32): [5.0, 2.0, 2.0]})
    assert found.step_seconds == 2.5
    assert found.hours == 2.5
    assert found.device_hours == 40
    assert replace(found, first_step=1800).hours == 1.25


def test_a_shape_that_was_not_tried_counts_as_the_largest():
    found = rehearsal({(32, 32): [4.0]}, device="NVIDIA H200")
    assert found.step_seconds == 4
    assert found.to_table().splitlines()[-1] == (
        "ready: 3,600 steps to take, at most 4 h 00 min, 64 GPU-hours"
    )


def test_steps_are_no_faster_than_their_batches_are_read():
    """Two batches a step, two seconds each, by four processes."""
    found = rehearsal({(32, 32): [0.1, 0.1], (16, 32): [0.1, 0.1]})
    assert found.read_seconds == 1
    assert found.step_seconds == 1
