"""Picture of a recording of a hand's controller, for `grasp replay`."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from grasp_env.control import Recording
from grasp_env.control.recording import ACTIVATE, FOREIGN, STATUSES, UPDATE
from grasp_env.inputs.arguments import Array
from grasp_env.inputs.files import replacing
from training.evaluation.report.page import INK, STYLE, axes

COLORS = {
    "inactive": "#ffffff",
    "holding": "#e3f1e1",
    "marginal": "#f3ecb4",
    "overloaded": "#f6cfa4",
    "pivoting": "#cfdcf3",
    "slipping": "#f4bcbc",
    "coasting": "#dcc9ea",
    "released": "#e4e4e4",
}
"""Colour of the background while a controller has this status."""
FINGERS = ("#1f5fbf", "#c8551b", "#1b8a5a", "#8a2f8f", "#8a6d00", "#008a9a", "#b0274f", "#555555")
NAMED = 3
"""Number of joints with the largest torques, whose lines have colours."""
GREY = "#8d9096"
_SIZE = (9.0, 7.6)  # width and height [in]
_MOST = 1e6  # [N] that the picture shows
_MOST_SHARE = 1.6  # of friction, that the picture shows


def write_picture(recording: Recording, path: Path) -> None:
    """Draw normal forces, shares of friction, shares of torque limits and status over time."""
    figure, panels = axes(_SIZE[1], _SIZE[0], rows=3)
    rows = recording["event"] != ACTIVATE
    rows |= ~np.isin(recording["event"], (UPDATE, FOREIGN)).any()
    times = recording.times[rows]
    with rc_context(STYLE):
        lines = _forces(panels[0], times, recording["force"][rows, :, 0].clip(-_MOST, _MOST))
        _friction(panels[1], times, recording["friction_used"][rows], recording.header)
        joints = _torques(panels[2], times, torque_shares(recording)[rows])
        shown = _statuses(panels, times, recording["status"][rows].astype(int))
        panels[-1].set_xlabel("time [s]")
        panels[-1].set_xlim(0.0, max(times[-1], 1e-9))
        patches = [Patch(facecolor=COLORS[name], edgecolor="#b0b0b0", label=name) for name in shown]
        where: dict[str, Any] = {"frameon": False, "borderaxespad": 0.0, "fontsize": 9.5}
        figure.legend(handles=patches, loc="outside upper left", ncols=len(patches), **where)
        for panel, handles in zip(panels, (lines, _LIMITS, joints), strict=True):
            panel.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.01, 1.0), **where)
        image = io.BytesIO()
        figure.savefig(image, format="png", dpi=150)
    with replacing(path) as hidden:
        hidden.write_bytes(image.getbuffer())


def torque_shares(recording: Recording) -> Array:
    """Return torques (K, M) as shares of their limits; of a limit of 0, nan or infinity."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return recording["torques"] / recording.limits


_LIMITS = [
    Line2D([], [], color=INK, linewidth=1.0, label="slips above"),
    Line2D([], [], color=INK, linewidth=1.0, linestyle=(0, (4, 2)), label="friction_margin"),
]


def _forces(panel: Any, times: Array, forces: Array) -> list[Any]:
    panel.set_ylabel("normal force [N]")
    return [
        panel.plot(times, force, color=FINGERS[k % len(FINGERS)], label=f"finger {k}")[0]
        for k, force in enumerate(forces.T)
    ]


def _friction(panel: Any, times: Array, shares: Array, header: dict[str, Any]) -> None:
    panel.set_ylabel("share of friction used [1]")
    finite = np.where(np.isfinite(shares), shares, np.nan)
    for k, share in enumerate(finite.T):
        panel.plot(times, share, color=FINGERS[k % len(FINGERS)], linewidth=1.2)
    largest = np.nan_to_num(finite).max(initial=0.0)
    panel.set_ylim(0.0, min(max(1.1, 1.05 * largest), _MOST_SHARE))
    for style, at in zip(_LIMITS, (1.0, header["settings"]["friction_margin"]), strict=True):
        panel.axhline(at, color=INK, linewidth=1.0, linestyle=style.get_linestyle())


def _torques(panel: Any, times: Array, shares: Array) -> list[Any]:
    panel.set_ylabel("torque / its limit [1]")
    finite = np.where(np.isfinite(shares), shares, np.nan)
    sizes = np.nan_to_num(np.abs(finite))
    peaks = sizes.max(axis=0, initial=0.0)
    order = np.lexsort((-sizes.sum(axis=0), -peaks.round(3)))
    handles = []
    for joint in order[NAMED:]:
        others = panel.plot(times, finite[:, joint], color=GREY, linewidth=0.6, label="others")
        handles = others
    for color, joint in zip(FINGERS, order[:NAMED].tolist(), strict=False):
        line = panel.plot(
            times, finite[:, joint], color=color, linewidth=0.9, label=f"joint {joint}", zorder=3
        )
        handles = [*handles[:-1], *line, *handles[-1:]] if len(order) > NAMED else [*handles, *line]
    edge = min(1.1 * max(peaks.max(initial=0.0), 0.05), 1.1)
    panel.set_ylim(-edge, edge)
    return handles


def _statuses(panels: Any, times: Array, statuses: Any) -> list[str]:
    """Colour the background of each span of equal status; return the names that occur."""
    begins = np.flatnonzero(np.diff(statuses, prepend=-1))
    # a row shows what holds from the update before to it
    left = np.where(begins == 0, 0.0, times[np.maximum(begins - 1, 0)])
    right = np.append(left[1:], times[-1])
    spans = np.column_stack([left, right - left])
    names = []
    for number, name in enumerate(STATUSES):
        of_it = spans[statuses[begins] == number]
        if not len(of_it):
            continue
        names.append(name)
        for panel in panels:
            panel.broken_barh(
                of_it.tolist(),
                (0.0, 1.0),
                transform=panel.get_xaxis_transform(),
                facecolor=COLORS[name],
                linewidth=0.0,
                zorder=0.0,
            )
    return names
