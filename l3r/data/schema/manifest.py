"""``manifest.json``: what a folder of shards holds."""

import json
import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from l3r.data.schema.graph import SCHEMA_VERSION
from l3r.errors import DataError
from l3r.files import write_atomic

MANIFEST_NAME = "manifest.json"
"""Name of the manifest in its folder; it is written last, so a folder that has it is complete."""

_TAR_NAME = re.compile(r"(?!\.)[^/\\\x00-\x1f\ud800-\udfff]+\.tar")
_DIGEST = re.compile(r"[0-9a-f]{64}")


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
            _check_fields(plain)
            shards = [ShardEntry(**entry) for entry in plain.pop("shards")]
            return Manifest(shards=shards, **plain)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DataError(
            f"{where}: no manifest ({error!r:.300}); rebuild the shards with l3r-prep"
        ) from error
    raise DataError(
        f"{where}: schema version {version!r:.40}, expected {SCHEMA_VERSION};"
        " rebuild the shards with l3r-prep of this version"
    )


def _check_fields(plain: dict[str, Any]) -> None:
    """Refuse what nobody wrote; the fields are as JSON gave them.

    Raises:
        ValueError: A field is of another type or out of range, or two shards share a name.
    """
    if not isinstance(plain["dataset"], str) or not isinstance(plain.get("request", {}), dict):
        raise ValueError("dataset is no text, or request no table")
    for field_name in ("min_views", "max_views"):
        _check_count(plain[field_name], field_name)
    names = set()
    for shard in plain["shards"]:
        name, digest = shard["name"], shard["sha256"]
        # The name becomes part of a path and of an address.
        if not isinstance(name, str) or not _TAR_NAME.fullmatch(name) or name in names:
            raise ValueError(f"shard {name!r:.80}, expected the plain name of a .tar, named once")
        names.add(name)
        for field_name in ("num_graphs", "bytes"):
            _check_count(shard[field_name], f"{field_name} of {name}")
        if not isinstance(digest, str) or not _DIGEST.fullmatch(digest):
            raise ValueError(f"sha256 of {name} is {digest!r:.80}, expected 64 hexadecimal digits")


def _check_count(value: Any, name: str) -> None:
    if type(value) is not int or not 0 <= value < 2**63:
        raise ValueError(f"{name} is {value!r:.40}, expected a whole number of 0 or more")
