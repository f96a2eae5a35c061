"""Stored graphs made by hand, and folders of shards of them."""

import dataclasses
import hashlib
import io
import tarfile

import numpy as np

from l3r.data.schema import (
    GraphSample,
    Manifest,
    PairTable,
    ShardEntry,
    encode_graph,
    write_manifest,
)


def make_graph(number=0, num_views=10, height=48, width=64):
    """A graph whose first pixels, depths and names say which graph and view they are."""
    rng = np.random.default_rng(number)
    yy, xx = np.mgrid[0:height, 0:width]
    images = [
        np.stack([(4 * number + v + xx) % 256, 3 * yy % 256, 0 * xx + 20 * v], -1).astype(np.uint8)
        for v in range(num_views)
    ]
    cams = np.tile(np.eye(4), (num_views, 1, 1))
    cams[1:, :3, 3] = rng.normal(size=(num_views - 1, 3))
    K = np.tile(
        [[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1.0]], (num_views, 1, 1)
    )
    table = np.eye(num_views) + 0.3 * (1 - np.eye(num_views))
    return GraphSample(
        dataset="hand",
        scene="room",
        is_metric=True,
        file=[f"{number}-{v}.png" for v in range(num_views)],
        image=images,
        depth=[np.full((height, width), 1 + v, np.float32) for v in range(num_views)],
        K=K,
        cam_from_world=cams,
        pairs=PairTable(
            iou=table, covisible=table, score=table, rotation=table, axis=table, parallax=table
        ),
    )


def make_mixed_graph(number=0, portrait=(False, True, True, False), height=48, width=64):
    """A graph whose images are landscape or portrait, of the same two sides."""
    upright = make_graph(number, len(portrait), width, height)
    graph = make_graph(number, len(portrait), height, width)
    chosen = [upright if turn else graph for turn in portrait]
    return dataclasses.replace(
        graph,
        image=[own.image[view] for view, own in enumerate(chosen)],
        depth=[own.depth[view] for view, own in enumerate(chosen)],
        K=np.stack([own.K[view] for view, own in enumerate(chosen)]),
    )


def write_folder(folder, graphs, graphs_per_shard=4):
    """Write shards the plain way: one tar after the other."""
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for shard, start in enumerate(range(0, len(graphs), graphs_per_shard)):
        chunk = graphs[start : start + graphs_per_shard]
        path = folder / f"hand-{shard:06d}.tar"
        with tarfile.open(path, "w") as tar:
            for number, graph in enumerate(chunk, start):
                members = encode_graph(graph, f"hand-{number:06d}")
                key = members.pop("__key__")
                for name, data in members.items():
                    info = tarfile.TarInfo(f"{key}.{name}")
                    info.size = len(data)
                    tar.addfile(info, io.BytesIO(data))
        content = path.read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        entries.append(
            ShardEntry(name=path.name, num_graphs=len(chunk), bytes=len(content), sha256=digest)
        )
    write_manifest(folder, Manifest(dataset="hand", min_views=2, max_views=10, shards=entries))
    return folder
