"""Checkpoints: weights and the configuration that made them, nothing else needed."""

import pickle
import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from l3r.config import RunConfig, from_plain, load_config, override_config
from l3r.errors import CheckpointError
from l3r.model.light3r import Light3R

_UNREADABLE = (
    pickle.UnpicklingError,
    struct.error,
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""What torch's restricted unpickler raises on bytes that are no checkpoint."""
MODEL_PREFIX = "model."
"""Where the network's weights stand in a training checkpoint."""


def load_model(path: str | Path, device: str | torch.device = "cpu") -> Light3R:
    """Load a network, ready for inference.

    Args:
        path: A checkpoint written by ``l3r train``.
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
        path: A checkpoint written by ``l3r train``.
        device: Where the network goes.
        settings: ``inference.key=value`` and ``graph.key=value`` to change.

    Raises:
        CheckpointError: See :func:`load_model`.
        ConfigError: A setting cannot be used.
    """
    checkpoint = read_checkpoint(Path(path))
    config = from_plain(checkpoint["l3r_config"], str(path))
    config = override_config(config, settings, ("inference", "graph"))
    model = Light3R(config.model, config.graph)
    weights = {
        key.removeprefix(MODEL_PREFIX): value
        for key, value in checkpoint["state_dict"].items()
        if key.startswith(MODEL_PREFIX)
    }
    try:
        model.load_state_dict(weights)
    except RuntimeError as error:
        first = " ".join(str(error).split("\n")[1:2]).strip()
        raise CheckpointError(
            f"{path}: weights do not fit the configuration in the file: {first}"
        ) from error
    return model.to(device).eval(), config


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


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint without executing anything in it.

    Raises:
        CheckpointError: The file is missing, cut off or no Light3R checkpoint.
    """
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file; expected a checkpoint of 'l3r train'")
    try:
        if not zipfile.is_zipfile(path):  # torch would fall back to bare pickles
            raise ValueError("no zip archive")
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except _UNREADABLE as error:
        reason = str(error).split("\n")[0].split(". ")[0]
        raise CheckpointError(
            f"{path}: cannot be read safely ({reason}); expected a checkpoint of 'l3r train'"
        ) from error
    missing = {"l3r_config", "state_dict"} - set(checkpoint if isinstance(checkpoint, dict) else ())
    if missing:
        raise CheckpointError(
            f"{path}: no {' and no '.join(sorted(missing))} inside; expected a checkpoint of "
            "'l3r train'"
        )
    return dict(checkpoint)
