"""``manifest.json``: what a folder of shards holds."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from l3r.data.schema.graph import SCHEMA_VERSION
from l3r.errors import DataError
from l3r.files import write_atomic

MANIFEST_NAME = "manifest.json"
"""Name of the manifest in its folder; it is written last, so a folder that has it is complete."""


@dataclass(frozen=True, kw_only=True)
class ShardEntry:
    """One tar of the folder."""

    name: str
    """File name."""
    num_graphs: int
    """Graphs in it."""
    bytes: int
    """Size of the file."""
    sha256: str
    """Digest of the file, hexadecimal."""


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """All shards of one data set."""

    dataset: str
    """Name of the data set."""
    min_views: int
    """Fewest images a graph may hold."""
    max_views: int
    """Most images a graph may hold."""
    shards: list[ShardEntry]
    """The tars, in order."""
    request: dict[str, Any] = field(default_factory=dict)
    """Options the shards were built with, builtins only."""

    @property
    def num_graphs(self) -> int:
        """Graphs in all shards."""
        return sum(shard.num_graphs for shard in self.shards)

    @property
    def num_bytes(self) -> int:
        """Size of all shards."""
        return sum(shard.bytes for shard in self.shards)


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write ``folder/manifest.json``, whole or not at all."""
    plain = {
        "schema_version": SCHEMA_VERSION,
        **asdict(manifest),
        "num_graphs": manifest.num_graphs,
        "num_bytes": manifest.num_bytes,
    }
    write_atomic(folder / MANIFEST_NAME, (json.dumps(plain, indent=2) + "\n").encode())


def read_manifest(folder: Path) -> Manifest:
    """Read ``folder/manifest.json``.

    Raises:
        DataError: It is missing, malformed or of another schema version.
    """
    path = folder / MANIFEST_NAME
    if not path.is_file():
        raise DataError(
            f"{path}: no such file; expected a folder of finished shards, build it with"
            " 'l3r-prep build', or run that again if it was interrupted"
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: {error}; check the folder of shards") from error
    return parse_manifest(data, str(path))


def parse_manifest(data: bytes, where: str) -> Manifest:
    """Read a manifest from the bytes of its file.

    Args:
        data: The whole file.
        where: Its path or address, for the message.

    Raises:
        DataError: It is malformed or of another schema version.
    """
    try:
        plain = json.loads(data)
        version = plain.pop("schema_version")
        if version == SCHEMA_VERSION:
            del plain["num_graphs"], plain["num_bytes"]
            shards = [ShardEntry(**entry) for entry in plain.pop("shards")]
            return Manifest(shards=shards, **plain)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"{where}: no manifest ({error!r}); rebuild the shards with l3r-prep"
        ) from error
    raise DataError(
        f"{where}: schema version {version}, expected {SCHEMA_VERSION};"
        " rebuild the shards with l3r-prep of this version"
    )
