"""Smoothing of edges in rendered pictures."""

from __future__ import annotations

import numpy as np
from PIL import Image

from grasp_env.inputs.arguments import Array

_LONGEST = 8.0  # longest distance along an edge for smoothing [pixels]
_CONTRAST = 16  # differences of brightness below this, of 255, are kept
_BRIGHTNESS = np.array([0.299, 0.587, 0.114])  # weights of red, green and blue


def smooth_edges(picture: Image.Image) -> Image.Image:
    """Smooth jagged edges of an RGB picture by blending along them.

    This is the fast approximate anti-aliasing of T. Lottes (FXAA, 2009). The brightness of four
    neighbours gives the direction of an edge. Two samples along it replace the pixel, or four if
    these stay within the brightness around it.
    """
    image = np.array(picture)
    height, width, _ = image.shape
    bright = np.pad(np.asarray(picture.convert("L"), np.int16), 1, mode="edge")
    around = [bright[r : r + height, c : c + width] for r in range(3) for c in range(3)]
    low = np.minimum.reduce(around[::2])
    high = np.maximum.reduce(around[::2])  # over the corners and the middle
    row, column = np.nonzero(high - low >= _CONTRAST)  # the rest is computed for these pixels only
    nw, up, ne, left, _, right, sw, down, se = (view[row, column].astype(float) for view in around)
    across = (sw + 2.0 * down + se) - (nw + 2.0 * up + ne)
    along = (nw + 2.0 * left + sw) - (ne + 2.0 * right + se)
    least = np.minimum(np.abs(across), np.abs(along)) + np.maximum((nw + ne + sw + se) / 32.0, 2.0)
    edge = np.clip(np.array([along, across]) / least, -_LONGEST, _LONGEST)  # rows, columns
    pixels = image.reshape(-1, 3)

    def sample(share: float) -> Array:
        """Return bilinear values (n, 3) at this share of the edge; the border extends outside."""
        y, x = np.clip([row, column] + share * edge, 0.0, [[height - 1.0], [width - 1.0]])
        r = y.astype(int)
        c = x.astype(int)
        v = (y - r)[:, None]
        u = (x - c)[:, None]
        at = r * width + c
        right = (c < width - 1).astype(int)
        down = np.where(r < height - 1, width, 0)
        above, below = (
            (1.0 - u) * pixels.take(start, axis=0) + u * pixels.take(start + right, axis=0)
            for start in (at, at + down)
        )
        return (1.0 - v) * above + v * below

    near = 0.5 * (sample(-1.0 / 6.0) + sample(1.0 / 6.0))
    far = 0.5 * near + 0.25 * (sample(-0.5) + sample(0.5))
    level = far @ _BRIGHTNESS
    within = (low[row, column] <= level) & (level <= high[row, column])
    image[row, column] = np.where(within[:, None], far, near) + 0.5
    return Image.fromarray(image)
