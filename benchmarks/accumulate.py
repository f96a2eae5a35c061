"""Accumulation of 8 graphs of 8 images at 384x512, forward and backward, beside an encoder."""

import torch

from benchmarks.timing import seconds, shown
from l3r.config import EncoderConfig, GraphConfig
from l3r.graph.accumulate import accumulate
from l3r.graph.trees import build_tree
from l3r.model.encoder import Encoder
from l3r.types import PairPointmaps

GRAPHS, VIEWS, HEIGHT, WIDTH = 8, 8, 384, 512


def run() -> list[tuple[str, str]]:
    """Time both; the encoder is the tiny network's (patch 8, width 128, 4 blocks)."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    draw = torch.Generator().manual_seed(0)
    scores = torch.rand(GRAPHS, VIEWS, VIEWS, generator=draw)
    config = GraphConfig()
    tree = build_tree((scores + scores.transpose(1, 2)) / 2, config)
    shape = (GRAPHS, VIEWS - 1, HEIGHT * WIDTH)
    maps = [torch.randn((*shape, 3), generator=draw).to(device).requires_grad_() for _ in "pc"]
    confs = [torch.rand(shape, generator=draw).to(device).requires_grad_() for _ in "pc"]
    pairs = PairPointmaps(
        parent_pts3d=maps[0],
        child_pts3d=maps[1],
        parent_log_conf=confs[0],
        child_log_conf=confs[1],
    )

    def chain() -> None:
        world = accumulate(pairs, tree, config)
        (world.pts3d_world.sum() + world.log_conf.sum()).backward()

    encoder = Encoder(EncoderConfig(patch_size=8, width=128, depth=4, num_heads=4)).to(device)
    # The encoder in slices of one graph: all 64 images at once would not fit a small machine.
    image = torch.rand(VIEWS, 3, HEIGHT, WIDTH, generator=draw).to(device)

    def encode() -> None:
        encoder(image).sum().backward()

    chained, encoded = seconds(chain, 3), seconds(encode, 2)
    encoded = (encoded[0] * GRAPHS, encoded[1] * GRAPHS)
    return [
        ("accumulate 8 graphs of 8 images at 384x512 (least / median)", shown(chained)),
        ("tiny's encoder on the same images, 8 graphs one by one", shown(encoded)),
        ("accumulation against encoder", f"{chained[0] / encoded[0]:.3f} x"),
    ]
