"""From photos to a reconstruction."""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l3r.config import InferenceConfig
from l3r.geometry.rigid import invert_rigid
from l3r.graph.accumulate import accumulate
from l3r.graph.diagnostics import split_components
from l3r.inference.cameras import collect_self_views, fit_cameras, fit_intrinsics
from l3r.inference.clock import StageClock
from l3r.inference.decoding import (
    DirectedEdges,
    align_photos,
    decode_photos,
    encode_photos,
)
from l3r.inference.photos import load_photos
from l3r.inference.symmetrize import symmetrize
from l3r.model.light3r import Light3R
from l3r.model.precision import reduced_precision
from l3r.types import (
    Cameras,
    PairPointmaps,
    Photos,
    Reconstruction,
    SceneTree,
    Views,
    Window,
    WorldPointmaps,
)


def reconstruct(
    model: Light3R, files: Sequence[Path], config: InferenceConfig | None = None
) -> Reconstruction:
    """Reconstruct a set of photos, in any order and of any shapes.

    Args:
        model: From :func:`l3r.load_model`.
        files: Image files; unusable ones are left out with a warning.
        config: How; by default :class:`~l3r.config.InferenceConfig`'s values.

    Returns:
        Cameras at the photos' original sizes, dense points, tree and timings. The world is the
        root camera's frame, in metres only if the training data were metric.

    Raises:
        DataError: Fewer than two photos can be used.
    """
    config = config or InferenceConfig()
    clock = StageClock(next(model.parameters()).device)
    with clock.stage("load"):
        loaded = load_photos(files, model.config, crop=config.crop)
    return reconstruct_photos(model, loaded.photos, config, clock)


@torch.no_grad()
def reconstruct_photos(
    model: Light3R,
    photos: Photos,
    config: InferenceConfig,
    clock: StageClock,
    scores: Float[Tensor, "n n"] | None = None,
) -> Reconstruction:
    """Run all stages on loaded photos, measuring each.

    Args:
        model: The network, in evaluation mode.
        photos: Two or more.
        config: Precision, chunks, symmetrisation and camera fitting.
        clock: Receives seconds and peak memory.
        scores: Ground-truth overlap, which ``graph.algorithm=oracle`` needs.
    """
    # Validation calls this under the training's autocast, which must not reach the fits.
    with torch.autocast(next(model.parameters()).device.type, enabled=False):
        return _reconstruct(model, photos, config, clock, scores)


def _reconstruct(
    model: Light3R,
    photos: Photos,
    config: InferenceConfig,
    clock: StageClock,
    scores: Float[Tensor, "n n"] | None,
) -> Reconstruction:
    sizes = photos.network_size
    half = partial(reduced_precision, config.precision, next(model.parameters()).device)
    with clock.stage("encode"), half():
        tokens = encode_photos(model, photos, config.chunk_size)
    with clock.stage("tree"):
        mean_tokens = torch.stack([image.mean(0) for image in tokens])
        given = None if scores is None else scores[None]
        all_scores, tree = model.connect(mean_tokens[None], given)
    with clock.stage("align"), half():
        aligned = align_photos(model, tokens, config.chunk_size)
    with clock.stage("decode"), half():
        forward, reverse = _decode_both_ways(model, aligned, sizes, tree, config)
    with clock.stage("accumulate"):
        pairs = forward
        if config.symmetrize != "off":
            pairs = symmetrize(forward, reverse, config.symmetrize)
        world = accumulate(pairs, tree, model.graph)
    with clock.stage("focal"):
        K = fit_intrinsics(collect_self_views(pairs, reverse, tree), photos)
    with clock.stage("cameras"):
        fits = fit_cameras(world, K, photos, config)
    residual = world.residual[0].cpu()
    host_scores = all_scores[0].cpu()
    pts3d_world, conf = _unpad(world, sizes)
    return Reconstruction(
        cameras=Cameras(
            file=list(photos.file),
            image_size=list(photos.original_size),
            K=K,
            cam_from_world=fits.cam_from_world,
            registered=fits.registered,
            component=split_components(tree, host_scores, residual, model.graph),
        ),
        image=list(photos.image),
        window=list(photos.window),
        pts3d_world=pts3d_world,
        conf=conf,
        tree=tree,
        scores=host_scores,
        residual=residual,
        point_rule=fits.point_rule,
        seconds=clock.seconds,
        peak_mib=clock.peak_mib,
    )


def reconstruct_views(
    model: Light3R, views: Views, config: InferenceConfig
) -> Iterator[tuple[Reconstruction, Float[Tensor, "n 4 4"]]]:
    """Run the full inference path on every graph of a batch with ground truth.

    Images that the batch holds transposed go in upright.

    Yields:
        The reconstruction of each graph and its true ``cam_from_world``, float64.
    """
    was_training = model.training
    model.eval()
    for graph in range(len(views.image)):
        clock = StageClock(views.image.device)
        photos = _upright_photos(views, graph)
        scene = reconstruct_photos(model, photos, config, clock, views.scores[graph])
        yield scene, invert_rigid(views.world_from_cam[graph].double().cpu())
    model.train(was_training)


def _upright_photos(views: Views, graph: int) -> Photos:
    """Take a graph's images out of the training layout, each in its own orientation."""
    sizes = [(height, width) for height, width in views.true_shape[graph].tolist()]
    return Photos(
        image=[
            image if tuple(image.shape[-2:]) == size else image.mT
            for image, size in zip(views.image[graph], sizes, strict=True)
        ],
        original_size=sizes,
        window=[Window.whole(height, width) for height, width in sizes],
        file=[f"{view:02d}" for view in range(len(sizes))],
    )


def _decode_both_ways(
    model: Light3R,
    tokens: Sequence[Tensor],
    sizes: Sequence[tuple[int, int]],
    tree: SceneTree,
    config: InferenceConfig,
) -> tuple[PairPointmaps, PairPointmaps]:
    """Decode every edge from either side, in the same chunks.

    Without symmetrisation only the edges of leaves are decoded in reverse: their own views tell
    their focal lengths. The reverse maps of other edges are then those of an arbitrary edge.
    """
    parent, child = tree.parent[0], tree.child[0]
    reverse = torch.arange(tree.num_edges)
    if config.symmetrize == "off":
        reverse = (~torch.isin(child, parent)).nonzero()[:, 0]
    edges = DirectedEdges(
        parent=torch.cat([parent, child[reverse]]), child=torch.cat([child, parent[reverse]])
    )
    both = decode_photos(model, tokens, sizes, edges, config.chunk_size)
    place = torch.full((tree.num_edges,), tree.num_edges)
    place[reverse] += torch.arange(len(reverse))
    return _select(both, torch.arange(tree.num_edges)), _select(both, place)


def _select(pairs: PairPointmaps, edges: Int[Tensor, " e"]) -> PairPointmaps:
    edges = edges.to(pairs.parent_pts3d.device)
    return PairPointmaps(**{name: value[:, edges] for name, value in vars(pairs).items()})


def _unpad(
    world: WorldPointmaps, sizes: Sequence[tuple[int, int]]
) -> tuple[list[Float[Tensor, "_h _w 3"]], list[Float[Tensor, "_h _w"]]]:
    """Give each image its points and confidences in its own shape, on the host."""
    pts3d, conf = world.pts3d_world[0].cpu(), world.log_conf[0].exp().cpu()
    pixels = [height * width for height, width in sizes]
    return (
        [pts3d[view, :count].reshape(*sizes[view], 3) for view, count in enumerate(pixels)],
        [conf[view, :count].reshape(sizes[view]) for view, count in enumerate(pixels)],
    )
