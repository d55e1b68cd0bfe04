"""Python's side of the core: arrays that are not as the core reads them are refused, never misread; numbers that are none, too."""

from __future__ import annotations

import array
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from calls import (
    CALLS,
    COUNT,
    INTERNAL,
    LIMITS,
    LOADS,
    REFUSED,
    SAMPLE,
    SIZE,
    SPOILED,
    begun,
    fits,
    model,
    optimizer,
    refused,
    spoil,
)  # fmt: skip
from cases import START
from samples import wrenches

from grasp_env.core import _core
from grasp_env.force.record import FORCE

ROOT = Path(__file__).parents[2]
BAD = (np.nan, np.inf, -np.inf, 1e300, -1e300)
each_call = pytest.mark.parametrize("name", CALLS)


def run(name: str, arguments: dict[str, object]) -> object:
    """What a call returns; an error of argument types or values counts as REFUSED."""
    try:
        return CALLS[name].run(**arguments)
    except (TypeError, ValueError):
        return REFUSED


@each_call
def test_good_arguments_are_taken_and_left_as_they_are(name: str) -> None:
    call, arguments = CALLS[name], CALLS[name].arguments()
    assert not refused(call.run(**arguments))
    for argument in call.given:
        np.testing.assert_array_equal(arguments[argument], call.given[argument])
    for argument in call.written:
        assert name == "Pipeline.carry" or not (arguments[argument] == -7.0).all()


@each_call
def test_every_way_to_spoil_an_argument_is_refused(name: str) -> None:
    call, tried = CALLS[name], 0
    for argument in (*call.given, *call.written):
        for way in (*SPOILED, "read-only"):
            arguments: dict[str, object] = dict(call.arguments())
            right = arguments[argument]
            assert isinstance(right, np.ndarray)
            if way == "read-only":
                right.setflags(write=False)
                if argument in call.given:
                    continue
            else:
                arguments[argument] = spoil(way, right)
                if fits(name, argument, arguments[argument], right, way):
                    continue
            assert refused(run(name, arguments)), (argument, way)
            for other, written in arguments.items():  # and nothing was written
                if other in call.written and (other != argument or way == "read-only"):
                    assert (written == -7.0).all(), (argument, way, other)
            tried += 1
    assert tried > 20 * (len(call.given) + len(call.written))


def read_only(a: np.ndarray) -> np.ndarray:
    a.setflags(write=False)
    return a


SAME = {
    "read-only": read_only,
    "memoryview": memoryview,
    "a part of more": lambda a: np.concatenate([a, a])[: len(a)],
    "not aligned to a register": lambda a: np.frombuffer(b"\0" * 8 + a.tobytes(), np.float64, offset=8).reshape(
        a.shape
    ),
    "array.array": lambda a: memoryview(array.array("d", a.reshape(-1))).cast("B").cast("d", a.shape),
}


@pytest.mark.parametrize("way", SAME)
@pytest.mark.parametrize(
    "name", ["ForceOptimizer.solve_many", "ForceOptimizer.deepest", "descend_flow", "newton_grasps", "Pipeline.solve"]
)
def test_the_same_numbers_elsewhere_give_the_same_bits(name: str, way: str) -> None:
    call = CALLS[name]
    plain, other = call.arguments(), call.arguments()
    solve = begun().solve if name == "Pipeline.solve" else call.run
    first = solve(**plain)
    if name == "Pipeline.solve":
        solve = begun().solve
    assert solve(**{argument: SAME[way](a) if argument in call.given else a for argument, a in other.items()}) == first
    for argument in call.written:
        np.testing.assert_array_equal(other[argument], plain[argument])


# --- numbers that are none, too large or tiny: refused, or an answer that holds


def valid(row: np.ndarray, wrench: np.ndarray) -> bool:
    """Whether a record's force is what it says: finite, in the cones, balanced."""
    x = (row[FORCE : FORCE + 3 * COUNT].reshape(-1, 3) * SAMPLE.scale).reshape(-1)
    if not np.isfinite(np.delete(row, 4)).all() or not row[6] >= 0.0:
        return False
    w = SAMPLE.unit @ wrench
    return bool(np.abs(SAMPLE.rows @ x + w).max() <= 1e-9 * (np.abs(x).max() + np.abs(w).max()))


def solver_of(name: str) -> Callable[..., np.ndarray]:
    """(wrench, positions, normals) -> row."""
    if name == "pipeline":
        held = begun()

        def carried(wrench: np.ndarray, positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
            row = np.zeros(SIZE)
            held.solve(positions, normals, wrench, None, row)
            if row[0] == REFUSED:
                held.reset()  # a basis renewed for contacts far away may not reach back
            return row

        return carried
    made = optimizer(**LIMITS) if name == "limited" else optimizer(method=name)

    def solve(wrench: np.ndarray, positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
        found = made.solve(wrench, positions, normals, None, None, None, None)
        return made.ended if found is None else found._record

    return solve


@pytest.mark.parametrize("name", ["newton", "reduced_flow", "conic", "limited", "pipeline"])
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
    # and nothing of it stays
    assert valid(solve(**good)[:SIZE], LOADS[0])


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


@pytest.mark.parametrize("argument", ["positions", "normals"])
def test_contacts_of_numbers_that_are_none(argument: str) -> None:
    given = CALLS["Contacts.make"].given
    for bad in (*BAD, 1e160, 1e-160):
        for every in (True, False):
            a = given[argument].copy()
            a.reshape(-1)[slice(None) if every else 4] = bad
            if argument == "positions" and not every and bad == 1e-160:
                continue  # is a contact next to an axis
            with pytest.raises(ValueError, match=r"finite|rank"):
                _core.Contacts.make(**(given | {argument: a}))


GARBAGE = {
    "scale of nan": lambda a: {"scale": np.where(np.arange(3) == 1, np.nan, a["scale"])},
    "scale of inf": lambda a: {"scale": np.where(np.arange(3) == 1, np.inf, a["scale"])},
    "no normal force": lambda a: {"scale": np.where(np.arange(3) == 0, 0.0, a["scale"])},
    "weights of nan": lambda a: {"weights": a["weights"] * [1.0, np.nan]},
    "weights below zero": lambda a: {"weights": -a["weights"]},
    "tangents of nan": lambda a: {"tangents": a["tangents"] * np.nan},
    "tangents along the normals": lambda a: {"tangents": a["normals"]},
    "all in one place": lambda a: {"positions": np.full((COUNT, 3), 0.1)},
    "none at all": lambda a: {name: each[:0] for name, each in a.items()},
}


@pytest.mark.parametrize("what", GARBAGE)
def test_contacts_of_garbage_are_refused(what: str) -> None:
    arguments = CALLS["Contacts.make"].arguments()
    with pytest.raises(ValueError, match=r"."):
        _core.Contacts.make(**(arguments | GARBAGE[what](arguments)))


@pytest.mark.parametrize("limit", [0, -1, -(2**31), 2**31 - 1])
@pytest.mark.parametrize("tolerance", [0.0, -1.0, 1e-300, 1.0])
@pytest.mark.parametrize("method", ["newton", "conic"])
def test_any_settings_end(method: str, tolerance: float, limit: int) -> None:
    """Whatever is asked, a solve ends with a valid force: 2^31 steps are never taken."""
    made = optimizer(method=method, tolerance=tolerance, limit=limit)
    for load in LOADS:
        rows = np.zeros((1, made.size))
        made.solve_many(load[None], rows)
        assert rows[0, 0] != REFUSED
        assert valid(rows[0, :SIZE], load)


@pytest.mark.parametrize("factor", [np.nan, np.inf, -1.0, 0.0, "unbalanced"])
def test_a_basis_of_garbage_is_never_a_start_of_something_certified(factor: float | str) -> None:
    made, rng = optimizer(start=START["linear_combination"]), np.random.default_rng(0)
    loads = wrenches(rng, 100, 3.0)
    made.set_basis(SAMPLE.basis * (1.0 + rng.standard_normal((13, 1)) if factor == "unbalanced" else factor))
    rows = np.zeros((len(loads), made.size))
    made.solve_many(loads, rows)
    for row, load in zip(rows, loads, strict=True):
        assert row[0] != 0.0 or valid(row[:SIZE], load)
        assert row[0] != 0.0 or row[3] >= row[4] * (1.0 - 1e-9)


@pytest.mark.parametrize("what", ["points", "wrench"])
def test_carry_says_where_it_cannot(what: str) -> None:
    given = {"points": SAMPLE.positions, "normals": SAMPLE.normals, "wrench": LOADS[0]}
    given[what] = np.outer(np.arange(4.0), [0.01, 0.02, 0.03]) if what == "points" else LOADS[0] * np.nan
    force = np.full((COUNT, 3), -7.0)
    assert begun().carry(**given, force=force) not in (0, 1)
    assert np.isfinite(force).all()


def test_models_of_other_contacts_and_wrong_numbers_are_refused() -> None:
    short = model()
    short.place(np.ascontiguousarray(INTERNAL[:, :5]), 0.5, 1.0, 20.0)
    for fails in (
        lambda: optimizer(model=model(placed=False)),
        lambda: optimizer(model=short),
        lambda: _core.Network.make([8, 10**6], np.zeros(1)),
        lambda: _core.Network.make([], np.zeros(1)),
        lambda: _core.Network.make([8, 6], np.full(54, 1e39)),
        lambda: _core.Network.make([8, 6], np.full(54, np.nan)),
        lambda: model().normalise(0.0, 0.2, 0.5, 1.3, 0.4, 0.12),
        lambda: model().normalise(0.05, 0.2, 0.5, np.nan, 0.4, 0.12),
    ):
        with pytest.raises(ValueError, match=r"another number|stages|finite"):
            fails()


def test_what_training_covered() -> None:
    made = model()
    for load in 10.0 * LOADS:
        assert made.covers(load) == (np.linalg.norm(load / [1.0, 1.0, 1.0, 0.05, 0.05, 0.05]) <= 20.0)
        assert not made.covers(load * np.nan)
        assert not made.covers(load * 1e13)
    made.place(INTERNAL, 0.5, 1.0, -1.0)  # contacts that it does not know
    assert not made.covers(np.zeros(6))
    assert not made.covers(0.01 * LOADS[0])


# --- in a process of its own, which a crash ends


def test_nothing_crashes_where_objects_end() -> None:
    script = (
        f"import sys; sys.path[:0] = [{str(ROOT)!r}]; import conftest; sys.path[:0] = {sys.path!r}\n"
        + """
from calls import *
from grasp_env.core import _core
for make in (optimizer, pipeline, model, lambda: optimizer(model=model(), start=START["learned"])):
    made = make(); del made
for huge in (2**31 - 1, 2**40):
    try:
        _core.record_size(huge)
    except (ValueError, TypeError):
        continue
    sys.exit(1)
"""
    )
    command, environment = [sys.executable, "-c", script], os.environ | {"ASAN_OPTIONS": "detect_leaks=0"}
    done = subprocess.run(command, cwd=ROOT, env=environment, timeout=120, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


TRIAL = Path(__file__).with_name("boundary_trial.py")
SEED = int(os.environ.get("GRASP_TRIAL_SEED", "0"))


@pytest.mark.parametrize(
    ("part", "count"), [(0, 1000), *(pytest.param(k, 10_000, marks=pytest.mark.slow) for k in range(1, 11))]
)
def test_a_hundred_thousand_random_calls(part: int, count: int) -> None:
    """A crash or a hang is a fault of the last call. `GRASP_TRIAL_SEED=S make slow GRASP_SANITIZE=ON ARGS="tests/core -k hundred_thousand"`."""
    command = [sys.executable, str(TRIAL), "--seed", str(SEED + part), "--count", str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout + (done.stderr[-3000:] if done.returncode else "") == ""
