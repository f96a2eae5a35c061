"""What stands in which slot of which step: a pure function, hence exact resume."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from l3r.data.color import ColorChange, draw_color_changes

# Streams of randomness that must not meet: the second word of every seed.
DRAW_SOURCE, SHUFFLE, DRAW_SIZE, DRAW_COLOR = 1, 2, 3, 4


class SampleChooser:
    """Choose a source and a graph for each global slot of each step.

    The choice depends on (seed, step, global slot) and on nothing else: another number of devices
    or workers sees the same samples, and no state must be kept but the step. Slots are counted
    over all steps, so that another number of slots a step gives the same graphs in the same order.
    A source alone runs through a permutation of its graphs before any comes again; of several,
    each uses those parts of its permutations that its slots fall on.

    Args:
        sizes: Graphs of each source.
        weights: Relative frequency of each source.
        slots_per_step: Graphs of one step over all devices.
        seed: Seed of all choices.
    """

    def __init__(
        self, sizes: Sequence[int], weights: Sequence[float], slots_per_step: int, seed: int
    ) -> None:
        self.sizes = tuple(sizes)
        self.share = np.cumsum(np.asarray(weights, dtype=float) / np.sum(weights))
        self.slots_per_step = slots_per_step
        self.seed = seed

    def choose(self, step: int, slot: int) -> tuple[int, int]:
        """Return (source, graph within it) for one slot of one step."""
        place, source = step * self.slots_per_step + slot, 0
        if len(self.sizes) > 1:
            draw = np.random.default_rng((self.seed, DRAW_SOURCE, place)).random()
            source = min(int(np.searchsorted(self.share, draw, side="right")), len(self.sizes) - 1)
        # Counted over the slots of all sources: a source uses part of each of its permutations.
        epoch, position = divmod(place, self.sizes[source])
        order = _permutation(self.seed, source, epoch, self.sizes[source])
        return source, int(order[position])


@dataclass(frozen=True, kw_only=True)
class Variation:
    """How training images vary: the shape from step to step, the colours from image to image.

    Shapes depend on (seed, step), so that all devices agree, and colours on (seed, step, global
    slot, view).

    Args:
        image_sizes: (height, width), one of which each step takes.
        color_jitter: Strengths of brightness, contrast, saturation and hue.
        seed: Seed of all draws.
    """

    image_sizes: tuple[tuple[int, int], ...]
    color_jitter: tuple[float, float, float, float]
    seed: int

    def draw_image_size(self, step: int) -> tuple[int, int]:
        """Draw the (height, width) of a step's images; all are equally likely."""
        if len(self.image_sizes) == 1:
            return self.image_sizes[0]
        rng = np.random.default_rng((self.seed, DRAW_SIZE, step))
        return self.image_sizes[int(rng.integers(len(self.image_sizes)))]

    def draw_colors(self, step: int, slot: int, num_views: int) -> tuple[ColorChange, ...]:
        """Draw the change of colours of each image of one slot; empty without jitter."""
        if not any(self.color_jitter):
            return ()
        rng = np.random.default_rng((self.seed, DRAW_COLOR, step, slot))
        return draw_color_changes(rng, self.color_jitter, num_views)


@lru_cache(maxsize=32)
def _permutation(seed: int, source: int, epoch: int, size: int) -> np.ndarray:
    return np.random.default_rng((seed, SHUFFLE, source, epoch)).permutation(size)
