"""``sweep.json``: what a folder of runs is, for reports that come later, from anywhere."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from l3r.config import from_plain, to_plain
from l3r.errors import DataError
from l3r.files import write_atomic
from l3r.launch.expand import Run, Sweep
from l3r.launch.sweep_config import EvaluateConfig, SweepConfig

NAME = "sweep.json"
_VERSION = 1


def write_sweep(sweep: Sweep) -> None:
    """Write ``sweep.json`` into the folder of a sweep, which is made where absent."""
    plain = {
        "version": _VERSION,
        "file": str(sweep.file),
        "extra": sweep.extra,
        "spec": asdict(sweep.spec),
        "num_views": sweep.num_views,
        "changes": sweep.changes,
        "runs": [_plain_run(run) for run in sweep.runs],
    }
    sweep.out.mkdir(parents=True, exist_ok=True)
    write_atomic(sweep.out / NAME, json.dumps(plain, indent=1) + "\n")


def read_sweep(folder: Path) -> Sweep:
    """Read the sweep of a folder, which may have been moved.

    Raises:
        DataError: There is none, or it cannot be read.
    """
    path = folder / NAME
    try:
        plain = json.loads(path.read_text())
        if plain["version"] != _VERSION:
            raise ValueError(f"version {plain['version']}, expected {_VERSION}")
        spec = {**plain["spec"], "evaluate": EvaluateConfig(**plain["spec"]["evaluate"])}
        return Sweep(
            file=Path(plain["file"]),
            extra=tuple(plain["extra"]),
            out=folder,
            spec=SweepConfig(**spec),
            num_views=plain["num_views"],
            changes={
                row: {key: (before, now) for key, (before, now) in changed.items()}
                for row, changed in plain["changes"].items()
            },
            runs=tuple(_read_run(run, folder) for run in plain["runs"]),
        )
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise DataError(
            f"{path}: not the file that l3r sweep writes ({error}); run l3r sweep again, it leaves "
            "finished runs alone"
        ) from error


def _plain_run(run: Run) -> dict[str, Any]:
    return {
        "row": run.row,
        "seed": run.seed,
        "layers": run.layers,
        "checkpoint": None if run.config is not None else str(run.checkpoint),
        "config": None if run.config is None else to_plain(run.config),
    }


def _read_run(plain: dict[str, Any], out: Path) -> Run:
    folder = out / plain["row"] / f"seed_{plain['seed']}"
    is_trained = plain["config"] is not None
    return Run(
        row=plain["row"],
        seed=plain["seed"],
        folder=folder,
        layers=tuple(plain["layers"]),
        checkpoint=folder / "model.ckpt" if is_trained else Path(plain["checkpoint"]),
        config=from_plain(plain["config"], str(out / NAME)) if is_trained else None,
    )
