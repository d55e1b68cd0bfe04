"""Claims as data: a name, a query on the summary of a run, a comparison and a bound.

The claims of each kind of run are the lists `CLAIMS` in `starts_page`, `holds_page` and
`reproduce_page` of `training.evaluation.report`; benchmarks and `grasp rl` save theirs with the
run.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from training.evaluation.results.columns import KEYS
from training.evaluation.results.table import chosen, numbers, pd

COMPARISONS: dict[str, tuple[Callable[[Any, Any], Any], Callable[[Any], Any]]] = {
    "<=": (operator.le, np.max),
    "<": (operator.lt, np.max),
    ">=": (operator.ge, np.min),
    ">": (operator.gt, np.min),
    "within": (
        lambda value, bound: abs(value) <= bound,
        lambda values: values[np.abs(values).argmax()],
    ),
}
"""Comparison of a measured number with the bound, and choice of the worst of several numbers."""
VERDICTS = {False: "MISSED", None: "not measured", True: "met"}
"""Verdicts, in the order in which they are printed."""


@dataclass(frozen=True)
class Claim:
    """Bound that a number of a run should meet.

    Attributes:
        name: the claim in words.
        query: query for rows of the run's summary, as for `pandas.DataFrame.query`. The claim must
            hold in each of them.
        column: column of the summary.
        comparison: one of `COMPARISONS`.
        target: the bound.
        over: a second query. Its rows, paired by the other keys, divide the column, or are
            subtracted from it if `difference`.
        difference: see `over`.
        unit: unit of the bound.
    """

    name: str
    query: str
    column: str
    comparison: str
    target: float
    over: str = ""
    difference: bool = False
    unit: str = ""

    @classmethod
    def of(
        cls, name: str, query: str, bound: str, over: str = "", difference: bool = False
    ) -> Claim:
        """Make a claim from its bound as text, such as "drift_max < 1 mm"."""
        column, comparison, target, *unit = bound.split()
        return cls(name, query, column, comparison, float(target), over, difference, *unit)

    def values(self, rows: pd.DataFrame) -> np.ndarray:
        """Return the measured number of every selected row; nan if one of its cases has none."""
        mine = chosen(rows, self.query)
        if self.column not in rows.columns:
            return np.empty(0)
        missing = f"{self.column.rpartition('_')[0]}_missing"
        # percentiles ignore the cases without a number
        if missing in rows.columns and missing != self.column:
            known = np.where(numbers(mine, missing) > 0, np.nan, numbers(mine, self.column))
            mine = mine.assign(**{self.column: known})
        if not self.over:
            return numbers(mine, self.column)
        other = chosen(rows, self.over)
        # pair the rows by the keys that still have several values after both queries
        keys = [
            name
            for name in KEYS
            if name in rows.columns and min(mine[name].nunique(), other[name].nunique()) > 1
        ]
        if not keys:
            mine = mine.iloc[:1]
            other = other.iloc[:1]
        how = "left" if keys else "cross"
        paired: Any = mine.merge(other, how, keys or None, suffixes=("", "_over"))
        if other.empty or paired.empty:
            return np.empty(0)
        value = numbers(paired, self.column)
        base = numbers(paired, f"{self.column}_over")
        return value - base if self.difference else value / base


@dataclass(frozen=True)
class Verdict:
    """Verdict on a claim.

    Attributes:
        claim: the claim.
        measured: the worst number; None: this run did not measure it.
        met: the verdict; None: not measured.
    """

    claim: Claim
    measured: float | None
    met: bool | None

    @property
    def target(self) -> str:
        """Comparison and bound, as text."""
        return f"{self.claim.comparison} {self.claim.target:g} {self.claim.unit}".strip()

    @property
    def result(self) -> str:
        """Measured number, as text."""
        return "–" if self.measured is None else f"{self.measured:.4g} {self.claim.unit}".strip()


def judge(claims: Iterable[Claim], rows: pd.DataFrame) -> list[Verdict]:
    """Judge claims against the summary of a run.

    Missed claims come first, then those not measured, then those met. A claim is missed if one of
    its rows lacks the number.

    Example:
        >>> rows = pd.DataFrame({"case": ["ball", "ball"], "start": ["paper", "network"], "iterations_median": [45.0, 4.0]})
        >>> network = "start == 'network'"
        >>> few = Claim.of("few steps", network, "iterations_median <= 8")
        >>> share = Claim.of("a tenth of the paper's", network, "iterations_median <= 0.05", "start == 'paper'")
        >>> [(row.claim.name, row.target, row.result, row.met) for row in judge([few, share], rows)]
        [("a tenth of the paper's", '<= 0.05', '0.08889', False), ('few steps', '<= 8', '4', True)]
    """
    judged = []
    for claim in claims:
        values = claim.values(rows)
        compare, worst = COMPARISONS[claim.comparison]
        finite = values[np.isfinite(values)]
        met = (
            len(finite) == len(values) and bool(np.all(compare(values, claim.target)))
            if len(values)
            else None
        )
        judged.append(Verdict(claim, float(worst(finite)) if len(finite) else None, met))
    order = list(VERDICTS)
    return sorted(judged, key=lambda row: order.index(row.met))


def lines(judged: Sequence[Verdict]) -> Iterator[str]:
    """Yield two lines for each claim, for a terminal."""
    for row in judged:
        verdict = "" if row.met is None else VERDICTS[row.met]
        measured = "not measured in this run" if row.measured is None else f"measured {row.result}"
        yield f"{verdict:6}  {row.claim.name}\n        target {row.target}; {measured}"
