"""A CSV file that a run adds rows to, and a resumed run goes on with."""

import csv
from collections.abc import Mapping
from pathlib import Path

from l3r.files import write_atomic


def append_row(path: Path, row: Mapping[str, float]) -> None:
    """Add a row; a column that the file lacks is added to it, empty above.

    Columns come later where a data set is met for the first time, or a run is resumed by a newer
    version. A column that ``row`` lacks stays empty in it.
    """
    header = _read_header(path)
    if new := [name for name in row if name not in header]:
        rows = _read_rows(path)
        header = [*header, *new]
        _write(path, header, rows)
    with path.open("a", newline="") as stream:
        writer = csv.DictWriter(stream, fieldnames=header, lineterminator="\n")
        writer.writerow({name: f"{value:.9g}" for name, value in row.items()})


def drop_rows_after(path: Path, step: int) -> None:
    """Forget what a stopped run wrote after the step it goes on from, and half a row."""
    if path.exists():
        rows = [row for row in _read_rows(path) if float(row["step"]) <= step]
        _write(path, _read_header(path), rows)


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
