"""Laws of all parts together."""

import subprocess
import sys

import pytest
import torch

from l3r.model.heads import pointmap_from_raw
from tests.model.official import PairNetwork, tiny_config


def test_every_parameter_of_the_pair_network_gets_a_gradient():
    torch.manual_seed(0)
    network = PairNetwork(tiny_config())
    tokens = network.encoder(torch.randn(2, 3, 32, 48))
    grid = network.encoder.token_grid(32, 48)
    streams = network.decoder(tokens, tokens.flip(0), grid, grid)
    loss = torch.zeros(())
    for head, stream in zip((network.parent_head, network.child_head), streams, strict=True):
        pts3d, log_conf = pointmap_from_raw(head((2, 3), *stream))
        loss = loss + pts3d.square().sum() + log_conf.sum()
    loss.backward()
    assert [name for name, value in network.named_parameters() if value.grad is None] == []
    assert all(value.grad.isfinite().all() for value in network.parameters())
    assert [name for name, value in network.named_parameters() if not value.grad.any()] == []


COMPILED = """
import torch
from torch._dynamo.testing import CompileCounterWithBackend
from l3r.config import *
from l3r.model.light3r import Light3R

config = ModelConfig(
    encoder=EncoderConfig(width=32, depth=3, num_heads=2),
    alignment=AlignmentConfig(num_blocks=2, num_heads=2),
    decoder=DecoderConfig(width=16, depth=4, num_heads=2),
    head="dpt",
    dpt=DptConfig(stage_channels=[16, 16, 32, 32], fusion_channels=32, out_channels=32),
    image_size=[384, 512],
)
torch.manual_seed(0)
model, plain = Light3R(config, GraphConfig()), Light3R(config, GraphConfig())
plain.load_state_dict(model.state_dict())
counter = CompileCounterWithBackend("eager")  # what is asked for is one graph, not its code
model.compile_blocks(backend=counter)

def step(height, turned):
    image = torch.rand(1, 4, 3, height, 512)
    true_shape = torch.tensor([height, 512]).repeat(1, 4, 1)
    true_shape[0, turned] = torch.tensor([512, height])
    return image, true_shape, model(image, true_shape).world.pts3d_world

heights = (384, 336, 288, 256, 160)  # the five shapes of the paper's training, 512 wide
for height in heights:
    for turned in ([0], [0, 1]):
        step(height, turned)
seen = counter.frame_count
for height in heights:
    for turned in ([], [2], [1, 3], [0, 1, 2, 3]):
        step(height, turned)
assert counter.frame_count == seen, (seen, counter.frame_count)
image, true_shape, found = step(160, [0, 1])
found.mean().backward()
torch.testing.assert_close(found, plain(image, true_shape).world.pts3d_world)
assert seen < 16, seen  # blocks share their code: 3 + 2 + 2 + 4 + 4 of them, and two heads
print(seen)
"""


@pytest.mark.slow
def test_blocks_compile_without_breaks_and_never_again_once_each_training_shape_was_seen():
    # In a process of its own: the shape checks of the test run cannot be compiled.
    command = [sys.executable, "-c", COMPILED]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
