"""An image that cannot be used, with the name its problem is counted under."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from l3r.errors import DataError


class RejectedError(Exception):
    """Carries what :meth:`data_prep.problems.Problems.add` takes: kind, where, detail."""

    def __init__(self, kind: str, where: Path | str, detail: str) -> None:
        super().__init__(kind, where, detail)
        self.problem = kind, where, detail


@contextmanager
def reject_as(kind: str, where: Path | str) -> Iterator[None]:
    """Name what a DataError means for the image.

    Args:
        kind: Name of the problem.
        where: File.

    Raises:
        RejectedError: In place of a DataError.
    """
    try:
        yield
    except DataError as error:
        # The message begins with the file, which the problem names by itself.
        raise RejectedError(kind, where, str(error).removeprefix(f"{where}: ")) from error
