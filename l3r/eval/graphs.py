"""A network on validation shards, by the full inference path."""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import track

from l3r.config import InferenceConfig
from l3r.config.check import require
from l3r.data.source import ShardFolder
from l3r.data.steps import read_graph
from l3r.files import write_atomic
from l3r.inference.reconstruct import reconstruct_views
from l3r.metrics.cameras import CameraMetrics, camera_metrics, mean_metrics
from l3r.model.light3r import Light3R


@dataclass(frozen=True, kw_only=True)
class GraphScores:
    """Mean metrics over graphs, a failed camera counted as failed pairs."""

    network: CameraMetrics
    """Of the network."""
    identity: CameraMetrics
    """Of all cameras at one place, looking one way."""
    num_graphs: int
    """Graphs scored."""
    num_views: int
    """Images of each."""
    seconds: float
    """Wall time of inference and scoring."""

    def to_table(self) -> str:
        """Lay out as a table of at most 80 columns."""
        rows = [f"{self.num_graphs} graphs of {self.num_views} images, {self.seconds:.1f} s"]
        rows.append(f"{'':<16}{'network':>10}{'identity':>10}")
        identity = self.identity.to_dict()
        for name, value in self.network.to_dict().items():
            digits = 4 if name.startswith("ate") else 1
            rows.append(f"{name:<16}{value:>10.{digits}f}{identity[name]:>10.{digits}f}")
        rows.append("percent, but for ate; pairs of unregistered images count as failed")
        return "\n".join(rows) + "\n"

    def write_json(self, path: Path) -> None:
        """Write all metrics."""
        write_atomic(path, json.dumps(self.to_plain(), indent=2, allow_nan=False) + "\n")

    def to_plain(self) -> dict[str, Any]:
        """Plain numbers, for JSON."""
        return {
            "network": self.network.to_plain(),
            "identity": self.identity.to_plain(),
            "num_graphs": self.num_graphs,
            "num_views": self.num_views,
            "seconds": self.seconds,
            "missing": "fail",
        }


def evaluate_shards(
    model: Light3R,
    config: InferenceConfig,
    folder: Path,
    *,
    num_views: int = 8,
    max_graphs: int | None = None,
) -> GraphScores:
    """Reconstruct every graph of a folder of shards from its images alone, and score the cameras.

    Args:
        model: The network.
        config: Camera fitting.
        folder: Shards.
        num_views: The first so many images of each graph are used.
        max_graphs: The first so many graphs are used; by default all.

    Raises:
        DataError: The shards cannot be read.
        ConfigError: ``max_graphs`` or ``num_views`` is too small.
    """
    require(num_views >= 2, "--num-views", num_views, "2 or more")
    require(max_graphs is None or max_graphs >= 1, "--max-graphs", max_graphs, "1 or more")
    return evaluate_opened(model, config, ShardFolder(folder, num_views), max_graphs=max_graphs)


def evaluate_opened(
    model: Light3R,
    config: InferenceConfig,
    shards: ShardFolder,
    *,
    max_graphs: int | None = None,
) -> GraphScores:
    """Do what :func:`evaluate_shards` does with shards that are open, or a span of them.

    Args:
        model: The network.
        config: Camera fitting.
        shards: Graphs, and how many images of each.
        max_graphs: The first so many are used; by default all.

    Raises:
        DataError: The shards cannot be read.
    """
    count = len(shards) if max_graphs is None else min(max_graphs, len(shards))
    size = (model.config.image_size[0], model.config.image_size[1])
    device = next(model.parameters()).device
    network, identity = [], []
    began = time.perf_counter()
    for index in track(range(count), "evaluate", console=Console(stderr=True), transient=True):
        views = read_graph(shards, index, size).to(device)
        for scene, truth in reconstruct_views(model, views, config):
            network.append(camera_metrics(scene.cam_from_world, truth))
            identity.append(camera_metrics(torch.eye(4).double().expand_as(truth), truth))
    return GraphScores(
        network=mean_metrics(network),
        identity=mean_metrics(identity),
        num_graphs=count,
        num_views=shards.num_views,
        seconds=time.perf_counter() - began,
    )
