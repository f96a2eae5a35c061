"""A folder of shards as a list of graphs."""

from pathlib import Path

from l3r.data.schema import GraphSample, IndexEntry, decode_graph, load_index, read_manifest
from l3r.data.schema import read_members as read_shard_members
from l3r.data.stages import KeyedGraph
from l3r.errors import DataError


class ShardFolder:
    """Random access to the graphs of a folder of shards, one read each.

    Args:
        folder: Holds ``manifest.json`` and the tars.
        num_views: Graphs with fewer images are left out.
        span: (first, last) share of the others that is taken, in stored order.

    Raises:
        DataError: The folder holds no finished shards, or no graph of so many images.
    """

    def __init__(
        self, folder: Path, num_views: int, span: tuple[float, float] = (0.0, 1.0)
    ) -> None:
        self.num_views = num_views
        manifest = read_manifest(folder)
        self.dataset = manifest.dataset
        stored: list[tuple[Path, IndexEntry]] = [
            (folder / shard.name, entry)
            for shard in manifest.shards
            for entry in load_index(folder / shard.name).graphs
            if entry.num_views >= num_views
        ]
        first, last = (round(share * len(stored)) for share in span)
        self.entries = stored[first:last]
        if not self.entries:
            raise DataError(
                f"{folder}: no graph of {num_views} images in the span {list(span)}; lower "
                "data.num_views or build the shards with a larger --max-views"
            )

    def __len__(self) -> int:
        return len(self.entries)

    def key(self, index: int) -> str:
        """Name a graph for messages: shard and key."""
        shard, entry = self.entries[index]
        return f"{shard.parent.name}/{shard.name}:{entry.key}"

    def read(self, index: int) -> KeyedGraph:
        """Read the first ``num_views`` images of a graph, in greedy order.

        Raises:
            DataError: The graph cannot be read.
        """
        shard, entry = self.entries[index]
        graph: GraphSample = decode_graph(read_shard_members(shard, entry), self.num_views)
        return KeyedGraph(key=self.key(index), graph=graph)
