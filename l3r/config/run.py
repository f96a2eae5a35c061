"""The whole configuration of a run."""

from dataclasses import dataclass, field

from l3r.config.check import require
from l3r.config.data import DataConfig
from l3r.config.graph import GraphConfig
from l3r.config.inference import InferenceConfig
from l3r.config.logs import LogsConfig
from l3r.config.loss import LossConfig
from l3r.config.model import ModelConfig
from l3r.config.train import TrainConfig


@dataclass(kw_only=True, slots=True)
class RunConfig:
    """One section per room."""

    model: ModelConfig = field(default_factory=ModelConfig)
    """The network."""
    graph: GraphConfig = field(default_factory=GraphConfig)
    """Tree and accumulation."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Training loss."""
    data: DataConfig = field(default_factory=DataConfig)
    """Sources and batches."""
    train: TrainConfig = field(default_factory=TrainConfig)
    """Optimisation."""
    logs: LogsConfig = field(default_factory=LogsConfig)
    """What a run writes about itself."""
    inference: InferenceConfig = field(default_factory=InferenceConfig)
    """Reconstruction."""

    def __post_init__(self) -> None:
        """Check ranges across sections."""
        patch = self.model.encoder.patch_size
        require(
            all(side % patch == 0 for size in self.data.image_sizes for side in size),
            "data.image_sizes",
            self.data.image_sizes,
            f"multiples of model.encoder.patch_size = {patch}",
        )
