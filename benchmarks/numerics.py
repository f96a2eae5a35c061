"""What bfloat16 changes: point maps, confidences and cameras beside those of float32.

python -m benchmarks.numerics --checkpoint runs/demo/tiny.ckpt --shards runs/demo/shards/val
python -m benchmarks.numerics --model configs/model/l3r_512.yaml      # fresh weights, one pair

Differences of points are shares of each point's distance from the origin: the parent's camera for
a pair, the root's for a scene. Scenes with an unregistered camera are left out of the differences.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from l3r.config import InferenceConfig, Precision
from l3r.data.source import ShardFolder
from l3r.data.steps import read_graph
from l3r.eval.graphs import evaluate_shards
from l3r.geometry.rigid import rotation_angle
from l3r.inference.checkpoint import build_untrained, load_model_and_config
from l3r.inference.job import choose_device
from l3r.inference.reconstruct import reconstruct_views
from l3r.model.light3r import EdgePointmaps, Light3R
from l3r.model.precision import reduced_precision

SHARES = (0.5, 0.9, 0.99)


def main(argv: list[str]) -> int:
    """Measure and print."""
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--shards", type=Path, help="validation shards for the checkpoint")
    parser.add_argument("--model", default="configs/model/l3r_512.yaml")
    parser.add_argument("--max-graphs", type=int, default=64)
    args = parser.parse_args(argv)
    device = choose_device("auto")
    print(f"{device}, torch {torch.__version__}\n{'':<36}{'50%':>10}{'90%':>10}{'99%':>10}")
    if args.checkpoint is None:
        model, _ = build_untrained(["configs/base.yaml", args.model], device)
        rows = _compare_pair(model)
    elif args.shards is None:
        parser.error("--checkpoint needs --shards")
    else:
        model, config = load_model_and_config(args.checkpoint, device)
        rows = _compare_scenes(model, config.inference, args.shards, args.max_graphs)
    for name, values in rows:
        print(f"{name:<36}" + "".join(f"{value:>10.5f}" for value in values), flush=True)
    return 0


@torch.inference_mode()
def _compare_pair(model: Light3R) -> Iterator[tuple[str, list[float]]]:
    """Compare the maps of one pair of noise images."""
    device = next(model.parameters()).device
    draw = torch.Generator().manual_seed(0)
    image = torch.rand(2, 3, *model.config.image_size, generator=draw).to(device)
    grid = model.encoder.token_grid(*model.config.image_size)

    def decode(precision: Precision) -> tuple[Tensor, EdgePointmaps]:
        with reduced_precision(precision, device):
            tokens = model.encode(image)
            return tokens, model.decode(tokens[:1], tokens[1:], grid, grid)

    (tokens, full), (half_tokens, half) = decode("fp32"), decode("bf16")
    yield "tokens, share of their norm", _quantiles(_relative(half_tokens, tokens))
    for view in ("parent", "child"):
        expected, found = (getattr(maps, f"{view}_pts3d") for maps in (full, half))
        yield f"points, {view}", _quantiles(_relative(found, expected))
        expected, found = (getattr(maps, f"{view}_log_conf") for maps in (full, half))
        yield f"log confidence, {view}", _quantiles((found - expected).abs())


def _compare_scenes(
    model: Light3R, config: InferenceConfig, shards: Path, max_graphs: int
) -> Iterator[tuple[str, list[float]]]:
    """Compare whole reconstructions of the same graphs, and their accuracy."""
    folder = ShardFolder(shards, 8)
    size = (model.config.image_size[0], model.config.image_size[1])
    points, conf, rotations, centers, trees = [], [], [], [], []
    for index in range(min(max_graphs, len(folder))):
        views = read_graph(folder, index, size).to(next(model.parameters()).device)
        ((full, _),) = reconstruct_views(model, views, replace(config, precision="fp32"))
        ((half, _),) = reconstruct_views(model, views, replace(config, precision="bf16"))
        trees.append(float(torch.equal(full.tree.parent, half.tree.parent)))
        # One tree for both: what a changed tree does is told by the accuracy below.
        if trees[-1] and (full.cameras.registered & half.cameras.registered).all():
            both = [_joined(scene.pts3d_world).reshape(-1, 3) for scene in (half, full)]
            points.append(_relative(*both))
            both = [_joined(scene.conf).log() for scene in (half, full)]
            conf.append((both[0] - both[1]).abs())
            turned = full.cam_from_world[:, :3, :3].mT @ half.cam_from_world[:, :3, :3]
            rotations.append(rotation_angle(turned).rad2deg())
            centers.append(_center_shift(full.cam_from_world, half.cam_from_world))
    yield "points", _quantiles(torch.cat(points))
    yield "log confidence", _quantiles(torch.cat(conf))
    yield "camera rotation [deg]", _quantiles(torch.cat(rotations))
    yield "camera centre, share of the extent", _quantiles(torch.cat(centers))
    print(f"the same tree in {100 * sum(trees) / len(trees):.1f}% of {len(trees)} graphs")
    for precision in ("fp32", "bf16"):
        changed = replace(config, precision=precision)
        scores = evaluate_shards(model, changed, shards, max_graphs=max_graphs)
        print(f"{precision}: {scores.network.to_dict()}")


def _joined(maps: list[Tensor]) -> Tensor:
    return torch.cat([values.flatten() for values in maps])


def _relative(found: Tensor, expected: Tensor) -> Tensor:
    return (found - expected).norm(dim=-1) / expected.norm(dim=-1).clamp_min(1e-9)


def _center_shift(full: Tensor, half: Tensor) -> Tensor:
    """Distance between camera centres over the largest distance between two cameras."""
    one, other = (-(cam[:, :3, :3].mT @ cam[:, :3, 3:])[..., 0] for cam in (full, half))
    return (one - other).norm(dim=-1) / torch.cdist(one, one).max()


def _quantiles(values: Tensor) -> list[float]:
    values = values.flatten().double()
    values = values[values.isfinite()].sort().values
    return [float(values[int(share * (len(values) - 1))]) for share in SHARES]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
