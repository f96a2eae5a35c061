"""``l3r train`` that writes down what each process sees, and spoils or ends what a test names.

Run it as ``python -m tests.train.recorded LAYERS``. In the environment: ``RECORD`` is a folder;
``NAN_AT=STEP:RANK`` makes the loss of a step not finite in one process; ``DIE_AT`` kills the
process there, ``HANG_AT`` stops it.
"""

import json
import os
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


def training_step(self, batch, batch_idx):
    outputs = _step(self, batch, batch_idx)
    step, rank = self.trainer.global_step + 1, self.trainer.global_rank
    if folder := os.environ.get("RECORD"):
        row = {"step": step, "keys": batch.key, "size": list(batch.image.shape)}
        row["collectives"] = COLLECTIVES.total()
        with (Path(folder) / f"{rank}.jsonl").open("a") as stream:
            stream.write(json.dumps(row) + "\n")
    here = f"{step}:{rank}"
    if os.environ.get("DIE_AT") == here:
        os.kill(os.getpid(), signal.SIGKILL)
    if os.environ.get("HANG_AT") == here:
        time.sleep(600)
    # After the loss was computed: its gradient is what must not reach the weights.
    is_bad = os.environ.get("NAN_AT") == here
    return {**outputs, "loss": outputs["loss"] * torch.nan} if is_bad else outputs


TrainModule.training_step = training_step
dist.barrier, dist.broadcast = counted("barrier"), counted("broadcast")

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
