"""What a dry run has found out, and its table."""

import io
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from statistics import fmean, median

from rich.console import Console
from rich.table import Table

from l3r.config import RunConfig
from l3r.export.durations import format_seconds
from l3r.train.first_reads import BatchRead, SourceFacts
from l3r.train.ranks import Ranks

Size = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class StepFacts:
    """One optimisation step that was taken."""

    image_size: Size
    """(height, width)."""
    seconds: float
    """From the end of the step before to its own."""
    waited: float
    """Seconds of them in which there was no batch."""
    loss: float
    """Mean over its graphs."""
    grad_norm: float
    """Before clipping."""


@dataclass(frozen=True, kw_only=True)
class MemoryFacts:
    """Bytes of one process."""

    weights: int = 0
    """Parameters and buffers."""
    gradients: int = 0
    """One for each parameter."""
    optimizer: int = 0
    """State of the optimiser."""
    activations: int = 0
    """Kept for the backward pass of the largest batch; counted, not measured."""
    others: int = 0
    """What a checkpoint holds beside weights and optimiser, such as a moving average."""
    peak: int = 0
    """Measured: tensors of the process that is nearest to its GPU's capacity; on a CPU all that
    this process had in use."""
    reserved: int = 0
    """What torch's allocator took for them."""
    capacity: int = 0
    """Of that GPU; 0 where there is none."""

    @property
    def counted(self) -> int:
        """Sum of the parts."""
        parts = self.weights + self.gradients + self.optimizer + self.others
        return parts + self.activations

    def shared_out(self, num_processes: int) -> "MemoryFacts":
        """What each process keeps where they share out all but the activations."""
        return replace(
            self,
            weights=self.weights // num_processes,
            gradients=self.gradients // num_processes,
            optimizer=self.optimizer // num_processes,
            others=self.others // num_processes,
        )


@dataclass(frozen=True, kw_only=True)
class Rehearsal:
    """A training run that was found ready to start.

    What concerns files and data is known to the first process alone; others leave it empty.
    """

    config: RunConfig
    """Of the run."""
    ranks: Ranks
    """Processes of the run."""
    num_processes: int
    """How many took the steps here; a single one may stand for all."""
    first_step: int
    """Steps that the run has taken already."""
    image_sizes: tuple[Size, ...]
    """Shapes of the run's batches, the largest first."""
    free_bytes: int
    """Room for checkpoints, those that the run will replace included."""
    sources: tuple[SourceFacts, ...] = ()
    """Training data."""
    validation: tuple[SourceFacts, ...] = ()
    """Validation data."""
    reads: tuple[BatchRead, ...] = ()
    """Batches that were read without a step."""
    memory: MemoryFacts = MemoryFacts()
    """Of a process."""
    device: str = "CPU"
    """Name of the GPU, or CPU."""
    steps: tuple[StepFacts, ...] = ()
    """Steps that were taken."""
    checkpoint_bytes: int = 0
    """Size of ``last.ckpt``."""

    @property
    def seconds_of(self) -> dict[Size, float]:
        """Median seconds of a step of each shape that was tried, without the first where more."""
        seconds: dict[Size, list[float]] = {}
        for step in self.steps:
            seconds.setdefault(step.image_size, []).append(step.seconds)
        return {size: median(values[1:] or values) for size, values in seconds.items()}

    @property
    def read_seconds(self) -> float:
        """Seconds in which the loader processes of a device read a step; 0 without any."""
        data = self.config.data
        if not data.num_workers or not self.reads:
            return 0.0
        mean = fmean(read.seconds for read in self.reads)
        return self.config.train.accumulate * mean / data.num_workers

    @property
    def step_seconds(self) -> float:
        """Seconds of a step, in the mean over all shapes.

        An upper bound where not all shapes were tried: the largest stands for the others. No less
        than reading takes, which a few steps do not feel as their batches were read before.
        """
        tried = self.seconds_of
        largest = tried[self.image_sizes[0]]
        mean = fmean(tried.get(size, largest) for size in self.image_sizes)
        return max(mean, self.read_seconds)

    @property
    def hours(self) -> float:
        """What the rest of the run takes at this rate, without validation and checkpoints."""
        return self.step_seconds * self.steps_left / 3600

    @property
    def device_hours(self) -> float:
        """The same over all devices."""
        return self.hours * self.ranks.world_size

    @property
    def steps_left(self) -> int:
        """Steps that the run has before it."""
        return self.config.train.max_steps - self.first_step

    def to_table(self) -> str:
        """Draw what was found in 80 columns; the last line says that the run is ready."""
        table = Table.grid(padding=(0, 2))
        table.add_column(no_wrap=True)
        table.add_column(overflow="fold")
        for name, found in self._rows():
            table.add_row(name, found)
        stream = io.StringIO()
        console = Console(file=stream, width=80, highlight=False, markup=False)
        console.print(table)
        console.print(self._verdict(), soft_wrap=True)
        return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()) + "\n"

    def _rows(self) -> Iterator[tuple[str, str]]:
        count = self.ranks.world_size
        who = _count(count, "process", "processes")
        if self.num_processes < count:
            who = f"one process in place of {count}, with the share of one"
        yield "devices", f"{self.device}, {who}"
        start = f"goes on after step {self.first_step:,}" if self.first_step else "a new run"
        yield "output", f"{self.config.train.output_dir}: {start}; nothing is written yet"
        size, free = format_bytes(self.checkpoint_bytes), format_bytes(self.free_bytes)
        yield "disk", f"room for {free}; a checkpoint takes {size}, and three must fit"
        yield from self._describe_data()
        yield from self._describe_memory()
        yield from self._describe_steps()

    def _describe_data(self) -> Iterator[tuple[str, str]]:
        data = self.config.data
        for number, source in enumerate(self.sources):
            steps = source.num_graphs / (source.share * data.graphs_per_step)
            graphs = _count(source.num_graphs, "graph")
            yield (
                "" if number else "training",
                f"{source.name}: {graphs} of {data.num_views} images; {source.share:.1%} of those "
                f"drawn, a pass lasts {_count(math.ceil(steps), 'step')}",
            )
        for number, source in enumerate(self.validation):
            words = f"{source.name}: {_count(source.num_graphs, 'graph')}"
            yield "" if number else "validation", words
        if not self.validation:
            yield "validation", "none"
        mean = format_seconds(fmean(read.seconds for read in self.reads))
        graphs = _count(max(read.num_graphs for read in self.reads), "graph")
        shapes = _count(len({read.image_size for read in self.reads}), "shape")
        yield "reading", f"{mean} for a batch of {graphs}, by one process; {shapes} tried"
        if data.num_workers:
            rate = format_seconds(self.read_seconds)
            workers = _count(data.num_workers, "loader process", "loader processes")
            yield "", f"{rate} a step by {workers} of each device"

    def _describe_memory(self) -> Iterator[tuple[str, str]]:
        memory = self.memory
        parts = {
            "weights": memory.weights,
            "gradients": memory.gradients,
            "optimiser": memory.optimizer,
            "average": memory.others,
            "activations": memory.activations,
        }
        shown = ", ".join(f"{name} {format_bytes(size)}" for name, size in parts.items() if size)
        yield "memory", f"{format_bytes(memory.counted)} a process, counted: {shown}"
        if memory.capacity:
            peak, reserved = format_bytes(memory.peak), format_bytes(memory.reserved)
            capacity = format_bytes(memory.capacity)
            yield "", f"{peak} measured at the peak, {reserved} reserved, of {capacity}"
        else:
            peak = format_bytes(memory.peak)
            yield "", f"{peak} measured, all of this process on the CPU; no GPU was tried"

    def _describe_steps(self) -> Iterator[tuple[str, str]]:
        for number, (size, seconds) in enumerate(self.seconds_of.items()):
            same = [step for step in self.steps if step.image_size == size]
            settled = same[1:] or same
            wait = sum(step.waited for step in settled) / sum(step.seconds for step in settled)
            # The first step waits for the loader processes to start.
            waited = f", {wait:.0%} of it waiting for data" if len(same) > 1 else ""
            rate = self.config.data.graphs_per_step / seconds
            yield (
                "" if number else "step",
                f"{size[0]}x{size[1]}: {format_seconds(seconds)}, {rate:.3g} graphs/s{waited}",
            )
        first = self.steps[0]
        yield "", f"loss {first.loss:.4g}, gradient norm {first.grad_norm:.4g} in the first"

    def _verdict(self) -> str:
        is_bound = len(self.seconds_of) < len(self.image_sizes)
        took = f"{'at most ' if is_bound else ''}{format_seconds(3600 * self.hours)}"
        if self.device == "CPU":
            took += " at the rate of this CPU"
        else:
            took += f", {self.device_hours:,.3g} GPU-hours"
        return f"ready: {_count(self.steps_left, 'step')} to take, {took}"


def tell(words: str) -> None:
    """Write a line of progress."""
    sys.stderr.write(f"dry run: {words}\n")
    sys.stderr.flush()


def format_bytes(size: int) -> str:
    """Three digits and a unit: GiB, or MiB below one."""
    return f"{size / 2**30:,.1f} GiB" if size >= 2**30 else f"{size / 2**20:,.1f} MiB"


def _count(number: int, one: str, several: str = "") -> str:
    return f"{number:,} {one if number == 1 else several or one + 's'}"
