"""Where in a tar each graph lies, so that a sample is one read."""

import io
import json
import re
import tarfile
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from l3r.data.schema.graph import SCHEMA_VERSION
from l3r.errors import DataError
from l3r.files import write_atomic

_BLOCK = 512
_IMAGE = re.compile(r"\d\d\.jpg")
_BEYOND = 2**63
"""Offsets travel as 64-bit integers."""


@dataclass(frozen=True, kw_only=True, slots=True)
class IndexEntry:
    """One graph: a contiguous range of whole tar records."""

    key: str
    """Name of the graph."""
    offset: int
    """First byte of its first header."""
    size: int
    """Bytes up to the end of its last record, padding included."""
    num_views: int
    """Images it holds."""


@dataclass(frozen=True, kw_only=True)
class ShardIndex:
    """All graphs of one tar, in order."""

    tar_bytes: int
    """Size of the tar it was made of."""
    graphs: list[IndexEntry]
    """One entry per graph."""


def index_path(shard: Path) -> Path:
    """Name the index that stands beside a tar: ``x.tar`` has ``x.index.json``."""
    return shard.with_suffix(".index.json")


def write_index(shard: Path, index: ShardIndex) -> None:
    """Write the index beside its tar, whole or not at all."""
    plain = {"schema_version": SCHEMA_VERSION, **asdict(index)}
    write_atomic(index_path(shard), json.dumps(plain, indent=0).encode())


def read_index(shard: Path) -> ShardIndex:
    """Read the index that stands beside a tar.

    Raises:
        DataError: It is missing, malformed, of another version, or of a tar of another size.
    """
    path = index_path(shard)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: no index ({error}); delete it, it is made again") from error
    index = parse_index(data, str(path))
    if not shard.is_file() or shard.stat().st_size != index.tar_bytes:
        raise DataError(
            f"{path}: made of a tar of {index.tar_bytes} bytes, {shard.name} is missing or another;"
            " delete the index, it is made again"
        )
    return index


def parse_index(data: bytes, where: str) -> ShardIndex:
    """Read an index from the bytes of its file.

    Args:
        data: The whole file.
        where: Its path or address, for the message.

    Raises:
        DataError: It is malformed or of another version.
    """
    try:
        plain = json.loads(data)
        if plain["schema_version"] != SCHEMA_VERSION:
            raise ValueError(f"schema version {plain['schema_version']!r:.40}")
        tar_bytes = plain["tar_bytes"]
        if type(tar_bytes) is not int or not 0 < tar_bytes < _BEYOND:
            raise ValueError(f"tar_bytes is {tar_bytes!r:.40}, expected the size of a tar")
        for number, entry in enumerate(plain["graphs"]):
            problem = _find_problem(entry, tar_bytes)
            if problem:
                raise ValueError(f"graph {number}, key {entry['key']!r:.80}: {problem}")
        graphs = [IndexEntry(**entry) for entry in plain["graphs"]]
        _check_apart(graphs)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError(f"{where}: no index ({error}); delete it, it is made again") from error
    return ShardIndex(tar_bytes=tar_bytes, graphs=graphs)


def _find_problem(entry: dict[str, Any], tar_bytes: int) -> str:
    """Say what no graph of a tar can be; the fields are as JSON gave them."""
    if not isinstance(entry["key"], str) or not _is_key(entry["key"]):
        return "expected a printable name without dots and slashes"
    for name, least in (("offset", 0), ("size", _BLOCK), ("num_views", 1)):
        value = entry[name]
        if type(value) is not int or not least <= value < _BEYOND:
            return f"{name} is {value!r:.40}, expected a whole number of {least} or more"
    offset, size = entry["offset"], entry["size"]
    if offset % _BLOCK or size % _BLOCK:
        return f"offset {offset}, size {size}: expected multiples of {_BLOCK}"
    if offset + size > tar_bytes:
        return f"it ends at {offset + size}, the tar at {tar_bytes}"
    return ""


def _check_apart(graphs: list[IndexEntry]) -> None:
    """Refuse graphs that share bytes or a key.

    Raises:
        ValueError: Two do.
    """
    for one, two in pairwise(sorted(graphs, key=lambda entry: entry.offset)):
        if one.offset + one.size > two.offset:
            raise ValueError(f"key {two.key!r:.80}: its range overlaps that of {one.key!r:.80}")
    if len({entry.key for entry in graphs}) < len(graphs):
        raise ValueError("a key stands there twice")


def _is_key(key: str) -> bool:
    return bool(key) and key.isprintable() and not any(letter in key for letter in "./\\")


def load_index(shard: Path) -> ShardIndex:
    """Read the index beside a tar, or scan the tar where the index is absent or out of date.

    Raises:
        DataError: The tar cannot be read.
    """
    try:
        return read_index(shard)
    except DataError:
        return index_shard(shard)


def index_shard(shard: Path) -> ShardIndex:
    """Scan a tar for its graphs; reads headers only.

    Raises:
        DataError: The tar is missing, cut off, or the members of a graph do not stand together.
    """
    graphs: dict[str, dict[str, Any]] = {}
    last, end = "", 0
    try:
        with tarfile.open(shard, "r:") as tar:
            for member in tar:
                key, _, name = member.name.partition(".")
                if not _is_key(key):
                    raise DataError(
                        f"{shard}: found member {member.name!r:.80}, expected the files of graphs;"
                        " rebuild it with l3r-prep"
                    )
                if key in graphs and key != last:
                    raise DataError(
                        f"{shard}: members of {key} do not stand together; rebuild it with l3r-prep"
                    )
                last = key
                graph = graphs.setdefault(
                    key, {"key": key, "offset": member.offset, "num_views": 0}
                )
                end = member.offset_data + -(-member.size // _BLOCK) * _BLOCK
                graph["size"] = end - graph["offset"]
                graph["num_views"] += bool(_IMAGE.fullmatch(name))
        # A tar cut off within a header reads like one that ends; only its end mark is missing.
        if shard.stat().st_size < end + 2 * _BLOCK:
            raise tarfile.ReadError("the mark at its end is missing")
    except (OSError, tarfile.TarError, ValueError) as error:
        raise DataError(f"{shard}: no whole tar ({error}); rebuild it with l3r-prep") from error
    entries = [IndexEntry(**graph) for graph in graphs.values()]
    return ShardIndex(tar_bytes=shard.stat().st_size, graphs=entries)


def members_from_bytes(data: bytes, where: str, key: str) -> dict[str, Any]:
    """Split the bytes of one graph's range into members.

    Args:
        data: ``size`` bytes of the tar from ``offset``, or any part that ends between records.
        where: What a message begins with: the shard and key.
        key: The graph they are said to be.

    Returns:
        ``__key__`` and the members' bytes, as :func:`decode_graph` takes them.

    Raises:
        DataError: The bytes are cut off, or of another key, or hold what is no file.
    """
    members: dict[str, Any] = {"__key__": key}
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as tar:
            for member in tar:
                stream = tar.extractfile(member) if member.isreg() else None
                found, _, name = member.name.partition(".")
                if found != key:
                    raise DataError(
                        f"{where}: the index says {key}, the tar holds {found!r:.80}; delete the"
                        " shard's index, it is made again"
                    )
                if stream is None:
                    raise DataError(
                        f"{where}: found member {member.name!r:.80}, expected files of one key;"
                        " delete the shard's index, it is made again"
                    )
                members[name] = stream.read()
    except (tarfile.TarError, ValueError) as error:
        raise DataError(
            f"{where}: bytes cut off or no tar ({error}); delete the shard's index, it is made"
            " again, or rebuild the shard with l3r-prep"
        ) from error
    return members


def read_members(shard: Path, entry: IndexEntry) -> dict[str, Any]:
    """Read one graph's members from its tar in one read.

    Raises:
        DataError: The range cannot be read or is not what the index says.
    """
    return members_from_bytes(read_range(shard, entry), f"{shard.name}:{entry.key}", entry.key)


def read_range(shard: Path, entry: IndexEntry) -> bytes:
    """Read the bytes of one graph from its tar.

    Raises:
        DataError: They cannot be read, or the tar ends before them.
    """
    where = f"{shard.name}:{entry.key}"
    try:
        with shard.open("rb") as stream:
            stream.seek(entry.offset)
            data = stream.read(entry.size)
    except OSError as error:
        raise DataError(f"{where}: {error}; check the folder of shards") from error
    if len(data) < entry.size:
        raise DataError(
            f"{where}: {len(data)} of {entry.size} bytes, the tar is cut off;"
            " rebuild it with l3r-prep"
        )
    return data
