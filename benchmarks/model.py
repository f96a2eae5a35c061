"""Seconds, operations and share of the machine's matmul rate of every part of the network.

python -m benchmarks.model                 # full size on a GPU, the tiny network on a CPU
python -m benchmarks.model --model configs/model/l3r_512.yaml --views 2 --precision fp32
python -m benchmarks.model --compiled --training --checkpointing --set-of 50

One graph of N images; medians. The matmul rate is measured beside, in the same precision, and
operations are the model's: what recomputation repeats counts once.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.flops import backward_from, count_flops
from benchmarks.timing import seconds
from l3r.config import InferenceConfig, Precision, RunConfig, load_config
from l3r.inference.clock import StageClock
from l3r.inference.reconstruct import reconstruct_photos
from l3r.loss.joint import JointLoss
from l3r.model.activations import count_kept, part_calls
from l3r.model.light3r import Light3R
from l3r.model.precision import reduced_precision
from l3r.train.optim import build_optimizer
from l3r.types import Photos, Views, Window

ROW = "{:<11}{:<11}{:<6}{:<10}{:>9}{:>10}{:>9}{:>7}"
MATMUL_SIDE = {"cuda": 8192, "cpu": 2048}
DTYPE = {"fp32": torch.float32, "bf16": torch.bfloat16}


def main(argv: list[str]) -> int:
    """Measure and print a table."""
    args = _parse(argv)
    config = load_config(["configs/base.yaml", args.model, f"data.num_views={args.views}"])
    name = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
    height, width = config.model.image_size
    print(f"{name}, {torch.get_num_threads()} threads, torch {torch.__version__}")
    print(f"{args.model}, {args.views} images of {height}x{width}\n")
    print(ROW.format("part", "mode", "prec.", "code", "s", "GFLOP", "GFLOP/s", "share"))
    for line in _lines(config, args):
        print(line, flush=True)
    return 0


def run() -> list[tuple[str, str]]:
    """Give the figures of a whole graph of the default network, for ``benchmarks.run``."""
    layer = _default_layer()
    config = load_config(["configs/base.yaml", layer])
    flops = sum(count_flops(config.model, config.data.num_views).values())
    rows = []
    for precision in DTYPE:
        elapsed = _graph_seconds(_build(config, training=False), config, precision, repeats=5)
        share = flops / elapsed / matmul_rate(precision)
        label = f"{Path(layer).stem}, graph of {config.data.num_views}, {precision}"
        rows.append((f"{label}: inference", f"{elapsed:.3f} s"))
        rows.append((f"{label}: share of the matmul rate", f"{share:.2f}"))
    return rows


def matmul_rate(precision: Precision) -> float:
    """Measure FLOP/s of a large square matrix product."""
    device = _device()
    side = MATMUL_SIDE[device.type]
    a, b = (torch.randn(side, side, device=device, dtype=DTYPE[precision]) for _ in "ab")
    return float(2 * side**3 / seconds(lambda: a @ b, 10)[1])


def _parse(argv: list[str]) -> argparse.Namespace:
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    add = parser.add_argument
    add("--model", default=_default_layer(), help="configuration layer (%(default)s)")
    add("--views", type=int, default=8, help="images of the graph (8)")
    add("--precision", nargs="+", choices=list(DTYPE), default=list(DTYPE))
    add("--compiled", action="store_true", help="also with compiled blocks")
    add("--training", action="store_true", help="also training: parts, and the whole step")
    add("--checkpointing", action="store_true", help="also training with recomputed activations")
    add("--set-of", type=int, default=0, metavar="N", help="also reconstruct N images")
    add("--repeats", type=int, default=5, help="timings of each (5)")
    return parser.parse_args(argv)


def _lines(config: RunConfig, args: argparse.Namespace) -> Iterator[str]:
    for compiled in (False, True) if args.compiled else (False,):
        for precision in args.precision:
            rate = matmul_rate(precision)
            code = "compiled" if compiled else "eager"
            modes = [("inference", False)]
            modes += [("training", False)] if args.training else []
            modes += [("recompute", True)] if args.checkpointing else []
            for mode, recompute in modes:
                training = mode != "inference"
                flops = count_flops(config.model, args.views, training=training)
                flops["graph"] = sum(flops.values())
                model = _build(config, training=training, compiled=compiled)
                model.recompute_activations(enabled=recompute)
                timed = _timings(model, config, precision, args.repeats)
                for part, elapsed in timed:
                    figures = [flops[part] / 1e9, flops[part] / elapsed / 1e9]
                    yield ROW.format(
                        part,
                        mode,
                        precision,
                        code,
                        f"{elapsed:.4f}",
                        *(f"{value:.1f}" for value in figures),
                        f"{flops[part] / elapsed / rate:.2f}",
                    )
                if training:
                    yield _memory_line(config, precision, recompute=recompute)
                del model
            if args.set_of:
                model = _build(config, training=False, compiled=compiled)
                yield f"{code}: " + _set_line(model, precision, args.set_of, rate)


def _timings(
    model: Light3R, config: RunConfig, precision: Precision, repeats: int
) -> Iterator[tuple[str, float]]:
    """Time every part and the whole graph: forward, or with the backward pass in training."""
    device = _device()
    image = torch.rand(config.data.num_views, 3, *config.model.image_size, device=device)
    for part, call in part_calls(model, image).items():

        def once(call: Callable[[], object] = call) -> None:
            with torch.set_grad_enabled(model.training), reduced_precision(precision, device):
                result = call()
            if model.training:
                backward_from(result)

        yield part, seconds(once, repeats)[1]
    model.zero_grad()
    yield "graph", _graph_seconds(model, config, precision, repeats)


def _graph_seconds(model: Light3R, config: RunConfig, precision: Precision, repeats: int) -> float:
    """Time the whole network, or in training a whole step: loss and optimiser included."""
    device = _device()
    views = _build_views(config).to(device)
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    if not model.training:
        with torch.inference_mode(), reduced_precision(precision, device):
            return seconds(lambda: model(views.image, views.true_shape), repeats)[1]
    optimizer, loss = build_optimizer(model, config), JointLoss(config.loss)

    def step() -> None:
        with reduced_precision(precision, device):
            terms = loss(model(views.image, views.true_shape, views.scores), views)
        terms.total.backward()
        optimizer.step()
        optimizer.zero_grad()

    return seconds(step, repeats)[1]


def _memory_line(config: RunConfig, precision: Precision, *, recompute: bool) -> str:
    kept = count_kept(config.model, config.data.num_views, precision=precision, recompute=recompute)
    line = f"  kept for the backward pass, counted: {sum(kept.values()) / 2**30:.2f} GiB"
    if torch.cuda.is_available():
        line += f"; peak of the step: {torch.cuda.max_memory_allocated() / 2**30:.1f} GiB"
    return line


def _set_line(model: Light3R, precision: Precision, num_images: int, rate: float) -> str:
    """Reconstruct a set of images, cameras included, after once to warm up."""
    size = (model.config.image_size[0], model.config.image_size[1])
    draw = torch.Generator().manual_seed(1)
    photos = Photos(
        image=list(torch.rand(num_images, 3, *size, generator=draw)),
        original_size=[size] * num_images,
        window=[Window.whole(*size)] * num_images,
        file=[f"{number:04d}.jpg" for number in range(num_images)],
    )
    for _ in range(2):
        clock = StageClock(_device())
        reconstruct_photos(model, photos, InferenceConfig(precision=precision), clock)
    flops = count_flops(model.config, num_images)
    # Every edge is decoded both ways.
    total = sum(flops.values()) + flops["decoder"] + flops["heads"]
    network = sum(clock.seconds[stage] for stage in ("encode", "align", "decode"))
    stages = ", ".join(f"{name} {value:.2f}" for name, value in clock.seconds.items())
    return (
        f"{num_images} images, {precision}: {sum(clock.seconds.values()):.2f} s ({stages});\n"
        f"  network {total / 1e12:.2f} TFLOP, {total / network / rate:.2f} of the matmul rate"
    )


def _build(config: RunConfig, *, training: bool, compiled: bool = False) -> Light3R:
    torch.manual_seed(0)
    model = Light3R(config.model, config.graph).to(_device()).train(training)
    if compiled:
        model.compile_blocks()
    return model


def _build_views(config: RunConfig) -> Views:
    """Make a graph of noise before a wall: speed does not depend on what is seen."""
    num_views, (height, width) = config.data.num_views, config.model.image_size
    batch = (1, num_views)
    draw = torch.Generator().manual_seed(0)
    K = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
    scores: Tensor = torch.rand(1, num_views, num_views, generator=draw)
    return Views(
        image=torch.rand(*batch, 3, height, width, generator=draw),
        true_shape=torch.tensor([height, width]).expand(*batch, 2),
        K=K.expand(*batch, 3, 3),
        world_from_cam=torch.eye(4).expand(*batch, 4, 4),
        depth=torch.full((*batch, height, width), 2.0),
        valid=torch.ones(*batch, height, width, dtype=torch.bool),
        is_metric=torch.ones(1, dtype=torch.bool),
        dataset=["noise"],
        scores=(scores + scores.mT) / 2,
        key=["noise"],
    )


def _default_layer() -> str:
    return f"configs/model/{'l3r_512' if torch.cuda.is_available() else 'tiny'}.yaml"


def _device() -> torch.device:
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
