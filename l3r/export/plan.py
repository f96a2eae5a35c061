"""A plan of the scene: cameras, tree edges and points seen from above, in drawing units."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from l3r.export.points import PointSelection, sample_points
from l3r.geometry.rigid import invert_rigid, transform_points
from l3r.types import Reconstruction

WIDTH = 1000.0
"""Width of the drawing; its height follows the scene."""
_MARGIN = 40.0
_NUM_POINTS = 4000
_MIN_ASPECT, _MAX_ASPECT = 0.35, 0.75
"""Height of the drawing over its width."""
_STEPS = 5
"""Colours between the strongest and the weakest edge."""


@dataclass(frozen=True, kw_only=True)
class PlanCamera:
    """A camera as a small frustum."""

    view: int
    path: str
    """SVG path: the image plane and its four edges to the centre."""
    x: float
    y: float
    is_root: bool


@dataclass(frozen=True, kw_only=True)
class PlanEdge:
    """An edge of the tree between two drawn cameras."""

    edge: int
    start: tuple[float, float]
    end: tuple[float, float]
    step: int
    """0 strongest, 4 weakest."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The drawing."""

    width: float
    height: float
    cameras: list[PlanCamera]
    edges: list[PlanEdge]
    points: str
    """SVG path of dots."""
    hidden_edges: int
    """Edges that end at an image without camera."""


def draw_plan(scene: Reconstruction) -> Plan | None:
    """Project the scene along the cameras' mean up direction; None without any camera."""
    views = scene.cameras.registered.nonzero()[:, 0]
    if not len(views):
        return None
    cam_from_world = scene.cameras.cam_from_world[views].double().cpu()
    frusta = _frusta_world(cam_from_world, scene.cameras.K[views].double().cpu(), scene, views)
    axes = top_axes(cam_from_world)
    points = sample_points(_coarse(scene), PointSelection(max_points=_NUM_POINTS)).pts3d_world
    frusta_2d = (frusta @ axes.T).numpy()
    points_2d = _near(points.double().cpu() @ axes.T, frusta_2d[:, 0])
    to_page = _Page(np.concatenate([frusta_2d.reshape(-1, 2), points_2d]))
    frusta_2d = to_page(frusta_2d)
    root = int(scene.tree.root[0])
    cameras = [
        PlanCamera(
            view=view,
            path=_frustum_path(corners),
            x=round(float(corners[0, 0]), 1),
            y=round(float(corners[0, 1]), 1),
            is_root=view == root,
        )
        for view, corners in zip(views.tolist(), frusta_2d, strict=True)
    ]
    edges = _edges(scene, {camera.view: (camera.x, camera.y) for camera in cameras})
    return Plan(
        width=WIDTH,
        height=to_page.height,
        cameras=cameras,
        edges=edges,
        points="".join(f"M{x:.1f} {y:.1f}h0" for x, y in to_page(points_2d)),
        hidden_edges=scene.tree.num_edges - len(edges),
    )


def top_axes(cam_from_world: Float[Tensor, "n 4 4"]) -> Float[Tensor, "2 3"]:
    """Find right and up of the page, as unit vectors of the world, for a look from above.

    Above is where the cameras' tops point on average; cameras that do not agree on it give the
    direction in which their centres vary least. Right is where the centres vary most.
    """
    centers = invert_rigid(cam_from_world)[:, :3, 3]
    centered = centers - centers.mean(0)
    tops = -cam_from_world[:, 1, :3]
    above = tops.mean(0)
    if above.norm() < 0.3:  # a mean of unit vectors: 1 where all agree
        above = torch.linalg.svd(centered.T @ centered).U[:, 2]
    above = torch.nn.functional.normalize(above, dim=0)
    level = torch.eye(3, dtype=above.dtype) - torch.outer(above, above)
    flat = centered @ level
    right = torch.linalg.svd(flat.T @ flat).U[:, 0]
    if flat.norm() <= 1e-9 * max(1.0, float(centers.norm())):
        right = cam_from_world[0, 0, :3]
    # Once more into the plane: the first axis is arbitrary where the centres hardly vary.
    right = torch.nn.functional.normalize(level @ right, dim=0)
    return torch.stack([right, torch.linalg.cross(above, right)])


def edge_steps(similarity: Float[Tensor, " e"]) -> list[int]:
    """Sort edges into five classes from the strongest (0) to the weakest (4) similarity."""
    if not len(similarity):
        return []
    low, high = float(similarity.min()), float(similarity.max())
    if high - low < 1e-6:
        return [0] * len(similarity)
    return [round((high - float(s)) / (high - low) * (_STEPS - 1)) for s in similarity]


def tree_similarity(scene: Reconstruction) -> Float[Tensor, " e"]:
    """Similarity of the images that each edge joins."""
    return scene.scores.double().cpu()[scene.tree.parent[0], scene.tree.child[0]]


class _Page:
    """Maps scene coordinates (y up) to the page (y down), margins included."""

    def __init__(self, content: np.ndarray) -> None:
        low, high = content.min(0), content.max(0)
        extent = np.maximum(high - low, 1e-9 * max(1.0, float(np.abs(content).max())))
        inner = WIDTH - 2 * _MARGIN
        aspect = np.clip(extent[1] / extent[0], _MIN_ASPECT, _MAX_ASPECT)
        self._scale = inner * min(1 / extent[0], aspect / extent[1])
        self.height = round(inner * aspect + 2 * _MARGIN, 1)
        self._center = (low + high) / 2
        self._middle = np.array([WIDTH / 2, self.height / 2])

    def __call__(self, xy: np.ndarray) -> np.ndarray:
        scale = np.array([self._scale, -self._scale])
        return np.asarray((xy - self._center) * scale + self._middle)


def _coarse(scene: Reconstruction) -> Reconstruction:
    """Every few pixels of each map: a drawing needs few of millions of points."""
    pixels = sum(conf.numel() for conf in scene.conf)
    step = max(1, int((pixels / (16 * _NUM_POINTS)) ** 0.5))
    return replace(
        scene,
        image=[image[:, ::step, ::step] for image in scene.image],
        pts3d_world=[points[::step, ::step] for points in scene.pts3d_world],
        conf=[conf[::step, ::step] for conf in scene.conf],
    )


def _frusta_world(
    cam_from_world: Float[Tensor, "n 4 4"],
    K: Float[Tensor, "n 3 3"],
    scene: Reconstruction,
    views: Tensor,
) -> Float[Tensor, "n 5 3"]:
    """Centre and image corners of each camera, drawn at a size that suits their spacing."""
    sizes = torch.tensor([scene.cameras.image_size[view] for view in views.tolist()])
    height, width = sizes.double().unbind(1)
    zero = torch.zeros_like(width)
    corners = [(zero, zero), (width, zero), (width, height), (zero, height)]
    pixels = torch.stack([torch.stack([x, y, zero + 1], -1) for x, y in corners], 1)
    rays = pixels @ torch.linalg.inv(K).mT
    world_from_cam = invert_rigid(cam_from_world)
    length = _frustum_length(world_from_cam[:, :3, 3])
    in_camera = torch.cat([torch.zeros_like(rays[:, :1]), rays * length], 1)
    return transform_points(world_from_cam, in_camera)


def _frustum_length(centers: Float[Tensor, "n 3"]) -> float:
    """Half the usual distance of neighbours, neither tiny nor huge beside the whole."""
    extent = float((centers - centers.mean(0)).norm(dim=1).max()) * 2
    if extent < 1e-9 * max(1.0, float(centers.abs().max())):
        return 1.0
    # Some hundreds of centres tell the spacing as well as all of them.
    some = centers[:: max(1, len(centers) // 500)]
    distances = torch.cdist(some, some).fill_diagonal_(torch.inf)
    usual = float(distances.min(1).values.median())
    return min(max(0.5 * usual, extent / 40), extent / 8)


def _near(points: Float[Tensor, "p 2"], centers: np.ndarray) -> np.ndarray:
    """Points that do not shrink the cameras to a dot: within a few times their extent."""
    xy = points.numpy()
    middle = centers.mean(0)
    reach = 4 * float(np.linalg.norm(centers - middle, axis=1).max())
    if reach == 0 and len(xy):
        reach = 2 * float(np.median(np.linalg.norm(xy - middle, axis=1)))
    near = np.linalg.norm(xy - middle, axis=1) <= reach
    return np.asarray(xy[near])


def _frustum_path(corners: np.ndarray) -> str:
    (apex, *plane) = [f"{x:.1f} {y:.1f}" for x, y in corners]
    spokes = "".join(f"M{apex}L{corner}" for corner in plane)
    return f"M{'L'.join(plane)}Z{spokes}"


def _edges(scene: Reconstruction, position: dict[int, tuple[float, float]]) -> list[PlanEdge]:
    pairs = zip(scene.tree.parent[0].tolist(), scene.tree.child[0].tolist(), strict=True)
    steps = edge_steps(tree_similarity(scene))
    return [
        PlanEdge(edge=edge, start=position[parent], end=position[child], step=steps[edge])
        for edge, (parent, child) in enumerate(pairs)
        if parent in position and child in position
    ]
