"""``scores.json``: what a run scored, on what, and by which weights; needs no torch."""

import hashlib
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from l3r.files import write_atomic
from l3r.launch.expand import Run, Sweep

NAME = "scores.json"
_VERSION = 2


def scoring_request(sweep: Sweep) -> dict[str, Any]:
    """Give what the scores of a sweep depend on beside the network."""
    evaluate = sweep.spec.evaluate
    config = sweep.runs[0].config
    sources = {} if config is None or evaluate.shards else config.data.validation
    return {
        "shards": evaluate.shards,
        "sources": {name: [found.shards, *found.span] for name, found in sources.items()},
        "num_views": sweep.num_views,
        "max_graphs": evaluate.max_graphs,
    }


def describe_scored(run: Run, request: Mapping[str, Any], max_steps: int) -> dict[str, Any]:
    """Give what ``scores.json`` says beside the scores, for :func:`read_scores` to compare.

    Args:
        run: The run; its checkpoint is there.
        request: See :func:`scoring_request`.
        max_steps: Steps that the checkpoint was trained for.
    """
    return {
        "version": _VERSION,
        "request": {**request, "settings": _settings_of(run)},
        "checkpoint": str(run.checkpoint),
        "weights": digest_checkpoint(run.checkpoint),
        "max_steps": max_steps,
    }


def write_scores(run: Run, content: Mapping[str, Any]) -> None:
    """Write the scores of a run into its folder, which is made where absent."""
    run.folder.mkdir(parents=True, exist_ok=True)
    write_atomic(run.folder / NAME, json.dumps(content, indent=1, allow_nan=False) + "\n")


def read_scores(run: Run, request: Mapping[str, Any]) -> dict[str, Any] | None:
    """Read the scores of a run; None where there are none of these weights and this request.

    Scores outlive their checkpoint: without one, steps or path say what was scored.
    """
    try:
        scores = dict(json.loads((run.folder / NAME).read_text()))
    except (OSError, ValueError, TypeError):
        return None
    is_wanted = scores.get("version") == _VERSION and scores.get("request") == {
        **request,
        "settings": _settings_of(run),
    }
    if run.config is not None:
        is_wanted &= scores.get("max_steps") == run.config.train.max_steps
    if run.checkpoint.is_file():
        is_wanted &= scores.get("weights") == digest_checkpoint(run.checkpoint)
    elif run.config is None:
        is_wanted &= scores.get("checkpoint") == str(run.checkpoint)
    return scores if is_wanted else None


def digest_checkpoint(path: Path) -> str:
    """Tell one checkpoint from another without reading its weights.

    Checkpoints are zip archives, whose directory has size and CRC of each tensor.
    """
    digest = hashlib.sha256()
    try:
        with zipfile.ZipFile(path) as archive:
            for entry in archive.infolist():
                name = entry.filename.partition("/")[2]
                digest.update(f"{name} {entry.file_size} {entry.CRC}\n".encode())
    except zipfile.BadZipFile:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _settings_of(run: Run) -> list[str]:
    """Changes to a checkpoint that is only scored; a training's are in its checkpoint."""
    return [] if run.config is not None else list(run.layers)
