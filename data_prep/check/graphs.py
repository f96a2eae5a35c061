"""One stored graph, decoded fully; where that fails, what is wrong with it."""

import json
import os
import sys
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeVar

import cv2
import numpy as np

from data_prep.check.faults import Fault
from data_prep.check.tars import StoredGraph
from l3r.data.schema import GraphSample, PairTable, decode_graph, read_members
from l3r.data.schema.graph import check_cameras
from l3r.errors import DataError

_DAMAGE = b"Corrupt JPEG data"
"""How libjpeg's warnings begin; it fills what it cannot read and goes on."""
_BY_SUFFIX = {"json": "bad_meta", "jpg": "bad_image", "npy": "bad_depth"}
_NO_META = (KeyError, TypeError, ValueError, OverflowError, RecursionError)
"""What reading numbers out of any bytes raises."""

_T = TypeVar("_T")


class GraphError(DataError):
    """A graph that cannot be used."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(str(fault))
        self.fault = fault


def read_graph(stored: StoredGraph) -> GraphSample:
    """Read and decode a whole graph, every image and every number.

    Raises:
        GraphError: Something in it cannot be used; the first thing found is named.
    """
    try:
        members = read_members(stored.shard, stored.entry)
    except DataError as error:
        raise _error(stored, "unreadable_graph", str(error)) from error
    try:
        sample, damaged = _listen(lambda: decode_graph(members, _count_images(members)))
    except DataError as error:
        kind, detail = _explain(stored, members, str(error))
        raise _error(stored, kind, detail) from error
    if damaged:
        raise _error(stored, "bad_image", _find_damaged(members))
    problem = _find_pair_problem(sample.pairs)
    if problem:
        raise _error(stored, "bad_pairs", f"{problem}; rebuild it with l3r-prep")
    return sample


def _error(stored: StoredGraph, kind: str, detail: str) -> GraphError:
    shard, key = stored.shard.name, stored.entry.key
    # The detail begins with the key or with shard and key, which the fault names already.
    for prefix in (f"{shard}:{key}: ", f"{key}."):
        detail = detail.removeprefix(prefix)
    return GraphError(Fault(kind=kind, shard=shard, key=key, detail=detail))


def _count_images(members: Mapping[str, Any]) -> int:
    """Count the images a graph should hold: by its JSON, since files may be missing."""
    try:
        return max(1, len(json.loads(members["json"])["file"]))
    except _NO_META:
        return 1  # decoding says what is wrong


def _explain(stored: StoredGraph, members: Mapping[str, Any], message: str) -> tuple[str, str]:
    """Name the kind of fault: the message begins with the member it is about."""
    member = message.removeprefix(f"{stored.entry.key}.").partition(":")[0]
    if member not in members:
        return "missing_member", message
    if member == "json":
        return _find_camera_problem(members["json"]) or ("bad_meta", message)
    return _BY_SUFFIX[member.rpartition(".")[2]], message


def _find_camera_problem(data: bytes) -> tuple[str, str] | None:
    """Tell a camera that nobody can use from other trouble with the JSON."""
    try:
        meta = json.loads(data)
        K = np.array(meta["K"], dtype=np.float64).reshape(-1, 3, 3)
        cam_from_world = np.array(meta["cam_from_world"], dtype=np.float64).reshape(-1, 4, 4)
        check_cameras(K, cam_from_world, "json")
    except DataError as error:
        return "bad_camera", str(error)
    except _NO_META:
        return None
    return None


def _find_pair_problem(pairs: PairTable) -> str:
    """Say what no pair table can hold; parallax is NaN where two images share no point."""
    for name, table in vars(pairs).items():
        known = table[~np.isnan(table)] if name == "parallax" else table
        if not np.isfinite(known).all():
            return f"{name} holds a NaN or an infinity, expected finite numbers"
        if name in ("iou", "covisible") and not ((known >= 0) & (known <= 1)).all():
            return f"{name} from {known.min():.3g} to {known.max():.3g}, expected 0 to 1"
    if not np.array_equal(pairs.iou, pairs.iou.T):
        return "iou is not symmetric"
    return ""


def _find_damaged(members: Mapping[str, Any]) -> str:
    """Name the images whose compressed data libjpeg complains about."""
    names = [
        name
        for name, data in members.items()
        if name.endswith(".jpg") and _listen(partial(_decode, data))[1]
    ]
    return (
        f"{', '.join(names)}: damaged JPEG data, decoded in part; rebuild it with l3r-prep, or"
        " compare the tars' checksums with --digests"
    )


def _decode(data: bytes) -> None:
    cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)


def _listen(work: Callable[[], _T]) -> tuple[_T, bool]:
    """Run ``work``; give its value and whether libjpeg warned of damaged data meanwhile.

    libjpeg has no other way to say so than to print on file descriptor 2. Whatever else is
    printed there meanwhile, a progress bar perhaps, is passed on.
    """
    sys.stderr.flush()
    with tempfile.TemporaryFile() as heard:
        real = os.dup(2)
        os.dup2(heard.fileno(), 2)
        try:
            value = work()
        finally:
            os.dup2(real, 2)
            heard.seek(0)
            lines = heard.read().splitlines(keepends=True)
            os.write(real, b"".join(line for line in lines if _DAMAGE not in line))
            os.close(real)
    return value, any(_DAMAGE in line for line in lines)
