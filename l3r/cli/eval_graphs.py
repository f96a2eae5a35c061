r"""``l3r eval graphs``.

Run the full inference path on every graph of validation shards and print mean
camera metrics, beside what all cameras at one place would score.

Examples::

  l3r eval graphs shards/val --checkpoint runs/room/model.ckpt
  l3r eval graphs shards/val --untrained configs/base.yaml
"""

import argparse
import sys
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("shards", type=Path, metavar="SHARDS", help="folder of shards")
    weights = parser.add_mutually_exclusive_group(required=True)
    weights.add_argument("--checkpoint", type=Path, help="made by 'l3r train'")
    weights.add_argument(
        "--untrained",
        nargs="+",
        metavar="LAYER",
        help="score fresh weights of this configuration instead",
    )
    parser.add_argument("--num-views", type=int, default=8, help="images of each graph (8)")
    parser.add_argument("--max-graphs", type=int, default=None, help="graphs at most (all)")
    parser.add_argument("--device", default="auto", help="auto (default), cpu or cuda")
    parser.add_argument("--json", type=Path, default=None, help="write the metrics here too")


def run(args: argparse.Namespace) -> int:
    """Score and print a table."""
    from l3r.eval.graphs import evaluate_shards
    from l3r.inference.checkpoint import build_untrained, load_model_and_config
    from l3r.inference.job import choose_device

    device = choose_device(args.device)
    if args.checkpoint:
        model, config = load_model_and_config(args.checkpoint, device)
    else:
        model, config = build_untrained(args.untrained, device)
    scores = evaluate_shards(
        model, config.inference, args.shards, num_views=args.num_views, max_graphs=args.max_graphs
    )
    sys.stdout.write(scores.to_table())
    if args.json:
        scores.write_json(args.json)
    return 0
