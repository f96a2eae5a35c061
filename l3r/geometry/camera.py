"""Pinhole cameras: pixels, rays, and intrinsics under changes of the image.

Pixel coordinates are (x, y); the centre of the top-left pixel is (0.5, 0.5), so that resizing is
a multiplication and cropping a shift.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from l3r.types import Window


def pixel_centers(height: int, width: int, like: Tensor) -> Float[Tensor, "p 2"]:
    """Centres (x, y) of all pixels, row by row, in the dtype and on the device of ``like``."""
    y = torch.arange(height, dtype=like.dtype, device=like.device) + 0.5
    x = torch.arange(width, dtype=like.dtype, device=like.device) + 0.5
    grid_y, grid_x = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([grid_x, grid_y], dim=-1).reshape(-1, 2)


def window_centers(height: int, width: int, window: Window, like: Tensor) -> Float[Tensor, "p 2"]:
    """Centres (x, y) of all pixels of a resized window, in pixels of the image it was cut from.

    Args:
        height: Rows of the resized window.
        width: Columns of it.
        window: What was cut out, before it was resized.
        like: Gives dtype and device.
    """
    corner = [window.left, window.top]
    scale = [window.width / width, window.height / height]
    affine = like.new_tensor([corner, scale])
    return affine[0] + pixel_centers(height, width, like) * affine[1]


def resize_K(K: Float[Tensor, "*b 3 3"], scale_x: float, scale_y: float) -> Float[Tensor, "*b 3 3"]:
    """Intrinsics of the image after its sides were multiplied by the two factors."""
    factors = torch.tensor([scale_x, scale_y, 1.0], dtype=K.dtype, device=K.device)
    return K * factors[:, None]


def crop_K(K: Float[Tensor, "*b 3 3"], left: float, top: float) -> Float[Tensor, "*b 3 3"]:
    """Intrinsics after ``left`` columns and ``top`` rows were cut off (negative: padded)."""
    shift = torch.zeros_like(K)
    shift[..., 0, 2] = left
    shift[..., 1, 2] = top
    return K - shift


def transpose_K(K: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3"]:
    """Intrinsics after the pixel axes were swapped; the camera's own axes stay.

    The first two rows change places, so K[0, 0] becomes 0: invert K, never divide by K[0, 0].
    """
    return K[..., [1, 0, 2], :]


def unproject(
    depth: Float[Tensor, "*b h w"], K: Float[Tensor, "*b 3 3"]
) -> Float[Tensor, "*b p 3"]:
    """Lift a depth map to points in the camera's frame, pixels flattened row by row.

    Args:
        depth: z in the camera.
        K: Intrinsics in pixels of ``depth``; any invertible form, a transposed one included.
    """
    height, width = depth.shape[-2:]
    pts2d = pixel_centers(height, width, like=depth)
    homogeneous = torch.cat([pts2d, torch.ones_like(pts2d[:, :1])], dim=-1)
    # The plain inverse would wait for the device to learn whether there is one.
    rays: Tensor = homogeneous @ torch.linalg.inv_ex(K).inverse.transpose(-1, -2)
    return rays * depth.flatten(-2)[..., None]


def project(
    pts3d_cam: Float[Tensor, "*b p 3"], K: Float[Tensor, "*b 3 3"]
) -> tuple[Float[Tensor, "*b p 2"], Float[Tensor, "*b p"]]:
    """Project points of the camera's frame.

    Returns:
        ``(pts2d, depth)``: pixel coordinates, which mean nothing where ``depth`` <= 0, and z.
    """
    depth = pts3d_cam[..., 2]
    # Points on the camera plane would divide by zero and poison gradients; they are invalid anyway.
    safe = torch.where(depth.abs() > 1e-12, depth, torch.full_like(depth, 1e-12))
    pts2d = (pts3d_cam @ K.transpose(-1, -2))[..., :2] / safe[..., None]
    return pts2d, depth
