"""The starts that the evaluation compares: one row each, with all that tables, figures and clocks ask of it. Imports nothing heavy.

A new start is a new row of `STARTS`; one that is made in a new way needs a class here and its line in `starts.BUILDERS`, too. What
has no row here was given to a run (`given.py`): a rule of a user's, one of `grasp_env.force.RULES`, the model that the run fitted.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain

from grasp_env.errors import InvalidInputError


@dataclass(frozen=True)
class Named:
    """A start rule of `grasp_env.force`, by its name there."""

    name: str


@dataclass(frozen=True)
class Previous:
    """The previous solution, corrected to the new balance."""

    correction: str


@dataclass(frozen=True)
class Nearest:
    """The solution stored for the nearest wrench, corrected; of the fixed grasp and those near it."""

    correction: str


@dataclass(frozen=True)
class Model:
    """A saved model that ships with the package.

    Attributes:
        shipped: its name in the package.
    """

    shipped: str


@dataclass(frozen=True)
class Alone:
    """What the network of a model says, without any step."""

    model: str


@dataclass(frozen=True)
class Stepped:
    """Another start after a few plain Newton steps: the control of whatever takes such steps inside."""

    start: str
    steps: int


@dataclass(frozen=True)
class Remembering:
    """A model that also starts from the previous solution where that has less Phi: the first of `models` that is there."""

    models: tuple[str, ...]


@dataclass(frozen=True)
class Given:
    """What the run was given under this name."""


How = Named | Previous | Nearest | Model | Alone | Stepped | Remembering | Given


@dataclass(frozen=True)
class Row:
    """A start.

    Attributes:
        label: for tables.
        short: for legends.
        colours: on a light and on a dark page; no other line of a report has them.
        how: it is made, both for trials and, as a control loop has it, for the clock.
        dashed: whether its line is.
        main: whether it stands in the tables and figures that cannot show all.
    """

    label: str
    short: str
    colours: tuple[str, str]
    how: How
    dashed: bool = False
    main: bool = False

    @property
    def learned(self) -> bool:
        """Whether a saved model stands behind it, with its repair."""
        return isinstance(self.how, (Model, Remembering))

    @property
    def second_order(self) -> bool:
        """Whether it takes Newton steps, learned or plain, before a method begins; not known of one that was given."""
        correction = getattr(self.how, "correction", "")
        return isinstance(self.how, (Stepped, Remembering)) or correction == "tangent"

    @property
    def compiled(self) -> bool:
        """Whether a control loop has it in the method's own compiled call; the others return to Python in between."""
        return isinstance(self.how, (Model, Remembering)) or self.how in (
            Named("linear_combination"),
            Previous("tangent"),
        )

    @property
    def remembers(self) -> bool:
        """Whether the previous solution changes it."""
        return isinstance(self.how, (Previous, Remembering))


STARTS: dict[str, Row] = {
    "single_value": Row("single value", "single value", ("#767677", "#a4a4a5"), Named("single_value")),
    "phase_one": Row("phase one, the deepest force", "phase one", ("#6b7a12", "#b5c44a"), Named("phase_one")),
    "lagrange": Row("Lagrange", "Lagrange", ("#93651d", "#d3a04f"), Named("lagrange")),
    "linear_combination_printed": Row(
        "12-basis, as printed", "12-basis, printed", ("#3f87c9", "#8cc4f5"), Named("linear_combination_printed"), dashed=True
    ),
    "linear_combination": Row(
        "12-basis (the paper, fixed at w = 0)", "12-basis", ("#1f5fa8", "#4f9df0"), Named("linear_combination"), main=True
    ),
    "basis_tangent": Row(
        "12-basis, one Newton correction", "12-basis + Newton", ("#0e7c86", "#4fd0dc"), Stepped("linear_combination", 1)
    ),
    "basis_newton_2": Row(
        "12-basis, two Newton corrections", "12-basis + 2 Newton", ("#0a6b5c", "#5fc9b4"), Stepped("linear_combination", 2)
    ),
    "basis_newton": Row(
        "12-basis, four Newton corrections", "12-basis + 4 Newton", ("#123a7a", "#8fa8f0"), Stepped("linear_combination", 4),
        main=True,
    ),
    "previous_pseudoinverse": Row(
        "previous solution, G^+", "previous, G^+", ("#549354", "#a5d8a0"), Previous("pseudoinverse"), dashed=True
    ),
    "previous_tangent": Row(
        "previous solution, tangent", "previous, tangent", ("#1e7a3e", "#4fc47a"), Previous("tangent"), main=True
    ),
    "nearest_pseudoinverse": Row(
        "nearest of 10,000 stored, G^+", "nearest, G^+", ("#9273c4", "#c9b5f2"), Nearest("pseudoinverse"), dashed=True
    ),
    "nearest_tangent": Row(
        "nearest of 10,000 stored, tangent", "nearest, tangent", ("#6a3fa0", "#a985e8"), Nearest("tangent"), main=True
    ),
    "network": Row(
        "network alone, fixed grasp", "network alone", ("#7d3c98", "#d7a6ee"), Alone("learned_fixed"), main=True
    ),
    "network_newton_1": Row(
        "network, one Newton step", "network + Newton", ("#a0498f", "#e6a0d8"), Stepped("network", 1)
    ),
    "network_newton_2": Row(
        "network, two Newton steps", "network + 2 Newton", ("#5a1f7a", "#c08af5"), Stepped("network", 2)
    ),
    "learned_fixed": Row("learned, fixed grasp", "learned, fixed", ("#b3261e", "#ff7468"), Model("four_finger"), main=True),
    "learned_previous": Row(
        "learned, with the previous solution", "learned + previous", ("#c2187a", "#ff80c4"),
        Remembering(("learned_fixed",)), dashed=True, main=True,
    ),
}  # fmt: skip
"""Every start, in the order of the tables."""


def check(rows: dict[str, Row]) -> None:
    """Raises `InvalidInputError` for a row that is not whole: without words, without colours of its own, made of one that is not there."""
    every = list(chain.from_iterable(row.colours for row in rows.values()))
    for key, row in rows.items():
        if not row.label or not row.short:
            raise InvalidInputError(f"the start {key} needs a label and a short one")
        wrong = [
            colour for colour in row.colours if not re.fullmatch("#[0-9a-f]{6}", colour) or every.count(colour) > 1
        ]
        if wrong or len(row.colours) != 2:
            raise InvalidInputError(f"the start {key} needs two colours #rrggbb that no other has, got {row.colours}")
        how, before = row.how, list(rows)[: list(rows).index(key)]
        of = (how.model,) if isinstance(how, Alone) else how.models if isinstance(how, Remembering) else ()
        missing = [other for other in of if other not in rows or not isinstance(rows[other].how, Model)]
        missing += [how.start] if isinstance(how, Stepped) and how.start not in before else []
        if missing:
            raise InvalidInputError(
                f"the start {key} is made of {missing[0]}, which is no model, or no start before it"
            )


check(STARTS)
MAIN = tuple(key for key, row in STARTS.items() if row.main)
LEARNED = tuple(key for key, row in STARTS.items() if row.learned)
SHIPPED = {key: row.how.shipped for key, row in STARTS.items() if isinstance(row.how, Model)}
"""The models' names in the package."""
FITTED = "learned_fitted"
"""Under which name a run is given the model that it fits."""
GIVEN_COLOURS = (
    ("#8a5a44", "#d9a58c"), ("#006d9c", "#7fd4ff"), ("#a8326e", "#ffb0d8"), ("#4b6b00", "#c8e86a"), ("#5c4bc4", "#b9b0ff"),
    ("#00706b", "#6fe8da"), ("#9c4a00", "#ffc48a"), ("#5f5f00", "#dede7a"),
)  # fmt: skip
"""Of given starts, on a light and on a dark page, in their order: a run compares no more of them."""


def row_of(key: str) -> Row:
    """What tables say of a start; a given one is called by its name, a rule of the package by its label there.

    Example:
        >>> row_of("lagrange").label, row_of("my_rule").label, row_of("my_rule").main
        ('Lagrange', 'my rule', True)
    """
    if key in STARTS:
        return STARTS[key]
    from grasp_env.force import RULES  # loads the core, which most that read this table have no need of

    name = RULES[key].label if key in RULES else key.replace("_", " ")
    return Row(name, name, GIVEN_COLOURS[0], Given(), dashed=True, main=True)


def given_in(keys: Iterable[str]) -> list[str]:
    """Those that were given to a run."""
    return [key for key in keys if key not in STARTS]


def main_of(keys: Iterable[str]) -> list[str]:
    """Those that stand in what cannot show all, in the order of the tables."""
    return [key for key in keys if row_of(key).main]
