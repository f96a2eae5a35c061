"""``report.html``: one file that shows what a reconstruction is and where it is weak."""

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import torch

from l3r.export.durations import format_seconds
from l3r.export.plan import draw_plan, edge_steps, tree_similarity
from l3r.export.run_json import RunRecord, num_components
from l3r.export.thumbnails import Picture, confidence_picture, depth_picture, photo_picture
from l3r.files import write_atomic
from l3r.types import Reconstruction
from l3r.version import __version__

MAX_IMAGES = 60
"""Images shown with their pictures."""
_NUM_WEAKEST = 5


def write_report(
    path: Path, scene: Reconstruction, record: RunRecord, seconds: Mapping[str, float] | None = None
) -> None:
    """Write a report that needs no network and no script.

    Args:
        path: The file to write.
        scene: What to show.
        record: Warnings, skipped images, command and diagnostics.
        seconds: Wall time of every stage, those of the export included; by default the scene's.
    """
    write_atomic(path, render_report(scene, record, seconds))


def render_report(
    scene: Reconstruction, record: RunRecord, seconds: Mapping[str, float] | None = None
) -> str:
    """Give the report as HTML; all text that comes from outside is escaped."""
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["duration"] = format_seconds
    source = files("l3r.export").joinpath("report.html").read_text(encoding="utf-8")
    stages = dict(scene.seconds if seconds is None else seconds)
    shown = min(len(scene.cameras.file), MAX_IMAGES)
    return environment.from_string(source).render(
        version=__version__,
        record=record,
        summary=_summary(scene, stages),
        plan=draw_plan(scene),
        files=scene.cameras.file,
        tree=_tree_facts(scene),
        diagnostics=_short_entries(record.diagnostics),
        stages=_stage_rows(stages, scene.peak_mib),
        images=_image_cards(scene, shown),
        num_images=len(scene.cameras.file),
    )


def _summary(scene: Reconstruction, seconds: Mapping[str, float]) -> dict[str, Any]:
    return {
        "images": len(scene.cameras.file),
        "registered": int(scene.cameras.registered.sum()),
        "components": num_components(scene),
        "seconds": sum(seconds.values()),
        "peak_mib": max(scene.peak_mib.values(), default=None),
    }


def _stage_rows(
    seconds: Mapping[str, float], peak_mib: Mapping[str, float]
) -> list[dict[str, Any]]:
    longest, total = max(seconds.values(), default=0.0), sum(seconds.values())
    return [
        {
            "name": name.replace("_", " "),
            "seconds": value,
            "bar": 100 * value / longest if longest else 0,
            "share": 100 * value / total if total else 0,
            "peak_mib": peak_mib.get(name),
        }
        for name, value in seconds.items()
    ]


def _tree_facts(scene: Reconstruction) -> dict[str, Any]:
    tree, similarity = scene.tree, tree_similarity(scene)
    parent, child = tree.parent[0], tree.child[0]
    degree = torch.bincount(torch.cat([parent, child]), minlength=len(scene.cameras.file))
    depths = [1, *torch.bincount(tree.level[0])[1:].tolist()]
    order = similarity.argsort(stable=True).tolist() if len(similarity) else []
    return {
        "root": int(tree.root[0]),
        "depths": [{"count": count, "bar": 100 * count / max(depths)} for count in depths],
        "largest_degree": int(degree.max()),
        "largest_degree_view": int(degree.argmax()),
        "weakest": [
            {
                "parent": int(parent[edge]),
                "child": int(child[edge]),
                "similarity": float(similarity[edge]),
                "residual": float(scene.residual[edge]),
            }
            for edge in order[:_NUM_WEAKEST]
        ],
    }


def _short_entries(diagnostics: Mapping[str, Any]) -> dict[str, str]:
    """Diagnostics that fit a line; ``run.json`` has all of them."""
    texts = {str(key): str(value) for key, value in diagnostics.items()}
    return {key: text for key, text in texts.items() if len(text) <= 200}


def _image_cards(scene: Reconstruction, shown: int) -> list[dict[str, Any]]:
    tree, similarity = scene.tree, tree_similarity(scene)
    steps = edge_steps(similarity)
    edge_of = {child: edge for edge, child in enumerate(tree.child[0].tolist())}
    confident = [conf.double().quantile(0.98) for conf in _thinned(scene.conf[:shown])]
    highest = max((float(value) for value in confident), default=2.0)
    cards = []
    for view in range(shown):
        edge = edge_of.get(view)
        height, width = scene.cameras.image_size[view]
        focal = float(scene.cameras.K[view, 0, 0])
        card = {
            "file": scene.cameras.file[view],
            "width": width,
            "height": height,
            "focal": focal if focal == focal else None,
            "registered": bool(scene.cameras.registered[view]),
            "component": int(scene.cameras.component[view]),
            "rule": scene.point_rule[view],
            "pictures": _pictures(scene, view, highest),
            "parent": None if edge is None else scene.cameras.file[int(tree.parent[0, edge])],
        }
        if edge is not None:
            card["similarity"] = float(similarity[edge])
            card["residual"] = float(scene.residual[edge])
            card["step"] = steps[edge]
        cards.append(card)
    return cards


def _pictures(scene: Reconstruction, view: int, highest: float) -> dict[str, Picture | None]:
    depth = None
    if scene.cameras.registered[view]:
        points = scene.pts3d_world[view]
        forward = scene.cameras.cam_from_world[view, 2].to(points)
        depth = depth_picture(points @ forward[:3] + forward[3])
    return {
        "photo": photo_picture(scene.image[view]),
        "depth": depth,
        "confidence": confidence_picture(scene.conf[view], highest),
    }


def _thinned(maps: list[torch.Tensor]) -> list[torch.Tensor]:
    """Every so many pixels: torch's quantile is slow, and refuses 16 million."""
    return [map_.flatten()[:: max(1, map_.numel() // 10_000)] for map_ in maps]
