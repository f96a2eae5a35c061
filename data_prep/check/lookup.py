"""A graph by its name."""

from collections.abc import Iterator
from difflib import get_close_matches
from pathlib import Path

from data_prep.check.tars import StoredGraph, find_folders
from l3r.data.schema import load_index, read_manifest
from l3r.errors import DataError

_NUM_NEAREST = 3


def find_graph(path: Path, name: str) -> StoredGraph:
    """Find a graph in a folder of shards, or in its ``train`` and ``val``.

    Args:
        path: The folder.
        name: Key of the graph, or shard and key as messages of training name them:
            ``folder/shard.tar:key`` or ``shard.tar:key``.

    Raises:
        DataError: No such graph, or one in several tars; the message names the nearest.
    """
    shard, _, key = name.rpartition(":") if ".tar:" in name else ("", "", name)
    wanted = Path(shard).parts[-2:]
    keys: list[str] = []
    found: list[StoredGraph] = []
    unread: list[str] = []
    for tar in _tars(find_folders(path)):
        if tar.parts[-len(wanted) :] != wanted and wanted:
            continue
        try:
            entries = load_index(tar).graphs
        except DataError:
            unread.append(tar.name)
            continue
        keys += [entry.key for entry in entries]
        found += [StoredGraph(shard=tar, entry=entry) for entry in entries if entry.key == key]
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(stored.name for stored in found)
        raise DataError(f"{path}: {len(found)} graphs of key '{key}': {names}; name one of them")
    raise DataError(f"{path}: no graph '{name}'; {_suggest(key, keys, unread)}")


def _tars(folders: list[Path]) -> Iterator[Path]:
    for folder in folders:
        for shard in read_manifest(folder).shards:
            # Resolved, so that `l3r-prep show . KEY` knows the folder's name too.
            yield folder.resolve() / shard.name


def _suggest(key: str, keys: list[str], unread: list[str]) -> str:
    lost = f"; {len(unread)} tars cannot be read, first {unread[0]}" if unread else ""
    if not keys:
        return f"no such tar has graphs{lost}; leave the tar's name out"
    nearest = ", ".join(get_close_matches(key, keys, n=_NUM_NEAREST, cutoff=0.0))
    return f"nearest of {len(keys)} keys: {nearest}{lost}"
