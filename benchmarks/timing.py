"""Repeated timings of a call."""

import statistics
import time
from collections.abc import Callable

import torch


def seconds(call: Callable[[], object], repeats: int = 5) -> tuple[float, float]:
    """Return (least, median) wall seconds after one call to warm up."""
    times = []
    for repeat in range(repeats + 1):
        _wait()
        start = time.perf_counter()
        call()
        _wait()
        if repeat:
            times.append(time.perf_counter() - start)
    return min(times), statistics.median(times)


def shown(times: tuple[float, float]) -> str:
    """Format as least / median."""
    return f"{times[0]:.3f} / {times[1]:.3f} s"


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
