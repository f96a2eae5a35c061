"""How fast pairs are related and graphs drawn, on a rendered room of 1,000 views of 48x48."""

import time
from functools import partial

import torch

from data_prep.candidates import choose_pairs
from data_prep.converters.synthetic import intrinsics
from data_prep.covisibility import relate_pairs
from data_prep.depth_views import prepare_views
from data_prep.graph_sampling import SamplingOptions, sample_graphs
from data_prep.raycast import render
from data_prep.room import build_room, draw_cameras
from data_prep.scene import Frame, Scene

NUM_VIEWS = 1000
NUM_GRAPHS = 2000
SIZE = (48, 48)


def run() -> list[tuple[str, str]]:
    """Render, relate and draw once, in one thread as the command line does.

    Returns:
        Names and values of what was measured.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return _measure()
    finally:
        torch.set_num_threads(threads)


def _measure() -> list[tuple[str, str]]:
    start = time.perf_counter()
    scene = _render_scene()
    rendered = time.perf_counter()
    views = prepare_views(scene)
    table = relate_pairs(scene, views, choose_pairs(scene, views, None, SamplingOptions()))
    related = time.perf_counter()
    graphs = sample_graphs(table, scene.world_from_cam[:, :3, :3], NUM_GRAPHS)
    drawn = time.perf_counter()
    return [
        ("views rendered per second (48x48), one thread", f"{NUM_VIEWS / (rendered - start):.0f}"),
        (
            "pairs chosen and related per second (48x48), one thread",
            f"{len(table) / (related - rendered):,.0f}",
        ),
        ("graphs drawn per second (1,000 views)", f"{len(graphs) / (drawn - related):,.0f}"),
    ]


def _render_scene() -> Scene:
    room = build_room(0)
    K = intrinsics(SIZE)
    cameras = draw_cameras(room, NUM_VIEWS, seed=0)
    frames = []
    for start in range(0, NUM_VIEWS, 4):
        chunk = cameras[start : start + 4]
        image, depth = render(room, torch.from_numpy(K), chunk, SIZE)
        for view in range(len(chunk)):
            frames.append(
                Frame(
                    name=f"{start + view:06d}",
                    image_size=SIZE,
                    K=K,
                    world_from_cam=chunk[view].numpy(),
                    read_image=partial((image[view] * 255).byte().numpy),
                    read_depth=partial(depth[view].numpy),
                )
            )
    return Scene(dataset="synthetic", name="room", is_metric=True, frames=frames)
