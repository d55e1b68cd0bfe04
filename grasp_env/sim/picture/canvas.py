"""Smooth 2D drawing over a picture: arrows, translucent shapes, dots and text."""

from __future__ import annotations

from functools import cache, lru_cache
from typing import TypeAlias

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from grasp_env._check import Array

Color: TypeAlias = tuple[int, ...]
"""Red, green, blue and maybe opacity, 0 to 255."""

WHITE = (255, 255, 255)
INK = (38, 42, 51)
FAINT = (112, 119, 132)
INACTIVE = (150, 154, 162)
ALARM = (190, 38, 30)

_FINE = 2
"""Pixels drawn per delivered pixel along each side."""


class Canvas:
    """Collects shapes in pixels of a picture and draws them in their order with smooth edges.

    Only the part of the picture that the shapes collected since the last `flush` touch is enlarged, drawn on and
    reduced again; text comes last, on top.

    Args:
        image: (H, W, 3) uint8; not written.
        veil: how much of the picture's contrast to take away, 0 to 1, so that what is drawn stands out.

    Attributes:
        unit: lengths that suit a picture of 480 pixels are multiplied by it [pixels].
    """

    def __init__(self, image: np.ndarray, veil: float = 0.0) -> None:
        self._picture = Image.fromarray(image).point([round(255 - (1.0 - veil) * (255 - k)) for k in range(256)] * 3)
        self.width, self.height = self._picture.size
        self.unit = min(self._picture.size) / 480.0
        self._shapes: list[tuple[Array, Color, float]] = []  # points (K, 2); width > 0: a line, 0: a polygon
        self._texts: list[tuple[float, float, str, Color, bool]] = []

    def polygon(self, points: Array, color: Color) -> None:
        """A filled polygon (K, 2)."""
        self._shapes.append((points, color, 0.0))

    def line(self, points: Array, color: Color, width: float) -> None:
        """A line through the points (K, 2), `width` pixels wide, its ends cut straight."""
        self._shapes.append((points, color, width))

    def disc(self, center: Array, radius: float, color: Color) -> None:
        """A filled circle."""
        self.polygon(center + radius * _CIRCLE, color)

    def ring(self, center: Array, radius: float, color: Color, width: float) -> None:
        """A circle's line."""
        self.line(center + radius * np.vstack([_CIRCLE, _CIRCLE[:2]]), color, width)

    def arrow(self, tail: Array, tip: Array, color: Color, width: float) -> None:
        """An arrow with a light rim; short ones get a smaller head, those of less than a pixel are left out."""
        along = tip - tail
        length = float(np.hypot(*along))
        if length < 1.0:
            return
        along = along / length
        across = np.array([-along[1], along[0]])
        head = min(3.6 * width, 0.75 * length)
        neck = tip - head * along
        half, side = 0.5 * width * min(1.0, length / (2.0 * width)), 0.42 * head
        outline = np.array(
            [tail + half * across, neck + half * across, neck + side * across, tip,
             neck - side * across, neck - half * across, tail - half * across]
        )  # fmt: skip
        self.line(np.vstack([outline, outline[:2]]), (*WHITE, 235), 0.7 * width)
        self.polygon(outline, color)

    def text(self, x: float, y: float, text: str, color: Color = INK, small: bool = False) -> None:
        """One line of text whose top left corner is at the point."""
        self._texts.append((x, y, text, color, small))

    def text_width(self, text: str, small: bool = False) -> float:
        """Pixels that a text takes along the line."""
        return _text_mask(text, self._font_size(small)).width - 2.0

    def text_height(self, small: bool = False) -> float:
        """Pixels from one line of text to the next."""
        return round(1.3 * self._font_size(small))

    def panel(self, left: float, top: float, right: float, bottom: float) -> None:
        """A light translucent plate with round corners for text to stand on."""
        radius = 6.0 * self.unit
        corners = np.array([(right - radius, bottom - radius), (left + radius, bottom - radius),
                            (left + radius, top + radius), (right - radius, top + radius)])  # fmt: skip
        quarter = len(_CIRCLE) // 4
        points = [c + radius * _CIRCLE[k * quarter : (k + 1) * quarter + 1] for k, c in enumerate(corners)]
        self.polygon(np.vstack(points), (*WHITE, 205))

    def flush(self) -> None:
        """Draws the shapes collected so far."""
        shapes, self._shapes = self._shapes, []
        if not shapes:
            return
        everything = np.vstack([points for points, _, _ in shapes])
        rim = 2.0 + max(width for _, _, width in shapes)
        low = np.clip(np.floor(everything.min(axis=0) - rim), 0, (self.width, self.height)).astype(int)
        high = np.clip(np.ceil(everything.max(axis=0) + rim), 0, (self.width, self.height)).astype(int)
        if (high <= low).any():
            return
        left, top, right, bottom = *low.tolist(), *high.tolist()
        fine = self._picture.crop((left, top, right, bottom))
        fine = fine.resize((_FINE * (right - left), _FINE * (bottom - top)), Image.Resampling.NEAREST)
        pen = ImageDraw.Draw(fine, "RGBA")  # this mode blends by opacity
        for points, color, width in shapes:
            corners = (_FINE * (points - low)).ravel().tolist()
            if width > 0.0:
                joint = "curve" if width > 2.0 else None  # round joints cost more than thin lines show
                pen.line(corners, fill=color, width=max(1, round(_FINE * width)), joint=joint)
            else:
                pen.polygon(corners, fill=color)
        self._picture.paste(fine.reduce(_FINE), (left, top))  # the mean of equal pixels: untouched ones stay the same

    def finish(self) -> np.ndarray:
        """The picture with everything drawn, (H, W, 3) uint8."""
        self.flush()
        for x, y, text, color, small in self._texts:
            self._picture.paste(color, (round(x), round(y)), _text_mask(text, self._font_size(small)))
        return np.array(self._picture)

    def _font_size(self, small: bool) -> int:
        return max(9 if small else 10, round((13 if small else 14) * self.unit))


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont), "Pillow was built without FreeType"
    return font


@lru_cache(maxsize=512)
def _text_mask(text: str, size: int) -> Image.Image:
    """How much of each pixel one line of text covers; kept, as most of it comes again in the next picture."""
    mask = Image.new("L", (max(1, round(_font(size).getlength(text)) + 2), round(1.4 * size)))
    ImageDraw.Draw(mask).text((0, 0), text, fill=255, font=_font(size))
    return mask


def _circle(count: int) -> Array:
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.column_stack([np.cos(angles), np.sin(angles)])


_CIRCLE = _circle(32)
