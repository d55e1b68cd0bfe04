"""How things look on the page: colours, unit meshes, lengths of arrows, numbers as HTML."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence

import numpy as np
import trimesh

from grasp_env._check import Array
from grasp_env.force import RULES
from training.live.question import Mood

FINGERS = np.array([(196, 72, 56), (42, 108, 176), (214, 148, 36), (46, 140, 84), (124, 86, 172), (60, 150, 160), (186, 92, 132), (112, 122, 62)], np.uint8)  # fmt: skip
"""Of contacts and fingers; beyond eight they repeat."""
LOAD, MOMENT = (150, 30, 140), (206, 98, 190)
BODY, BAD = (148, 163, 184), (214, 48, 49)
EDGES, QUIET = (90, 104, 124), (120, 130, 145)
MOODS = {Mood.GOOD: (46, 140, 84), Mood.WARNING: (214, 148, 36), Mood.BAD: BAD}
CONE_HEIGHT = 0.3
"""Of drawn friction cones, in the extent of the object."""
STARTS = (*RULES, "previous", "learned")
"""Start rules to choose from, by their names on the command line."""
_STYLE = """<style>
.g{font:13px/1.45 system-ui,sans-serif;padding:2px 10px 6px}.g b{font-weight:600}.g p{margin:4px 0}
.g .s{font-size:17px;font-weight:650;display:flex;align-items:center;gap:8px;margin:2px 0 4px}
.g .s i{width:11px;height:11px;border-radius:50%;display:inline-block}
.g table{width:100%;border-collapse:collapse;font-variant-numeric:tabular-nums;margin:6px 0 2px}
.g td,.g th{padding:1px 0 1px 6px;text-align:right;font-weight:400}.g th{opacity:.62;font-size:12px}
.g td:first-child,.g th:first-child{text-align:left;padding-left:0}.g .d{width:9px;height:9px;border-radius:2px;display:inline-block;margin-right:6px}
.g .a{border-left:3px solid #d6942a;padding-left:8px;margin-top:8px}
</style>"""


def colours(count: int) -> np.ndarray:
    """(N, 3) uint8 of contacts."""
    return FINGERS[np.arange(count) % len(FINGERS)]


def tint(color: Iterable[float]) -> tuple[int, int, int]:
    """A colour of a description, parts in [0, 1], as bytes."""
    red, green, blue = (round(255.0 * min(max(part, 0.0), 1.0)) for part in color)
    return red, green, blue


def css(colour: Iterable[int]) -> str:
    """A colour for HTML."""
    return "#" + "".join(f"{int(part):02x}" for part in colour)


def cone(sections: int = 40) -> tuple[Array, np.ndarray]:
    """Corners and faces of a mantle with its tip at the origin, height and radius 1, opening along z."""
    angles = 2.0 * np.pi * np.arange(sections) / sections
    rim = np.column_stack([np.cos(angles), np.sin(angles), np.ones(sections)])
    around = np.arange(sections)
    return np.vstack([np.zeros(3), rim]), np.column_stack(
        [np.zeros_like(around), 1 + around, 1 + (around + 1) % sections]
    )


def ball(sections: int = 3) -> tuple[Array, np.ndarray]:
    """Corners and faces of a unit ball."""
    mesh = trimesh.creation.icosphere(sections)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def sharp_edges(mesh: trimesh.Trimesh) -> Array:
    """The edges (E, 2, 3) at which a mesh bends by more than 30 degrees."""
    bent = mesh.face_adjacency_angles > math.radians(30.0)
    return np.asarray(mesh.vertices[mesh.face_adjacency_edges[bent]])


def along(directions: Array) -> Array:
    """Quaternions wxyz (N, 4) that turn z into unit directions (N, 3)."""
    x, y, z = directions.T
    made = np.column_stack([1.0 + z, -y, x, np.zeros(len(z))])
    made[z < -1.0 + 1e-9] = (0.0, 1.0, 0.0, 0.0)
    return made / np.linalg.norm(made, axis=1, keepdims=True)


def arc(centre: Array, axis: Array, radius: float, sweep: float, pieces: int = 36) -> Array:
    """Pieces (P, 2, 3) of a circle about an axis, `sweep` [rad] long."""
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    angles = np.linspace(0.0, sweep, pieces + 1)
    points = centre + radius * (np.outer(np.cos(angles), first) + np.outer(np.sin(angles), np.cross(axis, first)))
    return np.stack([points[:-1], points[1:]], axis=1)


def round_number(value: float) -> float:
    """The number of one digit nearest to `value`, for a legend's bar.

    Example:
        >>> round_number(0.0231), round_number(7.4)
        (0.02, 7.0)
    """
    return float(f"{value:.0e}")


def said(status: str, words: str, colour: Iterable[int], rest: str = "", advice: Sequence[str] = ()) -> str:
    """The head of the panel: a status, what it means, a table or more, what looks wrong."""
    warned = "".join(f'<p class="a">{html.escape(text)}</p>' for text in advice)
    return (
        f'{_STYLE}<div class="g"><div class="s"><i style="background:{css(colour)}"></i><span id="status">{html.escape(status)}</span></div>'
        f"<p>{html.escape(words)}</p>{rest}{warned}</div>"
    )


def table(head: Sequence[str], rows: Iterable[Sequence[str]], dots: np.ndarray | None = None) -> str:
    """Rows of text under a head; the first column has a colour before it where `dots` (N, 3) are given."""
    lines = "<tr>" + "".join(f"<th>{html.escape(cell)}</th>" for cell in head) + "</tr>" if head else ""
    for k, row in enumerate(rows):
        dot = "" if dots is None else f'<span class="d" style="background:{css(dots[k])}"></span>'
        cells = [dot + html.escape(row[0]), *map(html.escape, row[1:])]
        lines += "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
    return f"<table>{lines}</table>"
