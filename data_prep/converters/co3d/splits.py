"""Which frames may be trained on: CO3D's set lists and sequence scores.

A category holds ``set_lists/set_lists_<subset>.json``, each with lists ``train``, ``val`` and
``test`` of ``[sequence, frame_number, image_path]``. Subsets are ``fewview_{train,dev,test}``,
whose tests are whole sequences, and ``manyview_{dev,test}[_k]``, one sequence each, whose tests are
frames between the training frames.

The rule:

* ``fewview_train`` counts for its ``train`` list alone: its ``test`` repeats the same frames
  (facebookresearch/co3d issue 49).
* Where a category has few-view lists, training frames are those of their ``train`` lists, and a
  sequence with a single frame in the ``val`` or ``test`` list of any other file is held out whole.
* Where it has many-view lists alone, as the single-sequence download, training frames are those of
  their ``train`` lists, and frames of ``val`` and ``test`` lists are held out one by one.
* A frame without a list is not trained on.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from data_prep.converters.co3d.annotations import FrameRecord, SequenceRecord
from l3r.errors import DataError

Split = Literal["train", "val", "test", "all"]
Members = dict[str, dict[int, str]]
"""Sequence -> frame_number -> image path."""

MIN_VIEWPOINT_QUALITY = 0.5
"""Sequences are trained on whose cameras score more than this: the public recipes' threshold."""

_PREFIX = "set_lists_"
_MAX_BYTES = 2**28
_PARTS = ("train", "val", "test")


@dataclass(kw_only=True)
class SetLists:
    """The lists of a category, joined by the rule of this module."""

    train: Members = field(default_factory=dict)
    """Frames that may be trained on unless they are held out."""
    val: Members = field(default_factory=dict)
    """Frames for validation."""
    test: Members = field(default_factory=dict)
    """Frames for testing."""
    held_out: set[str] = field(default_factory=set)
    """Sequences never trained on."""

    def holds(self, split: Split, record: FrameRecord) -> bool:
        """Tell whether a frame belongs to a split; ``all`` has every frame, listed or not.

        Args:
            split: The split.
            record: The frame.

        Raises:
            DataError: A list names another image under this frame's number.
        """
        if split == "all":
            return True
        key = record.sequence, record.number
        listed = [
            path for members in (self.train, self.val, self.test) if (path := _at(members, key))
        ]
        if any(path != record.image_path for path in listed):
            raise DataError(
                f"set lists call frame {key[1]} '{listed[0][:200]}', its annotation says"
                f" '{record.image_path[:200]}'; both must be of one release"
            )
        in_test, in_val = bool(_at(self.test, key)), bool(_at(self.val, key))
        if split == "test":
            return in_test
        if split == "val":
            return in_val and not in_test
        trainable = record.sequence not in self.held_out and bool(_at(self.train, key))
        return trainable and not in_val and not in_test

    def members(self, split: Split) -> set[str] | None:
        """Name the sequences that may have frames of a split; None: any."""
        if split == "all":
            return None
        return set(getattr(self, split)) - (self.held_out if split == "train" else set())


def _at(members: Members, key: tuple[str, int]) -> str:
    return members.get(key[0], {}).get(key[1], "")


def read_set_lists(folder: Path) -> SetLists:
    """Read all set lists of a category.

    Args:
        folder: ``<category>/set_lists``.

    Raises:
        DataError: There is none, or one is damaged: what is held out would be unknown.
    """
    # A Mac leaves a '._' companion beside every file it packs.
    files = sorted(path for path in folder.glob(f"{_PREFIX}*.json") if path.is_file())
    if not files:
        raise DataError(
            f"{folder}: no {_PREFIX}*.json, so training frames are unknown; unpack the category's"
            " archives again, or take split 'all'"
        )
    subsets = {path.stem.removeprefix(_PREFIX): _read_file(path) for path in files}
    few_view = any(name.startswith("fewview") for name in subsets)
    joined = SetLists()
    for name, parts in subsets.items():
        if name.startswith("fewview") or not few_view:
            _merge(joined.train, parts["train"])
        if name != "fewview_train":
            _merge(joined.val, parts["val"])
            _merge(joined.test, parts["test"])
    if few_view:
        joined.held_out = set(joined.val) | set(joined.test)
    return joined


def _merge(into: Members, members: Members) -> None:
    for sequence, frames in members.items():
        into.setdefault(sequence, {}).update(frames)


def _read_file(path: Path) -> dict[str, Members]:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise DataError(f"{path}: more than {_MAX_BYTES:,} bytes; unpack the archive again")
        lists = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: no whole JSON ({error}); unpack the archive again") from error
    if not isinstance(lists, dict) or not all(isinstance(lists.get(p), list) for p in _PARTS):
        raise DataError(
            f"{path}: expected lists 'train', 'val' and 'test'; unpack the archive again"
        )
    return {part: _members(path, part, lists[part]) for part in _PARTS}


def _members(path: Path, part: str, entries: list[Any]) -> Members:
    members: Members = {}
    for number, entry in enumerate(entries):
        match entry:
            case [str(sequence), int(frame), str(image)] if image and not isinstance(frame, bool):
                members.setdefault(sequence, {})[frame] = image
            case _:
                raise DataError(
                    f"{path}: {part}[{number}] is {repr(entry)[:80]}, expected [sequence,"
                    " frame_number, image path]; unpack the archive again"
                )
    return members


def find_fault(
    record: SequenceRecord | None,
    *,
    min_viewpoint_quality: float,
    min_pointcloud_quality: float | None,
) -> tuple[str, str] | None:
    """Say why a sequence is not good enough to be trained on.

    Args:
        record: Its annotation; None where there is none.
        min_viewpoint_quality: Its cameras must score more.
        min_pointcloud_quality: Its point cloud must score more; None: need not be judged.

    Returns:
        ``(problem, detail)``, or None where it is good. A score that is null passes no threshold.
    """
    views = record.viewpoint_quality if record else None
    cloud = record.pointcloud_quality if record else None
    limits = [("viewpoint", views, min_viewpoint_quality)]
    if min_pointcloud_quality is not None:
        limits.append(("point cloud", cloud, min_pointcloud_quality))
    for name, score, limit in limits:
        if score is None:
            return "quality_unknown", f"{name} quality unknown, expected more than {limit}"
        if not score > limit:
            return "low_quality", f"{name} quality {score:.2f}, expected more than {limit}"
    return None
