"""Optimiser and learning rate, from the configuration alone.

Never from ``trainer.estimated_stepping_batches``: asking for it makes lightning forget the
loader's state at resume.
"""

import math

import torch
from torch import nn

from l3r.config import RunConfig

REFERENCE_IMAGES = 64
"""``train.lr`` holds at 8 graphs of 8 images a step; the rate scales linearly from there."""


def build_optimizer(model: nn.Module, config: RunConfig) -> torch.optim.AdamW:
    """Build AdamW; 1-D parameters (norms, biases) do not decay."""
    train = config.train
    images = config.data.graphs_per_step * config.data.num_views
    decayed = [p for p in model.parameters() if p.ndim > 1]
    free = [p for p in model.parameters() if p.ndim <= 1]
    return torch.optim.AdamW(
        [
            {"params": decayed, "weight_decay": train.weight_decay},
            {"params": free, "weight_decay": 0.0},
        ],
        lr=train.lr * images / REFERENCE_IMAGES,
        betas=(train.betas[0], train.betas[1]),
        fused=True,
    )


def build_schedule(
    optimizer: torch.optim.Optimizer, config: RunConfig
) -> torch.optim.lr_scheduler.LambdaLR:
    """Build the schedule, one value a step."""

    def factor(step: int) -> float:
        return lr_factor(step, config)

    return torch.optim.lr_scheduler.LambdaLR(optimizer, factor)


def lr_factor(step: int, config: RunConfig) -> float:
    """Share of the full learning rate at a step: linear warm-up, then constant or half a cosine."""
    train = config.train
    if step < train.warmup_steps:
        return (step + 1) / train.warmup_steps
    if train.schedule == "constant":
        return 1.0
    progress = (step - train.warmup_steps) / max(1, train.max_steps - train.warmup_steps)
    cosine = (1 + math.cos(math.pi * min(1.0, progress))) / 2
    return train.min_lr_ratio + (1 - train.min_lr_ratio) * cosine
