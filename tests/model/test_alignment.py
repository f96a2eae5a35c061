import pytest
import torch
from torch.nn.functional import gelu, layer_norm, linear, softmax

from l3r.config.model import AlignmentConfig
from l3r.model.alignment import LatentAlignment
from tests.tolerance import TOLERANCE

WIDTH, HEADS = 32, 4
OUTPUTS = pytest.mark.parametrize("output", ["zero_linear", "paper"])


def build_alignment(num_blocks=2, output="zero_linear"):
    """Alignment in float64 with every weight random, W and biases too."""
    torch.manual_seed(0)
    config = AlignmentConfig(num_blocks=num_blocks, num_heads=HEADS, output=output)
    alignment = LatentAlignment(config, WIDTH).double()
    with torch.no_grad():
        for parameter in alignment.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    return alignment


def random_tokens(num_graphs=2, num_views=5, num_tokens=6):
    torch.manual_seed(1)
    return torch.randn(num_graphs, num_views, num_tokens, WIDTH, dtype=torch.float64)


def assert_same(found, expected):
    bound = TOLERANCE[torch.float64]
    torch.testing.assert_close(found, expected, rtol=bound, atol=bound)


def test_alignment_starts_as_the_identity():
    alignment = LatentAlignment(AlignmentConfig(num_blocks=4, num_heads=HEADS), WIDTH)
    tokens = random_tokens().float()
    assert torch.equal(alignment(tokens), tokens)


@OUTPUTS
def test_permuting_views_permutes_the_output(output):
    alignment, tokens = build_alignment(output=output), random_tokens()
    order = torch.tensor([3, 0, 4, 1, 2])
    assert_same(alignment(tokens[:, order]), alignment(tokens)[:, order])


@OUTPUTS
def test_aligning_one_image_equals_aligning_all(output):
    alignment, tokens = build_alignment(output=output), random_tokens()
    levels = alignment.update_summaries(tokens.mean(dim=2))
    one_by_one = [alignment.align(tokens[:, view], levels) for view in range(5)]
    assert_same(torch.stack(one_by_one, dim=1), alignment(tokens))


def test_a_graph_alone_equals_a_graph_in_a_batch():
    alignment, tokens = build_alignment(), random_tokens(num_graphs=3)
    alone = torch.cat([alignment(graph[None]) for graph in tokens])
    assert_same(alone, alignment(tokens))


def test_every_view_learns_of_every_other():
    alignment, tokens = build_alignment(), random_tokens()
    changed = tokens.clone()
    changed[0, 2] += torch.randn_like(changed[0, 2])
    moved = (alignment(changed) - alignment(tokens)).abs().amax(dim=(2, 3)) > 1e-6
    assert moved.tolist() == [[True] * 5, [False] * 5]


def test_no_blocks_means_no_parameters_and_no_change():
    for output in ("zero_linear", "paper"):
        alignment = build_alignment(num_blocks=0, output=output)
        tokens = random_tokens()
        assert list(alignment.parameters()) == []
        assert alignment.update_summaries(tokens.mean(dim=2)) == []
        assert torch.equal(alignment(tokens), tokens)


def test_only_the_linear_output_has_a_weight_of_its_own():
    linear_names = {name for name, _ in build_alignment().named_parameters()}
    paper_names = {name for name, _ in build_alignment(output="paper").named_parameters()}
    assert linear_names - paper_names == {"out.weight"}
    assert paper_names <= linear_names


def test_a_fresh_alignment_hands_a_gradient_to_every_parameter():
    alignment = LatentAlignment(AlignmentConfig(num_blocks=2, num_heads=HEADS), WIDTH)
    alignment(random_tokens().float()).square().sum().backward()
    gradients = {name: value.grad for name, value in alignment.named_parameters()}
    assert all(gradient is not None for gradient in gradients.values())
    assert gradients["out.weight"].any()  # it can leave zero


@OUTPUTS
def test_every_parameter_moves_the_output(output):
    alignment = build_alignment(output=output)
    weights = torch.randn_like(random_tokens())
    (alignment(random_tokens()) * weights).sum().backward()
    for name, value in alignment.named_parameters():
        assert value.grad is not None
        # Softmax does not see what is added to all keys alike.
        if name.endswith("projk.bias"):
            assert value.grad.abs().max() < TOLERANCE[torch.float64]
        else:
            assert value.grad.abs().max() > 1e-6, name


@OUTPUTS
def test_steps_follow_the_equations(output):
    """Both equations written out for L = 2, with explicit softmax over heads."""
    alignment, tokens = build_alignment(output=output), random_tokens(num_graphs=1)
    state = alignment.state_dict()

    def norm(x, name):
        return layer_norm(x, (WIDTH,), state[f"{name}.weight"], state[f"{name}.bias"], 1e-6)

    def dense(x, name):
        return linear(x, state[f"{name}.weight"], state[f"{name}.bias"])

    def with_mlp(x, block):
        hidden = gelu(dense(norm(x, f"{block}.norm2"), f"{block}.mlp.fc1"))
        return x + dense(hidden, f"{block}.mlp.fc2")

    def attention(q, k, v):
        heads = zip(*(x.split(WIDTH // HEADS, dim=-1) for x in (q, k, v)), strict=True)
        scale = (WIDTH // HEADS) ** -0.5
        return torch.cat([softmax(a @ b.T * scale, dim=-1) @ c for a, b, c in heads], dim=-1)

    start = tokens[0].flatten(0, 1)
    x, summaries = start, tokens[0].mean(dim=1)
    for step in range(2):
        block = f"self_blocks.{step}"
        qkv = dense(norm(summaries, f"{block}.norm1"), f"{block}.attn.qkv").chunk(3, dim=-1)
        summaries = with_mlp(summaries + dense(attention(*qkv), f"{block}.attn.proj"), block)

        block = f"cross_blocks.{step}"
        memory = norm(summaries, f"{block}.norm_y")
        gathered = attention(
            dense(norm(x, f"{block}.norm1"), f"{block}.cross_attn.projq"),
            dense(memory, f"{block}.cross_attn.projk"),
            dense(memory, f"{block}.cross_attn.projv"),
        )
        gathered = dense(gathered, f"{block}.cross_attn.proj")
        x = with_mlp(gathered if output == "paper" else x + gathered, block)
    expected = start + (x if output == "paper" else x @ state["out.weight"].T)
    assert_same(alignment(tokens)[0].flatten(0, 1), expected)


@pytest.mark.parametrize("output", ["zero_linear", "paper"])
def test_tokens_between_blocks_stay_in_float32_under_autocast(output):
    alignment = LatentAlignment(AlignmentConfig(num_blocks=3, num_heads=2, output=output), 16)
    seen = []
    for block in alignment.cross_blocks:
        block.register_forward_hook(lambda _, __, result: seen.append(result.dtype))
    with torch.autocast("cpu", torch.bfloat16):
        result = alignment(torch.randn(1, 4, 6, 16))
    assert {*seen, result.dtype} == {torch.float32}
