"""Hard problems (`hard_problems.py`): a sample always, thousands under `slow`; GRASP_TRIAL_SEED gives them a seed nobody has seen."""

from __future__ import annotations

import os

import pytest
from force.hard_problems import METHODS, TROUBLES, outcome, problem, trial

pytest.importorskip("clarabel")


@pytest.mark.parametrize("method", ["newton", "sum"])
def test_sample(method: str) -> None:
    """Contacts that the core solves itself, every kind of trouble: optimal or proven infeasible, whatever the trouble."""
    came = {}
    for index in range(120):
        p = problem(3, index)
        if p.model in ("hard", "elliptic") and p.trouble != "edge":
            came[index] = outcome(p, method)
    assert len(came) > 50
    assert {index: c for index, c in came.items() if c not in ("optimal", "infeasible")} == {}


# (method, seed, problem): what blind trials found wrong, each of a class of its own
FOUND = [
    ("sum", 777, 51),  # force closure to 1e-12 only: the general program refuses what the conic solver left
    ("sum", 1795335477, 16322),  # the same, with forces of 1e104 N
    ("newton", 1795335477, 433),  # contacts 1e-8 m apart: the least change that balances the last digit left a cone
    ("newton", 1795337778, 38687),  # whether there is force closure is not to be decided, but the wrench is safe
]


@pytest.mark.parametrize(("method", "seed", "index"), FOUND)
def test_what_trials_found(method: str, seed: int, index: int) -> None:
    assert outcome(problem(seed, index), method) in ("optimal", "infeasible")


def test_problems_are_those_of_their_seed() -> None:
    one, again, other = problem(5, 7), problem(5, 7), problem(6, 7)
    assert (one.grasp.positions == again.grasp.positions).all()
    assert (one.wrench == again.wrench).all()
    assert one.grasp.positions.shape != other.grasp.positions.shape or (one.wrench != other.wrench).all()
    assert {problem(5, k).trouble for k in range(60)} == set(TROUBLES)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_thousands(method: str) -> None:
    """Never outside a cone, never optimal without balance or far from it; the rest is counted and few are far."""
    counts, notes = trial(int(os.environ.get("GRASP_TRIAL_SEED", "20261122")), 3000, method)
    print("\n".join(notes))
    for key, number in sorted(counts.items()):
        print(*key, number)
    assert not [note for note in notes if ": wrong" in note]
    assert sum(number for (_, came), number in counts.items() if came.startswith("far")) <= 0.02 * 3000
