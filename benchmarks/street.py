"""What a bounded number of candidate pairs costs on a long walk, and what of all pairs it finds.

A street of 1 km, 2,000 depth maps of 192x256 of a walk up and down it: grids of 64x48 points, as
images of 480x640 have, and 256 columns to compare with where those have 320. Everything that is
timed runs in one thread, as the command line does; rendering is not timed. Candidates and their
scores come first, then all pairs by the same function: ten minutes altogether.
"""

import resource
import time
from functools import partial

import numpy as np
import torch

from data_prep.candidates import choose_pairs
from data_prep.converters.synthetic import intrinsics
from data_prep.covisibility import relate_pairs
from data_prep.depth_views import DepthViews, prepare_views
from data_prep.draw import SceneRelations
from data_prep.graph_sampling import SamplingOptions, sample_graphs
from data_prep.overlap_table import OverlapTable, all_pairs
from data_prep.scene import Frame, Scene
from data_prep.street import build_street, draw_stroll, street_depth

NUM_VIEWS = 2000
NUM_GRAPHS = 2000
SIZE = (192, 256)
OPTIONS = SamplingOptions()


def run() -> list[tuple[str, str]]:
    """Render, then relate candidates, draw graphs, and relate all pairs.

    Returns:
        Names and values of what was measured.
    """
    scene = _render_scene()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        rows, views, table, spent = _measure_candidates(scene)
        return rows + _compare(scene, views, table, spent)
    finally:
        torch.set_num_threads(threads)


def _measure_candidates(
    scene: Scene,
) -> tuple[list[tuple[str, str]], DepthViews, OverlapTable, float]:
    """Give rows, and the seconds that candidates and their scores took."""
    before = _peak_memory()
    times = [time.perf_counter()]
    views = prepare_views(scene)
    times.append(time.perf_counter())
    pairs = choose_pairs(scene, views, None, OPTIONS)
    times.append(time.perf_counter())
    table = relate_pairs(scene, views, pairs)
    times.append(time.perf_counter())
    relations = SceneRelations(scene, views, None, table)
    graphs = sample_graphs(
        table,
        scene.world_from_cam[:, :3, :3],
        NUM_GRAPHS,
        options=OPTIONS,
        overlap_of=relations.overlap_of,
    )
    relations.known(graphs)
    times.append(time.perf_counter())
    stages = ("thinning", "candidates", "scoring", f"sampling {len(graphs):,} graphs")
    seconds = np.diff(times)
    rows = [(f"{stage} [s]", f"{spent:.1f}") for stage, spent in zip(stages, seconds, strict=True)]
    rows += [
        ("in total [s]", f"{seconds.sum():.1f}"),
        ("peak memory, depth maps of the source included [GB]", f"{_peak_memory():.2f}"),
        ("before it began, with those depth maps [GB]", f"{before:.2f}"),
        ("candidates per image", f"{2 * len(pairs) / NUM_VIEWS:.1f}"),
    ]
    return rows, views, table, float(seconds[1:3].sum())


def _compare(
    scene: Scene, views: DepthViews, table: OverlapTable, spent: float
) -> list[tuple[str, str]]:
    start = time.perf_counter()
    whole = relate_pairs(scene, views, all_pairs(NUM_VIEWS))
    seconds = time.perf_counter() - start
    useful = (whole.iou >= OPTIONS.min_iou) & (whole.score >= OPTIONS.min_score)
    partners = np.bincount(whole.views[useful].reshape(-1), minlength=NUM_VIEWS)
    found = table.find(whole.views[useful]) >= 0
    few, many = np.quantile(partners, [0.05, 0.95])
    return [
        ("useful partners of an image (s >= 0.02, IoU >= 0.1)", f"{partners.mean():.1f}"),
        ("the same, 5% and 95% of the images", f"{few:.0f}, {many:.0f}"),
        ("useful pairs found, of all pairs' (recall)", f"{found.mean():.4f}"),
        ("all pairs [s]", f"{seconds:.1f}"),
        ("all pairs / candidates and scoring", f"{seconds / spent:.1f}"),
    ]


def _peak_memory() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def _render_scene() -> Scene:
    street = build_street(0)
    K = intrinsics(SIZE)
    cameras = draw_stroll(street, NUM_VIEWS, seed=0)
    depth = street_depth(street, torch.from_numpy(K), cameras, SIZE)
    frames = [
        Frame(
            name=f"{view:06d}",
            image_size=SIZE,
            K=K,
            world_from_cam=cameras[view].numpy(),
            read_image=partial(np.zeros, (*SIZE, 3), np.uint8),
            read_depth=partial(np.asarray, depth[view].numpy()),
        )
        for view in range(NUM_VIEWS)
    ]
    return Scene(dataset="synthetic", name="street", is_metric=True, frames=frames)
