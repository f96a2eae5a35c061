"""What is trained on."""

from dataclasses import dataclass, field

from l3r.config.check import require


@dataclass(kw_only=True, slots=True)
class SourceConfig:
    """One folder of shards."""

    shards: str = "???"
    """Folder that holds ``manifest.json`` and the tars."""
    weight: float = 1.0
    """Relative frequency of its graphs."""
    span: list[float] = field(default_factory=lambda: [0.0, 1.0])
    """[first, last] share of its graphs, in stored order: [0, 0.9] trains, [0.9, 1] is held out."""

    def __post_init__(self) -> None:
        """Check ranges."""
        require(self.weight > 0, "data.sources.*.weight", self.weight, "more than 0")
        span = self.span
        require(
            len(span) == 2 and 0 <= span[0] < span[1] <= 1,
            "data.*.span",
            span,
            "[first, last], rising, from 0 to 1",
        )


@dataclass(kw_only=True, slots=True)
class DataConfig:
    """Sources and batches."""

    sources: dict[str, SourceConfig] = field(default_factory=dict)
    """Training shards by name."""
    validation: dict[str, SourceConfig] = field(default_factory=dict)
    """Validation shards by name; none: no validation."""
    num_views: int = 8
    """N: the first N images of each stored graph."""
    graphs_per_step: int = 8
    """Graphs of one optimisation step, over all devices."""
    num_workers: int = 2
    """Loader processes of each device; 0 loads in the training process."""
    max_skip_rate: float = 0.01
    """Share of unreadable samples above which the run stops."""

    def __post_init__(self) -> None:
        """Check ranges."""
        require(2 <= self.num_views <= 10, "data.num_views", self.num_views, "2 to 10")
        require(
            self.graphs_per_step >= 1, "data.graphs_per_step", self.graphs_per_step, "1 or more"
        )
        require(self.num_workers >= 0, "data.num_workers", self.num_workers, "0 or more")
        require(0 <= self.max_skip_rate <= 1, "data.max_skip_rate", self.max_skip_rate, "0 to 1")
