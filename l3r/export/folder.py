"""The folder of a reconstruction appears whole, and never takes a user's files with it."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from l3r.errors import DataError
from l3r.files import flush_to_disk, hidden_sibling


def check_output(out: Path) -> None:
    """Refuse a folder that holds anything but a former reconstruction.

    Call it before the work begins; :func:`staged_folder` asks again.

    Raises:
        DataError: ``out`` is a file, or holds files that no former run lists in its ``run.json``.
    """
    if out.is_dir():
        former = _former_files(out)
        for name in _files_below(out):
            if name not in former:
                raise DataError(
                    f"{out}: holds {name!r}, which no reconstruction wrote there; "
                    "choose another --out, or move that file away"
                )
    elif out.exists() or out.is_symlink():
        raise DataError(f"{out}: is not a folder; choose another --out")


@contextmanager
def staged_folder(out: Path) -> Iterator[Path]:
    """Give an empty folder to write to; it becomes ``out`` when the block ends well.

    A former reconstruction is replaced. After an exception it is as it was.

    Raises:
        DataError: See :func:`check_output`; or the disk refuses (full, not allowed).
    """
    out = out.resolve()
    check_output(out)
    # A mounted folder (a container's volume) cannot be renamed: its content is exchanged instead.
    inside = out.is_dir() and (out.is_mount() or not os.access(out.parent, os.W_OK))
    staged = hidden_sibling(out / "new" if inside else out)
    try:
        staged.mkdir(parents=True)
        yield staged
        for path in staged.rglob("*"):
            flush_to_disk(path)
        if inside:
            _exchange_content(staged, out)
        else:
            _exchange_folder(staged, out)
    except OSError as error:
        reason = error.strerror or str(error)
        raise DataError(f"{out}: cannot be written ({reason}); free or choose a disk") from error
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def list_files(folder: Path) -> list[str]:
    """Name all files below a folder, relative to it and with forward slashes, sorted."""
    return sorted(_files_below(folder))


def _files_below(folder: Path) -> Iterator[str]:
    for path in folder.rglob("*"):
        if path.is_symlink() or not path.is_dir():
            yield path.relative_to(folder).as_posix()


def _former_files(out: Path) -> set[str]:
    try:
        run = json.loads((out / "run.json").read_bytes())
    except (OSError, ValueError, RecursionError):
        return set()
    files = run.get("files") if isinstance(run, dict) else None
    return {str(name) for name in files} if isinstance(files, list) else set()


def _exchange_folder(staged: Path, out: Path) -> None:
    if not out.exists():
        staged.rename(out)
        return
    former = hidden_sibling(out)
    out.rename(former)
    try:
        staged.rename(out)
    except OSError:
        former.rename(out)
        raise
    shutil.rmtree(former, ignore_errors=True)


def _exchange_content(staged: Path, out: Path) -> None:
    """Move entry by entry; ``run.json``, which makes it a reconstruction, comes last."""
    # What is really there, checked before, and not what run.json lists: that may name "..".
    for path in [path for path in out.iterdir() if path != staged]:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
    for path in sorted(staged.iterdir(), key=lambda entry: entry.name == "run.json"):
        path.rename(out / path.name)
    flush_to_disk(out)
