"""A sweep as a file: what differs from row to row, and nothing else."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from l3r.config import load_other
from l3r.config.check import require
from l3r.errors import ConfigError
from l3r.launch.paper_tables import PAPER_TABLES

_ROW_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


@dataclass(kw_only=True, slots=True)
class EvaluateConfig:
    """On what every run is scored: the same graphs and images for all."""

    shards: str = ""
    """Folder of shards, or its http(s) address; empty: ``data.validation`` of the runs."""
    num_views: int | None = None
    """Images of each graph; null: ``data.num_views`` of the base, whatever a row trains with."""
    max_graphs: int | None = None
    """The first so many graphs of each source; null: all."""

    def __post_init__(self) -> None:
        """Check ranges."""
        views, graphs = self.num_views, self.max_graphs
        require(views is None or views >= 2, "evaluate.num_views", views, "null, or 2 or more")
        require(graphs is None or graphs >= 1, "evaluate.max_graphs", graphs, "null, or 1 or more")


@dataclass(kw_only=True, slots=True)
class SweepConfig:
    """Base x rows x seeds. A layer is a YAML file or ``key=value``, as ``l3r train`` takes it."""

    base: list[str] = field(default_factory=list)
    """Layers of every run."""
    rows: dict[str, Any] = field(default_factory=dict)
    """Name of each row of the table, and what it adds: a layer, a list of layers, or ``[]``."""
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    """``train.seed`` of the runs of each row."""
    table: str = ""
    """Table of the paper that stands beside: a name of ``l3r/launch/paper_tables.py``."""
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    """What the runs are scored on."""
    checkpoint: str = ""
    """Score this checkpoint, ``{seed}`` filled in, rather than train; rows then change ``graph.*``
    and ``inference.*`` alone."""
    output_dir: str = ""
    """Where ``ROW/seed_S`` go; empty: ``runs/sweep/NAME``, NAME being the sweep file's."""
    equal_images: bool = True
    """Refuse rows that differ in steps, or in images a step by more than whole graphs make them."""

    def __post_init__(self) -> None:
        """Check names, and make a list of every row."""
        require(bool(self.rows), "rows", "empty", "a mapping from names to layers")
        for name in self.rows:
            words = "a name of a folder: letters, digits, '.', '_' and '-'"
            require(bool(_ROW_NAME.fullmatch(name)), "rows", f"'{name}'", words)
        self.rows = {name: _layers_of(name, found) for name, found in self.rows.items()}
        unique = bool(self.seeds) and len(set(self.seeds)) == len(self.seeds)
        require(unique, "seeds", self.seeds, "one or more, each once")
        known = ("", *PAPER_TABLES)
        require(self.table in known, "table", f"'{self.table}'", f"one of {', '.join(known[1:])}")
        if self.checkpoint and len(self.seeds) > 1:
            found = "{seed}" in self.checkpoint
            require(found, "checkpoint", self.checkpoint, "a path with {seed}, or a single seed")


def load_sweep(path: Path) -> SweepConfig:
    """Read a sweep file.

    Raises:
        ConfigError: It cannot be read, a key is unknown, or a value out of range.
    """
    config = load_other(str(path), SweepConfig)
    config.output_dir = config.output_dir or f"runs/sweep/{path.stem}"
    return config


def _layers_of(name: str, found: object) -> list[str]:
    layers = [found] if isinstance(found, str) else found
    if not isinstance(layers, list) or not all(isinstance(layer, str) for layer in layers):
        raise ConfigError(
            f"rows.{name} is {found}, expected a layer, FILE.yaml or key=value, or a list of them"
        )
    return layers
