"""How it is trained."""

from dataclasses import dataclass, field
from typing import Literal

from l3r.config.check import require
from l3r.config.model import Precision


@dataclass(kw_only=True, slots=True)
class TrainConfig:
    """Optimiser, schedule, checkpoints."""

    output_dir: str = "runs/train"
    """Where checkpoints, ``metrics.csv`` and ``config.yaml`` go; a run found there is resumed."""
    note: str = ""
    """What whoever uses the weights should know; ``l3r reconstruct`` prints it."""
    init: str = ""
    """Weights to start from: a Light3R checkpoint, or an official file (docs/weights.md); a resumed
    run does not read it."""
    seed: int = 0
    """Seed of weights and of every sample drawn."""
    max_steps: int = 100_000
    """Optimisation steps."""
    lr: float = 1e-6
    """Learning rate at 64 images (8 graphs of 8) a step; scaled linearly with images a step."""
    weight_decay: float = 5e-4
    """Weight decay; none on 1-D parameters."""
    betas: list[float] = field(default_factory=lambda: [0.9, 0.95])
    """AdamW's moments."""
    schedule: Literal["constant", "cosine"] = "constant"
    """Learning rate after the warm-up."""
    warmup_steps: int = 0
    """Steps of linear warm-up."""
    min_lr_ratio: float = 0.01
    """What the cosine ends at, as a share of ``lr``."""
    clip_norm: float | None = None
    """Clip the gradient's norm; off by default."""
    ema_decay: float | None = None
    """Validate and deliver the exponential moving average of the weights, of which a step leaves
    this share (0.9999, say); null: the weights themselves."""
    max_bad_steps: int = 3
    """Stop after so many steps in a row with a loss or gradient that is not finite."""
    checkpoint_every: int = 1000
    """Steps between checkpoints."""
    checkpoint_minutes: float | None = None
    """A checkpoint after so many minutes without one too; null: by steps alone."""
    validate_every: int = 1000
    """Steps between validations."""
    validation_graphs: int = 32
    """Graphs of each place of ``data.validation``, the same at every validation; 0: none."""
    log_every: int = 50
    """Steps between rows of ``metrics.csv``."""
    accelerator: Literal["auto", "cpu", "gpu"] = "auto"
    """Where to train; ``auto`` takes a GPU if there is one."""
    devices: int | None = None
    """Processes on each node, one for each device; null: as many as srun started, else one."""
    num_nodes: int | None = None
    """Nodes; null: as many as srun started processes on, else one."""
    strategy: Literal["ddp", "fsdp"] = "ddp"
    """Of several processes: each holds the whole network, or a share of its weights, gradients and
    optimiser, which it gathers block by block."""
    accumulate: int = 1
    """Batches in which a device takes its graphs of a step, one after the other: memory for time.
    ``data.graphs_per_step`` is that of all devices and batches."""
    timeout_minutes: float = 30.0
    """The run ends when a process has waited for another for so long."""
    precision: Precision = "fp32"
    """Of encoder, alignment and decoder; weights, heads, Procrustes and loss stay in float32."""
    tf32: bool = True
    """Let NVIDIA GPUs round the factors of the network's float32 products to 10 bits of mantissa;
    Procrustes and loss never do, and validation computes as inference does."""
    compile: bool = False
    """Compile transformer blocks and DPT heads; the first steps take minutes, later ones less."""
    gradient_checkpointing: bool = False
    """Keep only the input of every block for the backward pass, which computes it again."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for key in (
            "max_steps",
            "checkpoint_every",
            "validate_every",
            "log_every",
            "max_bad_steps",
        ):
            require(getattr(self, key) >= 1, f"train.{key}", getattr(self, key), "1 or more")
        for key in ("devices", "num_nodes", "accumulate"):
            value = getattr(self, key)
            require(value is None or value >= 1, f"train.{key}", value, "1 or more")
        for key in ("timeout_minutes", "checkpoint_minutes"):
            value = getattr(self, key)
            require(value is None or value > 0, f"train.{key}", value, "more than 0")
        for key in ("warmup_steps", "weight_decay", "validation_graphs", "min_lr_ratio"):
            require(getattr(self, key) >= 0, f"train.{key}", getattr(self, key), "0 or more")
        both = self.strategy == "fsdp" and self.compile
        require(not both, "train.compile", self.compile, "false under train.strategy=fsdp")
        require(self.lr > 0, "train.lr", self.lr, "more than 0")
        betas = self.betas
        in_range = len(betas) == 2 and all(0 <= beta < 1 for beta in betas)
        require(in_range, "train.betas", betas, "two numbers from 0 to less than 1")
        decay = self.ema_decay
        in_range = decay is None or 0 <= decay < 1
        require(in_range, "train.ema_decay", decay, "null or 0 to less than 1")
        clip = self.clip_norm
        require(clip is None or clip > 0, "train.clip_norm", clip, "null or more than 0")
