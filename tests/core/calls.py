"""Calls of the compiled module with good arguments, and ways to spoil them: for `test_boundary` and `boundary_trial`."""

from __future__ import annotations

import array
import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from cases import START
from samples import reference_of, sample, wrenches

from grasp_env.core import _core
from grasp_env.force import ForceSolution
from grasp_env.force.solution import STARTS

REFUSED = _core.codes()["refused"]
COUNT = 4
SAMPLE = sample(COUNT)
LOADS = wrenches(np.random.default_rng(0), 3)
SIZE = _core.record_size(COUNT)
INTERNAL = reference_of(SAMPLE)
RULE = np.array([2.0, 0.3, 1.5, 0.5, 0.0])
STOP = {"tolerance": 1e-6, "limit": 100}
PLACE = {"positions": SAMPLE.positions, "normals": SAMPLE.normals}
NORMALISATION = {
    "floor": 0.2, "smoothing": 0.05, "log_mean": 0.5, "log_scale": 1.3, "friction_mean": 0.4, "friction_scale": 0.12,
}  # fmt: skip
LIMITS = {
    "min_normal": np.full(COUNT, 0.1), "max_normal": np.full(COUNT, 9.0), "jacobian": np.full((COUNT, 6, 3), 0.05),
    "torque_limit": np.ones(3), "torque_bias": np.zeros(3),
}  # fmt: skip


def contacts() -> _core.Contacts:
    return _core.Contacts.make(**PLACE, scale=SAMPLE.scale, weights=SAMPLE.weights, tangents=np.zeros((0, 3)))


def optimizer(**given: Any) -> _core.ForceOptimizer:
    """Of hard contacts, on which no limits are."""
    options: dict[str, Any] = {"weights": SAMPLE.weights, "kind": ForceSolution, "name": "newton", "starts": STARTS}
    return _core.ForceOptimizer.make(contacts(), **options | STOP | given)


def model(placed: bool = True, **given: float) -> _core.Model:
    """A network of these contacts."""
    rng = np.random.default_rng(0)
    network, pairs = (
        _core.Network.make([a, b], 0.1 * rng.standard_normal((a + 1) * b))
        for a, b in ((_core.PLAIN_FEATURES + 2, 6), (6, 4))
    )
    made = _core.Model.make(network, pairs)
    made.normalise(**(NORMALISATION | given))
    if placed:
        made.place(INTERNAL, 0.5, 1.0, 20.0)
    return made


@dataclass(frozen=True)
class Call:
    """One call.

    Attributes:
        run: takes arguments by name.
        given: what is read; written: arrays that are filled, by their shapes.
        optional: those that may be None; of any length those of `any_length`.
    """

    run: Callable[..., object]
    given: dict[str, Any]
    written: dict[str, tuple[int, ...]]
    optional: frozenset[str] = frozenset()
    any_length: frozenset[str] = frozenset()

    @property
    def read(self) -> dict[str, np.ndarray]:
        """The arrays of `given`."""
        return {name: a for name, a in self.given.items() if isinstance(a, np.ndarray)}

    def arguments(self) -> dict[str, Any]:
        """Right ones, nothing shared."""
        filled = {name: np.full(shape, -7.0) for name, shape in self.written.items()}
        return self.given | {name: a.copy() for name, a in self.read.items()} | filled


def ended(made: Any, name: str, **given: Any) -> object:
    """False where arrays cannot be read, else the code."""
    found = getattr(made, name)(**given)
    row = made.ended if found is None else found._record
    return False if row is None else int(row[0])


def calls() -> dict[str, Call]:
    """Those that take arrays."""
    s, x = SAMPLE, SAMPLE.basis[0]
    force = (x / s.divisor.reshape(-1)).reshape(COUNT, 3)
    tangents = {"tangents": s.frames[:, :, 1].copy()}
    one, free, trained = optimizer(**LIMITS), optimizer(), model()
    now = PLACE | {
        "friction": s.scale[:, :1] / s.scale[:, 1:],
        "jacobian": LIMITS["jacobian"],
        "torque_bias": np.zeros(3),
    }
    own: dict[str, Any] = {"start": START["given"], "before": None, "contacts": None}
    balanced = {"force": force, "wrench": np.eye(6)[0]}
    may, trace = frozenset(now), frozenset({"trace"})
    many = {"contacts": [contacts()], "weights": s.weights, "first": np.array([0.0, 3.0]), "wrenches": LOADS} | STOP
    phi, records = {"x": x.reshape(-1, 3).copy(), "weights": s.weights}, {"records": (3, SIZE + 9 * COUNT)}
    return {
        "Contacts.make": Call(_core.Contacts.make, PLACE | {"scale": s.scale, "weights": s.weights} | tangents, {}),
        "Contacts.put": Call(_core.Contacts.put, PLACE | {"scale": s.scale, "torsion": np.full(COUNT, 0.01)} | tangents, {}),
        "Contacts.weighed": Call(contacts().weighed, {"weights": s.weights}, {}),
        "ForceOptimizer.make": Call(
            optimizer, {"weights": s.weights, "rule": RULE} | LIMITS, {},
            frozenset({"weights", "rule", "min_normal", "max_normal", "torque_bias"}),
        ),
        "ForceOptimizer.solve": Call(lambda **given: ended(one, "solve", contacts=None, **given), now | {"wrench": LOADS[0]}, {}, may),
        "ForceOptimizer.solve_from": Call(
            lambda **given: ended(one, "solve_from", **own, initial="given", optimum=np.nan, **given), balanced | now,
            {"trace": (5,)}, may | trace, trace,
        ),
        "ForceOptimizer.start": Call(lambda **given: int(one.start(**given, **own)[0]), balanced | now, {}, may),
        "ForceOptimizer.update": Call(optimizer(**LIMITS).update, now, {}, may),
        "ForceOptimizer.set_basis": Call(optimizer().set_basis, {"basis": s.basis}, {}),
        "ForceOptimizer.make_basis": Call(optimizer().make_basis, {"warm": False}, {"basis": (13, 12)}),
        "ForceOptimizer.deepest": Call(one.deepest, {"wrench": LOADS[0]}, {"force": (COUNT, 3), "torsion": (COUNT,), "twist": (6,)}),
        "ForceOptimizer.solve_many": Call(one.solve_many, {"wrenches": LOADS}, {"rows": (3, one.size)}),
        "ForceOptimizer.times": Call(free.times, {"wrenches": LOADS, "passes": 1}, {"rows": (3, free.size), "best": (3,)}),
        "along_normal": Call(_core.along_normal, tangents | {"normals": s.normals}, {}),
        "cone_scale": Call(_core.cone_scale, {"friction": np.full((COUNT, 2), 0.4)}, {"scale": (COUNT, 3)}),
        "limit_rows": Call(
            _core.limit_rows,
            {"least": LIMITS["min_normal"], "most": LIMITS["max_normal"], "jacobian": np.full((COUNT, 4, 3), 0.05),
             "torques": np.ones(3), "biases": np.zeros(3)},
            {"matrix": (14, COUNT, 4), "bounds": (14,), "limited": (14,)},
        ),
        "combine": Call(_core.combine, {"basis": s.basis, "wrench": LOADS[0], "printed": False}, {"to": (12,)}),
        "newton_grasps": Call(_core.newton_grasps, many, records),
        "conic_grasps": Call(_core.conic_grasps, many, records),
        "descend_flow": Call(
            _core.descend_flow, {"contacts": contacts(), "form": "paper", "optimum": np.nan, "rule": RULE} | STOP | balanced,
            {"trace": (5,), "record": (SIZE,)}, any_length=trace,
        ),
        "repeat_step": Call(_core.repeat_step, {"contacts": contacts(), "form": "reduced", "times": 2, "x": x}, {}),
        "Network.make": Call(_core.Network.make, {"sizes": [8, 6], "weights": np.full(54, 0.1)}, {}),
        "Model.covers": Call(trained.covers, {"wrench": LOADS[0]}, {}),
        "Model.predict": Call(trained.predict, {"wrench": LOADS[0]}, {"coordinates": (6,)}),
        "phi": Call(_core.phi, phi, {}),
        "phi_gradient": Call(_core.phi_gradient, phi, {"out": (COUNT, 3)}),
        "phi_hessian": Call(_core.phi_hessian, phi, {"out": (COUNT, 3, 3)}),
    }  # fmt: skip


def others() -> dict[str, Call]:
    """Those that take numbers, words and objects, and arrays in ways of their own."""
    network, pairs = _core.Network.make([9, 6], np.zeros(60)), _core.Network.make([6, 2], np.zeros(14))
    bounds = {"least_friction": 1e-4, "most_friction": 1e4, "least_length": 1e-9, "most_length": 1e6, "distance": 1e5}
    fresh, reader = _core.Model.make(network, pairs), _core.ContactReader(**bounds, most=1000)
    return {
        "Model.make": Call(_core.Model.make, {"network": network, "pairs": pairs}, {}),
        "Model.normalise": Call(fresh.normalise, NORMALISATION, {}),
        "Model.place": Call(fresh.place, {"null_space": np.ones((12, 6)), "friction": 0.4, "scale": 1.0, "largest": 20.0}, {}),
        "Model.load": Call(_core.Model.load, {"bytes": model().save()}, {}),
        "Model.save": Call(fresh.save, {}, {}),
        "ContactReader.read": Call(reader.read, PLACE | {"tangents": SAMPLE.frames[:, :, 1].copy(), "friction": 0.4}, {}),
        "Contacts.weighed alike": Call(contacts().weighed, {"force_weight": 1.0, "barrier_weight": 0.01}, {}),
        "all_finite": Call(_core.all_finite, {"array": np.ones(6)}, {}),
        "normalise": Call(_core.normalise, {}, {"normals": (COUNT, 3)}),
        "record_size": Call(_core.record_size, {"contacts": 4}, {}),
        "Solution": Call(_core.Solution, {"record": np.full(SIZE, -7.0), "method": "", "initial": ""}, {}),
    }  # fmt: skip


CALLS = calls()


SPOILED: dict[str, Callable[[np.ndarray], object]] = {
    **{kind: lambda a, kind=kind: a.astype(kind) for kind in ("f4", "f2", "g", "i8", "?", "c16", "O", "U8", ">f8")},
    "record": lambda a: np.ascontiguousarray(a).view(np.dtype([("value", np.float64)])),
    "Fortran order": np.asfortranarray, "transposed": lambda a: a.T, "strided": lambda a: np.repeat(a, 2, axis=-1)[..., ::2],
    "reversed": lambda a: a[..., ::-1], "broadcast": lambda a: np.broadcast_to(np.float64(1.0), a.shape),
    "off by a byte": lambda a: np.frombuffer(b"\0" + a.tobytes(), np.uint8)[1:].view(np.float32),
    "0-d": lambda a: np.array(1.0), "empty": lambda a: np.zeros((0,) * a.ndim) if a.size else np.zeros(7),
    "flat": lambda a: a.reshape(-1) if a.ndim > 1 else a[:, None], "one axis more": lambda a: a[None],
    "one more": lambda a: np.concatenate([a, a[..., :1]], axis=-1), "one less": lambda a: np.ascontiguousarray(a[..., :-1]),
    "a row more": lambda a: np.concatenate([a, a[:1]]), "a row less": lambda a: np.ascontiguousarray(a[:-1]),
    "huge": lambda a: np.broadcast_to(np.float64(0.0), (2**40,) * a.ndim if a.ndim == 1 else (2**31, *a.shape[1:])),
    "list": lambda a: a.tolist(), "none": lambda a: None, "number": lambda a: 1.0, "word": lambda a: "wrench",
    "bytes": lambda a: a.tobytes(), "memoryview of bytes": lambda a: memoryview(a).cast("B"), "dict": lambda a: {},
    "memoryview of int": lambda a: memoryview(array.array("q", [1] * a.size)), "type": lambda a: np.float64,
    "ctypes": lambda a: (ctypes.c_float * a.size)(*a.reshape(-1)),
    "wrapped": lambda a: type("Wrapped", (), {"__array__": lambda self, *_, **__: a, "__len__": lambda self: len(a)})(),
}  # fmt: skip
"""Ways to spoil an array."""
ROWS_OF_ANY = {"a row more", "a row less", "one more", "one less", "empty"}


def spoil(way: str, a: np.ndarray) -> object:
    with np.errstate(all="ignore"):
        return SPOILED[way](a)


def fits(name: str, argument: str, spoiled: object, right: np.ndarray, way: str) -> bool:
    """True where the changed argument is still valid: a vector in Fortran order is contiguous."""
    call = CALLS[name]
    if (argument in call.any_length and way in ROWS_OF_ANY) or (argument in call.optional and spoiled is None):
        return True
    if way == "empty" and argument == "tangents" and name != "along_normal":
        return True
    if way == "number" and argument == "friction" and name != "cone_scale":  # one for all contacts
        return True
    same = isinstance(spoiled, np.ndarray) and spoiled.dtype.char == "d" and spoiled.dtype.isnative
    return same and spoiled.flags.c_contiguous and spoiled.shape == right.shape


def refused(outcome: object) -> bool:
    return outcome is False or (type(outcome) is int and outcome == REFUSED)
