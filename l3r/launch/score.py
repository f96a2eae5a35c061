"""Score what a run has made on the graphs that all runs of its sweep are scored on."""

import hashlib
from typing import Any

import torch

from l3r.config import RunConfig, SourceConfig, override_config
from l3r.data.source import ShardFolder, open_store
from l3r.errors import ConfigError, NotFiniteError
from l3r.eval.graphs import GraphScores, evaluate_opened
from l3r.inference.checkpoint import load_model_and_config
from l3r.inference.job import choose_device
from l3r.launch.expand import Run, Sweep
from l3r.launch.score_file import describe_scored, scoring_request, write_scores
from l3r.metrics.cameras import mean_metrics
from l3r.model.light3r import Light3R


def score_run(sweep: Sweep, run: Run) -> dict[str, Any]:
    """Score a run's checkpoint and write ``scores.json`` into its folder.

    Args:
        sweep: Says on which graphs, and of how many images each.
        run: One of its runs, trained.

    Returns:
        What was written. ``network`` and ``identity`` are means over the sources, each weighing
        the same; ``problem`` says why there is none.

    Raises:
        CheckpointError: There is no checkpoint, or it cannot be read.
        ConfigError: There is nothing to score on.
        DataError: The shards cannot be read.
    """
    settings = [] if run.config is not None else list(run.layers)
    own = [text for text in settings if not text.startswith("data.")]
    device = choose_device(
        "cpu" if run.config and run.config.train.accelerator == "cpu" else "auto"
    )
    model, config = load_model_and_config(run.checkpoint, device, own)
    config = override_config(config, [text for text in settings if text not in own], ("data",))
    content: dict[str, Any] = {
        **describe_scored(run, scoring_request(sweep), config.train.max_steps),
        "problem": "",
        "network": None,
        "identity": None,
        "sources": {},
    }
    if not _is_finite(model):
        content["problem"] = "weights are not finite"
    else:
        try:
            # Shards may have moved since the training.
            content |= _score_sources(sweep, model, config, run.config or config)
        except NotFiniteError as error:
            content["problem"] = str(error)
    write_scores(run, content)
    return content


def open_scored(sweep: Sweep, config: RunConfig) -> dict[str, ShardFolder]:
    """Open the graphs that a sweep's runs are scored on, by source.

    Args:
        sweep: The sweep.
        config: Of one of its runs: its ``data.validation``, spans included, unless the sweep names
            other shards.

    Raises:
        ConfigError: There are none.
        DataError: The shards cannot be read.
    """
    evaluate = sweep.spec.evaluate
    sources = config.data.validation
    if evaluate.shards:
        sources = {"evaluate": SourceConfig(shards=evaluate.shards)}
    if not sources:
        raise ConfigError(
            f"{sweep.file}: nothing to score on; add data.validation.NAME.shards=FOLDER, or "
            "evaluate.shards to the file"
        )
    num_views = sweep.num_views or config.data.num_views
    return {
        name: ShardFolder(open_store(source.shards), num_views, (source.span[0], source.span[1]))
        for name, source in sources.items()
    }


def _score_sources(
    sweep: Sweep, model: Light3R, config: RunConfig, data: RunConfig
) -> dict[str, Any]:
    max_graphs = sweep.spec.evaluate.max_graphs
    scores: dict[str, GraphScores] = {}
    plain: dict[str, Any] = {}
    for name, shards in open_scored(sweep, data).items():
        scores[name] = evaluate_opened(model, config.inference, shards, max_graphs=max_graphs)
        found = _fingerprint(shards, scores[name].num_graphs)
        plain[name] = {**scores[name].to_plain(), "graphs_sha256": found}
    return {
        "network": mean_metrics([score.network for score in scores.values()]).to_plain(),
        "identity": mean_metrics([score.identity for score in scores.values()]).to_plain(),
        "sources": plain,
    }


def _fingerprint(shards: ShardFolder, count: int) -> str:
    """Tell one set of graphs from another by content, wherever the folder lies."""
    tars = [f"{entry.name} {entry.sha256}" for entry in shards.shards]
    keys = [shards.key(index).partition("/")[2] for index in range(count)]
    return hashlib.sha256("\n".join([*tars, *keys]).encode()).hexdigest()


def _is_finite(model: Light3R) -> bool:
    return all(bool(torch.isfinite(tensor).all()) for tensor in model.state_dict().values())
