"""File names out of data sets, kept inside the folder they belong to."""

from pathlib import Path, PurePosixPath

from l3r.errors import DataError

_LONGEST = 1024


def join_inside(folder: Path, name: str) -> Path:
    """Join a name written in a data set to the folder it is relative to.

    Args:
        folder: The folder.
        name: Relative path with slashes; a leading ``./`` is usual and harmless.

    Raises:
        DataError: The name is empty, absolute, climbs out by ``..`` or is no name of a file.
    """
    path = PurePosixPath(name)
    strange = "\0" in name or "\\" in name or len(name) > _LONGEST
    if strange or not path.parts or path.is_absolute() or ".." in path.parts:
        raise DataError(
            f"file name {name[:80]!r}, expected a path below {folder}; correct it in the source"
        )
    return folder / path
