"""A scene's plan on disk, so that an interrupted build need not relate its images again."""

import hashlib
import io
import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.draw import GraphPlan
from data_prep.plan import ScenePlan
from data_prep.problems import Problem
from l3r.data.schema import PairTable
from l3r.errors import DataError
from l3r.files import write_first

_DIGEST = 32
_TABLES = [f.name for f in fields(PairTable)]


def write_plan(path: Path, plan: ScenePlan) -> None:
    """Write a plan unless there is one: a digest, then an npz of numbers and of text.

    Tasks that plan the same scene at the same time then go by one plan, the first.
    """
    most = max((len(graph.views) for graph in plan.graphs), default=0)
    views = np.full((len(plan.graphs), most), -1, dtype=np.int64)
    tables = np.zeros((len(_TABLES), len(plan.graphs), most, most))
    for row, graph in enumerate(plan.graphs):
        n = len(graph.views)
        views[row, :n] = graph.views
        for number, name in enumerate(_TABLES):
            tables[number, row, :n, :n] = getattr(graph.pairs, name)
    text = {
        "keys": [graph.key for graph in plan.graphs],
        "fingerprint": plan.fingerprint,
        "dropped": {name: asdict(problem) for name, problem in plan.dropped.items()},
        "problems": plan.problems,
    }
    stream = io.BytesIO()
    encoded = np.frombuffer(json.dumps(text).encode(), np.uint8)
    np.savez_compressed(stream, views=views, tables=tables, text=encoded)
    content = stream.getvalue()
    write_first(path, hashlib.sha256(content).digest() + content)


def read_plan(path: Path) -> ScenePlan:
    """Read what :func:`write_plan` wrote.

    Raises:
        DataError: The file is damaged.
    """
    data = path.read_bytes()
    digest, content = data[:_DIGEST], data[_DIGEST:]
    if hashlib.sha256(content).digest() != digest:
        raise DataError(f"{path}: damaged; remove it, the scene is planned again")
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        text: dict[str, Any] = json.loads(file["text"].tobytes())
        views, tables = file["views"], file["tables"]
    return ScenePlan(
        graphs=[_graph(key, views[row], tables[:, row]) for row, key in enumerate(text["keys"])],
        fingerprint=text["fingerprint"],
        dropped={name: Problem(**plain) for name, plain in text["dropped"].items()},
        problems=text["problems"],
    )


def _graph(key: str, views: np.ndarray, tables: np.ndarray) -> GraphPlan:
    n = int((views >= 0).sum())
    pairs = {name: tables[number, :n, :n] for number, name in enumerate(_TABLES)}
    return GraphPlan(key=key, views=views[:n].tolist(), pairs=PairTable(**pairs))
