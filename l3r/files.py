"""Files appear whole or not at all: write beside, flush to disk, rename."""

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path


def hidden_sibling(path: Path) -> Path:
    """Name an unused hidden path in the same folder, hence on the same file system.

    Of a hidden path too: what is written beside such a one counts as its file's.
    """
    name = path.name.lstrip(".")
    return path.with_name(f".{name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")


def hidden_siblings(path: Path) -> list[Path]:
    """List what processes that were killed left of a file: names of :func:`hidden_sibling`."""
    return sorted(path.parent.glob(f".{escape(path.name.lstrip('.'))}.*.tmp"))


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Give a temporary name to write to; it becomes ``path`` when the block ends well.

    After an exception ``path`` is as it was, and the temporary file is gone.
    """
    temporary = hidden_sibling(path)
    try:
        yield temporary
        flush_to_disk(temporary)
        temporary.replace(path)
        flush_to_disk(path.parent)
    except OSError as error:
        # A disk that fills up in the middle of a write does not say of what.
        error.filename = error.filename or str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_atomic(path: Path, data: bytes | str) -> None:
    """Write a file as a whole; text becomes UTF-8 with the line ends as given."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)


def write_first(path: Path, data: bytes) -> None:
    """Write a file as a whole unless it is there: of several processes the first one wins."""
    temporary = hidden_sibling(path)
    try:
        temporary.write_bytes(data)
        flush_to_disk(temporary)
        with suppress(FileExistsError):
            os.link(temporary, path)
        flush_to_disk(path.parent)
    except OSError as error:
        error.filename = error.filename or str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def append_whole(path: Path, text: str) -> None:
    """Add text to a file, or leave the file as it was: a disk that fills up takes part of it."""
    data = text.encode()
    # No buffer: what it could not get rid of it would try again when closed.
    with path.open("ab", buffering=0) as stream:
        before = stream.tell()
        try:
            while data:
                data = data[stream.write(data) :]
        except OSError as error:
            stream.truncate(before)
            error.filename = error.filename or str(path)
            raise


def explain_failure(error: OSError) -> str:
    """Say what failed on a disk and what to do, in one line."""
    is_full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    hint = "free space, then run the same command again" if is_full else "check its permissions"
    return f"{error.filename or 'a file'}: {error.strerror or error}; {hint}"


def flush_to_disk(path: Path) -> None:
    """Wait until a file's content, or a folder's list of names, is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
