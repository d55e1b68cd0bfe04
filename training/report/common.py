"""What every report has: its claims first, its machine and versions last."""

from __future__ import annotations

from typing import Any

from training.report.model import Cell, Section, Table, at, flat, present
from training.runs.claims import ranked
from training.runs.words import number


def claims_section(metrics: dict[str, Any]) -> Section:
    """What was asked, what was measured; missed first, then not measured, then met."""
    verdicts = {False: Cell("NO", "bad"), None: Cell("not measured", "open"), True: Cell("yes", "good")}
    claims = ranked(metrics.get("claims", []))
    counts = {verdict: sum(row["met"] is verdict for row in claims) for verdict in verdicts}
    text = f"{counts[True]} of {len(claims)} met, {counts[False]} missed, {counts[None]} not measured in this run."
    rows = [[verdicts[row["met"]], pretty(row["claim"]), pretty(row["asked"]), row["measured"]] for row in claims]
    table = Table("Claims, the missed ones first", ("met", "claim", "asked", "measured"), rows, words=4)
    return Section("claims", "Claims", (text,), present([table]))


def pretty(text: str) -> str:
    """Signs instead of what is typed for them.

    Example:
        >>> pretty("G^+, force <= 2 N")
        'G⁺, force ≤ 2 N'
    """
    return text.replace("G^+", "G⁺").replace("<=", "≤")


def provenance_section(run: dict[str, Any]) -> Section:
    """Machine, versions, command and times."""
    machine, versions = at(run, "machine") or {}, at(run, "versions") or {}
    rule = at(run, "step_rule") or {}
    force, barrier = number(run.get("force_weight")), number(run.get("barrier_weight"))
    told = [
        ("machine", f"{machine.get('processor', '–')}, {number(machine.get('cores'))} cores, {machine.get('system', '–')}"),
        ("versions", ", ".join([f"Python {machine.get('python', '–')}", *(f"{name} {text}" for name, text in versions.items())])),
        *((name, str(run.get(key, "–"))) for name, key in (("commit", "commit"), ("when", "time"), ("command", "command"))),
        ("objective", f"ω = {force}, λ = {barrier} N², friction {number(run.get('friction'))}" if "force_weight" in run else ""),
        ("step rule, the same for all", ", ".join(f"{name} {text}" for name, text in flat(rule))),
        ("seeds", f"{run['seed']} and following" if "seed" in run else ""),
        ("settings", ", ".join(f"{name} {text}" for name, text in flat(at(run, "config") or {}) if name != "out")),
        ("seconds", ", ".join(f"{name.replace('_', ' ')} {text}" for name, text in flat(at(run, "seconds") or {}))),
    ]  # fmt: skip
    rows = [[name, text] for name, text in told if text]
    return Section("provenance", "Machine and versions", (), [Table("How this was made", ("", "value"), rows, words=2)])
