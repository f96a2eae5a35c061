"""Which graphs a scene's shards will hold, decided before any image is encoded."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass

from data_prep.depth_views import ThinView, stack_views, thin_view
from data_prep.draw import GraphPlan, draw_graphs
from data_prep.frames import read_image
from data_prep.graph_sampling import SamplingOptions
from data_prep.problems import Problem
from data_prep.scene import Frame, Scene
from l3r.errors import DataError

_LOG = logging.getLogger(__name__)


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
    graphs = draw_graphs(scene, stack_views(scene, thin), num_graphs, seed, options)
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
