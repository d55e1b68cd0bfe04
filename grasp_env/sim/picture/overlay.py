"""What a picture of a grasp says besides the bodies: forces, friction cones, the wrench and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grasp_env import ranges
from grasp_env._check import Array, as_array, as_list, as_text, is_a, positive, together
from grasp_env.errors import InvalidInputError, shown
from grasp_env.sim.picture.canvas import FAINT, INK, WHITE, Canvas, Color
from grasp_env.sim.picture.view import View

PALETTE = ((0.85, 0.33, 0.24), (0.20, 0.50, 0.80), (0.95, 0.69, 0.20), (0.27, 0.65, 0.42), (0.55, 0.40, 0.75),
           (0.35, 0.70, 0.75), (0.80, 0.45, 0.60), (0.50, 0.55, 0.30))  # fmt: skip
"""Colours of fingers that were given none, red, green and blue in [0, 1]; beyond eight they repeat."""

WRENCH_COLOR = (150, 30, 140)
VEIL = 0.3
"""Contrast taken from the picture below."""

LONGEST = 0.08
"""The longest force arrow [m] where `Annotation.scale` leaves the scale to the picture."""

CONE_LENGTH = 0.042
"""Of the drawn friction cones along their axis [m]."""

WRENCH_STRETCH = 2.0
"""The wrench's force is drawn so many times longer than the fingers', which squeeze with more."""

_TURN_RADIUS = 0.03  # of the moment's arc [m]
_HALF_TURN = 0.1  # moment [N m] that is drawn as half of the longest arc
_INACTIVE = (150, 154, 162)
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 25)
_UNIT_CIRCLE = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])


@dataclass(frozen=True, eq=False)
class Annotation:
    """What to draw over a picture of a grasp with N contacts; everything in the world frame.

    Attributes:
        points: (N, 3) contacts [m].
        normals: (N, 3) unit normals, into the object.
        forces: (N, 3) commanded force of each finger ON the object [N].
        friction: (N,) coefficients; the drawn cones have the half angle atan(friction).
        active: (N,) whether the contact takes part; the others are drawn hollow and grey.
        wrench: (6,) force [N] and moment [N m] that act on the object from outside.
        center: (3,) where the wrench's force attacks [m].
        measured: (N, 3) measured force of each finger ON the object [N], a thin dark line; None: not drawn.
        lines: (label, value) pairs of the text panel.
        colors: (N, 3) of the fingers, red, green and blue in [0, 1]; None: `PALETTE`.
        scale: drawn length of a force [m/N]; None: see `force_scale`.

    Raises:
        InvalidInputError: a wrong shape, or numbers that are not finite.
    """

    points: Array
    normals: Array
    forces: Array
    friction: Array
    active: Array
    wrench: Array
    center: Array
    measured: Array | None = None
    lines: Sequence[tuple[str, str]] = ()
    colors: Array | None = None
    scale: float | None = None

    def __post_init__(self) -> None:
        count = len(as_array(self.points, (None, 3), "points"))
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("points", "normals", "forces"), (count, 3))
        shapes |= {"friction": (count,), "active": (count,), "wrench": (6,), "center": (3,)}
        shapes |= {name: (count, 3) for name in ("measured", "colors") if getattr(self, name) is not None}
        together(*(lambda name=name, shape=shape: self._keep(name, shape) for name, shape in shapes.items()))
        if self.scale is not None:
            object.__setattr__(self, "scale", positive(self.scale, "scale"))
        pairs = [[as_text(part) for part in as_list(pair) or ()] for pair in as_list(self.lines) or ()]
        if as_list(self.lines) is None or any(len(pair) != 2 or None in pair for pair in pairs):
            raise InvalidInputError(f"lines must be a list of (label, value) pairs of text, got {shown(self.lines)}")

    def _keep(self, name: str, shape: tuple[int, ...]) -> None:
        value = getattr(self, name)
        if name == "active":  # true and false are no numbers elsewhere
            each = as_list(value)
            if each is not None:
                value = [float(entry) if is_a(entry, bool | np.bool_) else entry for entry in each]
            elif is_a(value, np.ndarray) and value.dtype == np.bool_:
                value = value.astype(np.float64)
        object.__setattr__(self, name, as_array(value, shape, name, ranges.SIZE))

    @property
    def force_scale(self) -> float:
        """Drawn length of forces [m/N]: `scale`, or the largest of 1, 2, 5 x 10^k with which no arrow passes `LONGEST`."""
        if self.scale is not None:
            return self.scale
        arrows = np.vstack([self.forces * self.active[:, None], WRENCH_STRETCH * self.wrench[:3]])
        return round_down(LONGEST / max(float(np.linalg.norm(arrows, axis=1).max()), 1e-3))


def round_down(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is at most `value` > 0.

    Example:
        >>> [round_down(value) for value in (0.013, 0.02, 7.0)]
        [0.01, 0.02, 5.0]
    """
    power = int(np.floor(np.log10(value) + 1e-9))
    return next(float(f"{k}e{power}") for k in (5, 2, 1) if k <= value / 10.0**power * (1.0 + 1e-9) or k == 1)


def draw(image: np.ndarray, annotation: Annotation, view: View) -> np.ndarray:
    """The picture with the annotation over it, (H, W, 3) uint8.

    A force arrow ends at its contact and is `force_scale` times the force long, so a force inside its friction cone is
    drawn inside the drawn cone. The wrench's force starts at `center`; its moment is an arc that turns about its axis,
    the longer the larger. Bodies in front hide nothing.

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
    right = _write_lines(canvas, annotation.lines)
    canvas.flush()
    _write_legend(canvas, view, annotation, scale, right)
    return canvas.finish()


def _draw_contact(canvas: Canvas, view: View, annotation: Annotation, i: int, scale: float) -> None:
    point, normal, unit = annotation.points[i], annotation.normals[i], canvas.unit
    if not annotation.active[i]:
        place = view.project(point[None])[0]
        canvas.ring(place, 6.0 * unit, (*WHITE, 220), 4.6 * unit)
        canvas.ring(place, 6.0 * unit, _INACTIVE, 2.0 * unit)
        return
    first = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = first - (first @ normal) * normal
    first /= np.sqrt(first @ first)
    second = np.array([normal[1] * first[2] - normal[2] * first[1], normal[2] * first[0] - normal[0] * first[2],
                       normal[0] * first[1] - normal[1] * first[0]])  # fmt: skip
    rim = CONE_LENGTH * annotation.friction[i] * (_UNIT_CIRCLE @ np.array([first, second]))
    rim += point - CONE_LENGTH * normal
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
    if size > 1e-4:
        axis = moment / size
        first = np.cross(view.axes[1] if abs(axis @ view.axes[1]) < 0.9 else view.axes[0], axis)
        first /= np.linalg.norm(first)
        sweep = np.radians(300.0) * size / (size + _HALF_TURN)
        angles = np.linspace(0.0, max(sweep, 0.35), 28)
        circle = np.outer(np.cos(angles), first) + np.outer(np.sin(angles), np.cross(axis, first))
        arc = view.project(center + _TURN_RADIUS * circle)
        canvas.line(arc[:-3], (*WHITE, 220), 5.0 * canvas.unit)
        canvas.line(arc[:-3], WRENCH_COLOR, 2.6 * canvas.unit)
        canvas.arrow(arc[-6], arc[-1], WRENCH_COLOR, 2.6 * canvas.unit)
    start, end = view.project(np.array([center, center + scale * force]))
    canvas.arrow(start, end, WRENCH_COLOR, 5.0 * canvas.unit)
    canvas.disc(start, 3.4 * canvas.unit, WRENCH_COLOR)


def _write_lines(canvas: Canvas, lines: Sequence[tuple[str, str]]) -> float:
    """The text panel in the lower left corner; returns its right edge [pixels]."""
    if not lines:
        return 0.0
    pad, step = 8.0 * canvas.unit, canvas.text_height()
    column = max(canvas.text_width(label) for label, _ in lines) + 10.0 * canvas.unit
    width = column + max(canvas.text_width(value) for _, value in lines)
    left, top = 2.0 * pad, canvas.height - 2.0 * pad - step * len(lines)
    canvas.panel(left - pad, top - pad, left + width + pad, canvas.height - pad)
    for k, (label, value) in enumerate(lines):
        canvas.text(left, top + k * step, label, FAINT)
        canvas.text(left + column, top + k * step, value)
    return left + width + pad


def _write_legend(canvas: Canvas, view: View, annotation: Annotation, scale: float, taken: float) -> None:
    """The scale of the forces and the wrench's size: lower right, or upper right where `taken` pixels leave no room."""
    bars: list[tuple[Color, float, str]] = []
    for color, of, name in ((INK, scale, "finger"), (WRENCH_COLOR, WRENCH_STRETCH * scale, "wrench")):
        newtons = round_down(0.04 / of)
        ends = view.project(annotation.center + np.outer([0.0, newtons * of], view.axes[0]))
        bars.append((color, float(ends[1, 0] - ends[0, 0]), f"{newtons:g} N {name}"))
    force, moment = np.linalg.norm(annotation.wrench[:3]), np.linalg.norm(annotation.wrench[3:])
    size = f"wrench {force:.2f} N, {moment:.3f} N m"
    pad, step = 8.0 * canvas.unit, canvas.text_height(small=True)
    indent = max(bar for _, bar, _ in bars) + pad
    width = max(canvas.text_width(size, True), indent + max(canvas.text_width(text, True) for _, _, text in bars))
    left, top = canvas.width - 2.0 * pad - width, canvas.height - 2.0 * pad - 3 * step
    if left - pad < taken:
        top = 2.0 * pad
    canvas.panel(left - pad, top - pad, canvas.width - pad, top + 3 * step + pad)
    for k, (color, bar, text) in enumerate(bars):
        y = top + (k + 0.45) * step
        canvas.arrow(np.array([left, y]), np.array([left + bar, y]), color, 3.2 * canvas.unit)
        canvas.text(left + indent, top + k * step, text, small=True)
    canvas.text(left, top + 2 * step, size, WRENCH_COLOR, small=True)


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
