"""Claims: what was asked, what was measured, the verdict. One form for reports, benchmarks and terminals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

Claim = dict[str, Any]
"""{kind, claim, asked, measured, met}; `met` is None where a run did not measure it."""
VERDICTS: dict[bool | None, str] = {False: "MISSED", None: "not measured", True: "met"}
"""The verdicts, in the order in which they are told."""
_BOUNDS = {
    "at least": lambda value, bound: value >= bound,
    "at most": lambda value, bound: value <= bound,
    "below": lambda value, bound: value < bound,
}


def claim(text: str, asked: str, measured: str | None, met: bool | None, kind: str = "target") -> Claim:
    """One claim.

    Args:
        text: what is claimed.
        asked: the number asked for, in words.
        measured: the number measured, in words; None: this run did not measure it.
        met: the verdict.
        kind: "target" (a number that the project asks of itself), "guarantee" (true by construction, checked), "reference" (a
            number measured before, which this run should find again), or what a benchmark calls it.
    """
    if measured is None:
        measured, met = "not measured in this run", None
    return {
        "kind": kind,
        "claim": text,
        "asked": asked,
        "measured": measured,
        "met": None if met is None else bool(met),
    }


def bounded(
    text: str, word: str, bound: float, value: float, unit: str = "", said: str = "", kind: str = "target"
) -> Claim:
    """A claim about one number.

    Args:
        text: what is claimed.
        word: "at least", "at most" or "below".
        bound: asked for.
        value: measured.
        unit: of both.
        said: after the measured number.
        kind: see `claim`.

    Example:
        >>> row = bounded("first solve", "at most", 0.5, 0.3, "s")
        >>> row["asked"], row["measured"], row["met"]
        ('at most 0.5 s', '0.3 s', True)
    """
    unit = f" {unit}" if unit else ""
    return claim(text, f"{word} {bound:g}{unit}", f"{value:.4g}{unit}{said}", _BOUNDS[word](value, bound), kind)


def ranked(claims: Sequence[Claim]) -> list[Claim]:
    """The missed ones first, then those that were not measured, then those that are met."""
    return sorted(claims, key=lambda row: list(VERDICTS).index(row["met"]))


def told(claims: Sequence[Claim]) -> Iterator[str]:
    """Two lines for each, for a terminal."""
    for row in ranked(claims):
        verdict = VERDICTS[row["met"]] if row["met"] is not None else ""
        yield f"{verdict:6}  {row['claim']}\n        asked {row['asked']}; measured {row['measured']}"
