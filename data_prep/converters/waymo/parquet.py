"""Parquet tables: small columns as a whole, single cells of large ones in passing.

A cell cannot be reached directly: its row group is read from the start. So the place reached is
kept open, and cells asked for in the order of the file cost one pass over it.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from l3r.errors import DataError

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as error:
    raise DataError(
        "version 2 of the data set is Parquet and pyarrow is not installed;"
        " pip install light3r[raw]"
    ) from error

_MAX_SMALL = 2**28
"""Most bytes of a column that is read as a whole; that of all labels of a segment has 0.2 MB."""
_MAX_LARGE = 2**33
"""Most bytes of one row group of a column read cell by cell; genuine ones have about 0.5 GB."""
_OPEN = 4
"""Columns kept open: images, ranges, projections, pixel poses."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Where one value lies."""

    path: Path
    """The file."""
    column: str
    """Full name of the column."""
    group: int
    """Row group."""
    row: int
    """Row within it."""

    def __str__(self) -> str:
        return f"{self.path}: row {self.row} of row group {self.group}"


@dataclass(frozen=True, kw_only=True)
class Table:
    """Small columns of a file, and where the cells of its large ones lie."""

    path: Path
    """The file."""
    columns: dict[str, list[Any]]
    """Values by the end of the column's name; None where null, the list empty where absent."""
    names: dict[str, str]
    """Full names by their ends."""
    places: list[tuple[int, int]]
    """Row group and row within it, of each row."""

    def cell(self, end: str, row: int) -> Cell:
        """Name the cell of a column in a row of the table."""
        group, within = self.places[row]
        return Cell(path=self.path, column=self.names[end], group=group, row=within)


def read_table(
    path: Path, small: Sequence[str], *, large: Sequence[str] = (), optional: Sequence[str] = ()
) -> Table:
    """Read columns of a file.

    Args:
        path: The file.
        small: Ends of the names of columns to read; names are ``[Component].part.of.it``.
        large: Ends of the names of columns whose cells are read later.
        optional: Ends of names of columns to read where they are there.

    Raises:
        DataError: The file is damaged or lacks a column.
    """
    with _explain(path), pq.ParquetFile(path, page_checksum_verification=True) as file:
        names = _find_names(path, file.schema_arrow.names, [*small, *large], optional)
        wanted = [end for end in (*small, *optional) if end in names]
        _check_size(path, file.metadata, [names[end] for end in wanted], _MAX_SMALL)
        table = file.read(columns=[names[end] for end in wanted], use_threads=False)
        table.validate(full=True)
        columns = {end: table.column(names[end]).to_pylist() for end in wanted}
        sizes = [file.metadata.row_group(g).num_rows for g in range(file.metadata.num_row_groups)]
    return Table(
        path=path,
        columns={end: columns.get(end, []) for end in (*small, *optional)},
        names=names,
        places=[(group, row) for group, size in enumerate(sizes) for row in range(size)],
    )


def _find_names(
    path: Path, names: Sequence[str], needed: Sequence[str], optional: Sequence[str]
) -> dict[str, str]:
    found = {}
    for end in (*needed, *optional):
        matches = [name for name in names if name == end or name.endswith(f".{end}")]
        if len(matches) == 1:
            found[end] = matches[0]
        elif end in needed:
            raise DataError(
                f"{path}: {len(matches)} columns whose name ends in '{end}', expected 1; download"
                " the file again"
            )
    return found


def _check_size(path: Path, metadata: Any, names: Sequence[str], limit: int) -> None:
    """Refuse a footer that claims what no file of the data set holds, before any allocation."""
    for group in range(metadata.num_row_groups):
        row_group = metadata.row_group(group)
        for index in range(row_group.num_columns):
            column = row_group.column(index)
            name = column.path_in_schema
            claimed = max(column.total_uncompressed_size, column.num_values)
            is_wanted = any(name == wanted or name.startswith(f"{wanted}.") for wanted in names)
            if is_wanted and not 0 <= claimed <= limit:
                raise DataError(
                    f"{path}: column {name} claims {claimed} bytes, expected {limit} or less;"
                    " download the file again"
                )


def read_cell(cell: Cell) -> Any:
    """Read one value as an Arrow scalar.

    Raises:
        DataError: The file is damaged, or the value null.
    """
    with _explain(cell.path):
        scalar = _open_column(cell.path, cell.column).read(cell.group, cell.row)
    if not scalar.is_valid:
        raise DataError(f"{cell}: null, expected a value; leave this segment out")
    return scalar


@lru_cache(maxsize=_OPEN)
def _open_column(path: Path, column: str) -> "_OpenColumn":
    return _OpenColumn(path, column)


class _OpenColumn:
    """A column being read forwards, one row at a time.

    Args:
        path: The file.
        column: Full name of the column.
    """

    def __init__(self, path: Path, column: str) -> None:
        self.column = column
        self.file = pq.ParquetFile(path, page_checksum_verification=True)
        _check_size(path, self.file.metadata, [column], _MAX_LARGE)
        self.path = path
        self._group = -1
        self._row = -1
        self._rows: Iterator[Any] = iter(())
        self._latest: Any = None

    def read(self, group: int, row: int) -> Any:
        """Give the scalar in a row: the latest, one further on, or by starting again."""
        if (group, row) < (self._group, self._row) or group != self._group:
            self._rows = self.file.iter_batches(
                batch_size=1, row_groups=[group], columns=[self.column], use_threads=False
            )
            self._group, self._row = group, -1
        while self._row < row:
            try:
                batch = next(self._rows)
            except StopIteration:
                self._group = -1
                raise DataError(f"{self.path}: row group {group} has no row {row}") from None
            except BaseException:
                self._group = -1
                raise
            batch.validate(full=True)
            self._latest = batch.column(0)[0]
            self._row += 1
        return self._latest


@contextmanager
def _explain(path: Path) -> Iterator[None]:
    try:
        yield
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        first_line = str(error).split("\n", 1)[0][:200]
        raise DataError(
            f"{path}: no sound Parquet file ({first_line}); download it again"
        ) from error
