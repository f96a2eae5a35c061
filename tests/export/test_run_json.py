import json
import math

import torch

from l3r.export.run_json import RunRecord, write_run
from l3r.version import __version__


def test_everything_is_recorded(tmp_path, scene_with_a_loss):
    record = RunRecord(
        command=["l3r", "reconstruct", "photos äöü"],
        config={"inference": {"min_conf": 3.0, "sizes": (1, 2)}},
        diagnostics={"root": 0, "views_at_depth": [1, 2, 3]},
        skipped=[("bad.jpg", "OSError: truncated")],
        warnings=["the tree is nearly a star"],
    )
    seconds = {**scene_with_a_loss.seconds, "export_ply": 0.5}
    write_run(tmp_path / "run.json", scene_with_a_loss, record, seconds)
    run = json.loads((tmp_path / "run.json").read_text())
    assert run["command"] == ["l3r", "reconstruct", "photos äöü"]
    assert run["versions"]["l3r"] == __version__
    assert run["versions"]["torch"] == torch.__version__
    assert run["versions"]["python"].startswith("3.")
    assert run["device"]
    assert (run["images"], run["registered"], run["components"]) == (6, 5, 1)
    assert run["skipped"] == [{"file": "bad.jpg", "reason": "OSError: truncated"}]
    assert run["warnings"] == ["the tree is nearly a star"]
    assert run["seconds"]["export_ply"] == 0.5
    assert run["seconds_total"] == sum(seconds.values())
    assert run["peak_mib"]["decode"] == 1400
    assert run["tree"]["views_at_depth"] == [1, 2, 3]
    assert run["config"]["inference"] == {"min_conf": 3.0, "sizes": [1, 2]}
    assert run["point_rule"]["ring_002.jpg"] == "none"


def test_nan_becomes_null(tmp_path, scene):
    write_run(tmp_path / "run.json", scene, RunRecord(diagnostics={"weakest": math.nan}))
    assert json.loads((tmp_path / "run.json").read_text())["tree"]["weakest"] is None
