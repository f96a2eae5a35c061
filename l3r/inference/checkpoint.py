"""Checkpoints: weights and the configuration that made them, nothing else needed."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from l3r.config import RunConfig, from_plain, load_config, override_config, to_plain
from l3r.model.light3r import Light3R
from l3r.model.pretrained import build_network
from l3r.model.weight_files import (
    MODEL_PREFIX,
    read_weight_file,
    require_own,
    write_checkpoint,
)
from l3r.version import __version__


def load_model(path: str | Path, device: str | torch.device = "cpu") -> Light3R:
    """Load a network, ready for inference.

    Args:
        path: A checkpoint written by ``l3r train`` or ``l3r weights import``, or a folder written
            by ``Light3R.save_pretrained``.
        device: Where the network goes.

    Raises:
        CheckpointError: The file is missing, cut off, no Light3R checkpoint, or does not fit.
    """
    return load_model_and_config(path, device)[0]


def load_model_and_config(
    path: str | Path, device: str | torch.device = "cpu", settings: Sequence[str] = ()
) -> tuple[Light3R, RunConfig]:
    """Load a network together with the configuration of the run that trained it.

    Args:
        path: See :func:`load_model`; what a folder does not say has its default.
        device: Where the network goes.
        settings: ``inference.key=value`` and ``graph.key=value`` to change.

    Raises:
        CheckpointError: See :func:`load_model`.
        ConfigError: A setting cannot be used.
    """
    checkpoint = read_checkpoint(Path(path), mapped=True)
    config = from_plain(checkpoint["l3r_config"], str(path))
    config = override_config(config, settings, ("inference", "graph"))
    return build_network(Light3R, config, checkpoint, str(path)).to(device).eval(), config


def build_untrained(
    layers: Sequence[str], device: str | torch.device = "cpu"
) -> tuple[Light3R, RunConfig]:
    """Build a network with the fresh weights that a training run of these layers starts from.

    Raises:
        ConfigError: The layers cannot be used.
    """
    config = load_config(layers)
    torch.manual_seed(config.train.seed)
    return Light3R(config.model, config.graph).to(device).eval(), config


def read_checkpoint(path: Path, *, mapped: bool = False) -> dict[str, Any]:
    """Read a checkpoint without executing anything in it.

    Args:
        path: See :func:`load_model`.
        mapped: See :func:`~l3r.model.weight_files.read_weight_file`.

    Raises:
        CheckpointError: The file is missing, cut off or no Light3R checkpoint.
    """
    content = read_weight_file(path, mapped=mapped)
    require_own(content, str(path))
    return content


def write_model(path: Path, model: Light3R, config: RunConfig) -> None:
    """Write weights and configuration alone, without the optimiser."""
    write_weights(path, model.state_dict(), config)


def write_weights(path: Path, weights: Mapping[str, Tensor], config: RunConfig) -> None:
    """Write the weights of a network, under its own names, and their configuration."""
    named = {MODEL_PREFIX + key: value.cpu() for key, value in weights.items()}
    content = {"state_dict": named, "l3r_config": to_plain(config), "l3r_version": __version__}
    write_checkpoint(path, content)
