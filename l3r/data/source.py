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

    Raises:
        DataError: The folder holds no finished shards, or no graph of so many images.
    """

    def __init__(self, folder: Path, num_views: int) -> None:
        self.num_views = num_views
        self.dataset = read_manifest(folder).dataset
        self.entries: list[tuple[Path, IndexEntry]] = [
            (folder / shard.name, entry)
            for shard in read_manifest(folder).shards
            for entry in load_index(folder / shard.name).graphs
            if entry.num_views >= num_views
        ]
        if not self.entries:
            raise DataError(
                f"{folder}: no graph of {num_views} images; lower data.num_views or build the "
                "shards with a larger --max-views"
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
