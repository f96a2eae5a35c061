"""Score the cameras of one scene against trusted ones."""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from l3r.errors import DataError
from l3r.export.cameras_json import read_cameras
from l3r.export.colmap_read import read_colmap
from l3r.geometry.rigid import invert_rigid
from l3r.metrics.cameras import CameraMetrics, Missing, camera_metrics
from l3r.metrics.relative import short_baselines
from l3r.types import Cameras

SHORT_SHARE = 1e-3
"""Pairs nearer than this share of the longest true baseline are near-coincident."""


@dataclass(frozen=True, kw_only=True)
class PoseEvaluation:
    """Scores, and what they are scores of."""

    metrics: CameraMetrics
    missing: Missing
    """What became of images that are not registered."""
    num_images: int
    """Images with a true camera."""
    num_found: int
    """Those that the prediction names, registered or not."""
    num_registered: int
    """Those with a predicted camera."""
    num_extra: int
    """Predicted images without a true camera, which are left out."""
    num_short: int
    """Pairs of near-coincident true centres, whose direction is noise."""

    def to_dict(self) -> dict[str, Any]:
        """Builtins only, None for what is undefined: JSON knows no NaN."""
        scores = self.metrics.to_dict()
        defined = {name: None if math.isnan(value) else value for name, value in scores.items()}
        return {**asdict(self), "metrics": defined}


def evaluate_cameras(pred: Cameras, gt: Cameras, missing: Missing = "fail") -> PoseEvaluation:
    """Score predicted cameras.

    Images are matched by :func:`match_files`. Pairs are formed in the order of names, so that no
    score depends on the order of either list.

    Args:
        pred: Predicted cameras.
        gt: True cameras; those that are not registered are left out.
        missing: What becomes of true images without a predicted camera.

    Raises:
        DataError: No image matches, two match the same one, or there is no true camera.
    """
    known = [view for view in range(len(gt.file)) if gt.registered[view]]
    known.sort(key=lambda view: gt.file[view])
    if not known:
        raise DataError("ground truth: no registered image; expected cameras to compare with")
    match = match_files(pred.file, [gt.file[view] for view in known])
    gt_cam_from_world = gt.cam_from_world[known].double()
    pred_cam_from_world = torch.full_like(gt_cam_from_world, torch.nan)
    for row, view in enumerate(match):
        if view is not None and pred.registered[view]:
            pred_cam_from_world[row] = pred.cam_from_world[view]
    registered = pred_cam_from_world.isfinite().flatten(1).all(1)
    num_found = sum(view is not None for view in match)
    return PoseEvaluation(
        metrics=camera_metrics(pred_cam_from_world, gt_cam_from_world, registered, missing=missing),
        missing=missing,
        num_images=len(known),
        num_found=num_found,
        num_registered=int(registered.sum()),
        num_extra=len(pred.file) - num_found,
        num_short=_count_short(gt_cam_from_world),
    )


def match_files(pred: Sequence[str], gt: Sequence[str]) -> list[int | None]:
    """Find each true image among the predicted ones.

    By their whole names; where not one is in common, by the names without folders, which then must
    be unique. The two are not mixed: ``left/1.jpg`` would stand in for a missing ``right/1.jpg``.

    Returns:
        For each name of ``gt`` an index into ``pred``, None where it is absent.

    Raises:
        DataError: Nothing matches, or base names leave the choice open.
    """
    if set(pred) & set(gt):
        by_name = {file: view for view, file in enumerate(pred)}
        return [by_name.get(file) for file in gt]
    found, wanted = _by_base_name(pred), _by_base_name(gt)
    common = found.keys() & wanted.keys()
    if not common:
        raise DataError(
            f"no image in common: predicted {_first(pred)}, ground truth {_first(gt)}; "
            "check that both are of one scene and name their images alike"
        )
    for base in sorted(common):
        if len(found[base]) > 1 or len(wanted[base]) > 1:
            raise DataError(
                f"ambiguous image name {base!r}: predicted {[pred[i] for i in found[base]]}, "
                f"ground truth {[gt[i] for i in wanted[base]]}; give both the same relative names"
            )
    return [found.get(PurePosixPath(file).name, [None])[0] for file in gt]


def load_cameras(path: Path) -> Cameras:
    """Read cameras from a ``cameras.json``, a folder that holds one, or a COLMAP model.

    A COLMAP model may be the folder itself, or its ``sparse/0`` or ``sparse``.

    Raises:
        DataError: There is nothing of the kind, or it is damaged.
    """
    if path.is_file():
        return read_cameras(path)
    if (path / "cameras.json").is_file():
        return read_cameras(path / "cameras.json")
    for folder in (path, path / "sparse" / "0", path / "sparse"):
        if any((folder / f"images{suffix}").is_file() for suffix in (".bin", ".txt")):
            return read_colmap(folder)
    raise DataError(f"{path}: no cameras; expected a cameras.json, its folder, or a COLMAP model")


def _count_short(gt_cam_from_world: Float[Tensor, "n 4 4"]) -> int:
    centers = invert_rigid(gt_cam_from_world)[:, :3, 3]
    baselines = torch.pdist(centers)
    if not len(baselines):
        return 0
    # Where all cameras stand at one place the longest is 0 and every pair is short.
    shortest_good = max(SHORT_SHARE * float(baselines.max()), 1e-12)
    return short_baselines(gt_cam_from_world, shortest_good)


def _by_base_name(files: Sequence[str]) -> dict[str, list[int]]:
    views: dict[str, list[int]] = defaultdict(list)
    for view, file in enumerate(files):
        views[PurePosixPath(file).name].append(view)
    return dict(views)


def _first(files: Sequence[str]) -> str:
    return f"{files[0]!r} and {len(files) - 1} more" if files else "no image at all"
