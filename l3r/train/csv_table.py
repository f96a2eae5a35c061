"""A CSV file that a run adds rows to, and a resumed run goes on with."""

import csv
import io
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from l3r.files import append_whole, write_atomic

log = logging.getLogger(__name__)


def append_row(path: Path, row: Mapping[str, float]) -> None:
    """Add a row; a column that the file lacks is added to it, empty above.

    Columns come later where a data set is met for the first time, or a run is resumed by a newer
    version. A column that ``row`` lacks stays empty in it. A row that cannot be written whole, for
    want of space, is not written at all.
    """
    header = _read_header(path)
    if new := [name for name in row if name not in header]:
        rows = _read_rows(path)
        header = [*header, *new]
        _write(path, header, rows)
    line = io.StringIO()
    writer = csv.DictWriter(line, fieldnames=header, lineterminator="\n")
    writer.writerow({name: f"{value:.9g}" for name, value in row.items()})
    append_whole(path, line.getvalue())


def drop_rows_after(path: Path, step: int) -> None:
    """Forget what a stopped run wrote after the step it goes on from, and half a row."""
    if path.exists():
        rows = [row for row in _read_rows(path) if float(row["step"]) <= step]
        _write(path, _read_header(path), rows)


@contextmanager
def bear_loss_of(what: str) -> Iterator[None]:
    """Warn of a part of the log that cannot be written, and go on: the run is worth more."""
    try:
        yield
    except OSError as error:
        log.warning("%s is lost: %s (%s); make room", what, error.strerror, error.filename)


def _read_header(path: Path) -> list[str]:
    if not path.exists():
        return []
    with path.open(newline="") as stream:
        return next(csv.reader(stream), [])


def _read_rows(path: Path) -> list[dict[str, str]]:
    """Read whole rows: a kill in the middle of a write leaves one with fewer fields."""
    if not path.exists():
        return []
    with path.open(newline="") as stream:
        return [row for row in csv.DictReader(stream) if None not in row.values()]


def _write(path: Path, header: list[str], rows: list[dict[str, str]]) -> None:
    lines = [header, *([row.get(name, "") for name in header] for row in rows)]
    write_atomic(path, "".join(",".join(line) + "\n" for line in lines))
