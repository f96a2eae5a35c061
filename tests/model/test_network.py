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
    streams = network.decoder(tokens, tokens.flip(0), (2, 3), (2, 3))
    loss = torch.zeros(())
    for head, stream in zip((network.parent_head, network.child_head), streams, strict=True):
        pts3d, log_conf = pointmap_from_raw(head(stream, (2, 3)))
        loss = loss + pts3d.square().sum() + log_conf.sum()
    loss.backward()
    assert [name for name, value in network.named_parameters() if value.grad is None] == []
    assert all(value.grad.isfinite().all() for value in network.parameters())
    assert [name for name, value in network.named_parameters() if not value.grad.any()] == []


COMPILED = """
import torch
from l3r.config.model import AlignmentConfig, DecoderConfig, EncoderConfig
from l3r.model.alignment import LatentAlignment
from l3r.model.decoder import PairDecoder
from l3r.model.encoder import Encoder
from l3r.model.heads import LinearHead, pointmap_from_raw

encoder = Encoder(EncoderConfig(width=32, depth=1, num_heads=2))
alignment = LatentAlignment(AlignmentConfig(num_blocks=1, num_heads=4), 32)
decoder = PairDecoder(DecoderConfig(width=16, depth=1, num_heads=2), 32)
head = LinearHead(16, 16)

def network(image):
    tokens = alignment(encoder(image)[None])[0]
    parent, child = decoder(tokens, tokens.flip(0), (2, 3), (2, 3))
    return [pointmap_from_raw(head(stream, (2, 3))) for stream in (parent, child)]

image = torch.randn(2, 3, 32, 48)
compiled = torch.compile(network, fullgraph=True, backend="eager")
torch.testing.assert_close(compiled(image), network(image))
"""


@pytest.mark.slow
def test_the_parts_compile_into_one_graph_without_a_warning():
    # In a process of its own: the shape checks of the test run cannot be compiled.
    command = [sys.executable, "-W", "error", "-c", COMPILED]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
