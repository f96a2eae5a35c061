"""What is trained on."""

from dataclasses import dataclass, field

from l3r.config.check import require


@dataclass(kw_only=True, slots=True)
class SourceConfig:
    """One folder of shards."""

    shards: str = "???"
    """Folder that holds ``manifest.json``, the tars and their indices, or its http(s) address."""
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
    image_sizes: list[list[int]] = field(default_factory=list)
    """[height, width] of training batches [px], landscape or square: each step draws one, the same
    on all devices. Empty: ``model.image_size`` alone, which validation always has."""
    color_jitter: list[float] = field(default_factory=lambda: [0.5, 0.5, 0.5, 0.1])
    """Strengths of brightness, contrast, saturation and hue, drawn for each image of a training
    batch as torchvision's ColorJitter does; all zero: none."""
    num_workers: int = 2
    """Loader processes of each device; 0 loads in the training process."""
    prefetch_factor: int = 2
    """Batches that each loader process reads ahead."""
    max_skip_rate: float = 0.01
    """Share of unreadable samples, among a device's last 1,000, above which the run stops."""
    cache_dir: str = ""
    """Folder on a local disk that keeps graphs read from http(s) addresses; empty: none."""
    cache_gb: float = 0.0
    """Size of that folder [10^9 bytes]; the graphs unused for longest make room."""

    def __post_init__(self) -> None:
        """Check ranges."""
        require(2 <= self.num_views <= 10, "data.num_views", self.num_views, "2 to 10")
        require(
            self.graphs_per_step >= 1, "data.graphs_per_step", self.graphs_per_step, "1 or more"
        )
        require(self.num_workers >= 0, "data.num_workers", self.num_workers, "0 or more")
        require(0 <= self.max_skip_rate <= 1, "data.max_skip_rate", self.max_skip_rate, "0 to 1")
        require(
            self.prefetch_factor >= 1, "data.prefetch_factor", self.prefetch_factor, "1 or more"
        )
        for size in self.image_sizes:
            require(
                len(size) == 2 and 1 <= size[0] <= size[1],
                "data.image_sizes",
                self.image_sizes,
                "a list of [height, width], height at most width",
            )
        jitter = self.color_jitter
        in_range = len(jitter) == 4 and all(x >= 0 for x in jitter) and jitter[3] <= 0.5
        words = "[brightness, contrast, saturation, hue], each 0 or more, hue at most 0.5"
        require(in_range, "data.color_jitter", jitter, words)
        require(self.cache_gb >= 0, "data.cache_gb", self.cache_gb, "0 or more")
