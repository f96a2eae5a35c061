import pytest
import torch

from l3r.config.model import DecoderConfig
from l3r.model.decoder import PairDecoder
from l3r.model.grid import TokenGrid
from tests.tolerance import TOLERANCE

PARENT_GRID, CHILD_GRID = TokenGrid(2, 3), TokenGrid(4, 2)


@pytest.fixture
def decoder():
    torch.manual_seed(0)
    return PairDecoder(DecoderConfig(width=16, depth=3, num_heads=2), 24).double()


@pytest.fixture
def tokens():
    torch.manual_seed(1)
    return [torch.randn(3, count, 24, dtype=torch.float64) for count in (6, 8)]


def assert_same(found, expected):
    bound = TOLERANCE[torch.float64]
    torch.testing.assert_close(found, expected, rtol=bound, atol=bound)


def test_edges_of_a_batch_do_not_touch_each_other(decoder, tokens):
    together = decoder(*tokens, PARENT_GRID, CHILD_GRID)
    for edge in range(3):
        one = [stream[edge : edge + 1] for stream in tokens]
        alone = decoder(*one, PARENT_GRID, CHILD_GRID)
        for stream, expected in zip(alone, together, strict=True):
            assert_same(stream[0], expected[0][edge : edge + 1])


def test_hooks_choose_entries_in_their_own_order(decoder, tokens):
    every = decoder(*tokens, PARENT_GRID, CHILD_GRID, hooks=range(4))
    some = decoder(*tokens, PARENT_GRID, CHILD_GRID, hooks=(-1, 0, 2))
    last = decoder(*tokens, PARENT_GRID, CHILD_GRID)
    for stream, entries, chosen, final in zip(tokens, every, some, last, strict=True):
        assert [entry.shape[-1] for entry in entries] == [24, 16, 16, 16]
        assert entries[0] is stream
        assert len(final) == 1
        for found, expected in zip([*chosen, *final], [3, 0, 2, 3], strict=True):
            assert torch.equal(found, entries[expected])


def test_only_the_last_entry_is_normalised(decoder, tokens):
    with torch.no_grad():
        decoder.norm.weight.zero_()
        decoder.norm.bias.fill_(0.5)
    for entries in decoder(*tokens, PARENT_GRID, CHILD_GRID, hooks=range(4)):
        assert [bool((entry == 0.5).all()) for entry in entries] == [False, False, False, True]


def test_streams_swap_with_their_blocks(decoder, tokens):
    """Neither stream is ahead of the other: exchanging inputs and blocks exchanges outputs."""
    parent, child = decoder(*tokens, PARENT_GRID, CHILD_GRID)
    decoder.parent_blocks, decoder.child_blocks = decoder.child_blocks, decoder.parent_blocks
    swapped_child, swapped_parent = decoder(*tokens[::-1], CHILD_GRID, PARENT_GRID)
    assert_same(swapped_parent[0], parent[0])
    assert_same(swapped_child[0], child[0])
