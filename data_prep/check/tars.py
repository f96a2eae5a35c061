"""The files of a folder against its manifest, and where its graphs lie."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from data_prep.check.faults import Fault
from l3r.data.schema import (
    IndexEntry,
    Manifest,
    ShardEntry,
    ShardIndex,
    index_path,
    index_shard,
    load_index,
    read_index,
    read_manifest,
)
from l3r.errors import DataError

_PARTS = ("train", "val")
_REBUILD = "remove it and run the same l3r-prep build again, or copy it anew"
_COPY_INDEX = "copy it anew, or remove it and the tar and run the same l3r-prep build again"


@dataclass(frozen=True, kw_only=True)
class StoredGraph:
    """Where a graph lies."""

    shard: Path
    """Its tar."""
    entry: IndexEntry
    """Its place in the tar."""

    @property
    def name(self) -> str:
        """Shard and key, as the loader's messages name it: ``folder/shard.tar:key``."""
        return f"{self.shard.parent.name}/{self.shard.name}:{self.entry.key}"


@dataclass(kw_only=True)
class Tars:
    """What the tars of a folder are like."""

    graphs: list[StoredGraph] = field(default_factory=list)
    """Graphs of sound tars, in stored order."""
    faults: list[Fault] = field(default_factory=list)
    """One for each tar that is not as the manifest or its index says."""
    num_lost: int = 0
    """Graphs that the manifest counts in those tars."""


def find_folders(path: Path) -> list[Path]:
    """Give the folders of shards that a path stands for: itself, or its ``train`` and ``val``.

    Raises:
        DataError: A folder has no manifest.
    """
    parts = [path / part for part in _PARTS if (path / part).is_dir()]
    folders = [path] if (path / "manifest.json").is_file() or not parts else parts
    for folder in folders:
        read_manifest(folder)
    return folders


def check_tars(folder: Path, manifest: Manifest, *, digests: bool) -> Iterator[Tars]:
    """Hold every tar against the manifest.

    Args:
        folder: Holds the tars.
        manifest: What they should be.
        digests: Read every tar and compare its SHA-256.

    Yields:
        What each tar adds, in the manifest's order.
    """
    for shard in manifest.shards:
        try:
            index = _open_tar(folder / shard.name, shard, digests=digests)
        except _TarError as error:
            fault = Fault(kind=error.kind, shard=shard.name, key="", detail=str(error))
            yield Tars(faults=[fault], num_lost=shard.num_graphs)
            continue
        graphs = [StoredGraph(shard=folder / shard.name, entry=entry) for entry in index.graphs]
        problem = _find_index_problem(folder / shard.name, index)
        faults = [Fault(kind="wrong_index", shard=shard.name, key="", detail=problem)]
        yield Tars(graphs=graphs, faults=faults if problem else [])


def list_graphs(folder: Path) -> list[StoredGraph]:
    """Give all graphs of a folder, in stored order.

    Raises:
        DataError: The manifest or a tar cannot be read.
    """
    return [
        StoredGraph(shard=folder / shard.name, entry=entry)
        for shard in read_manifest(folder).shards
        for entry in load_index(folder / shard.name).graphs
    ]


class _TarError(DataError):
    """A tar that is not as the manifest says."""

    def __init__(self, kind: str, detail: str) -> None:
        super().__init__(detail)
        self.kind = kind


def _open_tar(path: Path, shard: ShardEntry, *, digests: bool) -> ShardIndex:
    if not path.is_file():
        raise _TarError(
            "missing_tar",
            f"no such file in {path.parent}; run the same l3r-prep build again, or copy it there",
        )
    size = path.stat().st_size
    if size != shard.bytes:
        detail = f"{size} bytes, the manifest says {shard.bytes} bytes; {_REBUILD}"
        raise _TarError("wrong_size", detail)
    if digests:
        _compare_digest(path, shard)
    try:
        index = index_shard(path)  # its headers, whatever the index beside it says
    except DataError as error:
        raise _TarError("unreadable_tar", str(error)) from error
    if len(index.graphs) != shard.num_graphs:
        detail = f"{len(index.graphs)} graphs, the manifest says {shard.num_graphs}; {_REBUILD}"
        raise _TarError("wrong_graph_count", detail)
    return index


def _find_index_problem(path: Path, scanned: ShardIndex) -> str:
    """Say what is wrong with the index beside a tar; readers over HTTP know only that."""
    try:
        index = read_index(path)
    except DataError as error:
        return str(error).partition("; delete")[0] + f"; {_COPY_INDEX}"
    if index != scanned:
        return f"{index_path(path).name} says other than the tar's headers; {_COPY_INDEX}"
    return ""


def _compare_digest(path: Path, shard: ShardEntry) -> None:
    try:
        with path.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise _TarError("unreadable_tar", f"{error}; check the disk") from error
    if digest != shard.sha256:
        detail = f"SHA-256 {digest[:12]}..., the manifest says {shard.sha256[:12]}...; {_REBUILD}"
        raise _TarError("wrong_checksum", detail)
