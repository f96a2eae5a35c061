"""Where the time of a training step goes, what of the machine it uses, and what memory it takes.

python -m benchmarks.train_step                        # full size on a GPU, tiny on a CPU
python -m benchmarks.train_step train.precision=fp32   # settings on top of that
python -m benchmarks.train_step configs/base.yaml configs/model/l3r_224.yaml --steps 50
python -m benchmarks.train_step --variants             # eager, compiled, checkpointed, both
python -m benchmarks.train_step --variants eager checkpointed --rounds 3

Steps of the real ``l3r train``, as one device of the run that the layers describe takes them, with
weights drawn at random, fed by its loader from shards that are made for it; all at the model's
image size. Medians. On a GPU times are those of the device (``benchmarks/step_clock.py``).
"""

import argparse
import gc
import io
import re
import statistics
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from omegaconf import OmegaConf

from benchmarks.flops import count_flops
from benchmarks.made_shards import write_shards
from benchmarks.model import matmul_rate
from benchmarks.step_clock import PARTS, StepClock
from l3r.config import RunConfig, load_config
from l3r.model.precision import set_tf32, true_float32
from l3r.train.run import train

GRAPHS = 16
"""Graphs in the shards, which are read over and over."""
WARMUP, OBSERVED = 5, 3
DEFAULT_LAYERS = {
    "cuda": ["configs/model/l3r_512.yaml", "configs/train/paper_512.yaml"],
    "cpu": ["configs/model/tiny.yaml"],
}
PEAK_BF16 = {
    "B200": 2250e12,
    "H200": 989e12,
    "H100 PCIe": 756e12,
    "H100 NVL": 835e12,
    "H100": 989e12,
    "A100": 312e12,
    "L40S": 362e12,
    "A40": 150e12,
    "V100": 125e12,  # in fp16: it has no bf16
}
"""FLOP/s of dense matrix products by the makers' data sheets; the first name found counts."""
VARIANTS = {
    "eager": (False, False),
    "compiled": (True, False),
    "checkpointed": (False, True),
    "both": (True, True),
}
"""``train.compile`` and ``train.gradient_checkpointing``."""


@dataclass(frozen=True)
class Measured:
    """Timed steps of one run."""

    steps: list[dict[str, float]]
    """Seconds of each part of each step."""
    peak_gib: float
    """Peak memory: the GPU's, or the process's on a CPU."""
    waits: Counter[str]
    """How often a step waits for the GPU, by place in the code; empty without a GPU."""
    num_bad: int
    """Steps that were skipped because loss or gradient were not finite."""

    @property
    def step_seconds(self) -> float:
        """Median of whole steps."""
        return statistics.median(sum(step.values()) for step in self.steps)

    def part_seconds(self, part: str) -> float:
        """Median of a part."""
        return statistics.median(step[part] for step in self.steps)


def main(argv: list[str]) -> int:
    """Measure and print."""
    args = _parse(argv)
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
    print(f"{device}, {torch.get_num_threads()} threads, torch {torch.__version__}")
    with prepared(args.layers) as config:
        size = "x".join(str(side) for side in config.model.image_size)
        print(
            f"{config.data.graphs_per_step} graphs of {config.data.num_views} images of {size} a "
            f"step, {config.train.precision}, {args.steps} steps after {WARMUP}\n"
        )
        if args.variants is None:
            rows = describe(config, measure(config, args.steps))
        else:
            rows = _compare(config, args.variants or list(VARIANTS), args.steps, args.rounds)
        for label, value in rows:
            print(f"  {label:<44}{value:>32}", flush=True)
    return 0


def run() -> list[tuple[str, str]]:
    """Give the figures of the default step, for ``benchmarks.run``."""
    with prepared([]) as config:
        return list(describe(config, measure(config, 20)))


@contextmanager
def prepared(layers: Sequence[str]) -> Iterator[RunConfig]:
    """Give the configuration of one device of a run, and the shards that it reads, for a while.

    Args:
        layers: Of ``l3r train``; where none of them is a file, on top of the default ones.
    """
    chosen = list(layers)
    if all("=" in layer for layer in chosen):
        kind = "cuda" if torch.cuda.is_available() else "cpu"
        chosen = ["configs/base.yaml", *DEFAULT_LAYERS[kind], *chosen]
    with tempfile.TemporaryDirectory() as temporary:
        shards = Path(temporary) / "shards"
        sources = [f"data.sources.{name}.shards={shards}" for name in _source_names(chosen)]
        config = load_config([*chosen, *sources])
        config.data.validation = {}
        config.data.image_sizes = []
        own = config.train
        # The most that a device of the run takes.
        parts = (own.devices or 1) * (own.num_nodes or 1)
        config.data.graphs_per_step = -(-config.data.graphs_per_step // parts)
        own.devices = own.num_nodes = 1
        own.strategy = "ddp"  # one process holds the whole network in any case
        own.init = ""
        own.output_dir = str(Path(temporary) / "run")
        config.logs.to = []
        height, width = config.model.image_size
        # As photos are: a quarter larger than what is trained on.
        write_shards(shards, GRAPHS, config.data.num_views, (height * 5 // 4, width * 5 // 4))
        yield config


def measure(config: RunConfig, steps: int, warmup: int = WARMUP) -> Measured:
    """Train for some steps and time them.

    Args:
        config: From :func:`prepared`.
        steps: How many are timed.
        warmup: How many go before them.
    """
    # Each run starts afresh, and writes no checkpoint: it is ended before its last step.
    with tempfile.TemporaryDirectory(dir=Path(config.train.output_dir).parent) as folder:
        rare = dict.fromkeys(("max_steps", "checkpoint_every", "log_every"), 1_000_000)
        own = replace(config, train=replace(config.train, output_dir=folder, **rare))
        own.train.checkpoint_minutes = None
        on_gpu = config.train.accelerator != "cpu" and torch.cuda.is_available()
        device = torch.device("cuda" if on_gpu else "cpu")
        clock = StepClock(
            device,
            config.train.accumulate,
            warmup=warmup,
            steps=steps,
            observed=OBSERVED if on_gpu else 0,
        )
        # Not on a terminal: a bar there looks at the loss now and then, and waits for it.
        with clock.attached(), redirect_stderr(io.StringIO()):
            train(own)
        bad = Path(folder) / "bad_steps.jsonl"
        num_bad = len(bad.read_text().splitlines()) if bad.exists() else 0
    gc.collect()
    if on_gpu:
        torch.cuda.empty_cache()
    waits = Counter({place: -(-number // OBSERVED) for place, number in clock.waits.items()})
    return Measured(clock.steps, clock.peak_mib / 1024, waits, num_bad)


def describe(config: RunConfig, measured: Measured) -> Iterator[tuple[str, str]]:
    """Give the rows of one run: parts, throughput, utilisation, memory, waits."""
    whole = measured.step_seconds
    for part in PARTS:
        own = measured.part_seconds(part)
        yield part, f"{1e3 * own:.2f} ms {own / whole:>6.1%}"
    yield "step", f"{1e3 * whole:.2f} ms"
    graphs = config.data.graphs_per_step
    yield "graphs/s", f"{graphs / whole:.2f}"
    yield "images/s", f"{graphs * config.data.num_views / whole:.1f}"
    flops = step_flops(config)
    rate = _measured_rate(config)
    yield "model FLOPs of a step, counted", f"{flops / 1e12:.3f} TFLOP"
    yield f"MFU by the data sheet ({_sheet_name()})", _share(flops / whole, _sheet_rate(config))
    yield f"MFU by the matmul rate, {rate / 1e12:.3g} TFLOP/s here", _share(flops / whole, rate)
    yield "peak memory", f"{measured.peak_gib:.2f} GiB"
    if measured.waits:
        yield "waits of the host for the GPU a step", str(measured.waits.total())
        for place, number in measured.waits.items():
            yield f"  {place}", str(number)
    if measured.num_bad:
        yield "steps that were not finite", str(measured.num_bad)


def step_flops(config: RunConfig) -> float:
    """Count the operations of a step, forward and backward; what is recomputed counts once."""
    of_graph = count_flops(config.model, config.data.num_views, training=True)
    return config.data.graphs_per_step * sum(of_graph.values())


def _compare(
    config: RunConfig, names: Sequence[str], steps: int, rounds: int
) -> Iterator[tuple[str, str]]:
    """Take turns with variants of one configuration; ratios are to the first."""
    taken: dict[str, list[Measured]] = {name: [] for name in names}
    for _ in range(rounds):
        for name, runs in taken.items():
            compiled, checkpointed = VARIANTS[name]
            changed = {"compile": compiled, "gradient_checkpointing": checkpointed}
            variant = replace(config, train=replace(config.train, **changed))
            runs.append(measure(variant, steps))
    joined = {
        name: replace(
            runs[0],
            steps=[step for run in runs for step in run.steps],
            peak_gib=max(run.peak_gib for run in runs),
        )
        for name, runs in taken.items()
    }
    first = joined[names[0]]
    flops, rate = step_flops(config), _measured_rate(config)
    for name, measured in joined.items():
        whole = measured.step_seconds
        ratio = f"{whole / first.step_seconds:.2f} of {names[0]}"
        yield name, f"{1e3 * whole:.1f} ms, {ratio}"
        yield "  MFU by the data sheet", _share(flops / whole, _sheet_rate(config))
        yield "  MFU by the matmul rate", _share(flops / whole, rate)
        yield "  peak memory", f"{measured.peak_gib:.2f} GiB"


def _source_names(layers: Sequence[str]) -> list[str]:
    """Find the sources that layers name, whose shards the made ones take the place of."""
    names: set[str] = set()
    for layer in layers:
        loaded = OmegaConf.from_dotlist([layer]) if "=" in layer else OmegaConf.load(layer)
        names.update(OmegaConf.select(loaded, "data.sources") or ())
    return sorted(names) or ["made"]


def _sheet_name() -> str:
    return torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"


def _sheet_rate(config: RunConfig) -> float | None:
    """FLOP/s that the data sheet promises in the precision of the matrix products, if known."""
    return find_sheet_rate(_sheet_name()) if config.train.precision == "bf16" else None


def find_sheet_rate(gpu: str) -> float | None:
    """FLOP/s of dense matrix products in bfloat16, by the data sheet of a GPU, if known."""
    # Whole words: an RTX A4000 is no A40.
    rates = (rate for name, rate in PEAK_BF16.items() if re.search(rf"\b{name}\b", gpu))
    return next(rates, None)


def _measured_rate(config: RunConfig) -> float:
    """FLOP/s of a large matrix product in the precision of the run's."""
    with true_float32(torch.device("cpu")):  # which restores what is chosen here
        set_tf32(products=config.train.tf32, convolutions=config.train.tf32)
        return matmul_rate(config.train.precision)


def _share(reached: float, possible: float | None) -> str:
    return "-" if possible is None else f"{reached / possible:.1%}"


def _parse(argv: list[str]) -> argparse.Namespace:
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    add = parser.add_argument
    add("layers", nargs="*", metavar="LAYER", help="of l3r train; settings alone: on the default")
    add("--steps", type=int, default=20, help="steps to time (20)")
    names = ", ".join(VARIANTS)
    add("--variants", nargs="*", choices=VARIANTS, metavar="NAME", help=f"compare them: {names}")
    add("--rounds", type=int, default=1, help="turns of the variants (1)")
    return parser.parse_intermixed_args(argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
