"""The conic solver against Clarabel and against certificates that are computed again from the geometry."""

from __future__ import annotations

from collections import Counter, defaultdict

import numpy as np
import pytest
from force.clarabel_reference import KINDS, Reference, random_grasp, random_limits, random_wrench

from grasp_env.errors import InfeasibleWrenchError, NotConvergedError, RankDeficientGraspError
from grasp_env.force import Status, optimize_force

pytest.importorskip("clarabel")

EDGE = 1e-7
"""Margin up to which a verdict is not compared."""
TRUSTED = 1e-8
"""Clarabel's own error up to which its objective is compared at 1e-6."""


class Trial:
    """Runs cases and keeps counters and the worst of every number."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.worst: dict[str, float] = defaultdict(float)
        self.notes: list[str] = []

    def run(
        self, seed: int, cases: int, kinds: tuple[str, ...], criteria: tuple[str, ...], limited: bool = False,
        flat: float = 1.0,
    ) -> None:  # fmt: skip
        rng = np.random.default_rng(seed)
        for case in range(cases):
            kind, criterion = str(rng.choice(kinds)), str(rng.choice(criteria))
            try:
                grasp = random_grasp(rng, kind, flat)
            except RankDeficientGraspError:
                self.counts["rank below 6"] += 1
                continue
            wrench = random_wrench(rng, grasp)
            size = float(np.abs(Reference(grasp).load(wrench)).max())
            limits = random_limits(rng, grasp, size) if limited else None
            self._case(f"seed {seed} case {case} {kind} {criterion}", grasp, wrench, limits, criterion, size)

    def _count(self, what: str, bad: bool, name: str) -> None:
        self.counts[what] += bad
        if bad:
            self.notes.append(f"{what}: {name}")

    def _case(self, name: str, grasp, wrench, limits, criterion: str, size: float) -> None:
        self.counts["cases"] += 1
        reference = Reference(grasp, limits)
        margin = reference.margin(wrench)
        name = f"{name}, {grasp.n_contacts} contacts, margin {margin:.2g}"
        try:
            found = optimize_force(grasp, wrench, method="conic", criterion=criterion, limits=limits)
        except InfeasibleWrenchError as error:
            self.counts["infeasible"] += 1
            self._count("wrong infeasible", margin > EDGE, name)
            if margin < -EDGE:
                self.counts["certificates"] += 1
                twist = np.asarray(getattr(error.solution, "certificate", np.zeros(6)))
                self._count("bad certificate", not reference.separates(twist, wrench) > 0.0, name)
            return
        except NotConvergedError:
            self._count("no verdict", abs(margin) > EDGE, name)
            return
        except RuntimeWarning:
            self._count("numpy warning", True, name)
            return
        self._count("wrong feasible", margin < -EDGE, name)
        self._count("not optimal", found.status is not Status.OPTIMAL, name)
        self.worst["balance"] = max(
            self.worst["balance"], reference.residual(found.force, found.torsion, wrench) / size
        )
        violation = reference.violation(found.force, found.torsion) / max(size, float(np.abs(found.force).max()))
        self.worst["violation"] = max(self.worst["violation"], violation)
        # the geometry is computed again with other rounding
        self._count("cone violations", found.cone_margin < 0.0 or violation > 1e-14, name)
        if found.status is not Status.OPTIMAL:
            return
        normals = found.force[:, 0]
        objective = float(normals.sum() if criterion == "sum" else normals.max())
        prices = found.limit_multipliers[len(found.limit_multipliers) - len(reference.bound) :]
        lower, theta = reference.dual_bound(found.multipliers, prices, wrench, criterion)
        self.worst["certified gap"] = max(self.worst["certified gap"], (objective - lower) / objective)
        self.worst["dual infeasibility"] = max(self.worst["dual infeasibility"], 1.0 - theta)
        self.worst["bound above its certificate"] = max(
            self.worst["bound above its certificate"], found.lower_bound / lower - 1.0
        )
        clarabel = reference.solve(wrench, criterion)
        if not clarabel.solved or clarabel.error > TRUSTED:
            self.counts["Clarabel off by more than 1e-8"] += 1
            return
        self.counts["compared"] += 1
        error = abs(objective / clarabel.objective - 1.0)
        self.worst["objective error"] = max(self.worst["objective error"], error)
        self._count("objective off", error > 1.01e-6, name)

    def check(self) -> None:
        for key, value in self.counts.items():
            print(f"{key:32s} {value}")
        for key, value in self.worst.items():
            print(f"worst {key:26s} {value:.3g}")
        print("\n".join(self.notes[:40]))
        assert self.worst["balance"] < 1e-9
        assert self.worst["certified gap"] < 1.01e-6
        assert self.worst["bound above its certificate"] < 1e-9
        bad = {
            key: self.counts[key]
            for key in (
                "objective off", "wrong infeasible", "wrong feasible", "bad certificate", "no verdict", "not optimal",
                "cone violations", "numpy warning",
            )
            if self.counts[key]
        }  # fmt: skip
        assert not bad, f"{bad} of {self.counts['cases']} cases: {self.notes[:10]}"


HARD = ("hard", "elliptic")


@pytest.mark.parametrize("limited", [False, True], ids=["plain", "limits"])
@pytest.mark.parametrize(
    ("kinds", "criterion"),
    [(HARD, "sum"), (("soft", "frictionless", "mixed"), "sum"), (KINDS, "max")],
    ids=["hard, sum", "others, sum", "all, max"],
)
def test_sample(kinds: tuple[str, ...], criterion: str, limited: bool) -> None:
    trial = Trial()
    trial.run(100 + limited, 60, kinds, (criterion,), limited)
    trial.check()
    assert trial.counts["compared"] >= 25


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "cases", "kinds", "criteria", "limited", "flat"),
    [
        (1, 2000, HARD, ("sum",), False, 1.0),
        (2, 1500, ("soft", "frictionless", "mixed"), ("sum",), False, 1.0),
        (3, 1500, KINDS, ("max",), False, 1.0),
        (4, 1500, KINDS, ("sum",), True, 1.0),
        (5, 800, KINDS, ("max",), True, 1.0),
        (6, 800, KINDS, ("sum",), False, 1e-3),
        (7, 800, KINDS, ("sum",), False, 1e-6),
    ],
    ids=["hard", "others", "max", "limits", "max, limits", "flat", "flatter"],
)
def test_thousands(
    seed: int, cases: int, kinds: tuple[str, ...], criteria: tuple[str, ...], limited: bool, flat: float
) -> None:
    trial = Trial()
    trial.run(seed, cases, kinds, criteria, limited, flat)
    print(f"\nseed {seed}, {kinds}, {criteria}, limits {limited}, flat {flat}")
    trial.check()
