"""Peers against Clarabel at 1e-10, measures of answers by hand, clocks, and the table of a run with known contestants."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import generated, solver
from benchmarks.core_side import timed
from benchmarks.peers import PEERS, Clarabel, Peer
from benchmarks.problem import achieved, best_times, problems
from benchmarks.settings import Effort
from grasp_env.force import ForceOptimizer, Status
from grasp_env.grasp import Grasp, presets, wrench
from training.results.table import summary

GRASP = presets.paper_cuboid()
PUSHING = Grasp.from_contacts(GRASP.positions, np.tile([0.0, 0.0, -1.0], (4, 1)), 0.4)
"""Four fingers on one side: they can push only one way."""


@pytest.mark.parametrize("name", PEERS)
def test_a_peer_agrees_with_the_reference_and_shows_its_failures(name, tmp_path_factory, monkeypatch):
    monkeypatch.setattr(generated, "LIBRARIES", tmp_path_factory.getbasetemp() / "qocogen")
    pytest.importorskip("clarabel")
    try:
        peer, other = PEERS[name].build(GRASP), PEERS[name].build(GRASP.with_friction([0.8, 0.7, 0.9, 0.6]))
        pushing = PEERS[name].build(PUSHING)
    except (ImportError, RuntimeError) as error:
        pytest.skip(str(error))
    wrenches = wrench.sample_ball(np.random.default_rng(5), 20)
    best = Clarabel(GRASP, 1e-10)
    truth, (objective, balance, violation) = (
        achieved(GRASP, wrenches, np.array([each.solve(w) for w in wrenches])) for each in (best, peer)
    )
    np.testing.assert_allclose(objective, truth[0], rtol=1e-6)
    assert balance.max() < 1e-5
    assert violation.max() < 1e-7
    assert not np.allclose(
        other.solve(wrenches[0]), peer.solve(wrenches[0]), rtol=1e-2
    )  # each has the numbers of its grasp
    assert ((peer.times(wrenches[:4], 2) > 1e-7) & (peer.times(wrenches[:4], 2) < 1.0)).all()
    can, cannot = np.array([0.1, 0.0, 1.0, 0.0, 0.0, 0.0]), np.array([0.1, 0.0, -1.0, 0.0, 0.0, 0.0])
    before, failed = pushing.solve(can), pushing.solve(cannot)
    assert before[::3] @ (1.0 / PUSHING.friction) == pytest.approx(1.0, rel=1e-5)
    # qoco reports success on infeasible wrenches: the balance tells
    assert np.isnan(failed).all() or (name == "qoco" and achieved(PUSHING, cannot[None], failed[None])[1] > 0.5)
    np.testing.assert_allclose(pushing.solve(can), before, atol=1e-6)


def test_measures_by_hand():
    force, load = np.zeros((2, 12)), np.zeros((2, 6))
    force[0, :3], load[:, 0], force[1] = (1.0, 3.0, 4.0), 2.0, np.nan
    objective, balance, violation = achieved(GRASP, load, force)
    assert objective[0] == pytest.approx(1.0 / GRASP.friction[0])
    assert violation[0] == pytest.approx((5.0 - 1.0) / 4.0)
    assert balance[0] == pytest.approx(np.abs(GRASP.cone_matrix[:, :3] @ [1.0, 3.0, 4.0] + load[0]).max() / 2.0)
    assert np.isnan([objective[1], balance[1], violation[1]]).all()


SLOW = 10**12
"""Nanoseconds of a call that must not be timed."""


@pytest.mark.parametrize(
    ("times", "took"),
    [
        (lambda solve: best_times(solve, ["a", "b"], 2), [SLOW, SLOW, 7000, 5000, 3000, 6000]),
        (
            lambda solve: timed(2, solve, [("a",), ("b",)])[0],
            [SLOW, SLOW, SLOW, SLOW, 7000, 5000, SLOW, 3000, 6000, SLOW, SLOW],
        ),
    ],
    ids=["best_times", "core_side"],
)
def test_a_time_is_the_best_of_the_passes_without_warm_up(times, took, monkeypatch):
    now = [0]

    def solve(wrench):
        now[0] += took.pop(0)
        return SimpleNamespace(force=0.0, objective=0.0, status=Status.OPTIMAL)

    monkeypatch.setattr("time.perf_counter_ns", lambda: now[0])
    np.testing.assert_allclose(times(solve), [3e-6, 5e-6])
    assert not took


class Known(solver.Ours):
    """Ours with known times and defects."""

    def __init__(self, grasp: Grasp, seconds: list[float], factor: float) -> None:
        super().__init__(grasp, "conic", 1e-6, False)
        self.seconds, self.factor = list(seconds), factor

    def times(self, wrenches, passes):
        return np.full(len(wrenches), self.seconds.pop(0) / passes)

    def solve(self, wrench):
        return np.full(9, np.nan) if self.factor != 1.0 and wrench[0] > 0.0 else self.factor * super().solve(wrench)


def test_rows_of_known_contestants(monkeypatch):
    def absent(grasp):
        raise ImportError("No module named 'mosek'")

    made = {
        "conic": Peer("", lambda grasp: Known(grasp, [4e-6, 3e-6, 8e-6], 1.0), against=""),
        "other": Peer("", lambda grasp: Known(grasp, [2e-5, 9e-5, 3e-5], 1.01), against="conic"),
        "slow": Peer("", lambda grasp: Known(grasp, [1e-4], 1.0), against="conic", slow=True),
        "mosek": Peer("", absent, "mosek"),
    }
    monkeypatch.setattr(solver, "CONTESTANTS", made)
    rows = solver.run(Effort((3,), wrenches=40, rounds=3, passes=1))
    pushed = sum(int((loads[:, 0] > 0.0).sum()) for _, loads in problems(0, 3, 40))
    assert 0 < pushed < 40
    lacking = rows[rows["reason"].notna()]
    assert lacking[["method", "reason"]].to_numpy().tolist() == [
        ["mosek", "No module named 'mosek': pip install mosek"]
    ]
    conic, other, slow = (row for _, row in summary(rows[rows["reason"].isna()]).iterrows())
    assert [row["n"] for row in (conic, other, slow)] == [40, 40, 40]
    assert [row["failed_sum"] for row in (conic, other, slow)] == [0, pushed, 0]
    assert [row["microseconds_p99"] for row in (conic, other, slow)] == pytest.approx([3.0, 20.0, 50.0])
    assert [row["ratio_median"] for row in (other, slow)] == pytest.approx([20.0 / 3.0, 50.0 / 3.0])
    assert conic["gap_max"] < 1e-6 < 1e-2 < other["gap_max"] < 1.1e-2
    assert conic["balance_max"] < 1e-12 < 9e-3 < other["balance_max"] < 1.1e-2


def test_the_gap_of_newton_is_that_of_phi():
    loads = wrench.sample_ball(np.random.default_rng(1), 20)
    made = solver.Ours(GRASP, "newton", 1e-2, False)
    gap = solver.check(GRASP, loads, made, True)["gap"]
    optimizer = ForceOptimizer(GRASP, method="newton", tolerance=1e-2)
    assert 1e-5 < gap.max() <= max(optimizer.solve(load).optimality_gap for load in loads) * 1.001
    assert (solver.check(GRASP, loads, made, False)["gap"] > 1e-2).all()  # another problem: not the least forces


def test_without_a_compiler_generated_code_says_so(monkeypatch):
    monkeypatch.setattr(generated, "compiler", lambda: None)
    pytest.importorskip("qocogen")
    with pytest.raises(RuntimeError, match="no C compiler: install gcc or clang, or set CC"):
        generated.library(3)
