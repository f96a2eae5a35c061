"""Draw how a run's pairwise error falls, beside fresh weights and the best constant point map.

python -m benchmarks.curve runs/hospital --out docs/images/tartanair_curve.png
"""

import argparse
import csv
import sys
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from l3r.config import RunConfig, load_config
from l3r.data.source import open_folders
from l3r.inference.checkpoint import build_untrained, load_model
from l3r.loss.joint import JointLoss
from l3r.loss.targets import PairTargets, build_targets
from l3r.model.light3r import Light3R
from l3r.train.datamodule import ValidationGraphs

WEISZFELD_ROUNDS = 300


def main(argv: list[str]) -> int:
    """Measure, print and plot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="train.output_dir of a finished run")
    parser.add_argument("--out", type=Path, required=True, help="picture to write")
    args = parser.parse_args(argv)
    config_file = str(args.run / "config.yaml")
    config = load_config([config_file])
    graphs = validation_graphs(config)
    model = load_model(args.run / "model.ckpt")
    untrained, _ = build_untrained([config_file])
    figures = {
        "fresh weights": network_error(untrained, config, graphs),
        "best constant": constant_error(model, graphs),
        "trained": network_error(model, config, graphs),
    }
    for name, value in figures.items():
        print(f"{name:<16}{value:.4f}")
    with (args.run / "validation.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    curve = [(int(row["step"]), float(row["pair_error"])) for row in rows]
    plot(args.out, [(0, figures["fresh weights"]), *curve], figures["best constant"])
    return 0


def validation_graphs(config: RunConfig) -> ValidationGraphs:
    """Give the graphs that the run's validation scored."""
    size = (config.model.image_size[0], config.model.image_size[1])
    folders = open_folders(config.data.validation, config.data)
    return ValidationGraphs(folders, size, config.train.validation_graphs)


@torch.no_grad()
def network_error(model: Light3R, config: RunConfig, graphs: ValidationGraphs) -> float:
    """Mean normalised pairwise error, as the log has it."""
    loss = JointLoss(config.loss)
    errors = []
    for index in range(len(graphs)):
        views = graphs[index]
        prediction = model(views.image, views.true_shape, views.scores)
        errors.append(float(loss(prediction, views).parts["pair_error"]))
    return sum(errors) / len(errors)


def constant_error(model: Light3R, graphs: ValidationGraphs) -> float:
    """Error of the two point maps, one for parents and one for children, that fit best.

    Chosen in hindsight on the very graphs they are scored on, over the trees of the trained
    network: no constant does better. Each pixel's point is a weighted geometric median.
    """
    targets, factors = zip(*_targets(model, graphs), strict=True)
    scale = torch.stack(factors)[:, None, None]
    total = 0.0
    for side in ("parent", "child"):
        points = torch.stack([getattr(t, f"{side}_pts3d")[0] for t in targets])
        valid = torch.stack([getattr(t, f"{side}_valid")[0] for t in targets])
        # Each graph's error is a mean over its pixels, in units of its own scale.
        weights = valid / (scale * valid.sum((1, 2), keepdim=True))
        center = _geometric_median(points.flatten(0, 1), weights.flatten(0, 1))
        error = torch.linalg.vector_norm(points - center, dim=-1) * weights
        total += float(error.sum((1, 2)).mean()) / 2
    return total


@torch.no_grad()
def _targets(model: Light3R, graphs: ValidationGraphs) -> Iterator[tuple[PairTargets, Tensor]]:
    for index in range(len(graphs)):
        views = graphs[index]
        pairs, _ = build_targets(views, model(views.image, views.true_shape, views.scores).tree)
        distance = torch.cat([pairs.parent_pts3d.norm(dim=-1), pairs.child_pts3d.norm(dim=-1)], -1)
        valid = torch.cat([pairs.parent_valid, pairs.child_valid], -1)
        yield pairs, (distance * valid).sum() / valid.sum()


def _geometric_median(points: Tensor, weights: Tensor) -> Tensor:
    """Per pixel, over the first dimension: points (m p 3), weights (m p) to (p 3)."""
    center = (points * weights[..., None]).sum(0) / weights.sum(0)[:, None].clamp_min(1e-12)
    for _ in range(WEISZFELD_ROUNDS):
        distance = torch.linalg.vector_norm(points - center, dim=-1).clamp_min(1e-6)
        pull = weights / distance
        center = (points * pull[..., None]).sum(0) / pull.sum(0)[:, None].clamp_min(1e-12)
    return center


def plot(path: Path, curve: list[tuple[int, float]], constant: float) -> None:
    """Draw the curve and the constant's line."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    steps, errors = zip(*curve, strict=True)
    figure, axes = pyplot.subplots(figsize=(7, 3.6), layout="constrained")
    axes.plot(steps, errors, marker="o", markersize=3, label="network, held-out graphs")
    axes.axhline(constant, color="grey", linestyle="--", label="best constant point map")
    axes.axhline(errors[0] / 2, color="grey", linestyle=":", label="half of fresh weights")
    axes.set(xlabel="step", ylabel="normalised pairwise error", ylim=(0, None))
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
