"""Read what a training run has left so far, whatever is missing or damaged."""

import csv
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from l3r.config import RunConfig, load_config
from l3r.errors import ConfigError, DataError

Table = dict[str, Float64[np.ndarray, " _"]]
"""Columns by name, one value a row, NaN where a cell is empty; ``step`` is always there."""


@dataclass(frozen=True, kw_only=True)
class RunFolder:
    """A run as its files tell it."""

    path: Path
    config: RunConfig | None
    """None where it cannot be read."""
    training: Table
    validation: Table
    bad_steps: list[dict[str, Any]]
    """Rows of ``bad_steps.jsonl``; ``problem`` says why one ended the run, empty: it did not."""
    machine: dict[str, Any]
    """Content of ``machine.json``."""
    pictures: list[Path]
    """Pictures of validations, by step."""
    is_complete: bool
    """Whether ``model.ckpt`` is there."""
    idle_seconds: float
    """Since the log was written to last; infinite without a log."""
    problems: list[str]
    """What is missing or damaged."""


def read_run_folder(path: Path) -> RunFolder:
    """Read a run's folder, also of one that is running or was killed.

    Raises:
        DataError: The folder holds no run.
    """
    log = path / "metrics.csv"
    if not log.is_file() and not (path / "config.yaml").is_file():
        raise DataError(
            f"{path}: no config.yaml and no metrics.csv, expected the folder of a training run; "
            "give its train.output_dir"
        )
    problems: list[str] = []
    return RunFolder(
        path=path,
        config=_read_config(path / "config.yaml", problems),
        training=_read_table(log, problems),
        validation=_read_table(path / "validation.csv", problems),
        bad_steps=_read_bad_steps(path / "bad_steps.jsonl", problems),
        machine=_read_machine(path / "machine.json", problems),
        pictures=sorted((path / "pictures").glob("step_*.png")),
        is_complete=(path / "model.ckpt").is_file(),
        idle_seconds=time.time() - log.stat().st_mtime if log.is_file() else np.inf,
        problems=problems,
    )


def _read_config(path: Path, problems: list[str]) -> RunConfig | None:
    try:
        return load_config([str(path)])
    except ConfigError as error:
        problems.append(f"config.yaml: {error}")
        return None


def _read_table(path: Path, problems: list[str]) -> Table:
    if not path.is_file():
        problems.append(f"{path.name}: not there (yet)")
        return {"step": np.zeros(0)}
    with path.open(newline="", errors="replace") as stream:
        rows = list(csv.reader(line.replace("\0", "") for line in stream))
    header, body = (rows[0], rows[1:]) if rows else ([], [])
    if "step" not in header:
        problems.append(f"{path.name}: no column 'step' in its first line")
        return {"step": np.zeros(0)}
    numbers = [found for row in body if (found := _numbers(row, len(header))) is not None]
    if len(numbers) < len(body):
        problems.append(f"{path.name}: {len(body) - len(numbers)} damaged rows left out")
    values = np.array(numbers, dtype=np.float64).reshape(-1, len(header))
    values = values[np.isfinite(values[:, header.index("step")])]
    return {name: values[:, column] for column, name in enumerate(header)}


def _numbers(row: list[str], length: int) -> list[float] | None:
    try:
        return [float(cell) if cell else np.nan for cell in row] if len(row) == length else None
    except ValueError:
        return None


def _read_bad_steps(path: Path, problems: list[str]) -> list[dict[str, Any]]:
    if not path.is_file():
        return []
    rows = []
    for line in path.read_text(errors="replace").splitlines():
        try:
            row = json.loads(line)
            found = {name: row[name] for name in ("step", "loss", "grad_norm", "keys")}
            rows.append({**found, "problem": row.get("problem", "")})
        except (json.JSONDecodeError, KeyError, TypeError):
            problems.append(f"{path.name}: a damaged line left out")
    return rows


def _read_machine(path: Path, problems: list[str]) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text())) if path.is_file() else {}
    except (ValueError, TypeError):
        problems.append(f"{path.name}: cannot be read")
        return {}
