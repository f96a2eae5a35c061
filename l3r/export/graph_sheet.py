"""One picture of a graph with ground truth: a column an image."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from l3r.export.thumbnails import confidence_colors, depth_colors
from l3r.files import write_atomic
from l3r.types import Reconstruction, Views

ROWS = ("photo", "depth", "true depth", "confidence")
"""From top to bottom."""
CELL = 128
"""Pixels of the long side of each picture."""
HIGHEST_CONF = 10.0
"""Confidence of the brightest colour, the same at every step."""
_GAP, _LABELS = 4, 76


def write_graph_sheet(path: Path, scene: Reconstruction, views: Views) -> None:
    """Write a PNG of photos, depth by the network, true depth and confidence.

    Depth is along the axis of the camera that the reconstruction found, in its own unit; grey where
    there is no camera or no ground truth. Each depth map has its own range of colours.

    Args:
        path: The file.
        scene: Reconstruction of the batch's last graph.
        views: The batch.
    """
    columns = [_column(scene, views, view) for view in range(len(scene.image))]
    sheet = np.hstack([_labels(columns[0].shape[0]), *columns])
    _, data = cv2.imencode(".png", sheet)
    write_atomic(path, data.tobytes())


def _column(scene: Reconstruction, views: Views, view: int) -> UInt8[np.ndarray, "h w 3"]:
    image = scene.image[view].float().cpu()
    photo = (image * 255).round().byte().permute(1, 2, 0).numpy()[..., ::-1]
    true_depth = views.depth[-1, view].cpu()
    # The batch holds portrait images transposed; reconstructions are upright.
    upright = true_depth if true_depth.shape == image.shape[1:] else true_depth.mT
    cells = [
        photo,
        depth_colors(_found_depth(scene, view))[0],
        depth_colors(upright.numpy())[0],
        confidence_colors(scene.conf[view].float().numpy(), HIGHEST_CONF),
    ]
    return np.vstack([_framed(cell) for cell in cells])


def _found_depth(scene: Reconstruction, view: int) -> Float32[np.ndarray, "h w"]:
    """Depth in the camera found; zero, which counts as unknown, without one."""
    points = scene.pts3d_world[view].double()
    if not scene.cameras.registered[view]:
        return np.zeros(points.shape[:2], np.float32)
    forward = scene.cameras.cam_from_world[view, 2]
    depth: Float32[np.ndarray, "h w"] = (points @ forward[:3] + forward[3]).float().numpy()
    return depth


def _framed(cell: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "s s 3"]:
    """Scale to the cell's size, a gap at its right and bottom; tiny ones show their pixels."""
    scale = CELL / max(cell.shape[:2])
    size = (round(cell.shape[1] * scale), round(cell.shape[0] * scale))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST
    scaled = cv2.resize(np.ascontiguousarray(cell), size, interpolation=way)
    square = np.full((CELL + _GAP, CELL + _GAP, 3), 255, np.uint8)
    square[: size[1], : size[0]] = scaled
    return square


def _labels(height: int) -> UInt8[np.ndarray, "h w 3"]:
    strip = np.full((height, _LABELS, 3), 255, np.uint8)
    for row, text in enumerate(ROWS):
        place = (2, row * (CELL + _GAP) + CELL // 2)
        cv2.putText(strip, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (60, 60, 60), 1, cv2.LINE_AA)
    return strip
