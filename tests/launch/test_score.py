import json
import shutil

import pytest

from l3r.config import load_config
from l3r.errors import NotFiniteError
from l3r.launch import score
from l3r.launch.expand import expand
from l3r.launch.run_state import read_state
from l3r.launch.score_file import scoring_request
from l3r.model.light3r import Light3R
from tests.data.graphs import make_graph, write_folder
from tests.launch.sweeps import train_by_hand, write_sweep_file
from tests.train.runs import TINY


@pytest.fixture
def trained(tmp_path, monkeypatch):
    """A sweep whose first run is trained, its network fresh."""
    monkeypatch.chdir(score.__file__.partition("l3r/launch")[0])
    graphs = [make_graph(n, num_views=3, height=16, width=16) for n in range(2)]
    shards = write_folder(tmp_path / "shards", graphs)
    base = [*TINY, f"data.sources.hand.shards={shards}", f"data.validation.hand.shards={shards}"]
    sweep = expand(write_sweep_file(tmp_path, base=base))
    train_by_hand(sweep.runs[0])
    config = load_config(base)
    model = Light3R(config.model, config.graph).eval()
    monkeypatch.setattr(score, "load_model_and_config", lambda *_: (model, config))
    return sweep


def test_a_network_whose_scores_are_not_finite_is_diverged(trained, monkeypatch):
    def explode(*_, **__):
        raise NotFiniteError("similarity scores are not finite")

    run = trained.runs[0]
    score.score_run(trained, run)
    assert read_state(run, scoring_request(trained)).kind == "scored"
    monkeypatch.setattr(score, "evaluate_opened", explode)
    score.score_run(trained, run)
    assert json.loads((run.folder / "scores.json").read_text())["network"] is None
    state = read_state(run, scoring_request(trained))
    assert state.describe() == "diverged: similarity scores are not finite"


def test_graphs_are_told_apart_by_what_is_in_them(trained, tmp_path):
    """Shards that are built anew have the same keys."""
    run = trained.runs[0]
    found = [score.score_run(trained, run)["sources"]["hand"]["graphs_sha256"]]
    copy = tmp_path / "copy"
    shutil.copytree(tmp_path / "shards", copy)
    for place in (copy, other_shards(tmp_path / "other")):
        sweep = expand(trained.file, [f"data.validation.hand.shards={place}"])
        scores = score.score_run(sweep, sweep.runs[0])
        found.append(scores["sources"]["hand"]["graphs_sha256"])
    assert found[0] == found[1] != found[2]


def other_shards(folder):
    graphs = [make_graph(n, num_views=3, height=16, width=24) for n in range(2)]
    return write_folder(folder, graphs)
