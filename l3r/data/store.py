"""Where shards lie: what every place can do, and the plain folder."""

from abc import ABC, abstractmethod
from pathlib import Path

from l3r.data.schema import (
    IndexEntry,
    Manifest,
    ShardEntry,
    ShardIndex,
    load_index,
    read_manifest,
    read_range,
)
from l3r.errors import DataError


class UnreachableError(DataError):
    """A place that does not answer at all: no other graph of it can be read either."""


class ShardStore(ABC):
    """A place with a manifest, tars and their indices.

    It travels to loader processes, so it keeps no open files or connections when pickled.
    """

    name: str
    """Last part of the place's name, with which the keys of its graphs begin."""
    place: str
    """The whole of it, for messages."""

    @abstractmethod
    def read_manifest(self) -> Manifest:
        """Read what the place holds.

        Raises:
            DataError: It holds no finished shards, or cannot be reached.
        """

    @abstractmethod
    def read_index(self, shard: ShardEntry) -> ShardIndex:
        """Read where a shard's graphs lie in its tar.

        Raises:
            DataError: There is no such tar or index, or they do not belong together.
        """

    @abstractmethod
    def read_graph(self, shard: ShardEntry, entry: IndexEntry) -> bytes:
        """Read one graph's range of a tar.

        Raises:
            DataError: The range cannot be read whole.
        """


class FolderStore(ShardStore):
    """A folder of this machine.

    Args:
        folder: Holds ``manifest.json`` and the tars.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.name = folder.name
        self.place = str(folder)

    def read_manifest(self) -> Manifest:
        """Read ``manifest.json``."""
        return read_manifest(self.folder)

    def read_index(self, shard: ShardEntry) -> ShardIndex:
        """Read the index beside the tar; scan the tar where it is absent or out of date."""
        return load_index(self.folder / shard.name)

    def read_graph(self, shard: ShardEntry, entry: IndexEntry) -> bytes:
        """Read the range from the tar."""
        return read_range(self.folder / shard.name, entry)
