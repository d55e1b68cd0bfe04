"""What was asked of the core's speed against that of the compiled Python it replaced, and whether it is met."""

from __future__ import annotations

from typing import Any

LARGE = 50
"""Contacts from which on a bound of its own holds where one was asked."""
RATIOS: tuple[tuple[str, str, str, float, float | None], ...] = (
    ("newton, compiled", "newton", "asked", 0.5, None),
    ("newton from Python", "newton_python", "asked", 0.42, 0.4),
    ("newton from the learned layers of any grasp, from Python", "learned_any", "asked", 0.45, None),
    ("conic, compiled", "conic", "asked", 1.05, None),
    ("conic, compiled", "conic", "goal", 0.95, None),
    ("conic from Python", "conic_python", "asked", 0.65, 0.7),
    ("ForcePipeline, newton", "pipeline_newton", "asked", 0.35, None),
    ("Grasp.from_contacts", "from_contacts", "goal", 0.3, None),
    ("Grasp.unchecked", "unchecked", "goal", 0.3, None),
    ("reduced_flow from Python", "flow", "goal", 0.6, None),
)
"""(text, row, asked or goal, largest ratio of medians, the same from `LARGE` contacts on)."""
START_S = 0.5
"""Most seconds from the start of a process to its first force, nothing cached."""


def asked_of(row: str, count: int) -> float | None:
    """The largest ratio asked (or hoped) of a row, None where there is none."""
    return next(
        (large if large and count >= LARGE else limit for _, key, _, limit, large in RATIOS if key == row), None
    )


def claims(rows: list[dict[str, Any]], starts: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """[{claim, kind, asked, measured, met}]: of a ratio the worst over the numbers of contacts; none without a baseline."""
    out = []
    for text, key, kind, limit, large in RATIOS:
        of_row = [row for row in rows if row["method"] == key and "ratio_p50" in row]
        groups = [("", limit, of_row)]
        if large is not None:
            groups = [
                (f", N < {LARGE}", limit, [row for row in of_row if row["contacts"] < LARGE]),
                (f", N >= {LARGE}", large, [row for row in of_row if row["contacts"] >= LARGE]),
            ]
        for where, bound, group in groups:
            if group:
                worst = max(group, key=lambda row: row["ratio_p50"])
                measured = f"{worst['ratio_p50']:.3f} (N = {worst['contacts']}, the worst)"
                out.append(_claim(f"{text}{where}: time over the baseline's", kind, f"{bound:g}", measured,
                                  worst["ratio_p50"] <= bound))  # fmt: skip
    for row in starts:
        if row["side"] == "now":
            met = row["median_s"] <= START_S
            out.append(_claim(f"first solve of a new process, {row['method']}, nothing cached", "asked", f"{START_S:g} s",
                              f"{row['median_s']:.3g} s", met))  # fmt: skip
    return out


def _claim(text: str, kind: str, bound: str, measured: str, met: bool) -> dict[str, Any]:
    return {"claim": text, "kind": kind, "asked": f"at most {bound}", "measured": measured, "met": met}
