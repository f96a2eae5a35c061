import pytest
import torch

from l3r.config.model import EncoderConfig
from l3r.errors import DataError
from l3r.model.encoder import Encoder
from l3r.model.grid import TokenGrid
from tests.tolerance import TOLERANCE


@pytest.fixture
def encoder():
    torch.manual_seed(0)
    return Encoder(EncoderConfig(width=32, depth=2, num_heads=2))


def test_images_of_a_batch_do_not_touch_each_other(encoder):
    encoder.double()
    images = torch.randn(3, 3, 32, 48, dtype=torch.float64)
    tokens = encoder(images)
    alone = torch.cat([encoder(image[None]) for image in images])
    bound = TOLERANCE[torch.float64]
    torch.testing.assert_close(tokens, alone, rtol=bound, atol=bound)


def test_tokens_stand_row_by_row(encoder):
    """Patch embedding at token r * columns + c sees the patch at (r, c) and nothing else."""
    image = torch.zeros(1, 3, 32, 48)
    embedded = encoder.patch_embed(image)
    image[:, :, 16:, 32:] = 1.0
    changed = (encoder.patch_embed(image) - embedded).flatten(2).abs().sum(dim=(0, 1)) > 0
    assert changed.tolist() == [False] * 5 + [True]
    assert encoder.token_grid(32, 48) == TokenGrid(2, 3)


@pytest.mark.parametrize(("height", "width"), [(40, 48), (32, 50), (0, 32), (8, 8)])
def test_sides_that_hold_no_whole_patches_are_refused(encoder, height, width):
    with pytest.raises(DataError, match=f"{height} x {width}.*patch size 16") as error:
        encoder(torch.zeros(1, 3, height, width))
    assert "\n" not in str(error.value)


def test_fresh_weights_are_xavier_uniform_with_zero_bias(encoder):
    embed = encoder.patch_embed.weight.detach()
    limit = (6 / (3 * 16 * 16 + 32)) ** 0.5
    assert 0.95 * limit < embed.abs().max() <= limit
    qkv = encoder.blocks[0].attn.qkv
    limit = (6 / (32 + 96)) ** 0.5
    assert 0.95 * limit < qkv.weight.abs().max() <= limit
    assert not qkv.bias.any()
    assert encoder.norm.eps == 1e-6
