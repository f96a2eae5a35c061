"""A folder of limited size that keeps graphs read from afar; all processes of a node share it."""

import fcntl
import hashlib
import logging
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from l3r.data.schema import IndexEntry, Manifest, ShardEntry, ShardIndex, members_from_bytes
from l3r.data.store import ShardStore
from l3r.files import hidden_sibling

log = logging.getLogger(__name__)

LEDGER_NAME = "bytes.txt"
"""Holds the sum of all entries' sizes; locked while the folder changes."""
_MARK = 4
"""Bytes of the checksum at the end of each entry."""
_KEPT = 0.95
"""Share of the limit down to which room is made, so that the folder is rarely listed."""


class GraphCache:
    """Bytes by name, at most so many in all; those unused for longest make room.

    Reading takes no lock. Writing takes one, for as long as a file takes to write, so that the
    limit holds at every moment whatever the number of processes. Entries appear whole; one whose
    checksum fails counts as absent.

    Args:
        folder: Where; on a local disk. Nothing else may lie in it.
        max_bytes: Limit of the sum of file sizes.

    Raises:
        OSError: The folder cannot be made.
    """

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self.folder = folder
        self.max_bytes = max_bytes
        self.is_on = True
        folder.mkdir(parents=True, exist_ok=True)

    def read(self, name: str) -> bytes | None:
        """Give what was written under a name, or None where it is not there or damaged."""
        path = self._path(name)
        try:
            stored = path.read_bytes()
        except OSError:
            return None
        data, mark = stored[:-_MARK], stored[-_MARK:]
        if mark != _checksum(data):
            log.warning("%s: damaged (%d bytes), read again from its source", path, len(stored))
            path.unlink(missing_ok=True)
            return None
        with suppress(OSError):
            os.utime(path)  # the time of its last use
        return data

    def write(self, name: str, data: bytes) -> None:
        """Keep bytes under a name, if there is room; after a failure keep nothing any more."""
        size = len(data) + _MARK
        if not self.is_on or size > self.max_bytes:
            return
        path = self._path(name)
        try:
            with self._locked() as ledger:
                if path.exists():
                    return
                used = self._used(ledger)
                if used + size > self.max_bytes:
                    used = self._make_room(min(self.max_bytes - size, int(_KEPT * self.max_bytes)))
                # Before the file: a process that is killed in between leaves a sum too large.
                _set(ledger, used + size)
                _write_whole(path, data + _checksum(data))
        except OSError as error:
            self.is_on = False
            log.warning(
                "data.cache_dir %s: %s; this process goes on without keeping graphs",
                self.folder,
                error,
            )

    def _path(self, name: str) -> Path:
        digest = hashlib.sha256(name.encode()).hexdigest()
        return self.folder / digest[:2] / digest[2:]

    @contextmanager
    def _locked(self) -> Iterator[BinaryIO]:
        """Open the ledger alone; the lock ends with the file, or with its process."""
        descriptor = os.open(self.folder / LEDGER_NAME, os.O_RDWR | os.O_CREAT, 0o666)
        with os.fdopen(descriptor, "r+b", buffering=0) as ledger:
            fcntl.flock(ledger, fcntl.LOCK_EX)
            yield ledger

    def _used(self, ledger: BinaryIO) -> int:
        """Read the sum; measure where the ledger is new or damaged."""
        text = ledger.read(20)
        return int(text) if text.isdigit() else self._make_room(self.max_bytes)

    def _make_room(self, limit: int) -> int:
        """Remove what was unused for longest until the rest is within a limit; give its size."""
        entries = []
        for path in self.folder.glob("??/*"):
            with suppress(OSError):
                status = path.stat()
                entries.append((status.st_mtime_ns, status.st_size, path))
        used = sum(size for _, size, _ in entries)
        for _, size, path in sorted(entries):
            if used <= limit:
                break
            path.unlink(missing_ok=True)
            used -= size
        return used


class CachedStore(ShardStore):
    """Another store whose graphs are kept once read.

    Args:
        store: The other one.
        cache: Where they are kept.
    """

    def __init__(self, store: ShardStore, cache: GraphCache) -> None:
        self.store = store
        self.cache = cache
        self.name = store.name
        self.place = store.place

    def read_manifest(self) -> Manifest:
        """Read what the place holds."""
        return self.store.read_manifest()

    def read_index(self, shard: ShardEntry) -> ShardIndex:
        """Read where a shard's graphs lie."""
        return self.store.read_index(shard)

    def read_graph(self, shard: ShardEntry, entry: IndexEntry) -> bytes:
        """Take one graph's range from the cache, else from the store into the cache."""
        # The digest, so that shards that are built anew at the same place are read anew.
        name = f"{shard.sha256} {entry.offset} {entry.size}"
        data = self.cache.read(name)
        if data is None:
            data = self.store.read_graph(shard, entry)
            members_from_bytes(data, f"{self.place}/{shard.name}:{entry.key}", entry.key)
            self.cache.write(name, data)
        return data


def _checksum(data: bytes) -> bytes:
    return zlib.crc32(data).to_bytes(_MARK, "big")


def _set(ledger: BinaryIO, used: int) -> None:
    ledger.seek(0)
    ledger.truncate()
    ledger.write(str(used).encode())


def _write_whole(path: Path, data: bytes) -> None:
    """Make a file appear whole; not flushed, since a checksum tells what a power cut leaves."""
    temporary = hidden_sibling(path)
    try:
        path.parent.mkdir(exist_ok=True)
        temporary.write_bytes(data)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
