"""The work of a build, cut into tars before any scene is opened.

Which graphs stand in which tar follows from the scenes' names and the request alone: a scene has
room for ``num_graphs`` graphs, whether it fills it or not. So any number of tasks and workers, in
any order, writes the same tars.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from data_prep.graph_sampling import SamplingOptions
from l3r.errors import DataError


@dataclass(frozen=True, kw_only=True)
class BuildRequest:
    """What a folder of shards shall hold."""

    num_graphs: int = 1000
    """Most graphs of each scene."""
    graphs_per_image: float = 1.0
    """Most graphs of each scene for each of its images, so that short scenes do not repeat."""
    graphs_per_shard: int = 128
    """Graphs of each tar; 128 of ten images of 480x640 are 1 GB."""
    seed: int = 0
    """Seed of the draw of graphs."""
    sampling: SamplingOptions = field(default_factory=SamplingOptions)
    """Thresholds of the sampler."""
    source: dict[str, Any] = field(default_factory=dict)
    """Options of the converter; only recorded and compared."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if (
            self.num_graphs < 1
            or self.graphs_per_shard < 1
            or not 0 < self.graphs_per_image < math.inf
        ):
            raise DataError(
                f"build: {self.num_graphs} graphs, {self.graphs_per_image} per image,"
                f" {self.graphs_per_shard} per shard, expected 1 or more, more than 0 per image;"
                " change --num-graphs, --graphs-per-image or --graphs-per-shard"
            )


@dataclass(frozen=True, kw_only=True)
class Part:
    """Some consecutive graphs of a scene."""

    scene: str
    """Its name."""
    first: int
    """Number of the first graph."""
    last: int
    """One past the last, if the scene has so many."""


@dataclass(frozen=True, kw_only=True)
class Unit:
    """One tar."""

    name: str
    """File name."""
    parts: tuple[Part, ...]
    """What it holds, in order."""

    @property
    def room(self) -> int:
        """Graphs it has room for."""
        return sum(part.last - part.first for part in self.parts)


@dataclass(frozen=True, kw_only=True)
class TaskShare:
    """One of several tasks that build a folder of shards together."""

    index: int = 0
    """Which one."""
    count: int = 1
    """How many there are."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if not 0 <= self.index < self.count:
            raise DataError(
                f"task {self.index} of {self.count}, expected a number from 0 to one less than the"
                " number of tasks; change --task-index or --tasks"
            )

    def take(self, units: Sequence[Unit]) -> list[Unit]:
        """Give this task's units: neighbours, since they are of the same scenes and folders."""
        first, last = (len(units) * at // self.count for at in (self.index, self.index + 1))
        return list(units[first:last])


def list_units(dataset: str, names: Sequence[str], request: BuildRequest) -> list[Unit]:
    """Cut the work into tars: several scenes in one where they are small, else several of one.

    Args:
        dataset: Name of the data set, which begins the tars' names.
        names: All its scenes, in order.
        request: What the folder shall hold.
    """
    size = request.graphs_per_shard
    scenes_each = max(1, size // request.num_graphs)
    packs: list[tuple[Part, ...]] = []
    for at in range(0, len(names), scenes_each):
        some = names[at : at + scenes_each]
        for first in range(0, request.num_graphs, size):
            last = min(first + size, request.num_graphs)
            packs.append(tuple(Part(scene=name, first=first, last=last) for name in some))
    return [
        Unit(name=f"{dataset}-{number:06d}.tar", parts=parts) for number, parts in enumerate(packs)
    ]
