"""Drawing of forces, friction cones, wrench and text (title, numbers, legend) over a picture."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from grasp_env.inputs.arguments import Array
from grasp_env.sim.picture.annotation import LONGEST_TURN, WRENCH_COLOR, WRENCH_STRETCH, Annotation
from grasp_env.sim.picture.view import View

Color: TypeAlias = tuple[int, ...]
"""Red, green, blue and optional opacity, 0 to 255."""
CONE_LENGTH = 0.036  # length of the sides of the drawn friction cones [m]
VEIL = 0.2  # share of contrast removed from the picture below
_WHITE = (255, 255, 255)
_INK = (38, 42, 51)
_FAINT = (112, 119, 132)
_INACTIVE = (150, 154, 162)
_ALARM = (190, 38, 30)
_FINE = 2  # drawn pixels per delivered pixel along each side, for smooth edges
_BAR = 0.03  # longest arrow of the legend [m]
_LINE = 1.3  # line spacing over font size
_HIGHEST = 0.4  # largest share of the picture's height for text; otherwise it is left out
_THREE_COLUMNS = 320  # width from which the legend has three columns [pixels]
_TURN_RADIUS, _LEAST_TURN = 0.03, 0.15  # radius of the moment's arc [m]; least visible arc [rad]


def draw(picture: Image.Image, annotation: Annotation, view: View) -> Image.Image:
    """Return a copy of the RGB picture, taken with `view`, with an annotation over it.

    A force arrow ends at its contact and its length is `scale` times the force, so that a force
    inside its friction cone is drawn inside the drawn cone. The wrench's force starts at `center`.
    Its moment is an arc about the moment's axis, by `turn` times the moment. Bodies in front hide
    nothing.
    """
    veiled = picture.point(lambda value: 255.0 - (1.0 - VEIL) * (255.0 - value))
    view = replace(view, width=_FINE * view.width, height=_FINE * view.height)
    fine = veiled.resize((view.width, view.height), Image.Resampling.NEAREST)
    pen = _Pen(fine)
    for i in np.argsort(-view.depth(annotation.points), kind="stable").tolist():
        _draw_contact(pen, view, annotation, i)
    _draw_wrench(pen, view, annotation)
    texts = _draw_legend(pen, view, annotation, *picture.size)
    picture = fine.reduce(_FINE)  # pixels that are not drawn on keep their value
    text_pen = ImageDraw.Draw(picture)
    for options in texts:
        text_pen.text(**options)
    return picture


class _Pen:
    """Pen on an enlarged picture; widths and radii are for 480 pixels and scale with its size."""

    def __init__(self, fine: Image.Image) -> None:
        self.unit = min(fine.size) / 480.0
        self._pen = ImageDraw.Draw(fine, "RGBA")  # this mode blends by opacity

    def polygon(self, points: Array, color: Color) -> None:
        self._pen.polygon(points.ravel().tolist(), color)

    def line(self, points: Array, color: Color, width: float) -> None:
        self._pen.line(points.ravel().tolist(), color, max(1, round(self.unit * width)), "curve")

    def disc(self, center: Array, radius: float, color: Color) -> None:
        self._pen.circle(center.tolist(), self.unit * radius, color)

    def ring(self, center: Array, radius: float, color: Color, width: float) -> None:
        outside = self.unit * (radius + 0.5 * width)
        wide = max(1, round(self.unit * width))
        self._pen.circle(center.tolist(), outside, outline=color, width=wide)

    def panel(self, box: Array) -> None:
        """Draw a light plate (left, top, right, bottom) as background of text."""
        self._pen.rounded_rectangle(box.tolist(), 6.0 * self.unit, (*_WHITE, 205))

    def arrow(self, tail: Array, tip: Array, color: Color, width: float) -> None:
        """Draw an arrow with a light rim; short ones get a smaller head."""
        length = float(np.hypot(*(tip - tail)))
        if length < _FINE:
            return
        wide = width * self.unit
        along = (tip - tail) / length
        head = min(3.6 * wide, 0.75 * length)
        half = 0.5 * wide * min(1.0, length / (2.0 * wide))
        side = 0.42 * head
        right = np.array([(0.0, half), (length - head, half), (length - head, side), (length, 0.0)])
        local = np.vstack([right, right[-2::-1] * (1.0, -1.0)])  # along and across the arrow
        outline = tail + local @ np.array([along, (-along[1], along[0])])
        self.line(np.vstack([outline, outline[:2]]), (*_WHITE, 235), 0.7 * width)
        self.polygon(outline, color)


def _draw_contact(pen: _Pen, view: View, annotation: Annotation, i: int) -> None:
    point = annotation.points[i]
    normal = annotation.normals[i]
    friction = annotation.friction[i]
    if not annotation.active[i]:
        center = view.project(point[None])[0]
        pen.ring(center, 6.0, (*_WHITE, 220), 4.6)
        pen.ring(center, 6.0, _INACTIVE, 2.0)
        return
    length = CONE_LENGTH / math.hypot(1.0, friction)
    across = np.linalg.svd(normal[None])[2][1:]  # two directions in the tangent plane
    rim = point - length * normal + length * friction * (_circle(24) @ across)
    tails = point - annotation.scale * np.array([annotation.forces[i], annotation.measured[i]])
    pixels = view.project(np.vstack([rim, point, tails]))
    mouth = pixels[:-3]
    cone = pixels[:-2]
    contact, tail, measured = pixels[-3:]
    # convex hull: the farthest point in each direction
    outline = cone[np.argmax(cone @ _circle(64).T, axis=0)]
    # darker than the links
    color = tuple((215.0 * annotation.colors[i]).clip(0.0, 255.0).astype(int).tolist())
    for shape, fill, edge in ((outline, 70, 170), (mouth, 45, 190)):
        pen.polygon(shape, (*color, fill))
        pen.line(shape, (*color, edge), 1.1)
    pen.arrow(tail, contact, color, 5.0)
    pen.line(np.array([measured, contact]), _INK, 1.4)
    pen.disc(contact, 3.6, _WHITE)
    pen.disc(contact, 2.6, color)


def _draw_wrench(pen: _Pen, view: View, annotation: Annotation) -> None:
    if not annotation.wrench.any():
        return
    center = annotation.center
    force = annotation.wrench[:3]
    moment = annotation.wrench[3:]
    turn = annotation.turn * float(np.linalg.norm(moment))
    if turn > _LEAST_TURN:
        axis = moment / np.linalg.norm(moment)
        first = np.cross(view.axes[1] if abs(axis @ view.axes[1]) < 0.9 else view.axes[0], axis)
        first /= np.linalg.norm(first)
        circle = _circle(27, min(turn, 1.1 * LONGEST_TURN))
        plane = np.array([first, np.cross(axis, first)])
        arc = view.project(center + _TURN_RADIUS * (circle @ plane))
        pen.line(arc[:-3], (*_WHITE, 220), 5.0)
        pen.line(arc[:-3], WRENCH_COLOR, 2.6)
        pen.arrow(arc[-7], arc[-1], WRENCH_COLOR, 3.4)
    tip = center + WRENCH_STRETCH * annotation.scale * force
    start, end = view.project(np.array([center, tip]))
    pen.arrow(start, end, WRENCH_COLOR, 5.0)
    pen.disc(start, 3.4, WRENCH_COLOR)


def room(width: int, height: int) -> tuple[float, float]:
    """Return a camera's margin and footer, shares of the height, that leave room for text."""
    pad, text, small = _sizes(width, height)
    above = pad + _LINE * text
    below = 5.1 * pad + _LINE * (text + 3.0 * small)
    return min(max(0.06, above / height), 0.2), min(max(0.06, below / height), _HIGHEST)


def _sizes(width: int, height: int) -> tuple[float, int, int]:
    """Return the padding around text and the sizes of normal and small text [delivered pixels]."""
    unit = min(width, height) / 480.0
    return 8.0 * unit, max(10, round(14.0 * unit)), max(9, round(13.0 * unit))


def _draw_legend(
    pen: _Pen, view: View, annotation: Annotation, width: int, height: int
) -> list[dict[str, Any]]:
    """Draw the band at the bottom and its icons; return the texts, arguments of `ImageDraw.text`.

    Small pictures have no text. Positions do not depend on the numbers, so that nothing jumps in a
    film.
    """
    texts: list[dict[str, Any]] = []
    pad, normal, small = _sizes(width, height)
    left = 2.0 * pad
    wide = width - 4.0 * pad
    step = _LINE * small
    legend = _legend(pen, view, annotation)
    # shares of the band's width
    columns = (0.0, 0.385, 0.77) if width >= _THREE_COLUMNS else (0.0,)
    numbers = step + _LINE * normal + 0.6 * pad if annotation.lines else 0.0
    band = numbers + step * len(legend) / len(columns)
    if band + 3.0 * pad > _HIGHEST * height:
        return texts

    def write(
        x: float, y: float, text: str, color: Color = _INK, size: int = small, **options: Any
    ) -> None:
        xy = round(x), round(y)
        texts.append({"xy": xy, "text": text, "fill": color, "font": _font(size), **options})

    top = height - 2.0 * pad - band
    pen.panel(_FINE * np.array([pad, top - pad, width - pad, height - pad]))
    for k, (label, value) in enumerate(annotation.lines):
        x = left + k * wide / len(annotation.lines)
        alarmed = bool(annotation.alarm) and k == 0
        write(x, top, label, _ALARM if alarmed else _FAINT)
        write(x, top + step, value, _ALARM if alarmed else _INK, normal)
    for k, (text, icon, draw_icon) in enumerate(legend):
        x = left + columns[k % len(columns)] * wide
        y = top + numbers + k // len(columns) * step
        draw_icon(_FINE * np.array([x, y + 0.5 * step]))
        write(x + icon / _FINE + 0.75 * pad, y, text)
    if _font(normal).getlength(annotation.title + annotation.hand) + 2.0 * pad < wide:
        write(width - left, pad, annotation.hand, _FAINT, normal, anchor="ra")
    write(left, pad, annotation.title, _INK, normal)
    if annotation.alarm:  # over the hand
        y = pad + _LINE * normal
        write(left, y, annotation.alarm, _ALARM, normal, stroke_width=2, stroke_fill=_WHITE)
    return texts


def _legend(
    pen: _Pen, view: View, annotation: Annotation
) -> list[tuple[str, float, Callable[[Array], None]]]:
    """Return for each entry text, icon width and a function to draw the icon right of a point."""
    unit = pen.unit
    right = np.array([1.0, 0.0])
    stretched = WRENCH_STRETCH * annotation.scale
    newtons = round_down(_BAR / annotation.scale)
    wrench = round_down(_BAR / stretched)
    lengths = [0.0, _BAR, newtons * annotation.scale, wrench * stretched]
    ends = view.project(annotation.center + np.outer(lengths, view.axes[0]))[:, 0]
    longest, bar, wrench_bar = (ends[1:, None] - ends[0]) * right
    moment = round_down(0.5 * math.pi / annotation.turn)
    x, y = _circle(11, moment * annotation.turn).T
    arc = 20.0 * unit * np.column_stack([x - x[-1], 0.5 * y[-1] - y])
    cone = 9.0 * unit * np.array([[2.0, 0.0], [0.0, -0.7], [0.0, 0.7], [2.0, 0.0]])

    def draw_cone(at: Array) -> None:
        pen.polygon(at + cone, (*_INACTIVE, 90))
        pen.line(at + cone, _INACTIVE, 1.2)

    def draw_arc(at: Array) -> None:
        pen.line(at + arc[:-3], WRENCH_COLOR, 2.2)
        pen.arrow(at + arc[-6], at + arc[-1], WRENCH_COLOR, 2.2)

    def draw_wrench(at: Array) -> None:
        pen.arrow(at, at + wrench_bar, WRENCH_COLOR, 3.2)

    def draw_ring(at: Array) -> None:
        pen.ring(at + 6.0 * unit * right, 4.5, _INACTIVE, 1.8)

    return [
        (f"commanded {newtons:g} N", longest[0], lambda at: pen.arrow(at, at + bar, _INK, 3.2)),
        ("measured", longest[0], lambda at: pen.line(np.array([at, at + bar]), _INK, 1.4)),
        ("friction cone", 18.0 * unit, draw_cone),
        (f"wrench {wrench:g} N", longest[0], draw_wrench),
        (f"moment {moment:g} N m", longest[0], draw_arc),
        ("contact lost", 18.0 * unit, draw_ring),
    ]


def round_down(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is at most `value` > 0.

    Example:
        >>> [round_down(value) for value in (0.013, 0.02, 7.0)]
        [0.01, 0.02, 5.0]
    """
    power = 10.0 ** math.floor(math.log10(value) + 1e-9)
    return next(float(f"{k * power:.0e}") for k in (5, 2, 1) if k * power <= value * (1.0 + 1e-9))


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont), "Pillow was built without FreeType"
    return font


def _circle(count: int, angle: float = 2.0 * np.pi) -> Array:
    """Return points (count + 1, 2) of the unit circle, from 0 to the angle."""
    angles = np.linspace(0.0, angle, count + 1)
    return np.column_stack([np.cos(angles), np.sin(angles)])
