"""Which graphs a scene's shards will hold, decided before any image is encoded."""

import hashlib
import logging
from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float32

from data_prep.covisibility import OverlapTable, build_table, median_parallax, pairs_of
from data_prep.depth_views import DepthViews, ThinView, stack_views, thin_view
from data_prep.frames import read_image
from data_prep.graph_sampling import SamplingOptions, sample_graphs
from data_prep.problems import Problem
from data_prep.scene import Frame, Scene
from l3r.data.schema import PairTable
from l3r.errors import DataError

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class GraphPlan:
    """One graph to be stored."""

    key: str
    """Its name in the shard."""
    views: list[int]
    """Frames of the planned scene, in greedy order."""
    pairs: PairTable
    """How they relate."""


@dataclass(frozen=True, kw_only=True)
class ScenePlan:
    """What will be stored of one scene."""

    scene: Scene
    """Its frames that can be read."""
    graphs: list[GraphPlan]
    """In the order drawn."""
    dropped: dict[str, Problem]
    """What is wrong with the frames left out, by name."""


def plan_graphs(
    scene: Scene,
    num_graphs: int,
    seed: int,
    options: SamplingOptions,
    dropped: Mapping[str, Problem] | None = None,
) -> ScenePlan:
    """Relate all frames of a scene and draw its graphs.

    Image and depth of every frame are read once before anything is drawn, and frames that cannot
    be read, or of whose depth nothing is known, are left out: the graphs are then complete.

    Args:
        scene: Frames with depth.
        num_graphs: How many graphs are wanted.
        seed: Seed of the whole build; every scene derives its own from it and its name.
        options: Thresholds of the sampler.
        dropped: Frames left out when the scene was planned before: exactly those are left out
            again, and the images are not read.

    Returns:
        The plan; with fewer graphs, and a warning, where the scene has no more.

    Raises:
        DataError: The scene's own overlap is damaged, or depth that could be read when the scene
            was planned before cannot be read now.
    """
    found = dict(dropped or {})
    if len(scene.frames) < options.min_views:
        _warn_few(scene, options)
        return ScenePlan(scene=scene, graphs=[], dropped=found)
    thin: list[ThinView] = []
    kept: list[int] = []
    for number, frame in enumerate(scene.frames):
        if dropped is not None and frame.name in dropped:
            continue
        view = _read_view(scene, frame, again=dropped is not None)
        if isinstance(view, Problem):
            found[frame.name] = view
        else:
            kept.append(number)
            thin.append(view)
    scene = scene.take(kept)
    if len(kept) < options.min_views:
        _warn_few(scene, options)
        return ScenePlan(scene=scene, graphs=[], dropped=found)
    graphs = _draw(scene, stack_views(scene, thin), num_graphs, seed, options)
    return ScenePlan(scene=scene, graphs=graphs, dropped=found)


def _read_view(scene: Scene, frame: Frame, *, again: bool) -> ThinView | Problem:
    where = f"{scene.name}: {frame.name}"
    try:
        if not again:
            read_image(frame)
        view = thin_view(frame, sparse=scene.has_sparse_depth)
    except DataError as error:
        if again:
            raise DataError(
                f"{where}: has changed since the build began ({error}); restore the source, or"
                " name another --out"
            ) from error
        return Problem(kind="unreadable_frame", where=where, detail=str(error))
    if not view.valid.any():
        return Problem(kind="empty_depth", where=where, detail="no depth is known")
    return view


def _warn_few(scene: Scene, options: SamplingOptions) -> None:
    found = len(scene.frames)
    _LOG.warning("%s: %d frames, a graph has %d or more", scene.name, found, options.min_views)


def _draw(
    scene: Scene, views: DepthViews, num_graphs: int, seed: int, options: SamplingOptions
) -> list[GraphPlan]:
    table = build_table(scene, views)
    graphs = sample_graphs(
        table.iou.numpy(),
        table.score.numpy(),
        table.angle.numpy(),
        num_graphs,
        seed=scene_seed(scene.name, seed),
        options=options,
    )
    if len(graphs) < num_graphs:
        _LOG.warning(
            "%s: %d graphs of %d views or more, %d asked; the scene has no more start pairs",
            scene.name,
            len(graphs),
            options.min_views,
            num_graphs,
        )
    parallax = _parallax_of(views, graphs)
    return [
        GraphPlan(
            key=f"{scene.dataset}-{scene.slug}-{number:06d}",
            views=graph,
            pairs=_take_pairs(table, parallax, graph),
        )
        for number, graph in enumerate(graphs)
    ]


def scene_seed(name: str, seed: int) -> int:
    """Derive a scene's own seed, which does not depend on the scenes beside it."""
    return int.from_bytes(hashlib.sha256(f"{seed}:{name}".encode()).digest()[:4], "big")


def hold_out(scene: Scene, share: float) -> tuple[Scene, Scene]:
    """Split a scene by time: the last frames are held out, so that no graph sees both parts.

    Args:
        scene: The whole scene.
        share: Share of the frames to hold out.

    Returns:
        ``(kept, held_out)``.
    """
    cut = len(scene.frames) - round(share * len(scene.frames))
    return scene.take(range(cut)), scene.take(range(cut, len(scene.frames)))


def _parallax_of(views: DepthViews, graphs: list[list[int]]) -> Float32[np.ndarray, "n n"]:
    """Median parallax of all pairs that share a graph; NaN elsewhere."""
    parallax = np.full((views.num_views, views.num_views), np.nan, dtype=np.float32)
    np.fill_diagonal(parallax, 0)
    pairs = sorted({pair for graph in graphs for pair in pairs_of(graph)})
    if pairs:
        index = torch.tensor(pairs, device=views.center.device)
        first, second = np.array(pairs).T
        parallax[first, second] = median_parallax(views, index).cpu().numpy()
        parallax[second, first] = parallax[first, second]
    return parallax


def _take_pairs(
    table: OverlapTable, parallax: Float32[np.ndarray, "n n"], graph: list[int]
) -> PairTable:
    """Cut a graph's rows and columns out of the scene's tables."""
    rows = np.ix_(graph, graph)
    tables = {
        f.name: parallax if f.name == "parallax" else getattr(table, f.name).numpy()
        for f in fields(PairTable)
    }
    return PairTable(**{name: whole[rows].astype(np.float64) for name, whole in tables.items()})
