"""Progress on standard error: bars for who watches, lines for a log; results go to stdout alone."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

LINE_EVERY = 30.0
"""Time between two lines of a log about one thing [s]."""

Report = Callable[[str, int, int], None]
"""To be called with a name, the steps done and the steps in all."""


@contextmanager
def show_progress() -> Iterator[Report]:
    """Show how far each thing under way is, its rate and the time left.

    Yields:
        A function to call with a name, the steps done and the steps in all.
    """
    if not sys.stderr.isatty():
        yield _Lines()
        return
    progress = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _RateColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )
    tasks = {}
    with progress:

        def report(name: str, done: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = progress.add_task(name, total=total)
            progress.update(tasks[name], completed=done, total=total)

        yield report


class _RateColumn(ProgressColumn):
    """Steps per second."""

    def render(self, task: Task) -> Text:
        """Show the rate, once there is one."""
        return Text(f"{task.speed:.3g}/s" if task.speed else "")


class _Lines:
    """A line now and then about each thing, and one when it is done."""

    def __init__(self) -> None:
        self.began: dict[str, tuple[float, int]] = {}
        self.told: dict[str, float] = {}

    def __call__(self, name: str, done: int, total: int) -> None:
        now = time.monotonic()
        start, first = self.began.setdefault(name, (now, done))
        if done < total and now - self.told.setdefault(name, now) < LINE_EVERY:
            return
        self.told[name] = now
        line = f"{name}: {done}/{total}"
        if now > start and done > first:
            rate = (done - first) / (now - start)
            left = f", {_clock((total - done) / rate)} left" if done < total else ""
            line += f", {rate:.3g}/s{left}"
        sys.stderr.write(line + "\n")
        sys.stderr.flush()


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}"
