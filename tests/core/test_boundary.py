"""The compiled module refuses arrays that it cannot read as they are, and numbers that are not
finite, too large or of other contacts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from samples import reference_of, sample, wrenches

from grasp_env.core import _core
from grasp_env.force import ForceSolution
from grasp_env.force.call import Call as Changes
from grasp_env.force.solution import Names

REFUSED = _core.codes()["refused"]
COUNT = 4
SAMPLE = sample(COUNT)
LOADS = wrenches(np.random.default_rng(0), 3)
SIZE = _core.record_size(COUNT)
INTERNAL = reference_of(SAMPLE)
PLACE = {"positions": SAMPLE.positions, "normals": SAMPLE.normals}
STOP = {"tolerance": 1e-6, "limit": 100}
NORMALISATION = {
    "floor": 0.2,
    "smoothing": 0.05,
    "log_mean": 0.5,
    "log_scale": 1.3,
    "friction_mean": 0.4,
    "friction_scale": 0.12,
}
LIMITS = {
    "min_normal": np.full(COUNT, 0.1),
    "max_normal": np.full(COUNT, 9.0),
    "jacobian": np.full((COUNT, 6, 3), 0.05),
    "torque_limit": np.ones(3),
    "torque_bias": np.zeros(3),
}


def contacts() -> _core.Contacts:
    return _core.Contacts.make(
        **PLACE, scale=SAMPLE.scale, weights=SAMPLE.weights, tangents=np.zeros((0, 3))
    )


def optimizer(
    weights: Any = SAMPLE.weights, model: _core.Model | None = None, **limits: Any
) -> _core.ForceOptimizer:
    problem = _core.Problem(contacts(), weights, tuple(map(limits.get, LIMITS)) if limits else None)
    names = Names("newton", "internal_force")
    return _core.ForceOptimizer(problem, _core.Options(model=model, **STOP), ForceSolution, names)


def model(placed: bool = True, **given: float) -> _core.Model:
    """A network for these contacts."""
    rng = np.random.default_rng(0)
    network, pairs = (
        _core.Network.make([a, b], 0.1 * rng.standard_normal((a + 1) * b))
        for a, b in ((_core.PLAIN_FEATURES + 2, 6), (6, 4))
    )
    learned = _core.Model.make(network, pairs)
    learned.normalise(**(NORMALISATION | given))
    if placed:
        learned.place(INTERNAL, 0.5, 1.0, 20.0)
    return learned


@dataclass(frozen=True)
class Call:
    """A call by keywords: `given` is read, and arrays of the shapes in `written` are filled;
    `optional` ones may be None."""

    run: Callable[..., object]
    given: dict[str, Any]
    written: dict[str, tuple[int, ...]]
    optional: frozenset[str] = frozenset()

    @property
    def arrays(self) -> list[str]:
        return [name for name, a in self.given.items() if isinstance(a, np.ndarray)]

    def arguments(self) -> dict[str, Any]:
        filled = {name: np.full(shape, -7.0) for name, shape in self.written.items()}
        return self.given | {name: self.given[name].copy() for name in self.arrays} | filled


def solve(optimizer: _core.ForceOptimizer, wrench: Any, **changes: Any) -> object:
    """False where arrays cannot be read, else the code."""
    record: Any = optimizer.solve(wrench, Changes(contacts=None, **changes), None)
    return False if record is NotImplemented else record.code


def calls() -> dict[str, Call]:
    s = SAMPLE
    limited = optimizer(**LIMITS)
    tangents = {"tangents": s.frames[:, :, 1].copy()}
    now = PLACE | {
        "friction": np.full(COUNT, 0.5),
        "jacobian": LIMITS["jacobian"],
        "torque_bias": np.zeros(3),
    }
    many = {
        "contacts": [contacts()],
        "weights": s.weights,
        "first": np.array([0.0, 3.0]),
        "wrenches": LOADS,
        "stop": tuple(STOP.values()),
    }
    records = {"records": (3, SIZE + 10 * COUNT)}
    deepest = {"force": (COUNT, 3), "torsion": (COUNT,), "twist": (6,)}
    return {
        "Contacts.make": Call(
            _core.Contacts.make, PLACE | {"scale": s.scale, "weights": s.weights} | tangents, {}
        ),
        "ForceOptimizer": Call(
            optimizer,
            {"weights": s.weights} | LIMITS,
            {},
            frozenset({"weights", "min_normal", "max_normal", "torque_bias"}),
        ),
        "solve": Call(
            lambda **given: solve(limited, **given), now | {"wrench": LOADS[0]}, {}, frozenset(now)
        ),
        "deepest": Call(limited.deepest, {"wrench": LOADS[0]}, deepest),
        "solve_many": Call(limited.solve_many, {"wrenches": LOADS}, {"rows": (3, limited.size)}),
        "newton_grasps": Call(_core.newton_grasps, many, records),
        "conic_grasps": Call(_core.conic_grasps, many, records),
    }


CALLS = calls()
SPOILED: dict[str, Callable[[np.ndarray], object]] = {
    "float32": lambda a: a.astype(np.float32),
    "integers": lambda a: a.astype(int),
    "big endian": lambda a: a.astype(">f8"),
    "strided": lambda a: np.repeat(a, 2, axis=-1)[..., ::2],
    "an axis more": lambda a: a[None],
    "one more": lambda a: np.concatenate([a, a[..., :1]], axis=-1),
    "one less": lambda a: np.ascontiguousarray(a[..., :-1]),
    "a row less": lambda a: np.ascontiguousarray(a[:-1]),
    "list": lambda a: a.tolist(),
    "none": lambda a: None,
    "word": lambda a: "wrench",
    "huge": lambda a: np.broadcast_to(np.float64(0.0), (2**31, *a.shape[1:])),
}


@pytest.mark.parametrize("name", CALLS)
def test_arrays_are_as_the_core_reads_them_or_refused(name):
    call = CALLS[name]
    good = CALLS[name].arguments()
    outcome = call.run(**good)
    assert outcome is not False
    assert outcome != REFUSED
    for argument in call.arrays:
        np.testing.assert_array_equal(good[argument], call.given[argument])
    for argument in (*call.arrays, *call.written):
        for way in (*SPOILED, *(["read-only"] if argument in call.written else [])):
            if way == "none" and argument in call.optional:
                continue
            arguments = call.arguments()
            if way == "read-only":
                arguments[argument].setflags(write=False)
            else:
                arguments[argument] = SPOILED[way](arguments[argument])
            try:
                outcome = call.run(**arguments)
            except (TypeError, ValueError):
                outcome = False
            assert outcome is False or (type(outcome) is int and outcome == REFUSED), (
                argument,
                way,
            )
            for other in call.written:
                if other != argument or way == "read-only":
                    assert (arguments[other] == -7.0).all(), (argument, way)


BAD = (np.nan, np.inf, -np.inf, 1e300, -1e300)


@pytest.mark.parametrize("name", ["solve_many", "newton_grasps", "conic_grasps"])
def test_a_row_that_is_refused_leaves_the_others(name):
    call = CALLS[name]
    key = "rows" if name == "solve_many" else "records"
    expected = call.arguments()
    call.run(**expected)
    for bad in BAD:
        arguments = call.arguments()
        arguments["wrenches"][1] = bad
        call.run(**arguments)
        np.testing.assert_array_equal(arguments[key][[0, 2]], expected[key][[0, 2]])
        assert arguments[key][1, 0] == REFUSED


def made_of(**wrong: Any) -> _core.Contacts:
    return _core.Contacts.make(**CALLS["Contacts.make"].arguments() | wrong)


WRONG: dict[str, tuple[Callable[[], object], str]] = {
    **{
        f"{name} {bad}": (
            lambda name=name, bad=bad: made_of(**{name: PLACE[name] * 0.0 + bad}),
            "finite|rank",
        )
        for name in PLACE
        for bad in (*BAD, 1e160, 1e-160)
    },
    "scale": (lambda: made_of(scale=SAMPLE.scale * [1.0, np.nan, 1.0]), "."),
    "no friction": (lambda: made_of(scale=SAMPLE.scale * [0.0, 1.0, 1.0]), "."),
    "weights": (lambda: made_of(weights=-SAMPLE.weights), "."),
    "tangents along normals": (lambda: made_of(tangents=SAMPLE.normals), "."),
    "no contacts": (lambda: made_of(**{name: PLACE[name][:0] for name in PLACE}), "."),
    "a model without contacts": (lambda: optimizer(model=model(placed=False)), "another number"),
    "wide network": (lambda: _core.Network.make([8, 10**6], np.zeros(1)), "stages"),
    "no network": (lambda: _core.Network.make([], np.zeros(1)), "stages"),
    "beyond float32": (lambda: _core.Network.make([8, 6], np.full(54, 1e39)), "finite"),
    "other pairs": (
        lambda: _core.Model.make(
            _core.Network.make([10, 6], np.zeros(66)), _core.Network.make([6, 6], np.zeros(42))
        ),
        "one stage",
    ),
    "floor": (lambda: model(floor=0.0), "finite"),
    "log scale": (lambda: model(log_scale=np.nan), "finite"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_contacts_and_models_are_refused(name):
    call, message = WRONG[name]
    with pytest.raises((ValueError, TypeError), match=message):
        call()


def test_a_model_covers_wrenches_up_to_those_of_its_training():
    learned = model()
    for load in 10.0 * LOADS:
        assert learned.covers(load) == (np.linalg.norm(load) <= 20.0)
        assert not learned.covers(load * np.nan)
    learned.place(INTERNAL, 0.5, 1.0, -1.0)  # contacts that it does not know
    assert not learned.covers(np.zeros(6))
