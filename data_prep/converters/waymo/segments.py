"""Segments of the data set below a folder, in either version, and the split each belongs to."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from data_prep.problems import Problems

Split = Literal["train", "test", "all"]

COMPONENTS = (
    "camera_image",
    "camera_calibration",
    "vehicle_pose",
    "lidar",
    "lidar_calibration",
    "lidar_camera_projection",
    "lidar_pose",
    "lidar_box",
)
"""Folders of version 2 that are read."""

TESTING = "testing"
_SPLIT = re.compile(r"(training|validation|testing)(_|$)")
_FILE = re.compile(r"(?:segment-)?(.+?)(?:_with_camera_labels)?")


@dataclass(frozen=True, kw_only=True)
class Segment:
    """20 seconds of driving."""

    name: str
    """``SPLIT/CONTEXT``, or ``CONTEXT`` alone below no folder of a split."""
    context: str
    """Name by the data set, as file names carry it."""
    split: str | None
    """``training``, ``validation`` or ``testing``; None below no such folder."""
    path: Path
    """The TFRecord of version 1, or the folder of version 2 that holds the components."""
    is_parquet: bool
    """Whether it is version 2."""

    @property
    def excluded(self) -> str:
        """Why ``build`` leaves it out by default; empty where it does not."""
        if self.split == TESTING:
            return "testing split, never read"
        if self.split == "validation":
            return "held out for testing"
        return "" if self.split else "in no folder of a split"

    def is_in(self, split: Split) -> bool:
        """Tell whether it belongs to a split; ``all`` is everything but testing."""
        if split == "all":
            return self.split != TESTING
        return self.split == {"train": "training", "test": "validation"}[split]


def find_segments(root: Path, problems: Problems) -> list[Segment]:
    """Look for segments of both versions, sorted by name.

    Args:
        root: Any folder above them.
        problems: Told of segments that are there twice; the TFRecord, then the first path counts.
    """
    found: dict[str, Segment] = {}
    # A segment of version 2 is found once for each of its components.
    for segment in dict.fromkeys([*_find_tfrecords(root), *_find_parquet(root)]):
        kept = found.setdefault(segment.name, segment)
        if kept is not segment:
            problems.add("duplicate_segment", segment.path, f"{segment.name} is in {kept.path} too")
    return [found[name] for name in sorted(found)]


def _find_tfrecords(root: Path) -> Iterator[Segment]:
    for path in sorted(root.rglob("*.tfrecord")):
        if not _is_companion(path, root):
            match = _FILE.fullmatch(path.stem)
            context = match[1] if match else path.stem
            yield _segment(path, context, _split_of(path.parent, root), is_parquet=False)


def _find_parquet(root: Path) -> Iterator[Segment]:
    for path in sorted(root.rglob("*.parquet")):
        if path.parent.name in COMPONENTS and not _is_companion(path, root):
            folder = path.parent.parent
            yield _segment(folder, path.stem, _split_of(folder, root), is_parquet=True)


def _is_companion(path: Path, root: Path) -> bool:
    """A Mac leaves a '._' companion beside every file and folder it packs."""
    return any(part.startswith("._") for part in path.relative_to(root).parts)


def _segment(path: Path, context: str, split: str | None, *, is_parquet: bool) -> Segment:
    name = f"{split}/{context}" if split else context
    return Segment(name=name, context=context, split=split, path=path, is_parquet=is_parquet)


def _split_of(path: Path, root: Path) -> str | None:
    """Take the nearest folder, up to the root itself, that is named after a split."""
    parts = (root.resolve().name, *path.relative_to(root).parts)
    for part in reversed(parts):
        match = _SPLIT.match(part)
        if match:
            return match[1]
    return None
