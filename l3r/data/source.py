"""A folder of shards, here or on a web server, as a list of graphs."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from l3r.config import DataConfig, SourceConfig
from l3r.data.cache import CachedStore, GraphCache
from l3r.data.http_store import MAX_CONNECTIONS, HttpStore
from l3r.data.schema import IndexEntry, decode_graph, members_from_bytes
from l3r.data.stages import KeyedGraph
from l3r.data.store import FolderStore, ShardStore
from l3r.errors import DataError


class ShardFolder:
    """Random access to the graphs of a folder of shards, one read each.

    Args:
        place: A folder with ``manifest.json`` and the tars, or a store of such.
        num_views: Graphs with fewer images are left out.
        span: (first, last) share of all stored graphs that is taken, in stored order: what is held
            out for one number of images is held out for all.

    Raises:
        DataError: The place holds no finished shards, or no graph of so many images.
    """

    def __init__(
        self, place: Path | ShardStore, num_views: int, span: tuple[float, float] = (0.0, 1.0)
    ) -> None:
        self.store = FolderStore(place) if isinstance(place, Path) else place
        self.num_views = num_views
        manifest = self.store.read_manifest()
        self.dataset = manifest.dataset
        self.shards = manifest.shards
        with ThreadPoolExecutor(MAX_CONNECTIONS) as pool:
            indices = list(pool.map(self.store.read_index, self.shards))
        stored = [(number, entry) for number, index in enumerate(indices) for entry in index.graphs]
        first, last = (round(share * len(stored)) for share in span)
        taken = [(n, entry) for n, entry in stored[first:last] if entry.num_views >= num_views]
        if not taken:
            raise DataError(
                f"{self.store.place}: no graph of {num_views} images in the span {list(span)};"
                " lower data.num_views or build the shards with a larger --max-views"
            )
        # Arrays: every loader process gets a copy, and there may be millions of graphs.
        self._ranges = np.array([(number, e.offset, e.size, e.num_views) for number, e in taken])
        self._keys = np.array([entry.key.encode() for _, entry in taken])

    def __len__(self) -> int:
        return len(self._keys)

    def key(self, index: int) -> str:
        """Name a graph for messages: shard and key."""
        shard = self.shards[self._ranges[index, 0]]
        return f"{self.store.name}/{shard.name}:{self._keys[index].decode()}"

    def read(self, index: int) -> KeyedGraph:
        """Read the first ``num_views`` images of a graph, in greedy order.

        Raises:
            DataError: The graph cannot be read.
        """
        number, offset, size, num_views = map(int, self._ranges[index])
        key = self._keys[index].decode()
        entry = IndexEntry(key=key, offset=offset, size=size, num_views=num_views)
        data = self.store.read_graph(self.shards[number], entry)
        members = members_from_bytes(data, self.key(index), key)
        return KeyedGraph(key=self.key(index), graph=decode_graph(members, self.num_views))


def open_folders(sources: dict[str, SourceConfig], config: DataConfig) -> list[ShardFolder]:
    """Open the shards of every source.

    Args:
        sources: Places by name.
        config: ``num_views``, and the cache of what lies on web servers.

    Raises:
        DataError: A place holds no finished shards, or cannot be read by ranges.
    """
    cache = None
    if config.cache_dir and config.cache_gb:
        cache = GraphCache(Path(config.cache_dir), round(config.cache_gb * 1e9))
    return [
        ShardFolder(
            open_store(source.shards, cache), config.num_views, (source.span[0], source.span[1])
        )
        for source in sources.values()
    ]


def open_store(place: str, cache: GraphCache | None = None) -> ShardStore:
    """Find out what kind of place a text names.

    Args:
        place: A folder, or its http(s) address.
        cache: Keeps graphs of http(s) addresses.

    Raises:
        DataError: It is neither.
    """
    if place.startswith("pipe:"):
        raise DataError(
            f"{place}: a pipe has no ranges to read single graphs from; let its command write the"
            " folder of shards to a disk first, and give that folder"
        )
    scheme, is_address, _ = place.partition("://")
    if not is_address:
        return FolderStore(Path(place))
    if scheme.lower() not in ("http", "https"):
        raise DataError(
            f"{place}: found '{scheme}:', expected a folder or an http(s) address; object stores"
            " have one, such as https://BUCKET.s3.REGION.amazonaws.com/FOLDER"
        )
    store = HttpStore(place)
    return store if cache is None else CachedStore(store, cache)
