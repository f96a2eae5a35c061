"""Checkpoints that are whole or absent."""

import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO

from l3r.config import RunConfig, to_plain
from l3r.errors import CheckpointError, ConfigError
from l3r.files import write_atomic
from l3r.inference.checkpoint import MODEL_PREFIX, read_checkpoint
from l3r.model.light3r import Light3R
from l3r.version import __version__

FREE_TO_CHANGE = {
    "data.max_skip_rate",
    "data.num_workers",
    "train.accelerator",
    "train.checkpoint_every",
    "train.log_every",
    "train.note",
    "train.output_dir",
    "train.validate_every",
    "train.validation_graphs",
}
"""Keys that may differ when a run is resumed; they do not change what is learnt."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes to a temporary name, flushes to the disk, then renames; reads without pickles."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: Any = None
    ) -> None:
        """Write a checkpoint."""
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(target, _to_bytes(checkpoint))

    def load_checkpoint(
        self, path: str | os.PathLike[str], map_location: Any = None, weights_only: Any = None
    ) -> dict[str, Any]:
        """Read a checkpoint without executing anything in it."""
        return read_checkpoint(Path(path))


def write_model(path: Path, model: Light3R, config: RunConfig) -> None:
    """Write weights and configuration alone, without the optimiser."""
    weights = {MODEL_PREFIX + key: value.cpu() for key, value in model.state_dict().items()}
    content = {"state_dict": weights, "l3r_config": to_plain(config), "l3r_version": __version__}
    write_atomic(path, _to_bytes(content))


def find_resume(checkpoint: Path, config: RunConfig) -> Path | None:
    """Find what a run goes on from.

    Raises:
        CheckpointError: The checkpoint cannot be read.
        ConfigError: It was made with another configuration.
    """
    if not checkpoint.exists():
        return None
    before = _flatten(read_checkpoint(checkpoint)["l3r_config"])
    now = _flatten(to_plain(config))
    for key in sorted(before.keys() | now.keys()):
        old, new = before.get(key), now.get(key)
        if old != new and not _is_free(key, config):
            raise ConfigError(
                f"{checkpoint}: made with {key}={old}, this run has {new}; "
                "give that value, or another train.output_dir"
            )
    if config.train.max_steps < read_checkpoint(checkpoint).get("global_step", 0):
        raise CheckpointError(f"{checkpoint}: is past train.max_steps={config.train.max_steps}")
    return checkpoint


def _is_free(key: str, config: RunConfig) -> bool:
    if key == "train.max_steps":
        return config.train.schedule == "constant"
    # Shards may move, and inference is not trained.
    return key in FREE_TO_CHANGE or key.endswith(".shards") or key.startswith("inference.")


def _to_bytes(content: Mapping[str, Any]) -> bytes:
    stream = io.BytesIO()
    torch.save(dict(content), stream)
    return stream.getvalue()


def _flatten(plain: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in plain.items():
        if isinstance(value, Mapping):
            flat |= _flatten(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat
