"""FXAA pixel by pixel, and its bilinear samples."""

from __future__ import annotations

import numpy as np


def smooth_edges(image: np.ndarray) -> np.ndarray:
    """The picture (H, W, 3) uint8 with stairs at edges blended along the edge."""
    height, width, _ = image.shape
    bright = image[..., :3] * np.array([0.299, 0.587, 0.114], np.float32)
    bright = np.pad(bright[..., 0] + bright[..., 1] + bright[..., 2], 1, mode="edge")
    out = image.copy()
    for row in range(height):
        for column in range(width):
            around = bright[row : row + 3, column : column + 3]
            (nw, up, ne), (left, here, right), (sw, down, se) = around
            low, high = min(here, nw, ne, sw, se), max(here, nw, ne, sw, se)
            if high - low < 16.0:
                continue
            across = float(sw) + 2.0 * float(down) + float(se) - (float(nw) + 2.0 * float(up) + float(ne))
            along = float(nw) + 2.0 * float(left) + float(sw) - (float(ne) + 2.0 * float(right) + float(se))
            scale = 1.0 / (min(abs(across), abs(along)) + max(float(nw + ne + sw + se) / 32.0, 2.0))
            way = np.clip(np.array([along, across]) * scale, -8.0, 8.0)  # rows, columns
            pairs = {
                part: _sample(image, row, column, -way / part) + _sample(image, row, column, way / part)
                for part in (6.0, 2.0)
            }
            near = 0.5 * pairs[6.0]
            far = 0.5 * near + 0.25 * pairs[2.0]
            level = far @ np.array([0.299, 0.587, 0.114])
            out[row, column] = (near if level < low or level > high else far) + 0.5
    return out


def _sample(image: np.ndarray, row: int, column: int, way: np.ndarray) -> np.ndarray:
    height, width, _ = image.shape
    y, x = np.clip(np.array([row, column]) + way, 0.0, (height - 1.0, width - 1.0))
    r, c = int(y), int(x)
    s, d = min(r + 1, height - 1), min(c + 1, width - 1)
    above = (1.0 - (x - c)) * image[r, c] + (x - c) * image[r, d]
    below = (1.0 - (x - c)) * image[s, c] + (x - c) * image[s, d]
    return (1.0 - (y - r)) * above + (y - r) * below
