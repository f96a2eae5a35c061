import math

import pytest
import torch

from l3r.config.model import DecoderConfig, EncoderConfig, ModelConfig
from l3r.model.grid import TokenGrid
from l3r.model.heads import LinearHead, build_head, pointmap_from_raw, run_head
from tests.tolerance import TOLERANCE


def test_pixels_of_a_patch_stand_where_the_loop_puts_them():
    torch.manual_seed(0)
    patch, rows, columns = 4, 2, 3
    head = LinearHead(8, patch)
    tokens = torch.randn(2, rows * columns, 8)
    raw, values = head((rows, columns), tokens), head.proj(tokens)
    expected = torch.full((2, 4, rows * patch, columns * patch), math.nan)
    for row in range(rows * patch):
        for column in range(columns * patch):
            token = values[:, row // patch * columns + column // patch]
            for channel in range(4):
                place = channel * patch**2 + row % patch * patch + column % patch
                expected[:, channel, row, column] = token[:, place]
    torch.testing.assert_close(raw, expected)


def test_head_ignores_autocast_and_raises_half_precision():
    torch.manual_seed(0)
    head, tokens = LinearHead(8, 4), torch.randn(2, 6, 8).bfloat16()
    grid = TokenGrid(2, 3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = run_head(head, [tokens], grid, recompute=False)
    assert found.dtype == torch.float32
    assert torch.equal(found, head((2, 3), tokens.float()))
    doubled = run_head(head.double(), [tokens.double()], grid, recompute=False)
    assert doubled.dtype == torch.float64


def test_points_and_confidence_follow_the_formulas_row_by_row():
    torch.manual_seed(0)
    raw = torch.randn(2, 4, 3, 5, dtype=torch.float64)
    pts3d, log_conf = pointmap_from_raw(raw)
    assert pts3d.shape == (2, 15, 3)
    assert log_conf.shape == (2, 15)
    bound = TOLERANCE[torch.float64]
    for row, column in [(0, 0), (1, 3), (2, 4)]:
        xyz, logit = raw[1, :3, row, column], raw[1, 3, row, column].item()
        n = xyz.norm().item()
        expected = xyz / n * (math.exp(n) - 1)
        torch.testing.assert_close(pts3d[1, row * 5 + column], expected, rtol=bound, atol=bound)
        conf = 1 + math.exp(logit)
        assert math.exp(log_conf[1, row * 5 + column].item()) == pytest.approx(conf, rel=bound)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32, torch.float64])
def test_zero_gives_the_origin_with_finite_gradients(dtype):
    raw = torch.zeros(1, 4, 2, 2, dtype=dtype, requires_grad=True)
    pts3d, log_conf = pointmap_from_raw(raw)
    assert pts3d.dtype == log_conf.dtype != torch.bfloat16
    assert not pts3d.any()
    torch.testing.assert_close(log_conf, torch.full_like(log_conf, math.log(2)))
    (pts3d.sum() + log_conf.sum()).backward()
    assert raw.grad.isfinite().all()


def test_huge_confidences_and_far_points_stay_finite():
    # exp(50) metres is past any scene, and inside float32 (which ends at n = 88).
    raw = torch.tensor([50.0, 0.0, 0.0, 1e30]).view(1, 4, 1, 1).requires_grad_()
    pts3d, log_conf = pointmap_from_raw(raw)
    (pts3d.sum() + log_conf.sum()).backward()
    assert pts3d.isfinite().all()
    assert log_conf.item() == pytest.approx(1e30)
    assert raw.grad.isfinite().all()
    assert pointmap_from_raw(torch.full((1, 4, 1, 1), -1e30))[1].item() == 0.0


def test_softplus_threshold_does_not_show_in_float64():
    raw = torch.zeros(1, 4, 1, 1, dtype=torch.float64)
    raw[:, 3] = 20.5
    assert pointmap_from_raw(raw)[1].item() == 20.5 + math.log1p(math.exp(-20.5))


def test_configuration_names_the_head():
    config = ModelConfig(
        encoder=EncoderConfig(width=32, num_heads=2, patch_size=8),
        decoder=DecoderConfig(width=16, num_heads=2),
        image_size=[16, 16],
    )
    head = build_head(config)
    assert isinstance(head, LinearHead)
    assert head.hooks == (-1,)
    assert head.proj.weight.shape == (4 * 8 * 8, 16)
