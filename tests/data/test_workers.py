"""Loader processes that die, and signals that are not meant for them."""

import multiprocessing
import os
import signal
import tempfile
import time
from pathlib import Path

import pytest
import torch

from l3r.data.loader import MAX_TEMPORARY_PATH, build_training_loader
from l3r.data.steps import DeviceShare, StepBatch
from l3r.errors import ConfigError, LaunchError
from tests.data.described import data_config, datasets
from tests.data.graphs import make_graph, write_folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    graphs = [make_graph(n, 3, 32, 40) for n in range(9)]
    return write_folder(tmp_path_factory.mktemp("shards"), graphs)


def test_a_dead_process_ends_the_run_in_one_line_where_batches_are_asked_for(folder):
    config = data_config(folder, num_workers=1, prefetch_factor=1)
    share = DeviceShare()
    loader = build_training_loader(config, (32, 32), seed=0, num_steps=1000, share=share)
    others = set(multiprocessing.active_children())
    batches = iter(loader)
    next(batches)
    (worker,) = set(multiprocessing.active_children()) - others
    for meant_for_the_run in (signal.SIGINT, signal.SIGUSR1, signal.SIGUSR2, signal.SIGTERM):
        os.kill(worker.pid, meant_for_the_run)
    for _ in range(5):
        next(batches)
    os.kill(worker.pid, signal.SIGKILL)
    # Training goes on in the meantime; torch would raise here, out of its signal handler.
    time.sleep(1.0)
    with pytest.raises(LaunchError, match=rf"{worker.pid}.*exited.*data\.num_workers") as error:
        for _ in batches:
            pass
    assert "\n" not in str(error.value)


def test_a_batch_is_pinned_tensor_by_tensor(folder, monkeypatch):
    """Torch asks what it does not know for a method of that name, and takes what it returns."""
    pinned = []

    def pin(tensor, *_):
        pinned.append(tensor.data_ptr())
        return tensor.clone()

    monkeypatch.setattr(torch.Tensor, "pin_memory", pin)
    (dataset,) = datasets(data_config(folder), [DeviceShare()])
    batch, unpacked = dataset[0], dataset[0].unpack()
    monkeypatch.setattr(type(batch.views), "unpack", lambda packed: unpacked)
    found = torch.utils.data._utils.pin_memory.pin_memory(batch)
    assert isinstance(found, StepBatch)
    views = unpacked
    tensors = (views.image, views.depth, views.K, views.world_from_cam, views.valid, views.scores)
    assert {tensor.data_ptr() for tensor in tensors} <= set(pinned)
    assert torch.equal(found.views.image, views.image)
    assert found.views.key == views.key


@pytest.mark.gpu
def test_batches_of_other_processes_arrive_pinned(folder):
    config = data_config(folder, num_workers=1)
    share = DeviceShare()
    loader = build_training_loader(config, (32, 32), seed=0, num_steps=2, share=share)
    assert all(batch.image.is_pinned() for batch in loader)


@pytest.mark.parametrize("length", [MAX_TEMPORARY_PATH, MAX_TEMPORARY_PATH + 1])
def test_a_folder_for_temporary_files_with_too_long_a_name_is_refused(folder, monkeypatch, length):
    """Sockets are made there; where they cannot be, torch prints a traceback and waits for ever."""
    with tempfile.TemporaryDirectory(prefix="l3r-", dir="/tmp") as short:
        place = Path(short, "x" * (length - len(short) - 1))
        place.mkdir()
        monkeypatch.setenv("TMPDIR", str(place))
        # Python remembers the folder that sockets were made in before.
        monkeypatch.setattr(tempfile, "tempdir", str(place))
        monkeypatch.delitem(multiprocessing.process.current_process()._config, "tempdir", False)
        config = data_config(folder, num_workers=1, prefetch_factor=1)
        share = DeviceShare()
        loader = build_training_loader(config, (32, 32), seed=0, num_steps=2, share=share)
        if length > MAX_TEMPORARY_PATH:
            with pytest.raises(ConfigError, match=r"TMPDIR=.* 76 bytes, expected 75 at most"):
                next(iter(loader))
        else:
            assert len(list(loader)) == 2
