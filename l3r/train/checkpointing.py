"""Checkpoints that are whole or absent."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO

from l3r.config import RunConfig, from_plain, to_plain
from l3r.errors import CheckpointError, ConfigError
from l3r.inference.checkpoint import read_checkpoint
from l3r.model.weight_files import write_checkpoint

FREE_TO_CHANGE = {
    "data.cache_dir",
    "data.cache_gb",
    "data.max_skip_rate",
    "data.num_workers",
    "data.prefetch_factor",
    "train.accelerator",
    "train.checkpoint_every",
    "train.gradient_checkpointing",
    "train.init",
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
        write_checkpoint(Path(path), checkpoint)

    def load_checkpoint(
        self, path: str | os.PathLike[str], map_location: Any = None, weights_only: Any = None
    ) -> dict[str, Any]:
        """Read a checkpoint without executing anything in it."""
        return read_checkpoint(Path(path))


def find_resume(checkpoint: Path, config: RunConfig) -> Path | None:
    """Find what a run goes on from.

    Raises:
        CheckpointError: The checkpoint cannot be read.
        ConfigError: It was made with another configuration.
    """
    if not checkpoint.exists():
        return None
    content = read_checkpoint(checkpoint, mapped=True)
    # Keys that are younger than the checkpoint count as their defaults.
    before = _flatten(to_plain(from_plain(content["l3r_config"], str(checkpoint))))
    now = _flatten(to_plain(config))
    for key in sorted(before.keys() | now.keys()):
        old, new = before.get(key), now.get(key)
        if old != new and not _is_free(key, config):
            raise ConfigError(
                f"{checkpoint}: made with {key}={old}, this run has {new}; "
                "give that value, or another train.output_dir"
            )
    if config.train.max_steps < content.get("global_step", 0):
        raise CheckpointError(f"{checkpoint}: is past train.max_steps={config.train.max_steps}")
    return checkpoint


def _is_free(key: str, config: RunConfig) -> bool:
    if key == "train.max_steps":
        return config.train.schedule == "constant"
    # Shards may move; logs and inference change nothing that is learnt.
    may_change = key.endswith(".shards") or key.startswith(("inference.", "logs."))
    return key in FREE_TO_CHANGE or may_change


def _flatten(plain: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in plain.items():
        if isinstance(value, Mapping):
            flat |= _flatten(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat
