"""Rendered pictures, (H, W, 4) uint8: the background, an object that lets what is behind it be seen, smooth edges."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grasp_env._check import Array

Picture = NDArray[np.uint8]
Depth = NDArray[np.float32]

BACKGROUND_DEPTH = 0.99999
"""OpenGL depth from which on nothing was drawn; the far plane of `view.py` is that far away."""

_STEP = 8.0
"""Longest way [pixels] along an edge over which it is smoothed."""

_BRIGHTNESS = np.array([0.299, 0.587, 0.114], np.float32)
"""Of red, green and blue."""

_CONTRAST = 16.0
"""Differences of brightness, of 255, that are left as they are."""


def gradient(width: int, height: int, top: tuple[int, int, int], bottom: tuple[int, int, int]) -> Picture:
    """A background that changes evenly from the top to the bottom."""
    part = np.linspace(0.0, 1.0, height)[:, None, None]
    column = (1.0 - part) * np.array([*top, 255]) + part * np.array([*bottom, 255])
    return np.ascontiguousarray(np.broadcast_to(column.round().astype(np.uint8), (height, width, 4)))


def put_background(pixels: Picture, depth: Depth, background: Picture) -> Picture:
    """The pixels, and the background where nothing was drawn."""
    chosen = np.where(depth >= BACKGROUND_DEPTH, _words(background), _words(pixels))
    return chosen[..., None].view(np.uint8)


def see_through(front: Picture, front_depth: Depth, back: Picture, back_depth: Depth, opacity: float) -> Picture:
    """The front, and where their depths differ opacity * front + (1 - opacity) * back."""
    out, places = front.copy(), np.flatnonzero(front_depth != back_depth)
    over, under = (image.reshape(-1, 4).take(places, axis=0) for image in (front, back))
    out.reshape(-1, 4)[places] = (opacity * over + (1.0 - opacity) * under + 0.5).astype(np.uint8)
    return out


def smooth_edges(image: Picture) -> Picture:
    """The picture, (H, W, 3), with stairs at edges blended along the edge.

    The fast approximate anti-aliasing of T. Lottes (FXAA, 2009): the brightness of four neighbours tells the direction
    of an edge; two samples along it (four where they stay within the brightness around) replace the pixel.
    """
    height, width, _ = image.shape
    bright = _BRIGHTNESS[0] * image[..., 0]
    for k in (1, 2):
        bright += _BRIGHTNESS[k] * image[..., k]
    bright = np.pad(bright, 1, mode="edge")
    here, *corners = (bright[r : r + height, c : c + width] for r, c in ((1, 1), (0, 0), (0, 2), (2, 0), (2, 2)))
    low, high = here.copy(), here.copy()
    for corner in corners:
        np.minimum(low, corner, out=low)
        np.maximum(high, corner, out=high)
    places = np.flatnonzero(high - low >= _CONTRAST)  # all that follows is done for these pixels alone
    row, column = np.divmod(places, width)
    low, high = low[row, column], high[row, column]
    nw, ne, sw, se = (corner[row, column] for corner in corners)
    up, left, right, down = (bright[row + r, column + c].astype(float) for r, c in ((0, 1), (1, 0), (1, 2), (2, 1)))
    across = (sw + 2.0 * down + se) - (nw + 2.0 * up + ne)
    along = (nw + 2.0 * left + sw) - (ne + 2.0 * right + se)
    scale = 1.0 / (np.minimum(np.abs(across), np.abs(along)) + np.maximum((nw + ne + sw + se) / 32.0, 2.0))
    x, y = np.clip(across * scale, -_STEP, _STEP), np.clip(along * scale, -_STEP, _STEP)

    def both(part: float) -> Array:
        """The sum of the samples that far along the edge either way."""
        return _sample(image, row - y / part, column - x / part) + _sample(image, row + y / part, column + x / part)

    near = 0.5 * both(6.0)
    far = 0.5 * near + 0.25 * both(2.0)
    level = 0.299 * far[0] + 0.587 * far[1] + 0.114 * far[2]
    chosen = np.where((level < low) | (level > high), near, far)
    out = np.ascontiguousarray(image[..., :3])
    out.reshape(-1, 3)[places] = (chosen[:3] + 0.5).astype(np.uint8).T
    return out


def _sample(image: Picture, row: Array, column: Array) -> Array:
    """Bilinear values (4, n) between the pixels, the border continued outside."""
    height, width, _ = image.shape
    row, column = np.clip(row, 0.0, height - 1.0), np.clip(column, 0.0, width - 1.0)
    r, c = row.astype(np.intp), column.astype(np.intp)
    v, u = row - r, column - c
    at, words = r * width + c, _words(image).ravel()
    right, down = np.minimum(c + 1, width - 1) - c, (np.minimum(r + 1, height - 1) - r) * width

    def value(places: NDArray[np.intp]) -> Array:
        return words.take(places).view(np.uint8).reshape(-1, 4).T.astype(float)

    above = (1.0 - u) * value(at) + u * value(at + right)
    below = (1.0 - u) * value(at + down) + u * value(at + down + right)
    return (1.0 - v) * above + v * below


def _words(image: Picture) -> NDArray[np.uint32]:
    """A number for each pixel, (H, W): what moves whole pixels is four times as fast."""
    return image.view(np.uint32)[..., 0]
