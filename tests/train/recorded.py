"""``l3r train`` that writes down what each process sees, and spoils or ends what a test names.

Run it as ``python -m tests.train.recorded LAYERS``. In the environment: ``RECORD`` is a folder;
``NAN_AT=STEP:RANK,...`` makes the loss of a step not finite in one process; ``DIE_AT`` kills the
process there, ``TERM_AT`` sends it SIGTERM, ``HANG_AT`` stops it. ``FULL=STEP:STEP`` leaves no
room on any disk from one step on, up to the other. ``DIE_IN_SAVE=STEP`` kills the process with half
of that step's checkpoint written.
"""

import io
import json
import os
import resource
import signal
import sys
import time
from collections import Counter
from pathlib import Path

import torch
import torch.distributed as dist

from l3r.cli.main import main
from l3r.train.module import TrainModule

_step = TrainModule.training_step
COLLECTIVES = Counter()
"""Calls so far of what makes the host wait for a device if the processes meet over NCCL."""


def counted(name):
    function = getattr(dist, name)

    def call(*args, **kwargs):
        COLLECTIVES[name] += 1
        return function(*args, **kwargs)

    return call


_save = torch.save


def is_named(name, here):
    return here in os.environ.get(name, "").split(",")


def set_room(step):
    """The kernel refuses to let any file grow, as a full disk does."""
    first, last = map(int, os.environ["FULL"].split(":"))
    if step in (first, last):
        limit = 1 if step == first else resource.RLIM_INFINITY
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))


def save(content, stream):
    if content.get("global_step") != int(os.environ.get("DIE_IN_SAVE", "-1")):
        _save(content, stream)
        return
    whole = io.BytesIO()
    _save(content, whole)
    stream.write(whole.getvalue()[: whole.tell() // 2])
    stream.flush()
    os.kill(os.getpid(), signal.SIGKILL)


def training_step(self, batch, batch_idx):
    outputs = _step(self, batch, batch_idx)
    step, rank = self.trainer.global_step + 1, self.trainer.global_rank
    if folder := os.environ.get("RECORD"):
        row = {"step": step, "keys": batch.key, "size": list(batch.image.shape)}
        row["collectives"] = COLLECTIVES.total()
        with (Path(folder) / f"{rank}.jsonl").open("a") as stream:
            stream.write(json.dumps(row) + "\n")
    here = f"{step}:{rank}"
    if is_named("DIE_AT", here):
        os.kill(os.getpid(), signal.SIGKILL)
    if is_named("TERM_AT", here):
        os.kill(os.getpid(), signal.SIGTERM)
    if is_named("HANG_AT", here):
        time.sleep(600)
    if "FULL" in os.environ:
        set_room(step)
    # After the loss was computed: its gradient is what must not reach the weights.
    is_bad = is_named("NAN_AT", here)
    return {**outputs, "loss": outputs["loss"] * torch.nan} if is_bad else outputs


TrainModule.training_step = training_step
dist.barrier, dist.broadcast = counted("barrier"), counted("broadcast")
torch.save = save

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
