"""This project's exact solver on the problems of the benchmark that have limits, scored as an entrant."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from limited_tracks import TRACKS, drawn

from benchmarks.force.bounds import Measure
from benchmarks.force.entrant import Task
from benchmarks.force.entrants.clarabel import Clarabel
from benchmarks.force.entrants.ours import ConicPython
from benchmarks.force.problems import Problem, load
from benchmarks.force.score import parts_of, score

pytest.importorskip("clarabel")
LIMITED = (*TRACKS[:3], "soft", *TRACKS[3:])


def started(entrant: Any, track: str, problem: Problem) -> Any:
    entrant.setup(Task(track, "sum", "persistent", problem))
    return entrant


@pytest.mark.parametrize("track", LIMITED)
def test_every_problem_of_a_track_is_solved_and_proved(track):
    for session in load(track).sessions:
        solver = started(ConicPython(), track, session.problems[0])
        for problem, best in zip(session.problems, session.references["sum"].value, strict=True):
            row = score(problem, "sum", best, parts_of(problem, solver.solve(problem)))
            assert (row["solved"], row["proved"], row["wrong"]) == (True, True, False), session.name


def test_random_wrenches_have_clarabels_verdict_and_optimum():
    """The force is checked by itself, and so are the bound and the proof."""
    rng = np.random.default_rng(59)
    verdicts = {"solved": 0, "infeasible": 0}
    for track in LIMITED:
        for session in load(track).sessions[::2]:
            first = session.problems[0]
            ours = started(ConicPython(), track, first)
            other = started(Clarabel(), track, first.shifted())
            for problem in drawn(session, rng, 8):
                force, multipliers, status = ours.solve(problem)
                reference = parts_of(problem, other.solve(problem.shifted()))
                assert status == reference.status, (track, session.name)
                verdicts[status] += 1
                measure = Measure.of(problem)
                if status == "infeasible":
                    assert measure.witness(multipliers) > 0.0
                    continue
                flat = np.asarray(force).reshape(-1)
                misses = (measure.balance(flat), measure.violation(flat), measure.excess(flat))
                assert max(misses) <= 1e-9
                value = measure.objective("sum", flat)
                assert value - measure.lower("sum", multipliers) <= 1.01e-6 * value
                shifted = reference.force.reshape(problem.n_contacts, -1).copy()
                shifted[:, 0] += problem.shift
                # Clarabel's own tolerance leaves a few 1e-6
                expected = measure.objective("sum", shifted.reshape(-1))
                assert value == pytest.approx(expected, rel=1e-5)
    assert min(verdicts.values()) > 50
