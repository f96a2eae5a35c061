"""Repeated timings of a call, and where its time goes."""

import statistics
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import wraps
from pkgutil import resolve_name
from typing import Any
from unittest.mock import patch

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


@contextmanager
def stopwatch(stages: Mapping[str, Sequence[str]]) -> Iterator[Counter[str]]:
    """Add up the seconds of each stage; what one stage calls of another counts for the outer.

    Args:
        stages: Full names of the functions of each stage, where they are looked up.
    """
    spent: Counter[str] = Counter()
    under_way: list[str] = []

    @contextmanager
    def timed(stage: str) -> Iterator[None]:
        if under_way:
            yield
            return
        under_way.append(stage)
        start = time.perf_counter()
        try:
            yield
        finally:
            spent[under_way.pop()] += time.perf_counter() - start

    with surrounded(stages, timed):
        yield spent


@contextmanager
def surrounded(
    stages: Mapping[str, Sequence[str]], around: Callable[[str], AbstractContextManager[None]]
) -> Iterator[None]:
    """Let every call of some functions run inside a context of its stage.

    Args:
        stages: Full names of the functions of each stage, where they are looked up.
        around: Makes the context from the name of the stage.
    """

    def inside(stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            with around(stage):
                return function(*args, **kwargs)

        return call

    with ExitStack() as stack:
        for stage, names in stages.items():
            for name in names:
                owner, _, attribute = name.rpartition(".")
                home = resolve_name(owner)
                call = inside(stage, getattr(home, attribute))
                stack.enter_context(patch.object(home, attribute, call))
        yield


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
