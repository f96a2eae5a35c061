"""Trainings that a neighbouring sweep has done already: bases of two sweeps are often the same."""

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from l3r.config import to_yaml
from l3r.files import write_atomic
from l3r.launch.expand import Run
from l3r.version import __version__

TAKEN_FROM = "taken_from.txt"
"""File in a run's folder that names the one it was taken from, as ``SWEEP/ROW/seed_S``."""
_LINKED = ("last.ckpt", "model.ckpt")
_COPIED = ("metrics.csv", "validation.csv", "bad_steps.jsonl", "machine.json", "scores.json")


def find_twins(run: Run) -> Iterator[Path]:
    """Find trainings beside the sweep with the same configuration in all but ``output_dir``.

    Args:
        run: A training of a sweep in ``OUT``; looked for are ``OUT/../SWEEP/ROW/seed_S``.

    Yields:
        Folders with weights of an end, made by this version of the code. An end may be one that
        a longer training has gone on from, which the caller is to find out.
    """
    assert run.config is not None
    sweep, wanted = run.folder.parents[1], _but_folder(to_yaml(run.config))
    for path in sorted(sweep.parent.glob(f"*/*/{run.folder.name}/config.yaml")):
        folder = path.parent
        if folder.parents[1] == sweep or not (folder / "model.ckpt").is_file():
            continue
        try:
            facts = json.loads((folder / "machine.json").read_text())
            is_twin = _but_folder(path.read_text()) == wanted and facts["light3r"] == __version__
        except (OSError, ValueError, KeyError, TypeError):
            continue  # another user's, or damaged
        if is_twin:
            yield folder


def read_twin(run: Run) -> Path | None:
    """Give the folder that a run was taken from; None where it was not."""
    path = run.folder / TAKEN_FROM
    return run.folder.parents[1].parent / path.read_text().strip() if path.is_file() else None


def adopt_twin(run: Run, twin: Path) -> None:
    """Make a run of its twin, which stays as it is; weights are linked where the disk allows it.

    Args:
        run: Not begun.
        twin: A folder that :func:`find_twins` gave.
    """
    assert run.config is not None
    run.folder.mkdir(parents=True, exist_ok=True)
    for name in (*_LINKED, *_COPIED):
        own = run.folder / name
        own.unlink(missing_ok=True)
        if not (twin / name).is_file():
            continue
        if name in _COPIED:
            shutil.copyfile(twin / name, own)
            continue
        try:
            os.link(twin / name, own)
        except OSError:
            shutil.copy2(twin / name, own)
    write_atomic(run.folder / TAKEN_FROM, "/".join(twin.parts[-3:]) + "\n")
    # Without it the run counts as not begun, should this be killed half-way.
    write_atomic(run.folder / "config.yaml", to_yaml(run.config))


def _but_folder(text: str) -> list[str]:
    return [line for line in text.splitlines() if not line.startswith("  output_dir:")]
