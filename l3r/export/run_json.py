"""``run.json``: what ran, on what, for how long, and what it left out."""

import json
import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from l3r.files import write_atomic
from l3r.types import Reconstruction
from l3r.version import __version__

VERSION = 1


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """All that is known of a run beside the reconstruction itself."""

    command: Sequence[str] = ()
    """The command line."""
    config: Mapping[str, Any] = field(default_factory=dict)
    """The whole configuration as builtins."""
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    """Of the tree, as :mod:`l3r.graph.diagnostics` gives it."""
    skipped: Sequence[tuple[str, str]] = ()
    """(file, reason) of images that could not be used."""
    warnings: Sequence[str] = ()
    """What a user should know."""
    device: str = ""
    """Where it ran; empty: the accelerator there is, else the processor."""
    files: Sequence[str] = ()
    """What was written, relative to the folder; only these may be replaced by a later run."""


def write_run(
    path: Path, scene: Reconstruction, record: RunRecord, seconds: Mapping[str, float] | None = None
) -> None:
    """Write the record of a run.

    Args:
        path: The file to write.
        scene: Gives counts, point rules, seconds and peak memory.
        record: The rest.
        seconds: Wall time of every stage, those of the export included; by default the scene's.
    """
    stages = dict(scene.seconds if seconds is None else seconds)
    content = {
        "version": VERSION,
        "command": list(record.command),
        "versions": {
            "l3r": __version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
        },
        "device": record.device or device_name(),
        "images": len(scene.cameras.file),
        "registered": int(scene.cameras.registered.sum()),
        "components": num_components(scene),
        "skipped": [{"file": file, "reason": reason} for file, reason in record.skipped],
        "warnings": list(record.warnings),
        "point_rule": dict(zip(scene.cameras.file, scene.point_rule, strict=True)),
        "seconds": stages,
        "seconds_total": sum(stages.values()),
        "peak_mib": dict(scene.peak_mib),
        "tree": record.diagnostics,
        "config": record.config,
        "files": list(record.files),
    }
    text = json.dumps(_finite(content), indent=1, ensure_ascii=False, allow_nan=False)
    write_atomic(path, text + "\n")


def device_name() -> str:
    """Name the accelerator where there is one, else the processor's architecture."""
    if torch.cuda.is_available():
        return str(torch.cuda.get_device_name())
    return f"cpu ({platform.machine()}, {torch.get_num_threads()} threads)"


def num_components(scene: Reconstruction) -> int:
    """Count the connected parts of the scene."""
    return len(set(scene.cameras.component.tolist()))


def _finite(value: Any) -> Any:
    """Builtins only, with null for NaN and infinity, which JSON does not know."""
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
