"""The words of a picture: what is seen at the top; numbers and what the drawn things mean at the bottom."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from grasp_env._check import Array
from grasp_env.sim.picture.annotation import WRENCH_COLOR, WRENCH_STRETCH, Annotation, round_down
from grasp_env.sim.picture.canvas import ALARM, FAINT, INACTIVE, INK, Canvas
from grasp_env.sim.picture.view import View

BAR = 0.03
"""The longest bar of a force [m]."""

MOST = 0.4
"""Of the picture's height: where words would take more, it is too small for them."""


class _Entry(NamedTuple):
    """What a drawn thing means: its size [pixels], how it is drawn to the right of a point, its words."""

    width: float
    draw: Callable[[Array], None]
    text: str


def room(width: int, height: int) -> tuple[float, float]:
    """Margin and footer of a camera [parts of the height] that leave a picture's words their place."""
    canvas = Canvas(np.zeros((height, width, 3), np.uint8))
    pad = 8.0 * canvas.unit
    above, below = pad + canvas.text_height(), 4.5 * pad + _told(canvas) + 2.0 * canvas.text_height(small=True)
    return min(max(0.06, above / height), 0.2), min(max(0.06, below / height), MOST)


def write(canvas: Canvas, view: View, annotation: Annotation) -> None:
    """Title and hand at the top, a band at the bottom; nothing in pictures too small for it.

    The band's columns are where they are whatever the numbers, so that nothing jumps in a film.
    """
    pad, step, small = 8.0 * canvas.unit, canvas.text_height(), canvas.text_height(small=True)
    left, right = 2.0 * pad, canvas.width - 2.0 * pad
    table = _entries(canvas, view, annotation)
    if _width(canvas, table) > right - left:
        table = [[entry] for row in table for entry in row]
    told = _told(canvas) if annotation.lines else 0.0
    height = told + small * len(table)
    if height + 3.0 * pad > MOST * canvas.height or _width(canvas, table) > right - left:
        return
    top = canvas.height - 2.0 * pad - height
    canvas.panel(left - pad, top - pad, right + pad, canvas.height - pad)
    canvas.flush()
    for k, (label, value) in enumerate(annotation.lines):
        x, alarmed = left + k * (right - left) / len(annotation.lines), bool(annotation.alarm) and k == 0
        canvas.text(x, top, label, ALARM if alarmed else FAINT, small=True)
        canvas.text(x, top + small, value, ALARM if alarmed else INK)
    spare, x = (right - left - _width(canvas, table)) / len(table[0]), left
    for column in zip(*table, strict=True):
        icon = max(entry.width for entry in column) + _GAP * canvas.unit
        for k, entry in enumerate(column):
            y = top + told + k * small
            entry.draw(np.array([x, y + 0.5 * small]))
            canvas.text(x + icon, y, entry.text, small=True)
        x += _width(canvas, [[entry] for entry in column]) + spare
    canvas.text(left, pad, annotation.title)
    if canvas.text_width(annotation.title + annotation.hand) + 2.0 * pad < right - left:
        canvas.text(right - canvas.text_width(annotation.hand), pad, annotation.hand, FAINT)
    canvas.text(left, pad + step, annotation.alarm, ALARM)


def _told(canvas: Canvas) -> float:
    """Pixels that the numbers take, with their labels above them."""
    return canvas.text_height(small=True) + canvas.text_height() + 5.0 * canvas.unit


_GAP = 6.0  # between what is drawn and its words, and half of that between columns


def _width(canvas: Canvas, table: Sequence[Sequence[_Entry]]) -> float:
    """Pixels that rows of entries take side by side."""
    return sum(
        max(entry.width for entry in column)
        + max(canvas.text_width(entry.text, True) for entry in column)
        + 2.0 * _GAP * canvas.unit
        for column in zip(*table, strict=True)
    )


def _entries(canvas: Canvas, view: View, annotation: Annotation) -> Sequence[Sequence[_Entry]]:
    """What is drawn, two rows: of the fingers; of the wrench, and a contact lost."""
    unit, scale = canvas.unit, annotation.force_scale
    moment = round_down(0.5 * np.pi / annotation.moment_scale)
    angles = np.linspace(0.0, moment * annotation.moment_scale, 12)
    arc = (
        20.0 * unit * np.column_stack([np.cos(angles) - np.cos(angles[-1]), 0.5 * np.sin(angles[-1]) - np.sin(angles)])
    )
    cone = 9.0 * unit * np.array([[2.0, 0.0], [0.0, -0.7], [0.0, 0.7]])
    ring = np.array([6.0 * unit, 0.0])

    def draw_cone(at: Array) -> None:
        canvas.polygon(at + cone, (*INACTIVE, 90))
        canvas.line(at + cone[[0, 1, 2, 0]], INACTIVE, 1.2 * unit)

    def draw_arc(at: Array) -> None:
        canvas.line(at + arc[:-3], WRENCH_COLOR, 2.2 * unit)
        canvas.arrow(at + arc[-6], at + arc[-1], WRENCH_COLOR, 2.2 * unit)

    newtons, bar = _bar(view, annotation, scale)
    others, longer = _bar(view, annotation, WRENCH_STRETCH * scale)
    measured = _Entry(bar[0], lambda at: canvas.line(np.array([at, at + bar]), INK, 1.4 * unit), "measured")
    return (
        [
            _Entry(bar[0], lambda at: canvas.arrow(at, at + bar, INK, 3.2 * unit), f"commanded {newtons:g} N"),
            measured if annotation.measured is not None else _Entry(0.0, lambda at: None, ""),
            _Entry(18.0 * unit, draw_cone, "friction cone"),
        ],
        [
            _Entry(longer[0], lambda at: canvas.arrow(at, at + longer, WRENCH_COLOR, 3.2 * unit), f"wrench {others:g} N"),
            _Entry(20.0 * unit, draw_arc, f"moment {moment:g} N m"),
            _Entry(12.0 * unit, lambda at: canvas.ring(at + ring, 4.5 * unit, INACTIVE, 1.8 * unit), "contact lost"),
        ],
    )  # fmt: skip


def _bar(view: View, annotation: Annotation, scale: float) -> tuple[float, Array]:
    """A round number of newtons and their arrow [pixels] at that scale [m/N]."""
    newtons = round_down(BAR / scale)
    ends = view.project(annotation.center + np.outer([0.0, newtons * scale], view.axes[0]))
    return newtons, np.array([float(ends[1, 0] - ends[0, 0]), 0.0])
