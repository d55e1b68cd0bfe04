"""Draws what a picture of a grasp says besides the bodies: forces, friction cones and the wrench; the words are `legend`'s."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grasp_env._check import Array
from grasp_env.sim.picture.annotation import LONGEST_TURN, PALETTE, WRENCH_COLOR, WRENCH_STRETCH, Annotation
from grasp_env.sim.picture.canvas import INACTIVE, INK, WHITE, Canvas, Color
from grasp_env.sim.picture.legend import write
from grasp_env.sim.picture.view import View

VEIL = 0.2
"""Contrast taken from the picture below."""

CONE_LENGTH = 0.036
"""Of the drawn friction cones' sides [m]."""

_TURN_RADIUS = 0.03  # of the moment's arc [m]
_LEAST_TURN = 0.15  # [rad] that can still be seen to turn
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 25)
_UNIT_CIRCLE = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])


def draw(image: np.ndarray, annotation: Annotation, view: View) -> np.ndarray:
    """The picture with the annotation over it, (H, W, 3) uint8.

    A force arrow ends at its contact and is `force_scale` times the force long, so a force inside its friction cone is
    drawn inside the drawn cone. The wrench's force starts at `center`; its moment is an arc that turns about its axis, by
    `moment_scale` times the moment. Bodies in front hide nothing.

    Args:
        image: (H, W, 3) uint8, taken with `view`; not written.
        annotation: what to draw.
        view: where the camera stood.
    """
    canvas, scale = Canvas(image, VEIL), annotation.force_scale
    for i in np.argsort(-view.depth(annotation.points), kind="stable").tolist():
        _draw_contact(canvas, view, annotation, i, scale)
    _draw_wrench(canvas, view, annotation, WRENCH_STRETCH * scale)
    canvas.flush()
    write(canvas, view, annotation)
    return canvas.finish()


def _draw_contact(canvas: Canvas, view: View, annotation: Annotation, i: int, scale: float) -> None:
    point, normal, unit = annotation.points[i], annotation.normals[i], canvas.unit
    if not annotation.active[i]:
        place = view.project(point[None])[0]
        canvas.ring(place, 6.0 * unit, (*WHITE, 220), 4.6 * unit)
        canvas.ring(place, 6.0 * unit, INACTIVE, 2.0 * unit)
        return
    first = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = first - (first @ normal) * normal
    first /= np.sqrt(first @ first)
    second = np.array([normal[1] * first[2] - normal[2] * first[1], normal[2] * first[0] - normal[0] * first[2],
                       normal[0] * first[1] - normal[1] * first[0]])  # fmt: skip
    length = CONE_LENGTH / np.sqrt(1.0 + annotation.friction[i] ** 2)
    rim = length * annotation.friction[i] * (_UNIT_CIRCLE @ np.array([first, second]))
    rim += point - length * normal
    force = annotation.forces[i]
    measured = force if annotation.measured is None else annotation.measured[i]
    pixels = view.project(np.vstack([rim, point, point - scale * force, point - scale * measured]))
    mouth, (place, tail, seen) = pixels[:-3], pixels[-3:]
    color = _color(annotation, i)
    outline = _hull(pixels[:-2])
    canvas.polygon(outline, (*color, 70))
    canvas.line(np.vstack([outline, outline[:1]]), (*color, 170), 1.1 * unit)
    canvas.polygon(mouth, (*color, 45))
    canvas.line(mouth, (*color, 190), 1.1 * unit)
    canvas.arrow(tail, place, color, 5.0 * unit)
    if annotation.measured is not None:
        canvas.line(np.array([seen, place]), INK, 1.4 * unit)
    canvas.disc(place, 3.6 * unit, WHITE)
    canvas.disc(place, 2.6 * unit, color)


def _draw_wrench(canvas: Canvas, view: View, annotation: Annotation, scale: float) -> None:
    center, force, moment = annotation.center, annotation.wrench[:3], annotation.wrench[3:]
    if not annotation.wrench.any():
        return
    size = float(np.linalg.norm(moment))
    if annotation.moment_scale * size > _LEAST_TURN:
        axis = moment / size
        first = np.cross(view.axes[1] if abs(axis @ view.axes[1]) < 0.9 else view.axes[0], axis)
        first /= np.linalg.norm(first)
        angles = np.linspace(0.0, min(annotation.moment_scale * size, 1.1 * LONGEST_TURN), 28)
        circle = np.outer(np.cos(angles), first) + np.outer(np.sin(angles), np.cross(axis, first))
        arc = view.project(center + _TURN_RADIUS * circle)
        canvas.line(arc[:-3], (*WHITE, 220), 5.0 * canvas.unit)
        canvas.line(arc[:-3], WRENCH_COLOR, 2.6 * canvas.unit)
        canvas.arrow(arc[-7], arc[-1], WRENCH_COLOR, 3.4 * canvas.unit)
    start, end = view.project(np.array([center, center + scale * force]))
    canvas.arrow(start, end, WRENCH_COLOR, 5.0 * canvas.unit)
    canvas.disc(start, 3.4 * canvas.unit, WRENCH_COLOR)


def _color(annotation: Annotation, i: int) -> Color:
    """A finger's colour, a little darker than its links, 0 to 255."""
    color = PALETTE[i % len(PALETTE)] if annotation.colors is None else annotation.colors[i]
    return tuple(int(np.clip(215.0 * part, 0.0, 255.0)) for part in color)


def _hull(points: Array) -> Array:
    """Convex hull (K, 2) of points (N, 2) in order around it; Andrew's monotone chain."""
    ordered = sorted(map(tuple, points.tolist()))

    def half(sequence: Sequence[tuple[float, ...]]) -> list[tuple[float, ...]]:
        chain: list[tuple[float, ...]] = []
        for x, y in sequence:
            while len(chain) > 1:
                (ax, ay), (bx, by) = chain[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0.0:
                    break
                chain.pop()
            chain.append((x, y))
        return chain[:-1]

    return np.array(half(ordered) + half(ordered[::-1]))
