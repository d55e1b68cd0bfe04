"""Kernels on rendered pictures: the background, an object that lets what is behind it be seen, smooth edges."""

from __future__ import annotations

import numpy as np

from grasp_env._compile import compiled

BACKGROUND_DEPTH = 0.99999
"""OpenGL depth from which on nothing was drawn; the far plane of `view.py` is that far away."""

_STEP = 8.0
"""Longest way [pixels] along an edge over which it is smoothed."""

_CONTRAST = 16.0
"""Differences of brightness, of 255, that are left as they are."""


def gradient(width: int, height: int, top: tuple[int, int, int], bottom: tuple[int, int, int]) -> np.ndarray:
    """A background (height, width, 3) uint8 that changes evenly from the top to the bottom."""
    part = np.linspace(0.0, 1.0, height)[:, None, None]
    column = (1.0 - part) * np.array(top) + part * np.array(bottom)
    return np.ascontiguousarray(np.broadcast_to(column.round().astype(np.uint8), (height, width, 3)))


@compiled
def put_background(pixels, depth, background, out):
    """Writes into out (H, W, 3) the pixels (H, W, 4), and the background (H, W, 3) where nothing was drawn."""
    height, width = depth.shape
    for row in range(height):
        for column in range(width):
            source = background if depth[row, column] >= BACKGROUND_DEPTH else pixels
            for k in range(3):
                out[row, column, k] = source[row, column, k]


@compiled
def see_through(front, front_depth, back, back_depth, opacity, out):
    """Writes opacity * front + (1 - opacity) * back where their depths (H, W) differ, and front elsewhere.

    All pictures are (H, W, 3) uint8; out may be front.
    """
    height, width = front_depth.shape
    for row in range(height):
        for column in range(width):
            weight = opacity if front_depth[row, column] != back_depth[row, column] else 1.0
            for k in range(3):
                value = weight * front[row, column, k] + (1.0 - weight) * back[row, column, k]
                out[row, column, k] = np.uint8(value + 0.5)


@compiled
def smooth_edges(image, out):
    """Writes image (H, W, 3) uint8 with stairs at edges blended along the edge.

    The fast approximate anti-aliasing of T. Lottes (FXAA, 2009): the brightness of four neighbours tells the direction
    of an edge; two samples along it (four where they stay within the brightness around) replace the pixel.
    """
    height, width, _ = image.shape
    bright = np.empty((height, width), np.float32)
    for row in range(height):
        for column in range(width):
            bright[row, column] = (
                np.float32(0.299) * image[row, column, 0]
                + np.float32(0.587) * image[row, column, 1]
                + np.float32(0.114) * image[row, column, 2]
            )
    near, far = np.empty(3), np.empty(3)
    for row in range(height):
        up, down = max(row - 1, 0), min(row + 1, height - 1)
        for column in range(width):
            for k in range(3):
                out[row, column, k] = image[row, column, k]
            left, right = max(column - 1, 0), min(column + 1, width - 1)
            here, nw, ne = bright[row, column], bright[up, left], bright[up, right]
            sw, se = bright[down, left], bright[down, right]
            low, high = min(here, nw, ne, sw, se), max(here, nw, ne, sw, se)
            if high - low < _CONTRAST:
                continue
            across = (sw + 2.0 * bright[down, column] + se) - (nw + 2.0 * bright[up, column] + ne)
            along = (nw + 2.0 * bright[row, left] + sw) - (ne + 2.0 * bright[row, right] + se)
            scale = 1.0 / (min(abs(across), abs(along)) + max((nw + ne + sw + se) / 32.0, 2.0))
            x = min(max(across * scale, -_STEP), _STEP)
            y = min(max(along * scale, -_STEP), _STEP)
            for k in range(3):
                near[k] = 0.5 * (
                    _sample(image, row - y / 6.0, column - x / 6.0, k)
                    + _sample(image, row + y / 6.0, column + x / 6.0, k)
                )
                far[k] = 0.5 * near[k] + 0.25 * (
                    _sample(image, row - y / 2.0, column - x / 2.0, k)
                    + _sample(image, row + y / 2.0, column + x / 2.0, k)
                )
            level = 0.299 * far[0] + 0.587 * far[1] + 0.114 * far[2]
            chosen = near if level < low or level > high else far
            for k in range(3):
                out[row, column, k] = np.uint8(chosen[k] + 0.5)


@compiled
def _sample(image, row, column, k):
    """Bilinear value of channel k between the pixels, the border continued outside."""
    height, width, _ = image.shape
    row, column = min(max(row, 0.0), height - 1.0), min(max(column, 0.0), width - 1.0)
    r, c = int(row), int(column)
    s, d = min(r + 1, height - 1), min(c + 1, width - 1)
    v, u = row - r, column - c
    above = (1.0 - u) * image[r, c, k] + u * image[r, d, k]
    below = (1.0 - u) * image[s, c, k] + u * image[s, d, k]
    return (1.0 - v) * above + v * below
