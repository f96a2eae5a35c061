"""Sizes of the network."""

from dataclasses import dataclass, field
from typing import Literal

from l3r.config.check import require

Precision = Literal["fp32", "bf16"]
"""What the transformer computes in."""


@dataclass(kw_only=True, slots=True)
class EncoderConfig:
    """The image encoder, shared by all images (ViT-L by default)."""

    patch_size: int = 16
    """Side of a patch [px]; image sides are multiples of it."""
    width: int = 1024
    """Width of a token."""
    depth: int = 24
    """Transformer blocks."""
    num_heads: int = 16
    """Attention heads; width / num_heads is a multiple of 4 (RoPE turns y and x pairs)."""

    def __post_init__(self) -> None:
        """Check ranges."""
        require(self.patch_size >= 1, "model.encoder.patch_size", self.patch_size, "at least 1")
        require_heads("model.encoder", self.width, self.num_heads)
        require(self.depth >= 1, "model.encoder.depth", self.depth, "at least 1")


@dataclass(kw_only=True, slots=True)
class AlignmentConfig:
    """Latent global alignment: information exchange through one token per image."""

    num_blocks: int = 4
    """L of the paper; 0 switches the alignment off."""
    num_heads: int = 8
    """Attention heads of its layers."""
    output: Literal["zero_linear", "paper"] = "zero_linear"
    """``zero_linear``: F(0) + W F(L) with W starting at zero; ``paper``: F(0) + F(L)."""

    def __post_init__(self) -> None:
        """Check ranges."""
        require(self.num_blocks >= 0, "model.alignment.num_blocks", self.num_blocks, "at least 0")
        require(self.num_heads >= 1, "model.alignment.num_heads", self.num_heads, "at least 1")


@dataclass(kw_only=True, slots=True)
class DecoderConfig:
    """The pairwise decoder: two streams with weights of their own."""

    width: int = 768
    """Width of a token."""
    depth: int = 12
    """Blocks of each stream."""
    num_heads: int = 12
    """Attention heads; width / num_heads is a multiple of 4."""

    def __post_init__(self) -> None:
        """Check ranges."""
        require_heads("model.decoder", self.width, self.num_heads)
        require(self.depth >= 1, "model.decoder.depth", self.depth, "at least 1")


@dataclass(kw_only=True, slots=True)
class DptConfig:
    """Channels of the DPT head; the released networks have these, whatever their width."""

    stage_channels: list[int] = field(default_factory=lambda: [96, 192, 384, 768])
    """Channels of the four stages, finest first."""
    fusion_channels: int = 256
    """Channels while stages are fused."""
    out_channels: int = 128
    """Channels of the last convolutions."""

    def __post_init__(self) -> None:
        """Check ranges."""
        stages = self.stage_channels
        is_four = len(stages) == 4 and all(channels >= 1 for channels in stages)
        require(is_four, "model.dpt.stage_channels", stages, "four numbers, each at least 1")
        for key in ("fusion_channels", "out_channels"):
            require(getattr(self, key) >= 1, f"model.dpt.{key}", getattr(self, key), "at least 1")


@dataclass(kw_only=True, slots=True)
class ModelConfig:
    """The whole network."""

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    """Image encoder."""
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    """Latent global alignment."""
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    """Pairwise decoder."""
    head: Literal["linear", "dpt"] = "linear"
    """What turns decoder tokens into points and confidences."""
    dpt: DptConfig = field(default_factory=DptConfig)
    """Sizes of the head where it is ``dpt``."""
    image_size: list[int] = field(default_factory=lambda: [224, 224])
    """[height, width] the network is trained at [px], landscape or square; portrait images take it
    with height and width swapped, photos to reconstruct are scaled to its long side."""

    def __post_init__(self) -> None:
        """Check ranges across parts."""
        patch = self.encoder.patch_size
        require(
            len(self.image_size) == 2
            and all(s >= patch and s % patch == 0 for s in self.image_size)
            and self.image_size[0] <= self.image_size[1],
            "model.image_size",
            self.image_size,
            f"[height, width], multiples of the patch size {patch}, height at most width",
        )
        require(
            self.head != "dpt" or (patch == 16 and self.decoder.depth >= 4),
            "model.head",
            self.head,
            f"linear, or patches of 16 (not {patch}) and 4 or more decoder blocks (not "
            f"{self.decoder.depth})",
        )
        require(
            self.encoder.width % self.alignment.num_heads == 0,
            "model.alignment.num_heads",
            self.alignment.num_heads,
            f"a divisor of model.encoder.width = {self.encoder.width}",
        )


def require_heads(room: str, width: int, num_heads: int) -> None:
    """Check that heads divide the width into multiples of 4, which 2-D RoPE needs."""
    require(
        num_heads >= 1 and width % num_heads == 0 and (width // num_heads) % 4 == 0,
        f"{room}.num_heads",
        num_heads,
        f"a number that splits width {width} into multiples of 4",
    )
