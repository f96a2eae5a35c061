"""Which graphs a scene's shards will hold, decided before any image is encoded."""

import hashlib
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from data_prep.depth_views import ThinView, stack_views, thin_view
from data_prep.draw import GraphPlan, draw_graphs
from data_prep.frames import read_image
from data_prep.problems import Problem
from data_prep.scene import Frame, Scene
from data_prep.survey import quota
from data_prep.units import BuildRequest
from l3r.errors import DataError

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ScenePlan:
    """What will be stored of one scene."""

    graphs: list[GraphPlan] = field(default_factory=list)
    """In the order drawn; views are numbers of the scene's frames."""
    fingerprint: str = ""
    """Digest of the frames it was made of; empty where the scene could not be read."""
    dropped: dict[str, Problem] = field(default_factory=dict)
    """What is wrong with the frames left out, by name."""
    problems: dict[str, int] = field(default_factory=dict)
    """How often each kind of problem came up, those of dropped frames included."""


def plan_scene(
    scene: Scene, request: BuildRequest, problems: Mapping[str, int] | None = None
) -> ScenePlan:
    """Relate all frames of a scene and draw its graphs.

    Image and depth of every frame are read once before anything is drawn, and frames that cannot
    be read, or of whose depth nothing is known, are left out: the graphs are then complete.

    Args:
        scene: Frames with depth.
        request: How many graphs, of what kind.
        problems: What came up when the scene's cameras were read.

    Returns:
        The plan; with fewer graphs, and a warning, where the scene has no more. A scene that
        cannot be used has none, and one problem more.
    """
    dropped: dict[str, Problem] = {}
    graphs: list[GraphPlan] = []
    counts = dict(problems or {})
    try:
        graphs = _plan_graphs(scene, request, dropped)
    except DataError as error:
        _LOG.warning("unusable_scene: %s: %s", scene.name, error)
        counts["unusable_scene"] = counts.get("unusable_scene", 0) + 1
    for problem in dropped.values():
        counts[problem.kind] = counts.get(problem.kind, 0) + 1
    return ScenePlan(
        graphs=graphs, fingerprint=fingerprint(scene), dropped=dropped, problems=counts
    )


def _plan_graphs(
    scene: Scene, request: BuildRequest, dropped: dict[str, Problem]
) -> list[GraphPlan]:
    least = request.sampling.min_views
    thin: list[ThinView] = []
    kept: list[int] = []
    if len(scene.frames) >= least:
        for number, frame in enumerate(scene.frames):
            view = _read_view(scene, frame)
            if isinstance(view, Problem):
                dropped[frame.name] = view
            else:
                kept.append(number)
                thin.append(view)
    if len(kept) < least:
        found = len(kept) if thin else len(scene.frames)
        _LOG.warning("%s: %d frames, a graph has %d or more", scene.name, found, least)
        return []
    usable = scene.take(kept)
    wanted = quota(len(kept), request.num_graphs, request.graphs_per_image)
    graphs = draw_graphs(usable, stack_views(usable, thin), wanted, request.seed, request.sampling)
    return [replace(graph, views=[kept[view] for view in graph.views]) for graph in graphs]


def _read_view(scene: Scene, frame: Frame) -> ThinView | Problem:
    where = f"{scene.name}: {frame.name}"
    try:
        read_image(frame)
        view = thin_view(frame, sparse=scene.has_sparse_depth)
    except DataError as error:
        return Problem(kind="unreadable_frame", where=where, detail=str(error))
    if not view.valid.any():
        return Problem(kind="empty_depth", where=where, detail="no depth is known")
    return view


def fingerprint(scene: Scene) -> str:
    """Digest of a scene's frame names, sizes and cameras."""
    digest = hashlib.sha256()
    for frame in scene.frames:
        digest.update(f"{frame.name} {frame.image_size}".encode())
        digest.update(frame.K.tobytes() + frame.world_from_cam.tobytes())
    return digest.hexdigest()


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
