"""One pair through the full-size network, beside its bare operations and beside bfloat16.

python -m benchmarks.pair [--rounds 7] [--model configs/model/l3r_512.yaml]

All variants take turns in one process; the figures are medians over the rounds.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable

import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.bare import record_bare
from l3r.config import load_config
from l3r.model.light3r import Light3R
from l3r.model.precision import reduced_precision

OFFICIAL_GFLOP = {"dpt": 1856.78, "linear": 1485.79}
"""What the released network spends on a pair at 384x512, two encoders included."""


def main(argv: list[str]) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="configs/model/l3r_512.yaml")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--no-bf16", action="store_true", help="leave bfloat16 out")
    args = parser.parse_args(argv)
    config = load_config(["configs/base.yaml", args.model])
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.manual_seed(0)
    model = Light3R(config.model, config.graph).to(device).eval().requires_grad_(False)
    with torch.inference_mode():
        _compare(model, device, args.rounds, with_half=not args.no_bf16)
    return 0


def _compare(model: Light3R, device: torch.device, rounds: int, *, with_half: bool) -> None:
    height, width = model.config.image_size
    image = torch.rand(2, 3, height, width, device=device)
    grid = model.encoder.token_grid(height, width)

    def transform() -> object:
        tokens = model.encode(image)
        return model.decoder(tokens[:1], tokens[1:], grid, grid, hooks=model.parent_head.hooks)

    def pair() -> object:
        tokens = model.encode(image)
        return model.decode(tokens[:1], tokens[1:], grid, grid)

    def transform_half() -> object:
        with reduced_precision("bf16", device):
            return transform()

    bare = record_bare(model, pair)
    square = [torch.randn(4096, 4096, device=device) for _ in "ab"]
    calls: dict[str, Callable[[], object]] = {"pair": pair, "bare": bare}
    calls["transformer fp32"] = transform
    if with_half:
        calls["transformer bf16"] = transform_half
    calls["matmul"] = lambda: square[0] @ square[1]
    seconds = _interleave(calls, rounds)
    flops = {"pair": _count(pair), "bare": _count(bare)}
    _report(seconds, flops, OFFICIAL_GFLOP[model.config.head])


def _interleave(calls: dict[str, Callable[[], object]], rounds: int) -> dict[str, list[float]]:
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for number in range(rounds + 1):
        for name, call in calls.items():
            _wait()
            began = time.perf_counter()
            call()
            _wait()
            if number:  # the first round warms up
                seconds[name].append(time.perf_counter() - began)
    return seconds


def _count(call: Callable[[], object]) -> float:
    """Count GFLOP; fused attention on a CPU is counted by its plain form."""
    with FlopCounterMode(display=False) as counter, sdpa_kernel(SDPBackend.MATH):
        call()
    return counter.get_total_flops() / 1e9


def _report(seconds: dict[str, list[float]], flops: dict[str, float], official: float) -> None:
    middle = {name: statistics.median(times) for name, times in seconds.items()}
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
    print(f"{device}, {torch.get_num_threads()} threads, torch {torch.__version__}")
    for name, times in seconds.items():
        each = " ".join(f"{value:.2f}" for value in times)
        print(f"{name:<18}{middle[name]:8.3f} s   rounds: {each}")
    rate = 2 * 4096**3 / 1e9 / middle["matmul"]
    print(f"counted GFLOP      pair {flops['pair']:.2f}, bare {flops['bare']:.2f}")
    print(f"pair / bare        {middle['pair'] / middle['bare']:.3f}")
    if "transformer bf16" in middle:
        ratio = middle["transformer bf16"] / middle["transformer fp32"]
        print(f"bf16 / fp32        {ratio:.3f} (encoder and decoder)")
    share = official / middle["pair"] / rate
    print(f"matmul rate        {rate:.0f} GFLOP/s; the pair at {official} GFLOP: {share:.2f} of it")


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
