"""Sweep files of tests, and runs made by hand."""

import json

import yaml

from l3r.config import to_yaml
from l3r.launch.score_file import describe_scored, write_scores
from l3r.version import __version__

BASE = ["data.sources.hand.shards=shards", "data.validation.hand.shards=shards"]
NETWORK = {"rra_5": 40.0, "rta_5": 30.0, "ate": 0.05, "rra_15": 80.0, "rta_15": 70.0}
IDENTITY = {"rra_5": 0.0, "rta_5": 0.0, "ate": None, "rra_15": 1.0, "rta_15": 0.0}


def write_sweep_file(folder, name="own.yaml", **content):
    """A sweep over the global loss unless the content says otherwise."""
    plain = {
        "base": BASE,
        "rows": {"none": "loss.global_weight=0", "paper": []},
        "seeds": [0, 1],
        "output_dir": str(folder / "out"),
        **content,
    }
    path = folder / name
    path.write_text(yaml.safe_dump(plain, sort_keys=False))
    return path


def train_by_hand(run, *, steps=None, rate=16.0, machine="CPU", done=True):
    """Leave what a training leaves: all steps, or the first so many."""
    run.folder.mkdir(parents=True, exist_ok=True)
    (run.folder / "config.yaml").write_text(to_yaml(run.config))
    last = run.config.train.max_steps if steps is None else steps
    rows = [f"{step},{1 / step},{rate},3.5" for step in (1, last) if step]
    header = "step,loss,graphs_per_second,gpu_gib\n"
    (run.folder / "metrics.csv").write_text(header + "\n".join(rows) + "\n")
    facts = {"device": machine, "processes": 8, "light3r": __version__}
    (run.folder / "machine.json").write_text(json.dumps(facts))
    if done and steps is None:
        (run.folder / "model.ckpt").write_bytes(b"weights")


def score_by_hand(run, request, *, problem="", graphs="a" * 64, max_steps=None, **network):
    """Leave what scoring leaves."""
    source = {"num_graphs": 20, "num_views": request["num_views"], "graphs_sha256": graphs}
    if max_steps is None:
        max_steps = run.config.train.max_steps if run.config else 0
    content = {
        **describe_scored(run, request, max_steps),
        "problem": problem,
        "network": None if problem else {**NETWORK, **network},
        "identity": None if problem else IDENTITY,
        "sources": {} if problem else {"hand": source},
    }
    write_scores(run, content)


def note_bad_steps(run, steps, **more):
    rows = [{"step": n, "loss": "nan", "grad_norm": "inf", "keys": ["x"], **more} for n in steps]
    text = "".join(json.dumps(row) + "\n" for row in rows)
    (run.folder / "bad_steps.jsonl").write_text(text)
