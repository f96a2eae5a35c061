"""All camera metrics of a scene, and their mean over scenes."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from l3r.geometry.rigid import invert_rigid
from l3r.metrics.registration import registration_rate
from l3r.metrics.relative import maa, maa_min, pair_errors, rra, rta
from l3r.metrics.trajectory import ate, ate_rmse

Missing = Literal["fail", "exclude_image", "exclude_scene"]
"""What becomes of images that are not registered.

``fail``: their pairs count as wrong. ``exclude_image``: their pairs are left out.
``exclude_scene``: their pairs count as wrong, and a scene without a single registered image has no
accuracy (NaN), so that a mean leaves it out. The registration rate counts them in every case.
"""


@dataclass(frozen=True, kw_only=True)
class CameraMetrics:
    """Scores of one scene, or their mean; rates in percent, higher is better, but for the ATEs.

    To add a metric: a field here, its value in :func:`camera_metrics`. The tables of ``l3r eval``,
    ``validation.csv`` and every JSON file list all fields.
    """

    rra_5: float
    """Pairs with a relative rotation error below 5 degrees."""
    rra_15: float
    rra_30: float
    rta_5: float
    """Pairs with a relative translation direction within 5 degrees, its sign ignored."""
    rta_15: float
    rta_30: float
    rta_5_signed: float
    """The same with the sign respected."""
    rta_15_signed: float
    rta_30_signed: float
    maa_30: float
    """PoseDiffusion's AUC of the larger error, the primary reading of mAA@30."""
    maa_30_min: float
    """Area under min(RRA, RTA), the paper's wording."""
    maa_30_signed: float
    """``maa_30`` with the sign respected."""
    ate: float
    """Normalised Procrustes error of the centres; NaN where undefined. Lower is better."""
    ate_rmse: float
    """Error of the centres after a similarity, in the ground truth's unit; NaN where undefined."""
    reg: float
    """Images registered."""

    def to_dict(self) -> dict[str, float]:
        """Plain numbers by name."""
        return asdict(self)

    def to_plain(self) -> dict[str, float | None]:
        """Plain numbers by name, for JSON, which has no NaN: what is undefined is None."""
        return {name: None if math.isnan(x) else x for name, x in self.to_dict().items()}


def camera_metrics(
    pred_cam_from_world: Float[Tensor, "n 4 4"],
    gt_cam_from_world: Float[Tensor, "n 4 4"],
    registered: Bool[Tensor, " n"] | None = None,
    *,
    missing: Missing = "fail",
) -> CameraMetrics:
    """Score predicted cameras against true ones.

    Args:
        pred_cam_from_world: Predicted transforms, in any world frame of any scale.
        gt_cam_from_world: True transforms of the same images in the same order, all finite.
        registered: Whether each prediction exists; by default where it is finite.
        missing: What becomes of images that are not registered, see :data:`Missing`.
    """
    finite = pred_cam_from_world.isfinite().flatten(1).all(1)
    found = finite if registered is None else registered & finite
    scored = found if missing == "exclude_image" else torch.ones_like(found)
    pred, gt = pred_cam_from_world[scored].double(), gt_cam_from_world[scored].double()
    rates = _pair_rates(pred, gt, found[scored])
    if missing == "exclude_scene" and not found.any():
        rates = dict.fromkeys(rates, math.nan)
    pred_centers = invert_rigid(pred_cam_from_world[found].double())[:, :3, 3]
    gt_centers = invert_rigid(gt_cam_from_world[found].double())[:, :3, 3]
    return CameraMetrics(
        **rates,
        ate=ate(pred_centers, gt_centers),
        ate_rmse=ate_rmse(pred_centers, gt_centers),
        reg=registration_rate(found),
    )


def mean_metrics(scenes: Sequence[CameraMetrics]) -> CameraMetrics:
    """Average every metric over scenes, each scene weighing the same.

    A scene where a metric is NaN is left out of that metric's mean; NaN where no scene has it.
    """
    means = {}
    for field in fields(CameraMetrics):
        values = [getattr(scene, field.name) for scene in scenes]
        values = [value for value in values if not math.isnan(value)]
        means[field.name] = sum(values) / len(values) if values else math.nan
    return CameraMetrics(**means)


def _pair_rates(
    pred: Float[Tensor, "n 4 4"], gt: Float[Tensor, "n 4 4"], registered: Bool[Tensor, " n"]
) -> dict[str, float]:
    errors = pair_errors(pred, gt, registered)
    rates = {f"rra_{k}": rra(errors, float(k)) for k in (5, 15, 30)}
    for k in (5, 15, 30):
        rates[f"rta_{k}"] = rta(errors, float(k))
        rates[f"rta_{k}_signed"] = rta(errors, float(k), signed=True)
    rates["maa_30"] = maa(errors)
    rates["maa_30_min"] = maa_min(errors)
    rates["maa_30_signed"] = maa(errors, signed=True)
    return rates
