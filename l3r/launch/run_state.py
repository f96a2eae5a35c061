"""How far a run of a sweep is, from its folder alone; needs no torch."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from l3r.config import RunConfig, find_changes
from l3r.errors import ConfigError
from l3r.export.run_folder import RunFolder, read_run_folder
from l3r.export.run_report import recent_rate
from l3r.launch.expand import Run, Sweep
from l3r.launch.score_file import read_scores, scoring_request
from l3r.launch.twins import find_twins, read_twin

Kind = Literal["new", "waiting", "begun", "trained", "scored", "diverged", "failed"]
"""``waiting``: for a checkpoint that others make. ``begun``: under way, or to be gone on with."""
OVER: tuple[Kind, ...] = ("scored", "diverged")
"""What is not begun again."""
FAILURE = "failure.txt"
"""File in a run's folder that says why a process of it failed."""
LOG = "log.txt"
"""File with what a run's processes said."""


@dataclass(frozen=True, kw_only=True)
class RunState:
    """A run as its files tell it."""

    kind: Kind
    step: int = 0
    """Last optimisation step that was logged."""
    max_steps: int | None = None
    """Steps of the training; None where a checkpoint is only scored."""
    detail: str = ""
    """Why it failed or diverged."""
    scores: Mapping[str, Any] | None = None
    """Content of ``scores.json``, where it is of use."""
    step_seconds: float | None = None
    """Median of the last rows of the log."""
    gpu_gib: float | None = None
    """Peak memory on a GPU."""
    num_devices: int | None = None
    """GPUs that it was last trained on; None on a CPU, or where it never began."""
    trained_on: Mapping[str, str] = field(default_factory=dict)
    """Places of the shards that it was last trained on, by source."""
    twin: Path | None = None
    """Folder of the same training in a neighbouring sweep, that it was or will be taken from."""

    def describe(self) -> str:
        """Say it in a few words."""
        if self.twin is None:
            return self._describe()
        return f"{self._describe()}, of {'/'.join(self.twin.parts[-3:-1])}"

    def _describe(self) -> str:
        of = f"step {self.step:,} of {self.max_steps:,}" if self.max_steps is not None else ""
        match self.kind:
            case "begun":
                return f"goes on, reached {of}"
            case "diverged":
                return f"diverged: {self.detail}"
            case "failed" | "waiting":
                return f"{self.kind}: {self.detail}"
            case "trained":
                return "trained, not scored"
        return self.kind


def read_state(run: Run, request: Mapping[str, Any]) -> RunState:
    """Find out how far a run is.

    Args:
        run: The run.
        request: What it is scored on; other scores do not count.

    Raises:
        ConfigError: Its folder holds a run of another configuration.
    """
    state = _trained_state(run) if run.config is not None else _scored_state(run)
    failure = run.folder / FAILURE
    if state.kind in ("new", "begun", "trained") and failure.is_file():
        said = failure.read_text().strip()
        return replace(state, kind="failed", detail=f"{said}; see {run.folder / LOG}")
    is_at_end = state.kind == "begun" and state.step == state.max_steps
    if state.kind not in ("trained", "waiting") and not is_at_end:
        return state
    scores = read_scores(run, request)
    if scores is None:
        return state
    if scores["problem"]:
        return replace(state, kind="diverged", detail=str(scores["problem"]))
    return replace(state, kind="scored", scores=scores)


def read_states(sweep: Sweep) -> dict[str, RunState]:
    """Find out how far all runs are, by name."""
    request = scoring_request(sweep)
    return {run.name: read_state(run, request) for run in sweep.runs}


def _scored_state(run: Run) -> RunState:
    if not run.checkpoint.is_file():
        return RunState(kind="waiting", detail=f"no {run.checkpoint} yet")
    return RunState(kind="trained")


def _trained_state(run: Run) -> RunState:
    assert run.config is not None
    state = RunState(kind="new", max_steps=run.config.train.max_steps)
    if not (run.folder / "config.yaml").is_file():
        for other in find_twins(run):
            found = _trained_state(replace(run, folder=other))
            if found.kind == "trained":
                return replace(found, twin=other)
        return state
    folder = read_run_folder(run.folder)
    if folder.config is None:
        raise ConfigError(
            f"{run.folder / folder.problems[0]}; mend it, or give --out or output_dir for new runs"
        )
    _require_same(run.folder / "config.yaml", folder.config, run.config)
    places = {name: source.shards for name, source in folder.config.data.sources.items()}
    twin = read_twin(run)
    state = replace(state, **_measured(folder, run.config), trained_on=places, twin=twin)
    if bad := _last_bad_step(folder, run.config.train.max_bad_steps):
        return replace(state, kind="diverged", detail=bad)
    is_written = folder.is_complete and not _is_superseded(run)
    if is_written and state.step >= run.config.train.max_steps:
        return replace(state, kind="trained")
    return replace(state, kind="begun" if len(folder.training["step"]) else "new")


def _is_superseded(run: Run) -> bool:
    """Tell whether weights are those of a shorter training, which has gone on and saved since."""
    last, weights = run.folder / "last.ckpt", run.folder / "model.ckpt"
    return last.is_file() and last.stat().st_mtime > weights.stat().st_mtime


def _measured(folder: RunFolder, config: RunConfig) -> dict[str, Any]:
    steps = folder.training["step"]
    rate = recent_rate(folder.training)
    memory = folder.training.get("gpu_gib", np.zeros(0))
    memory = memory[np.isfinite(memory)]
    is_cpu = folder.machine.get("device", "CPU") == "CPU"
    return {
        "step": int(steps[-1]) if len(steps) else 0,
        "step_seconds": config.data.graphs_per_step / rate if rate else None,
        "gpu_gib": float(memory.max()) if len(memory) else None,
        "num_devices": None if is_cpu else int(folder.machine.get("processes", 1)),
    }


def _last_bad_step(folder: RunFolder, max_bad_steps: int) -> str:
    """Say where a run was given up; empty where it was not."""
    rows = folder.bad_steps[-max_bad_steps:]
    steps = [int(row["step"]) for row in rows]
    logged = folder.training["step"]
    if not steps or (len(logged) and logged[-1] > steps[-1] + 1):
        return ""
    if rows[-1]["problem"]:
        return f"step {steps[-1]}: {rows[-1]['problem']}"
    if steps != list(range(steps[0], steps[0] + max_bad_steps)):
        return ""
    return (
        f"{max_bad_steps} steps in a row were not finite, the last one {steps[-1]} (loss "
        f"{rows[-1]['loss']}, gradient {rows[-1]['grad_norm']})"
    )


def _require_same(path: Path, found: RunConfig, wanted: RunConfig) -> None:
    changes = find_changes(found, wanted)
    changes.pop("train.output_dir", None)  # of a folder that was moved
    if not changes:
        return
    # Brings torch, hence only where there is something to ask.
    from l3r.train.checkpointing import may_change

    for key, (old, new) in changes.items():
        if key.startswith("data.validation."):
            continue  # changes nothing that is learnt, and scores say what they are of
        # A run that is resumed does not read it again; a run of a sweep is told by it.
        if key == "train.init" or not may_change(key, wanted):
            raise ConfigError(
                f"{path}: made with {key}={old}, this sweep has {new}; give --out or output_dir "
                "for the runs of this one"
            )
