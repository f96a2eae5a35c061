"""What is broken in a folder of shards: named, counted, and the first ones listed."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

LISTED_EACH = 10
"""Faults listed of each kind; later ones are only counted."""

KINDS = {
    "missing_tar": "the manifest lists a tar that is not there",
    "wrong_size": "a tar has another size than the manifest says",
    "wrong_checksum": "a tar has another SHA-256 than the manifest says",
    "unreadable_tar": "a file is no whole tar",
    "wrong_graph_count": "a tar holds another number of graphs than the manifest says",
    "wrong_index": "the index beside a tar is missing, or says other than the tar's headers",
    "unreadable_graph": "the bytes of a graph cannot be read out of its tar",
    "missing_member": "a graph lacks one of its files",
    "bad_meta": "a graph's JSON cannot be used",
    "bad_camera": "intrinsics or a camera hold a NaN, an infinity, or are none",
    "bad_image": "a JPEG cannot be decoded, is damaged, or has another size than the JSON says",
    "bad_depth": "a depth map cannot be decoded, holds a NaN or a negative, or has another size",
    "bad_pairs": "a pair table holds a NaN, an infinity, or an overlap outside [0, 1]",
}
"""Every kind of fault, and what it means."""


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One broken thing."""

    kind: str
    """One of :data:`KINDS`."""
    shard: str
    """File name of the tar."""
    key: str
    """Graph in it; empty where the whole tar is meant."""
    detail: str
    """What was found and what was expected."""

    def __str__(self) -> str:
        """One line: kind, shard and key, detail."""
        where = f"{self.shard}:{self.key}" if self.key else self.shard
        return f"{self.kind}: {where}: {self.detail}"


@dataclass(kw_only=True)
class Faults:
    """All faults of a folder."""

    counts: Counter[str] = field(default_factory=Counter)
    """How often each kind was met."""
    listed: list[Fault] = field(default_factory=list)
    """The first few of each kind."""

    def add(self, fault: Fault) -> None:
        """Count a fault, and list it if it is among the first of its kind."""
        assert fault.kind in KINDS
        self.counts[fault.kind] += 1
        if self.counts[fault.kind] <= LISTED_EACH:
            self.listed.append(fault)

    def first(self, kind: str) -> Fault:
        """Give the first fault of a kind that was met."""
        return next(fault for fault in self.listed if fault.kind == kind)

    def to_plain(self) -> dict[str, Any]:
        """Give builtins only."""
        return {
            "counts": dict(sorted(self.counts.items())),
            "listed": [vars(fault) for fault in self.listed],
        }
