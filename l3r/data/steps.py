"""From the number of a step to its batch: first a plan, then pixels."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch.utils.data import Dataset

from l3r.data.color import ColorChange
from l3r.data.sampling import SampleChooser, Variation
from l3r.data.source import ShardFolder
from l3r.data.stages import KeyedGraph, PackedViews, jitter_colors, lay_out, resize_crop
from l3r.data.store import UnreachableError
from l3r.errors import DataError
from l3r.types import Views

MAX_ATTEMPTS = 20
"""Unreadable graphs in a row after which the source is given up."""
_GOLDEN = (math.sqrt(5) - 1) / 2


@dataclass(frozen=True, kw_only=True)
class DeviceShare:
    """The slots of a step that one device takes: ``rank``, ``rank + world_size``, ..."""

    rank: int = 0
    """This device."""
    world_size: int = 1
    """Devices."""
    accumulate: int = 1
    """Batches that a device's slots of one step come in, for accumulated gradients."""

    def slots(self, part: int, slots_per_step: int) -> range:
        """Give the slots of one of the step's batches, ``part`` from 0 to ``accumulate - 1``."""
        stride = self.world_size * self.accumulate
        return range(self.rank + part * self.world_size, slots_per_step, stride)


@dataclass(frozen=True, kw_only=True)
class SlotPlan:
    """What stands in one slot."""

    slot: int
    """Number among all slots of the step, over all devices."""
    source: int
    """Number of the source."""
    graph: int
    """Number of the graph in its source."""
    key: str
    """Shard and key of the graph."""
    colors: tuple[ColorChange, ...]
    """Change of each image's colours; empty: none."""


@dataclass(frozen=True, kw_only=True)
class StepPlan:
    """All that is drawn for one batch, before anything is read."""

    step: int
    """Optimisation step."""
    image_size: tuple[int, int]
    """(height, width)."""
    slots: tuple[SlotPlan, ...]
    """One graph each, in the batch's order."""


@dataclass(frozen=True, kw_only=True)
class StepBatch:
    """What a worker sends: the batch and what it had to leave out."""

    views: PackedViews | Views | None
    """The batch, packed until it has left the worker; None where no sample of a source could be
    read, or the source does not answer; the last line of ``skipped`` says why."""
    skipped: list[str]
    """One line for each unreadable sample, which another of the same source replaced."""

    def unpack(self) -> Views | None:
        """Give the batch that the model takes."""
        return self.views.unpack() if isinstance(self.views, PackedViews) else self.views

    def pin_memory(self) -> "StepBatch":
        """Unpack the batch and pin its tensors, in torch's thread for that."""
        views = self.unpack()
        return StepBatch(views=views and views.pin_memory(), skipped=self.skipped)


class StepDataset(Dataset[StepBatch]):
    """Batches by number: ``share.accumulate`` to each optimisation step.

    Args:
        folders: Shards of each source.
        chooser: Says which graph stands where.
        variation: Draws shapes and colours.
        share: Which slots are this device's.
    """

    def __init__(
        self,
        folders: list[ShardFolder],
        chooser: SampleChooser,
        variation: Variation,
        share: DeviceShare,
    ) -> None:
        self.folders = folders
        self.chooser = chooser
        self.variation = variation
        self.share = share

    def describe(self, number: int) -> StepPlan:
        """Draw a batch: which graphs, of which shape, in which colours. Reads nothing."""
        step, part = divmod(number, self.share.accumulate)
        slots = self.share.slots(part, self.chooser.slots_per_step)
        return StepPlan(
            step=step,
            image_size=self.variation.draw_image_size(step),
            slots=tuple(self._describe_slot(step, slot) for slot in slots),
        )

    def __getitem__(self, number: int) -> StepBatch:
        """Read this device's graphs of a batch."""
        plan = self.describe(number)
        skipped: list[str] = []
        graphs: list[KeyedGraph] = []
        for slot in plan.slots:
            folder = self.folders[slot.source]
            graph = read_or_another(folder, slot.graph, plan.image_size, skipped, slot.colors)
            if graph is None:
                # Not raised here: an error that leaves a worker arrives as a traceback.
                return StepBatch(views=None, skipped=skipped)
            graphs.append(graph)
        return StepBatch(views=lay_out(graphs), skipped=skipped)

    def _describe_slot(self, step: int, slot: int) -> SlotPlan:
        source, graph = self.chooser.choose(step, slot)
        folder = self.folders[source]
        return SlotPlan(
            slot=slot,
            source=source,
            graph=graph,
            key=folder.key(graph),
            colors=self.variation.draw_colors(step, slot, folder.num_views),
        )


def read_or_another(
    folder: ShardFolder,
    index: int,
    image_size: tuple[int, int],
    skipped: list[str],
    colors: Sequence[ColorChange] = (),
) -> KeyedGraph | None:
    """Read a graph for a batch; others of its folder stand in for an unreadable one.

    The others are far apart in the folder, since unreadable graphs come in whole shards. Which
    they are depends on ``index`` alone.

    Args:
        folder: Where it is.
        index: Which one.
        image_size: (height, width).
        skipped: Receives a line for each unreadable one.
        colors: Change of each image's colours; empty: none.

    Returns:
        None where ``MAX_ATTEMPTS`` in a row cannot be read, or at once where the place does not
        answer at all.
    """
    total = len(folder)
    stride = max(1, round(_GOLDEN * total))
    while math.gcd(stride, total) > 1:  # else some graphs would never be tried
        stride += 1
    for attempt in range(min(MAX_ATTEMPTS, total)):
        current = (index + attempt * stride) % total
        try:
            return _read_fitted(folder, current, image_size, colors)
        except UnreachableError as error:
            skipped.append(str(error))
            return None
        except DataError as error:
            skipped.append(f"{folder.key(current)}: {error}")
    return None


def read_graph(folder: ShardFolder, index: int, image_size: tuple[int, int]) -> Views:
    """Read one graph as a batch of one, its colours as stored.

    Args:
        folder: Where it is.
        index: Which one.
        image_size: (height, width).

    Raises:
        DataError: The graph cannot be read.
    """
    return lay_out([_read_fitted(folder, index, image_size)]).unpack()


def _read_fitted(
    folder: ShardFolder,
    index: int,
    image_size: tuple[int, int],
    colors: Sequence[ColorChange] = (),
) -> KeyedGraph:
    fitted = resize_crop([folder.read(index)], image_size=image_size)
    (graph,) = jitter_colors(fitted, changes=colors)
    return graph
