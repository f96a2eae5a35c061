import cv2
import numpy as np
import pytest
import torch

from l3r.export.graph_sheet import CELL, write_graph_sheet
from l3r.types import Views
from tests.export.conftest import ring_scene, unregister

LABELS, STRIDE = 76, CELL + 4


def as_batch(scene):
    """The exact scene as the training layout holds it: portrait images transposed."""
    points = torch.stack(scene.pts3d_world).double()
    forward = scene.cam_from_world[:, 2]
    depth = torch.einsum("nhwc,nc->nhw", points, forward[:, :3]) + forward[:, 3, None, None]
    image = torch.stack(scene.image)
    shape = torch.tensor(image.shape[2:])
    if shape[0] > shape[1]:
        image, depth = image.mT, depth.mT
    depth = depth.float()
    depth[1] = 0  # nothing is known of the second image
    n = len(image)
    return Views(
        image=image[None],
        true_shape=shape.expand(1, n, 2),
        K=scene.cameras.K.float()[None],
        world_from_cam=torch.linalg.inv(scene.cam_from_world).float()[None],
        depth=depth[None],
        valid=depth[None] > 0,
        is_metric=torch.tensor([True]),
        dataset=["ring"],
        scores=torch.eye(n)[None],
        key=["ring"],
    )


def cell(sheet, row, column):
    top, left = row * STRIDE, LABELS + column * STRIDE
    return sheet[top : top + CELL, left : left + CELL].astype(int)


@pytest.mark.parametrize(
    ("original", "size"), [((120, 160), (48, 64)), ((160, 120), (64, 48))], ids=["wide", "tall"]
)
def test_exact_depth_looks_like_the_truth_and_what_is_unknown_is_grey(tmp_path, original, size):
    scene = ring_scene(num_views=4, original=original, size=size)
    views = as_batch(scene)
    write_graph_sheet(tmp_path / "sheet.png", unregister(scene, 2), views)
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet.shape == (4 * STRIDE, LABELS + 4 * STRIDE, 3)
    # Rounding may move a colour by one step of the map.
    assert np.abs(cell(sheet, 1, 0) - cell(sheet, 2, 0)).mean() < 1
    seen = np.s_[: 2 * size[0], : 2 * size[1]]
    assert (cell(sheet, 2, 1)[seen] == 128).all()
    assert (cell(sheet, 1, 2)[seen] == 128).all()
    photo = scene.image[3].permute(1, 2, 0).flip(-1).repeat_interleave(2, 0).repeat_interleave(2, 1)
    assert np.abs(cell(sheet, 0, 3)[seen] - 255 * photo.numpy()).max() <= 0.51
