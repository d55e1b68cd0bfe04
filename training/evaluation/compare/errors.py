"""Controllers under errors of a real hand: settings are chosen on some seeds and compared on others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from training.evaluation.compare.scenarios import (
    CONTROL_RATE,
    EQUAL,
    GROUPS,
    RANDOM_WRENCH,
    RATES,
    RIVALS,
    ROBUST,
    SMALL_OBJECTS,
    WEAK_WRENCH,
    Group,
    Scenario,
    short_name,
)
from training.evaluation.results.table import Rows, chosen, pd, summary

TUNING, REPORT = "tuning", "report"
"""Parts of a run. Their seeds differ."""
APART = 100
"""Least number of seeds from the first one of the tuning to the first one of the report."""
TIED = 0.02
"""Share of the episodes by which candidates may differ and count as equal: less than chance."""
Stage = Callable[[pd.DataFrame], list[Scenario]]
"""Function from the rows of all stages before to the scenarios of the next one."""


@dataclass(frozen=True)
class Errors:
    """Plan of a comparison of `RIVALS` under the errors of `GROUPS`.

    Attributes:
        hands: names or files.
        engines: keys of `RATES`.
        tuning: number of seeds on which settings are chosen.
        episodes: number of other seeds, on which the rivals are compared.
    """

    hands: tuple[str, ...]
    engines: tuple[str, ...]
    tuning: int
    episodes: int

    def stages(self) -> list[Stage]:
        """Return the stages: the tuning, the report, and equal forces."""
        return [self.tuned, self.compared, self.equal]

    def tuned(self, rows: pd.DataFrame) -> list[Scenario]:
        """Plan the candidates of every rival that has several, on the hardest errors."""
        return [
            self.scenario(TUNING, case, rival, place, candidate)
            for place in product(self.hands, self.engines)
            for key, group in GROUPS.items()
            for rival, about in RIVALS.items()
            for candidate in about.candidates.get(key, ())
            for case in group.tuned_on
            if len(about.candidates[key]) > 1
        ]

    def compared(self, rows: pd.DataFrame) -> list[Scenario]:
        """Plan the chosen candidate of every rival, on all errors."""
        picked = choices(summary(rows))
        return [
            self.scenario(REPORT, case, rival, (hand, engine), choice.settings)
            for hand, engine in product(self.hands, self.engines)
            for key, group in GROUPS.items()
            for rival in RIVALS
            if (choice := picked.get((short_name(hand), engine, key, rival)))
            for case in group.errors
        ]

    def equal(self, rows: pd.DataFrame) -> list[Scenario]:
        """Plan the constant squeeze with the mean commanded force of `ROBUST` in the same row."""
        forces = equal_forces(summary(rows))
        return [
            self.scenario(REPORT, case, EQUAL, (hand, engine), {"squeeze": force})
            for hand, engine in product(self.hands, self.engines)
            for group in GROUPS.values()
            for case in group.errors
            if (force := forces.get((short_name(hand), engine, case)))
        ]

    def scenario(
        self,
        part: str,
        case: str,
        rival: str,
        place: tuple[str, str],
        settings: Mapping[str, float],
    ) -> Scenario:
        """Return the scenario of a rival at a hand and an engine, with settings of the controller.

        In the tuning these are keys of the rows. A rival without a margin of its own takes hold
        with that of the group.
        """
        hand, engine = place
        group = next(group for group in GROUPS.values() if case in group.errors)
        keys = {"part": part, "hand": short_name(hand), "engine": engine, "controller": rival}
        tuning = part == TUNING
        load = RANDOM_WRENCH if hand == "four_finger" else {**SMALL_OBJECTS, **WEAK_WRENCH}
        return Scenario(
            case,
            {**keys, **settings} if tuning else keys,
            self.tuning if tuning else self.episodes,
            {
                "hand": hand,
                "engine.rate": RATES[engine],
                "controller.rate": CONTROL_RATE,
                **load,
                "controller.friction_margin": group.margin,
                **group.errors[case].settings,
                **RIVALS[rival].settings,
                **{f"controller.{name}": value for name, value in settings.items()},
            },
            (engine,),
            same_grasp=group.margin,
            skipped=0 if tuning else max(self.tuning, APART),
        )


@dataclass(frozen=True)
class Choice:
    """A candidate of a rival, and how it did in the tuning.

    Attributes:
        settings: the candidate.
        held, episodes: number of episodes that it held, and of all; 0 without tuning.
        force: sum of the normal forces [N], mean; None without tuning, or if no episode began.
    """

    settings: dict[str, float]
    held: int
    episodes: int
    force: float | None


def choices(means: Rows) -> dict[tuple[str, str, str, str], Choice]:
    """Choose a candidate for every hand, engine, group and rival, from the summary of a run.

    That is the one with the smallest mean force, of those that hold as many episodes of the tuning
    as the best one, but for `TIED` of them.
    """
    tuning = chosen(means, f"part == '{TUNING}'")
    return {
        (hand, engine, key, rival): _best(
            [_tried(rows, group, rival, settings) for settings in about.candidates[key]]
        )
        for (hand, engine), rows in _places(tuning)
        for key, group in GROUPS.items()
        for rival, about in RIVALS.items()
        if key in about.candidates
    }


def _best(tried: list[Choice]) -> Choice:
    least = max(choice.held for choice in tried) - TIED * tried[0].episodes
    good = [choice for choice in tried if choice.held >= least]
    return min(good, key=lambda choice: np.inf if choice.force is None else choice.force)


def equal_forces(means: Rows) -> dict[tuple[str, str, str], float]:
    """Return the mean commanded normal force [N] of `ROBUST` in the report, to 0.01 N.

    The keys are hand, engine and case. Rows in which no episode began are left out.
    """
    rows = chosen(means, f"part == '{REPORT}' and controller == '{ROBUST}'")
    return {
        (row["hand"], row["engine"], row["case"]): round(force, 2)
        for row in rows.to_dict("records")
        if np.isfinite(force := row.get("commanded_force_mean", np.nan))
    }


def named(picked: Mapping[tuple[str, str, str, str], Choice]) -> list[dict[str, object]]:
    """Return choices that were made in a tuning, for run.json."""
    return [
        {
            **dict(zip(("hand", "engine", "group", "controller"), key, strict=True)),
            **vars(choice),
        }
        for key, choice in picked.items()
        if choice.episodes
    ]


def _places(rows: Rows) -> Iterator[tuple[tuple[str, str], Rows]]:
    yield from rows.groupby(["hand", "engine"], sort=False) if len(rows) else ()


def _tried(rows: Rows, group: Group, rival: str, settings: dict[str, float]) -> Choice:
    """Return how a candidate did in the tuning of a hand in an engine."""
    values = (f"{name} == {value}" for name, value in settings.items())
    mine: Rows = chosen(rows, " and ".join([f"controller == '{rival}'", *values]))
    mine = mine[mine["case"].isin(group.tuned_on)]
    forces = mine.get("normal_force_mean", pd.Series(dtype=np.float64)).dropna()
    force = float(forces.mean()) if len(forces) else None
    return Choice(settings, int(mine["held_sum"].sum()), int(mine["n"].sum()), force)
