import math

import pytest
import torch

from l3r.model.rope import apply_rope, rope_tables
from tests.tolerance import TOLERANCE

HEAD_DIM = 16


def rotated_grid(channels, grid):
    """The same vector rotated as if it stood at every token of a grid: (rows, columns, dim)."""
    tokens = channels.expand(1, grid[0] * grid[1], 1, HEAD_DIM)
    return apply_rope(tokens, rope_tables(*grid, HEAD_DIM, channels))[0, :, 0].unflatten(0, grid)


def test_products_depend_on_differences_of_positions_alone():
    torch.manual_seed(0)
    query, key = torch.randn(2, HEAD_DIM)
    queries, keys = rotated_grid(query, (7, 9)), rotated_grid(key, (7, 9))
    # All tokens of the first block of 3 x 4 against the same block moved by 2 rows, 3 columns.
    products = torch.einsum("ijd,ijd->ij", queries[2:5, 3:7], keys[:3, :4])
    torch.testing.assert_close(products, products[:1, :1].expand_as(products))
    assert abs(products[0, 0] - queries[0, 0] @ keys[2, 3]) > 0.01  # the direction does matter


def test_rotation_follows_the_written_formula():
    torch.manual_seed(0)
    grid, quarter = (3, 5), HEAD_DIM // 4
    q = torch.randn(HEAD_DIM)
    found = rotated_grid(q, grid)
    for row, column in [(0, 0), (2, 1), (1, 4)]:
        for run, position in enumerate((row, column)):
            for j in range(quarter):
                angle = position * 100 ** (-j / quarter)
                u, v = q[2 * run * quarter + j].item(), q[(2 * run + 1) * quarter + j].item()
                turned = found[row, column, 2 * run * quarter :]
                assert turned[j].item() == pytest.approx(
                    u * math.cos(angle) - v * math.sin(angle), abs=TOLERANCE[torch.float32]
                )
                assert turned[quarter + j].item() == pytest.approx(
                    v * math.cos(angle) + u * math.sin(angle), abs=TOLERANCE[torch.float32]
                )


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32, torch.float64])
def test_rotation_keeps_lengths_and_dtype(dtype):
    q = torch.randn(2, 6, 3, HEAD_DIM, dtype=dtype)
    tables = rope_tables(2, 3, HEAD_DIM, q)
    assert tables.cos.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
    found = apply_rope(q, tables)
    assert found.dtype == dtype
    bound = TOLERANCE[dtype]
    torch.testing.assert_close(found.norm(dim=-1), q.norm(dim=-1), rtol=bound, atol=bound)


def test_tables_are_made_once_for_a_shape():
    like = torch.zeros(1)
    assert rope_tables(4, 6, HEAD_DIM, like) is rope_tables(4, 6, HEAD_DIM, like)
    assert rope_tables(4, 6, HEAD_DIM, like) is not rope_tables(6, 4, HEAD_DIM, like)


def test_tables_first_made_in_inference_mode_serve_training():
    with torch.inference_mode():
        rope_tables(11, 13, HEAD_DIM, torch.zeros(1))
    q = torch.randn(1, 11 * 13, 1, HEAD_DIM, requires_grad=True)
    apply_rope(q, rope_tables(11, 13, HEAD_DIM, q)).sum().backward()
    assert q.grad is not None
