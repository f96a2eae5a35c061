"""The size images are stored in; apart from the pixels, so that a survey need not import torch."""

SHORT_SIDE = 480
"""A reduced image keeps at least this on its short side [px]."""
LONG_SIDE = 640
"""A reduced image keeps at least this on its long side [px]."""


def reduced_size(image_size: tuple[int, int]) -> tuple[int, int]:
    """Give (height, width) of the smallest copy that keeps both sides long enough.

    Args:
        image_size: (height, width) of the source.
    """
    scale = min(1.0, max(SHORT_SIDE / min(image_size), LONG_SIDE / max(image_size)))
    height, width = image_size
    return round(scale * height), round(scale * width)
