"""Python's side of the core: arrays that are not as the core reads them are refused, never misread; numbers that are none, too."""

from __future__ import annotations

import array
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import calls
import numpy as np
import pytest
from calls import CALLS, COUNT, INTERNAL, LIMITS, LOADS, REFUSED, SAMPLE, SIZE, SPOILED, model, optimizer
from cases import START
from samples import wrenches

from grasp_env.core import _core
from grasp_env.force.record import FORCE

BAD = (np.nan, np.inf, -np.inf, 1e300, -1e300)
each_call = pytest.mark.parametrize("name", CALLS)


@each_call
def test_good_arguments_are_taken_and_left_as_they_are(name: str) -> None:
    call, arguments = CALLS[name], CALLS[name].arguments()
    assert not calls.refused(call.run(**arguments))
    for argument, right in call.read.items():
        np.testing.assert_array_equal(arguments[argument], right)
    for argument in call.written:
        assert name == "Pipeline.carry" or not (arguments[argument] == -7.0).all()


@each_call
def test_every_way_to_spoil_an_argument_is_refused(name: str) -> None:
    call, tried = CALLS[name], 0
    for argument in (*call.read, *call.written):
        for way in (*SPOILED, *(["read-only"] if argument in call.written else [])):
            arguments = call.arguments()
            right = arguments[argument]
            if way == "read-only":
                right.setflags(write=False)
            else:
                arguments[argument] = calls.spoil(way, right)
                if calls.fits(name, argument, arguments[argument], right, way):
                    continue
            try:
                outcome = call.run(**arguments)
            except (TypeError, ValueError):
                outcome = REFUSED
            assert calls.refused(outcome), (argument, way)
            for other in call.written:  # and nothing was written
                if other != argument or way == "read-only":
                    assert (arguments[other] == -7.0).all(), (argument, way, other)
            tried += 1
    assert tried > 20 * (len(call.read) + len(call.written))


def read_only(a: np.ndarray) -> np.ndarray:
    a.setflags(write=False)
    return a


SAME = {
    "read-only": read_only,
    "memoryview": memoryview,
    "a part of more": lambda a: np.concatenate([a, a])[: len(a)],
    "not aligned to a register": lambda a: np.frombuffer(bytes(8) + a.tobytes(), np.float64, offset=8).reshape(a.shape),
    "array.array": lambda a: memoryview(array.array("d", a.reshape(-1))).cast("B").cast("d", a.shape),
}


@pytest.mark.parametrize("way", SAME)
@pytest.mark.parametrize(
    "name", ["ForceOptimizer.solve_many", "ForceOptimizer.deepest", "descend_flow", "newton_grasps"]
)
def test_the_same_numbers_elsewhere_give_the_same_bits(name: str, way: str) -> None:
    call, ends = CALLS[name], []
    plain, other = call.arguments(), call.arguments()
    for given in (plain, other | {argument: SAME[way](other[argument]) for argument in call.read}):
        ends.append(call.run(**given))
    assert ends[0] == ends[1]
    for argument in call.written:
        np.testing.assert_array_equal(other[argument], plain[argument])


# --- numbers that are none, too large or tiny: refused, or an answer that holds


def valid(row: np.ndarray, wrench: np.ndarray) -> bool:
    """True if the force of a record is finite, lies in the cones and balances the wrench."""
    x = (row[FORCE : FORCE + 3 * COUNT].reshape(-1, 3) * SAMPLE.scale).reshape(-1)
    if not np.isfinite(np.delete(row, 4)).all() or not row[6] >= 0.0:
        return False
    w = SAMPLE.unit @ wrench
    return bool(np.abs(SAMPLE.rows @ x + w).max() <= 1e-9 * (np.abs(x).max() + np.abs(w).max()))


def solver_of(name: str) -> Callable[..., np.ndarray]:
    """(wrench, positions, normals) -> row."""
    made = optimizer(**LIMITS) if name == "limited" else optimizer(method=name)

    def solve(wrench: np.ndarray, positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
        found = made.solve(wrench, positions, normals, None, None, None, None)
        return made.ended if found is None else found._record

    return solve


@pytest.mark.parametrize("name", ["newton", "reduced_flow", "conic", "limited"])
def test_numbers_that_are_none_are_refused_or_harmless(name: str) -> None:
    """A thousand calls with one to six numbers that are not finite, too large, or tiny."""
    rng, solve, outcomes = np.random.default_rng(len(name)), solver_of(name), set()
    good = {"wrench": LOADS[0], "positions": SAMPLE.positions, "normals": SAMPLE.normals}
    for _ in range(1000 if name != "reduced_flow" else 300):
        arguments = {key: a.copy() for key, a in good.items()}
        for argument in rng.choice(list(good), rng.integers(1, 3), replace=False):
            a = arguments[argument].reshape(-1)
            a[rng.integers(a.size, size=rng.integers(1, 4))] = rng.choice([*BAD, 1e-300, 0.0, -0.0, 1e12, 1e-12])
        row = solve(**arguments)
        outcomes.add(int(row[0]))
        # contacts with coordinates of 1e300 m are out of reach of the oracle, not of the rule
        there = all((arguments[k] == good[k]).all() for k in ("positions", "normals"))
        assert row[0] != 0.0 or not there or valid(row[:SIZE], arguments["wrench"]), arguments
        assert row[0] == 0.0 or np.isfinite(row[FORCE:]).all()
    assert {0, REFUSED} <= outcomes
    assert valid(solve(**good)[:SIZE], LOADS[0])  # and nothing of it stays


@pytest.mark.parametrize("name", ["ForceOptimizer.solve_many", "ForceOptimizer.times", "newton_grasps", "conic_grasps"])
def test_one_row_that_is_none_leaves_the_others(name: str) -> None:
    call, key = CALLS[name], "rows" if name.startswith("Force") else "records"
    wanted = call.arguments()
    call.run(**wanted)
    for bad in BAD:
        arguments = call.arguments()
        arguments["wrenches"][1] = bad
        call.run(**arguments)
        np.testing.assert_array_equal(arguments[key][[0, 2]], wanted[key][[0, 2]])
        assert arguments[key][1, 0] == REFUSED


def one(bad: float, at: int = 4) -> Callable[[np.ndarray], np.ndarray]:
    return lambda a: np.where(np.arange(a.size).reshape(a.shape) == at, bad, a)


GARBAGE: list[tuple[str, Callable[[np.ndarray], np.ndarray]]] = [
    *((name, lambda a, bad=bad: a * 0.0 + bad) for name in ("positions", "normals") for bad in (*BAD, 1e160, 1e-160)),
    *((name, one(bad)) for name in ("positions", "normals") for bad in (*BAD, 1e160)),
    ("normals", one(1e-160)),
    *(("scale", lambda a, bad=bad, k=k: np.where(np.arange(3) == k, bad, a)) for k, bad in ((1, np.nan), (1, np.inf), (0, 0.0))),
    ("weights", lambda a: a * [1.0, np.nan]),
    ("weights", np.negative),
    ("tangents", lambda a: a * np.nan),
    ("tangents", lambda a: SAMPLE.normals),
]  # fmt: skip


@pytest.mark.parametrize(("argument", "wrong"), GARBAGE)
def test_contacts_of_garbage_are_refused(argument: str, wrong: Callable[[np.ndarray], np.ndarray]) -> None:
    given = CALLS["Contacts.make"].arguments()
    with pytest.raises(ValueError, match=r"finite|rank" if argument in ("positions", "normals") else r"."):
        _core.Contacts.make(**(given | {argument: wrong(given[argument])}))
    with pytest.raises(ValueError, match=r"."):  # none at all
        _core.Contacts.make(**{name: each[:0] for name, each in given.items()})


@pytest.mark.parametrize("limit", [0, -1, -(2**31), 2**31 - 1])
@pytest.mark.parametrize("tolerance", [0.0, -1.0, 1e-300, 1.0])
@pytest.mark.parametrize("method", ["newton", "conic"])
def test_any_settings_end(method: str, tolerance: float, limit: int) -> None:
    """Whatever is asked, a solve ends with a valid force: 2^31 steps are never taken."""
    made = optimizer(method=method, tolerance=tolerance, limit=limit)
    rows = np.zeros((len(LOADS), made.size))
    made.solve_many(LOADS, rows)
    for row, load in zip(rows, LOADS, strict=True):
        assert row[0] != REFUSED
        assert valid(row[:SIZE], load)


@pytest.mark.parametrize("factor", [np.nan, np.inf, -1.0, 0.0, "unbalanced"])
def test_a_basis_of_garbage_is_never_a_start_of_something_certified(factor: float | str) -> None:
    made, rng = optimizer(start=START["linear_combination"]), np.random.default_rng(0)
    loads = wrenches(rng, 100, 3.0)
    made.set_basis(SAMPLE.basis * (1.0 + rng.standard_normal((13, 1)) if factor == "unbalanced" else factor))
    rows = np.zeros((len(loads), made.size))
    made.solve_many(loads, rows)
    for row, load in zip(rows, loads, strict=True):
        assert row[0] != 0.0 or (valid(row[:SIZE], load) and row[3] >= row[4] * (1.0 - 1e-9))


def test_models_of_other_contacts_and_wrong_numbers_are_refused() -> None:
    short = model()
    short.place(np.ascontiguousarray(INTERNAL[:, :5]), 0.5, 1.0, 20.0)
    for wrong in (model(placed=False), short):
        with pytest.raises(ValueError, match="another number"):
            optimizer(model=wrong)
    for sizes, weights in (
        ([8, 10**6], np.zeros(1)),
        ([], np.zeros(1)),
        ([8, 6], np.full(54, 1e39)),
        ([8, 6], np.full(54, np.nan)),
    ):
        with pytest.raises(ValueError, match=r"stages|finite"):
            _core.Network.make(sizes, weights)
    with pytest.raises(ValueError, match="one stage"):  # three vectors for a network that reads two lengths
        _core.Model.make(_core.Network.make([10, 6], np.zeros(66)), _core.Network.make([6, 6], np.zeros(42)))
    for number in ({"floor": 0.0}, {"log_scale": np.nan}, {"smoothing": -1.0}):
        with pytest.raises(ValueError, match="finite"):
            model(**number)
    for huge in (2**31 - 1, 2**40):
        with pytest.raises((ValueError, TypeError)):
            _core.record_size(huge)


def test_what_training_covered() -> None:
    made = model()
    for load in 10.0 * LOADS:
        assert made.covers(load) == (np.linalg.norm(load) <= 20.0)
        assert not made.covers(load * np.nan)
        assert not made.covers(load * 1e13)
    made.place(INTERNAL, 0.5, 1.0, -1.0)  # contacts that it does not know
    assert not made.covers(np.zeros(6))
    assert not made.covers(0.01 * LOADS[0])


SEED = int(os.environ.get("GRASP_TRIAL_SEED", "0"))


@pytest.mark.parametrize(
    ("part", "count"), [(0, 1000), *(pytest.param(k, 10_000, marks=pytest.mark.slow) for k in range(1, 11))]
)
def test_a_hundred_thousand_random_calls(part: int, count: int) -> None:
    """A crash or a hang is a fault of the last call. `GRASP_TRIAL_SEED=S make slow GRASP_SANITIZE=ON ARGS="tests/core -k hundred_thousand"`."""
    trial = Path(__file__).with_name("boundary_trial.py")
    command = [sys.executable, str(trial), "--seed", str(SEED + part), "--count", str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout + (done.stderr[-3000:] if done.returncode else "") == ""
