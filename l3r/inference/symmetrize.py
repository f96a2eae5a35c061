"""Two decodings of an edge, one from either side, become one."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from l3r.geometry.similarity import fit_similarity
from l3r.types import PairPointmaps


def symmetrize(
    forward: PairPointmaps, reverse: PairPointmaps, fit: Literal["child", "both"]
) -> PairPointmaps:
    """Merge edges (i, j) with the same edges decoded as (j, i).

    A rigid fit carries the reverse maps into the frame of i; points are then averaged by their
    log confidences, and confidences by their geometric mean.

    Args:
        forward: Edges (i, j): parent i, child j.
        reverse: Edges (j, i): its parent maps are of image j, in the frame of j.
        fit: Fit on the map of image j, or on the maps of both.

    Returns:
        Edges (i, j), in the frame of i.
    """
    target, source = forward.child_pts3d, reverse.parent_pts3d
    weights = (forward.child_log_conf + reverse.parent_log_conf) / 2
    if fit == "both":
        target = torch.cat([target, forward.parent_pts3d], dim=-2)
        source = torch.cat([source, reverse.child_pts3d], dim=-2)
        of_parent = (forward.parent_log_conf + reverse.child_log_conf) / 2
        weights = torch.cat([weights, of_parent], dim=-1)
    parent_from_child = fit_similarity(target, source, weights)
    parent_pts3d, parent_log_conf = _merge(
        forward.parent_pts3d,
        forward.parent_log_conf,
        parent_from_child.transform(reverse.child_pts3d),
        reverse.child_log_conf,
    )
    child_pts3d, child_log_conf = _merge(
        forward.child_pts3d,
        forward.child_log_conf,
        parent_from_child.transform(reverse.parent_pts3d),
        reverse.parent_log_conf,
    )
    return PairPointmaps(
        parent_pts3d=parent_pts3d,
        child_pts3d=child_pts3d,
        parent_log_conf=parent_log_conf,
        child_log_conf=child_log_conf,
    )


def _merge(
    pts3d: Float[Tensor, "b e p 3"],
    log_conf: Float[Tensor, "b e p"],
    other_pts3d: Float[Tensor, "b e p 3"],
    other_log_conf: Float[Tensor, "b e p"],
) -> tuple[Float[Tensor, "b e p 3"], Float[Tensor, "b e p"]]:
    total = log_conf + other_log_conf
    positive = total > 0
    share = torch.where(positive, log_conf, 0.5) / torch.where(positive, total, 1.0)
    merged = share[..., None] * pts3d + (1 - share[..., None]) * other_pts3d
    return merged, total / 2
