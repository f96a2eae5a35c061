"""The time of training steps, cut into parts that follow each other without a gap.

Functions of the real ``l3r train`` are surrounded by marks. Time between two marks belongs to the
innermost function under way, or to ``rest``: so the parts of a step add up to the step, whatever
they call of each other. On a GPU a mark is an event in its stream, which nothing waits for: parts
are then what the device spent, the time it stood idle included.
"""

import time
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch

from benchmarks.timing import surrounded
from l3r.data.loader import StepLoader
from l3r.inference.clock import StageClock

FORWARD = {
    "encoder": ["l3r.model.light3r.Light3R.encode"],
    "scores, tree": ["l3r.model.light3r.Light3R.connect"],
    "alignment": ["l3r.model.alignment.LatentAlignment.forward"],
    "decoder": ["l3r.model.decoder.PairDecoder.forward"],
    "heads": ["l3r.model.light3r.run_head", "l3r.model.light3r.pointmap_from_raw"],
    "accumulation": ["l3r.model.light3r.accumulate"],
    "forward, rest": ["l3r.model.light3r.Light3R.forward"],
}
"""The rooms of the forward pass; recomputation in the backward pass is the latter's."""
PARTS = {
    "data": ["l3r.types.Views.to"],
    **FORWARD,
    "loss": ["l3r.loss.joint.JointLoss.forward"],
    "backward": ["lightning.pytorch.strategies.strategy.Strategy.backward"],
    "optimiser": ["torch.optim.AdamW.step", "l3r.train.ema.WeightAverage.on_train_batch_end"],
    "rest": ["lightning.pytorch.loops.optimization.automatic.Closure.__call__"],
}
"""What is timed as which part. ``data`` is also the wait for the loader; the optimiser's step
calls the closure that runs the passes, whose own time is lightning's and the log's: the rest."""


class Enough(Exception):  # noqa: N818 - ends a run that did nothing wrong
    """Ends a run from the inside, so that it writes no checkpoint."""


class StepClock:
    """Times the steps of one training run, and ends it.

    Use :meth:`attached` around the run; read ``steps``, ``peak_mib`` and ``waits`` afterwards.

    Args:
        device: Where the run computes.
        accumulate: Batches of a step.
        warmup: Steps that are not timed.
        steps: Steps that are.
        observed: Steps after those in which the host's waits for a GPU are counted.
    """

    def __init__(
        self, device: torch.device, accumulate: int, *, warmup: int, steps: int, observed: int = 0
    ) -> None:
        self.device = device
        self.accumulate = accumulate
        self.first, self.last = warmup, warmup + steps
        self.end = self.last + observed
        self.steps: list[dict[str, float]] = []
        """Seconds of each part of each timed step."""
        self.peak_mib = 0.0
        """Peak memory of the timed steps: the GPU's, or the process's on a CPU."""
        self.waits: Counter[str] = Counter()
        """How often the host waited for the GPU in the steps observed, by place in the code."""
        self._batches = 0
        self._marks: list[list[tuple[str, Any]]] = []
        self._under_way = ["rest"]

    @contextmanager
    def attached(self) -> Iterator[None]:
        """Time the training run inside, which ends after the last step."""
        self._memory, self._phase = StageClock(self.device), ExitStack()
        batches = StepLoader.__iter__
        with (
            self._phase,
            surrounded(PARTS, self._inside),
            patch.object(StepLoader, "__iter__", lambda loader: self._pass_on(batches(loader))),
        ):
            try:
                yield
            except Enough:
                return
        raise RuntimeError(f"the run ended before step {self.end}; raise train.max_steps")

    @contextmanager
    def _inside(self, part: str) -> Iterator[None]:
        self._under_way.append(part)
        self._mark()
        try:
            yield
        finally:
            self._under_way.pop()
            self._mark()

    def _pass_on(self, batches: Iterator[Any]) -> Iterator[Any]:
        while True:
            step, begun = divmod(self._batches, self.accumulate)
            if not begun:
                self._begin_step(step)
            self._batches += 1
            with self._inside("data"):
                batch = next(batches)
            yield batch

    def _begin_step(self, step: int) -> None:
        """Start and end what is measured between the steps; a step begins as it asks for data."""
        if self._marks:
            self._mark()
        if step == self.last:
            self._phase.close()
            self.peak_mib = self._memory.peak_mib["steps"]
            self.steps = [self._seconds(marks) for marks in self._marks]
            self._marks.clear()
            self._phase.enter_context(count_waits(self.waits))
        if step == self.end:
            self._phase.close()
            raise Enough
        if step == self.first:
            self._phase.enter_context(self._memory.stage("steps"))
        if self.first <= step < self.last:
            self._marks.append([])
            self._mark()

    def _mark(self) -> None:
        """From here on time belongs to the innermost part under way."""
        if not self._marks:
            return
        mark: Any
        if self.device.type == "cuda":
            mark = torch.cuda.Event(enable_timing=True)
            mark.record()
        else:
            mark = time.perf_counter()
        self._marks[-1].append((self._under_way[-1], mark))

    def _seconds(self, marks: list[tuple[str, Any]]) -> dict[str, float]:
        spent = dict.fromkeys(PARTS, 0.0)
        for (part, begin), (_, end) in pairwise(marks):
            on_device = self.device.type == "cuda"
            spent[part] += begin.elapsed_time(end) / 1e3 if on_device else end - begin
        return spent


@contextmanager
def count_waits(waits: Counter[str]) -> Iterator[None]:
    """Count where the host waits for the GPU, by torch's own report; nothing without a GPU.

    Args:
        waits: Receives how often, by ``file:line``.
    """
    if not torch.cuda.is_available():
        yield
        return
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            yield
        finally:
            torch.cuda.set_sync_debug_mode("default")
    for warning in caught:
        if "synchronizing CUDA operation" in str(warning.message):
            waits["/".join(Path(warning.filename).parts[-3:]) + f":{warning.lineno}"] += 1
