"""What a sweep shows while it runs: a bar on a terminal, lines elsewhere."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from l3r.launch.expand import Run

_TAIL = 4096


class SweepProgress:
    """Progress on standard error."""

    def __init__(self) -> None:
        self.console = Console(stderr=True)
        self.bar: Progress | None = None
        self.total = 0
        self.ended = 0
        self.stages: dict[str, str] = {}

    @contextmanager
    def shown(self, runs: Sequence[Run]) -> Iterator[None]:
        """Show progress as long as the block lasts."""
        self.total, self.ended = len(runs), 0
        if not self.console.is_terminal:
            yield
            return
        columns = (TextColumn("sweep"), BarColumn(), MofNCompleteColumn())
        note = TextColumn("{task.fields[note]}", markup=False)
        with Progress(*columns, note, console=self.console) as self.bar:
            self.bar.add_task("", total=self.total, note="")
            yield
        self.bar = None

    def begin(self, run: Run, stage: str) -> None:
        """Note that a process has begun."""
        self.stages[run.name] = stage

    def end(self, run: Run, words: str) -> None:
        """Say what became of a run."""
        self.ended += 1
        line = f"{self.ended}/{self.total} {run.name}: {words}"
        if self.bar is None:
            sys.stderr.write(f"{line}\n")
            sys.stderr.flush()
        else:
            self.bar.console.print(line, markup=False, highlight=False)
            self.bar.update(self.bar.task_ids[0], completed=self.ended)

    def update(self, runs: Sequence[Run]) -> None:
        """Show how far the runs are that have a process."""
        if self.bar is not None:
            note = ", ".join(self._note(run) for run in runs)
            self.bar.update(self.bar.task_ids[0], note=note)

    def _note(self, run: Run) -> str:
        if self.stages.get(run.name) != "train" or run.config is None:
            return f"{run.name} scores"
        step = _last_step(run.folder / "metrics.csv")
        return f"{run.name} {step}/{run.config.train.max_steps}"


def _last_step(path: Path) -> str:
    """Read the first cell of the last whole row, without reading the rest of the log."""
    try:
        with path.open("rb") as stream:
            stream.seek(max(0, path.stat().st_size - _TAIL))
            rows = stream.read().decode(errors="replace").split("\n")
    except OSError:
        return "0"
    cell = rows[-2].split(",")[0] if len(rows) > 1 else "0"
    return cell if cell.isdecimal() else "0"
