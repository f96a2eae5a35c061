"""A network that knows the truth: ground-truth point maps in place of the decoder's answer."""

import torch

from l3r.config import AlignmentConfig, DecoderConfig, EncoderConfig, GraphConfig, ModelConfig
from l3r.geometry.camera import unproject
from l3r.geometry.rigid import invert_rigid, transform_points
from l3r.model.light3r import EdgePointmaps, Light3R

LOG_CONF = 2.0


class OracleNetwork(Light3R):
    """Tokens carry the number of their view; decoding looks the truth up.

    The tree is the real one, over similarities that fall with the distance of the views' numbers.
    """

    def __init__(self, depths, Ks, world_from_cams, graph=None):
        config = ModelConfig(
            encoder=EncoderConfig(patch_size=8, width=16, depth=1, num_heads=1),
            alignment=AlignmentConfig(num_blocks=0),
            decoder=DecoderConfig(width=16, depth=1, num_heads=1),
            image_size=[48, 64],
        )
        super().__init__(config, graph or GraphConfig())
        self.depths, self.Ks, self.world_from_cams = depths, Ks, world_from_cams

    def encode(self, image):
        """Read the view's number from its image's first pixel."""
        number = (image[:, 0, 0, 0] * 255).round().double()
        angle = 0.3 * number[:, None] * torch.tensor([1.0, 0.31], dtype=torch.float64)
        return torch.cat([angle.cos(), angle.sin(), number[:, None] * 1e-9], -1)[:, None]

    def decode(self, parent_tokens, child_tokens, parent_size, child_size):
        """Give the true maps, in the parent's frame."""
        parents, children = (self._numbers(tokens) for tokens in (parent_tokens, child_tokens))
        parent_maps = [self._points(view, view) for view in parents]
        child_maps = [self._points(c, p) for c, p in zip(children, parents, strict=True)]
        parent, child = torch.stack(parent_maps), torch.stack(child_maps)
        return EdgePointmaps(
            parent_pts3d=parent,
            child_pts3d=child,
            parent_log_conf=torch.where(parent[..., 2] > 0, LOG_CONF, 0.0).double(),
            child_log_conf=self._known(children),
        )

    def _numbers(self, tokens):
        return (tokens[:, 0, -1] * 1e9).round().long().tolist()

    def _points(self, view, frame):
        points = unproject(self.depths[view], self.Ks[view])
        frame_from_cam = invert_rigid(self.world_from_cams[frame]) @ self.world_from_cams[view]
        return transform_points(frame_from_cam, points)

    def _known(self, views):
        return torch.stack(
            [torch.where(self.depths[v].flatten() > 0, LOG_CONF, 0.0).double() for v in views]
        )


def numbered_images(sizes):
    """Images whose first pixel says which view they are."""
    images = []
    for view, (height, width) in enumerate(sizes):
        image = torch.zeros(3, height, width)
        image[0, 0, 0] = view / 255
        images.append(image)
    return images
