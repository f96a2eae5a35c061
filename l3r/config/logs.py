"""What a training run writes about itself beside its CSV files."""

from dataclasses import dataclass, field
from typing import Literal

from l3r.config.check import require


@dataclass(kw_only=True, slots=True)
class LogsConfig:
    """Where figures go beside ``metrics.csv`` and ``validation.csv``; free to change at resume."""

    to: list[str] = field(default_factory=list)
    """Any of ``tensorboard`` (folder ``tensorboard`` of the run; extra ``log``) and ``wandb``."""
    wandb_mode: Literal["online", "offline"] = "offline"
    """``offline`` writes to the run's folder alone, for ``wandb sync`` later."""
    wandb_project: str = "light3r"
    """Project of Weights & Biases."""
    pictures: bool = True
    """Draw the first validation graph at each validation: photos, depth, confidence; in
    ``pictures``."""

    def __post_init__(self) -> None:
        """Check values."""
        known = all(name in ("tensorboard", "wandb") for name in self.to)
        require(known, "logs.to", self.to, "a list of tensorboard and wandb, or an empty one")
