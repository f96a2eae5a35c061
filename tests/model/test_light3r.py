"""The composed network: training's forward and inference's chunks are one computation."""

import pytest
import torch

from l3r.config import (
    AlignmentConfig,
    DecoderConfig,
    DptConfig,
    EncoderConfig,
    GraphConfig,
    InferenceConfig,
    LossConfig,
    ModelConfig,
)
from l3r.errors import ConfigError, DataError
from l3r.inference.clock import StageClock
from l3r.inference.reconstruct import reconstruct_photos
from l3r.loss.joint import JointLoss
from l3r.model.grid import find_transposed
from l3r.model.light3r import Light3R
from l3r.types import Photos, Window
from tests.geometry.scenes import generator
from tests.loss.scenes import HEIGHT, WIDTH, random_views


def build(graph=None, seed=0, num_blocks=2, output="zero_linear", head="linear"):
    patch, depth, scale = (4, 2, 1) if head == "linear" else (16, 4, 4)  # a DPT head needs these
    config = ModelConfig(
        encoder=EncoderConfig(patch_size=patch, width=32, depth=2, num_heads=2),
        alignment=AlignmentConfig(num_blocks=num_blocks, num_heads=2, output=output),
        decoder=DecoderConfig(width=24, depth=depth, num_heads=2),
        head=head,
        dpt=DptConfig(stage_channels=[4, 6, 8, 10], fusion_channels=8, out_channels=6),
        image_size=[scale * HEIGHT, scale * WIDTH],
    )
    torch.manual_seed(seed)
    model = Light3R(config, graph or GraphConfig())
    if model.alignment.out is not None:  # away from the identity
        torch.nn.init.normal_(model.alignment.out.weight, std=0.05)
    return model.double()


def images(seed, num_graphs=2, num_views=5):
    shape = (num_graphs, num_views, 3, HEIGHT, WIDTH)
    image = torch.rand(shape, generator=generator(seed)).double()
    true_shape = torch.tensor([HEIGHT, WIDTH]).expand(num_graphs, num_views, 2)
    return image, true_shape


def test_graphs_of_a_batch_do_not_touch_each_other():
    model = build()
    image, true_shape = images(1)
    both = model(image, true_shape)
    for graph in range(2):
        alone = model(image[graph, None], true_shape[graph, None])
        torch.testing.assert_close(alone.world.pts3d_world[0], both.world.pts3d_world[graph])
        assert torch.equal(alone.tree.parent[0], both.tree.parent[graph])


@pytest.mark.parametrize("algorithm", ["spt", "mst"])
def test_permuting_the_views_permutes_the_answer(algorithm):
    model = build(GraphConfig(algorithm=algorithm))
    image, true_shape = images(2, num_graphs=1)
    order = torch.tensor([3, 0, 4, 1, 2])
    first, second = model(image, true_shape), model(image[:, order], true_shape)
    torch.testing.assert_close(second.world.pts3d_world, first.world.pts3d_world[:, order])
    torch.testing.assert_close(second.world.log_conf, first.world.log_conf[:, order])


@pytest.mark.parametrize("output", ["zero_linear", "paper"])
@pytest.mark.parametrize("num_blocks", [0, 2])
def test_every_parameter_gets_a_gradient_in_every_step(num_blocks, output):
    model = build(num_blocks=num_blocks, output=output)
    views = random_views(3)
    prediction = model(views.image.double(), views.true_shape)
    JointLoss(LossConfig())(prediction, views).total.backward()
    missing = [name for name, p in model.named_parameters() if p.grad is None]
    assert not missing
    assert all(p.grad.isfinite().all() for p in model.parameters())


def test_a_fresh_network_with_alignment_answers_as_one_without():
    image, true_shape = images(4)
    config = build().config
    torch.manual_seed(0)
    aligned = Light3R(config, GraphConfig())
    plain = Light3R(
        ModelConfig(
            encoder=config.encoder,
            alignment=AlignmentConfig(num_blocks=0, num_heads=2),
            decoder=config.decoder,
            image_size=config.image_size,
        ),
        GraphConfig(),
    )
    weights = aligned.state_dict()
    plain.load_state_dict({k: v for k, v in weights.items() if not k.startswith("alignment.")})
    first, second = aligned(image.float(), true_shape), plain(image.float(), true_shape)
    assert torch.equal(first.pairs.child_pts3d, second.pairs.child_pts3d)


def reconstruct_graph(model, image, **settings):
    names = [f"{view}.png" for view in range(len(image))]
    size = [tuple(view.shape[1:]) for view in image]
    window = [Window.whole(*view) for view in size]
    photos = Photos(image=list(image), original_size=size, window=window, file=names)
    clock = StageClock(torch.device("cpu"))
    return reconstruct_photos(model, photos, InferenceConfig(**settings), clock)


@pytest.mark.parametrize("chunk_size", [1, 3, 32])
def test_inference_in_chunks_gives_what_training_computes(chunk_size):
    model = build().eval()
    image, true_shape = images(5, num_graphs=1)
    whole = model(image, true_shape)
    scene = reconstruct_graph(model, image[0], chunk_size=chunk_size, symmetrize="off")
    assert torch.equal(scene.tree.parent, whole.tree.parent)
    points = torch.stack(scene.pts3d_world).flatten(1, 2)
    torch.testing.assert_close(points, whole.world.pts3d_world[0].detach())
    conf = torch.stack(scene.conf).flatten(1)
    torch.testing.assert_close(conf, whole.world.log_conf[0].exp().detach())
    torch.testing.assert_close(scene.residual, whole.world.residual[0].detach())
    stages = {"encode", "tree", "align", "decode", "accumulate", "focal", "cameras"}
    assert set(scene.seconds) == set(scene.peak_mib) == stages


def test_photos_of_mixed_shapes_do_not_depend_on_their_neighbours_padding():
    model = build().eval()
    draw = generator(6)
    sizes = [(12, 16), (16, 12), (12, 16), (8, 16), (16, 12)]
    image = [torch.rand((3, *size), generator=draw).double() for size in sizes]
    photos = Photos(
        image=image,
        original_size=sizes,
        window=[Window.whole(*size) for size in sizes],
        file=[str(i) for i in range(5)],
    )
    clock = StageClock(torch.device("cpu"))
    first, second = (
        reconstruct_photos(model, photos, InferenceConfig(chunk_size=c), clock) for c in (1, 32)
    )
    for one, two, size in zip(first.pts3d_world, second.pts3d_world, sizes, strict=True):
        assert one.shape == (*size, 3)
        torch.testing.assert_close(one, two)


def test_the_oracle_needs_scores_and_the_others_ignore_them():
    image, true_shape = images(7, num_graphs=1)
    oracle = build(GraphConfig(algorithm="oracle"))
    with pytest.raises(ConfigError, match="needs ground-truth overlap"):
        oracle(image, true_shape)
    scores = torch.eye(5)[None].double() + 0.1
    scores[0, 2], scores[0, :, 2] = 0.9, 0.9
    assert oracle(image, true_shape, scores).tree.root.tolist() == [2]
    plain = build()
    with_scores = plain(image, true_shape, scores)
    assert torch.equal(with_scores.tree.parent, plain(image, true_shape).tree.parent)


def test_images_of_another_shape_than_stored_are_refused():
    image, true_shape = images(8)
    odd = true_shape.clone()
    odd[1, 2] = torch.tensor([WIDTH, HEIGHT + 4])
    with pytest.raises(DataError, match=r"true shape \[16, 16\].*\[12, 16\], or \[16, 12\]"):
        build()(image, odd)


@pytest.mark.parametrize("head", ["linear", "dpt"])
@pytest.mark.parametrize("turned", [[1, 3], [2], [0, 1, 2, 3]])
def test_transposed_storage_gives_what_photos_in_their_own_orientation_give(head, turned):
    """Training's mixed batch against inference, which sees every photo as it was taken."""
    model = build(head=head).eval()
    height, width = model.config.image_size
    image = torch.rand(1, 4, 3, height, width, generator=generator(10)).double()
    true_shape = torch.tensor([height, width]).repeat(1, 4, 1)
    true_shape[0, turned] = torch.tensor([width, height])
    mixed = model(image, true_shape)
    photos = [view.transpose(1, 2) if i in turned else view for i, view in enumerate(image[0])]
    scene = reconstruct_graph(model, photos, symmetrize="off")
    assert torch.equal(scene.tree.parent, mixed.tree.parent)
    torch.testing.assert_close(scene.residual, mixed.world.residual[0].detach())
    for view, (points, conf) in enumerate(zip(scene.pts3d_world, scene.conf, strict=True)):
        as_stored = (points.transpose(0, 1), conf.T) if view in turned else (points, conf)
        stored_points, stored_conf = mixed.world.pts3d_world[0, view], mixed.world.log_conf[0, view]
        torch.testing.assert_close(as_stored[0].flatten(0, 1), stored_points.detach())
        torch.testing.assert_close(as_stored[1].flatten(), stored_conf.exp().detach())


def test_square_images_are_never_transposed():
    assert find_transposed(torch.tensor([[32, 32]]), 32, 32) is None
    assert find_transposed(torch.tensor([[16, 32], [32, 16]]), 16, 32).tolist() == [False, True]


@pytest.mark.parametrize("head", ["linear", "dpt"])
def test_recomputed_activations_give_the_same_gradients_for_less_memory(head):
    views = random_views(3, *build(head=head).config.image_size)
    gradients, kept = [], []
    for enabled in (False, True):
        model = build(head=head)
        model.recompute_activations(enabled=enabled)
        sizes = {}

        def keep(tensor, sizes=sizes):
            sizes[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            prediction = model(views.image.double(), views.true_shape)
        parameters = {p.untyped_storage().data_ptr() for p in model.parameters()}
        kept.append(sum(size for at, size in sizes.items() if at not in parameters))
        JointLoss(LossConfig())(prediction, views).total.backward()
        gradients.append([p.grad for p in model.parameters()])
    torch.testing.assert_close(gradients[0], gradients[1])
    assert kept[1] < 0.5 * kept[0]


def test_no_gradient_flows_through_the_choice_of_the_tree():
    image, true_shape = images(9)
    prediction = build()(image, true_shape)
    assert not prediction.scores.requires_grad
    assert prediction.world.pts3d_world.requires_grad
