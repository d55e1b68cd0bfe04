"""Every call of the compiled module that takes arrays, with arguments that are right: what `test_boundary` then spoils."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from samples import sample, wrenches
from test_pipeline import reference_of

from grasp_env.core import _core
from grasp_env.force import ForceLimits, ForceSolution
from grasp_env.force.program import ForceProgram
from grasp_env.force.solution import STARTS
from grasp_env.grasp import Grasp

REFUSED = _core.codes()["refused"]
TOLERANCE, LIMIT = 1e-6, 100
COUNT = 4
SAMPLE = sample(COUNT)
LOADS = wrenches(np.random.default_rng(0), 3)
SIZE = _core.record_size(COUNT)
INTERNAL = reference_of(SAMPLE)
RULE = np.array([2.0, 0.3, 1.5, 0.5, 0.0])


LIMITS = {
    "least": np.full(COUNT, 0.1), "most": np.full(COUNT, 9.0), "jacobian": np.full((COUNT, 4, 3), 0.05),
    "torques": np.ones(3), "biases": np.zeros(3),
}  # fmt: skip


def contacts() -> _core.Contacts:
    s = SAMPLE
    return _core.Contacts.make(s.positions, s.normals, s.scale, s.weights, np.zeros((0, 3)))


def newton() -> _core.Newton:
    made = _core.Newton.make(contacts(), TOLERANCE, LIMIT)
    made.set_basis(SAMPLE.basis)
    return made


def flow() -> _core.Flow:
    made = _core.Flow.on(contacts(), TOLERANCE, LIMIT, "reduced", RULE)
    made.set_basis(SAMPLE.basis)
    return made


def conic() -> _core.Conic:
    return _core.Conic.make(contacts(), TOLERANCE, LIMIT, SAMPLE.rest)


def rows() -> dict[str, np.ndarray]:
    """Two joints on the first finger, each with both sides."""
    a = np.array([[0.6, 0.8, 0.0], [0.8, 0.0, 0.6]])
    one = np.ones(4)
    return {
        "normals": np.vstack([a, -a]),
        "bounds": 9.0 * one,
        "shares": one,
        "weights": 0.01 * one,
        "owners": 0.0 * one,
    }


def limited() -> _core.LimitedNewton:
    return _core.LimitedNewton.make(contacts(), TOLERANCE, LIMIT, **rows(), basis=SAMPLE.basis, elastic=True)


def pipeline() -> _core.Pipeline:
    return _core.Pipeline.make(contacts(), TOLERANCE, LIMIT, SAMPLE.basis, SAMPLE.frames, True, INTERNAL)


LIMITED = LIMITS | {"jacobian": np.full((COUNT, 6, 3), 0.05)}


def optimizer(**given: Any) -> _core.ForceOptimizer:
    """Within limits on normal forces and three joints."""
    least, most, jacobian, torques, biases = LIMITED.values()
    arrays: dict[str, Any] = {
        "weights": SAMPLE.weights, "min_normal": least, "max_normal": most, "jacobian": jacobian, "torque_limit": torques,
        "torque_bias": biases, "rule": None,
    }  # fmt: skip
    options: dict[str, Any] = {
        "force_weight": 1.0, "barrier_weight": 0.01, "method": "newton", "largest": False, "start": 0, "tolerance": TOLERANCE,
        "limit": LIMIT, "elastic": False, "model": None, "kind": ForceSolution, "name": "newton", "starts": STARTS,
        "asked": "internal_force", "remembers": False,
    }  # fmt: skip
    return _core.ForceOptimizer.make(contacts(), **arrays | options | given)


def model(placed: bool = True) -> _core.Model:
    """A network of these contacts."""
    made = _core.Model.make(_core.Network.make([8, 6], 0.1 * np.random.default_rng(0).standard_normal(54)))
    made.normalise(0.05, 0.2, 0.5, 1.3, 0.4, 0.12)
    if placed:
        made.place(INTERNAL, 0.5, 1.0, 20.0)
    return made


def learned() -> _core.Learned:
    return _core.Learned.make(contacts(), TOLERANCE, LIMIT, SAMPLE.basis, model())


def program() -> tuple[_core.Program, dict[str, np.ndarray]]:
    """A program with one limit, u_0 <= 100 N, and the arrays that it is made of."""
    s = SAMPLE
    grasp = Grasp.from_contacts(s.positions, s.normals, 0.5)
    made = ForceProgram(grasp, ForceLimits(max_normal=[100.0, np.inf, np.inf, np.inf]), elastic=True)
    divisor = np.concatenate([grasp.models.cone_divisor, made.torsion_divisor[:, None]], axis=1)
    given = {"frame": made.frame, "balance": made.balance, "rows": made.rows, "bound": made.bound, "divisor": divisor}
    given["shares"] = 100.0 * np.ones(1)
    return made.solver, {name: np.ascontiguousarray(array) for name, array in given.items()}


def deepest() -> np.ndarray:
    """A start for `least_phi`."""
    z = np.zeros((COUNT, 4))
    assert program()[0].deepest(LOADS[0], 1e-7, z, np.zeros(6))[0] == 0
    return z


def begun() -> _core.Pipeline:
    made = pipeline()
    assert made.solve(SAMPLE.positions, SAMPLE.normals, LOADS[0], None, np.zeros(SIZE)) == 0
    return made


@dataclass(frozen=True)
class Call:
    """One call.

    Attributes:
        run: takes the arrays by name.
        given: the arrays that are read; written: those that are filled, by their shapes.
        any_length: those of `given` and `written` whose first axis may have any length.
    """

    run: Callable[..., object]
    given: dict[str, np.ndarray]
    written: dict[str, tuple[int, ...]]
    any_length: frozenset[str] = frozenset()

    def arguments(self) -> dict[str, np.ndarray]:
        """Right ones, nothing shared."""
        return {name: a.copy() for name, a in self.given.items()} | {
            name: np.full(shape, -7.0) for name, shape in self.written.items()
        }


def _record() -> np.ndarray:
    row = np.zeros(SIZE)
    assert newton().solve(LOADS[1], None, row) == 0
    return row


def calls() -> dict[str, Call]:
    s, x = SAMPLE, SAMPLE.basis[0]
    force = (x / s.divisor.reshape(-1)).reshape(COUNT, 3)
    records, many = np.array([_record()] * 3), (3, SIZE)
    basis, n, c, p, start, bounded = {"basis": s.basis}, newton(), conic(), pipeline(), learned(), limited()
    moved = {"points": s.positions, "normals": s.normals, "wrench": LOADS[0]}
    place = {"positions": s.positions, "normals": s.normals}
    optional = {"tangents": s.frames[:, :, 1].copy()}
    made = {"tolerance": TOLERANCE, "limit": LIMIT}
    one: Any = optimizer()
    now: dict[str, Any] = place | {
        "friction": s.scale[:, :1] / s.scale[:, 1:],
        "jacobian": LIMITED["jacobian"],
        "torque_bias": LIMITED["biases"],
    }
    own = {"start": STARTS.index("given"), "before": None, "contacts": None}
    first: Any = one.solve(LOADS[0], *(6 * [None]))
    balanced = {"force": first.force.copy(), "wrench": LOADS[0]}
    whole = {"rows": (3, one.size)}
    return {
        "Contacts.make": Call(_core.Contacts.make, place | {"scale": s.scale, "weights": s.weights} | optional, {}),
        "Contacts.put": Call(
            _core.Contacts.put, place | {"scale": s.scale, "torsion": np.full(COUNT, 0.01)} | optional, {}
        ),
        "Contacts.weighed": Call(contacts().weighed, {"weights": s.weights}, {}),
        "ForceOptimizer.make": Call(
            optimizer,
            {"weights": s.weights, "min_normal": LIMITED["least"], "max_normal": LIMITED["most"], "rule": RULE}
            | {"jacobian": LIMITED["jacobian"], "torque_limit": LIMITED["torques"], "torque_bias": LIMITED["biases"]},
            {},
        ),
        # what it cannot read it leaves to Python
        "ForceOptimizer.solve": Call(
            lambda **given: one.solve(**given, contacts=None) is not None, now | {"wrench": LOADS[0]}, {}
        ),
        "ForceOptimizer.solve_from": Call(
            lambda **given: one.solve_from(**given, **own, initial="given", optimum=np.nan) is not None,
            balanced | now,
            {"trace": (5,)},
            frozenset({"trace"}),
        ),
        "ForceOptimizer.start": Call(lambda **given: bool(one.start(**given, **own)[0] != REFUSED), balanced | now, {}),
        "ForceOptimizer.update": Call(optimizer().update, now, {}),
        "ForceOptimizer.set_basis": Call(optimizer().set_basis, basis, {}),
        "ForceOptimizer.solve_many": Call(one.solve_many, {"wrenches": LOADS}, whole),
        "ForceOptimizer.times": Call(partial(one.times, passes=1), {"wrenches": LOADS}, whole | {"best": (3,)}),
        "along_normal": Call(_core.along_normal, optional | {"normals": s.normals}, {}),
        "cone_scale": Call(_core.cone_scale, {"friction": np.full((COUNT, 2), 0.4)}, {"scale": (COUNT, 3)}),
        "limit_rows": Call(_core.limit_rows, LIMITS, {"matrix": (14, COUNT, 4), "bounds": (14,), "limited": (14,)}),
        "contact_rows": Call(
            _core.contact_rows,
            {"divisor": s.divisor, "lambdas": s.weights[:, 1].copy(), "matrix": np.eye(12).reshape(12, COUNT, 3)}
            | {"bounds": np.ones(12), "limited": np.ones(12)},
            {"normals": (12, 3), "table": (5, 12)},
        ),
        "combine": Call(partial(_core.combine, printed=False), basis | {"wrench": LOADS[0]}, {"to": (12,)}),
        "solve_scaled": Call(
            partial(_core.solve_scaled, contacts(), **made),
            {"scales": np.array([s.scale]), "wrenches": np.eye(6)[:1], "forces": force[None]},
            {"records": (1, SIZE)},
        ),
        **{
            name: Call(
                partial(call, **made),
                {
                    "positions": s.positions[None],
                    "normals": s.normals[None],
                    "scales": np.array([s.scale]),
                    "tangents": s.frames[None, :, :, 1].copy(),
                    "weights": s.weights,
                    "first": np.array([0.0, 3.0]),
                    "wrenches": LOADS,
                },
                {"records": many},
            )
            for name, call in (("newton_grasps", _core.newton_grasps), ("conic_grasps", _core.conic_grasps))
        },
        "newton_grasps of contacts": Call(
            partial(_core.newton_grasps, [contacts()], **made),
            {"weights": s.weights, "first": np.array([0.0, 3.0]), "wrenches": LOADS},
            {"records": (3, SIZE + 9 * COUNT)},
        ),
        "Newton.set_basis": Call(newton().set_basis, basis, {}),
        "Newton.make_basis": Call(partial(newton().make_basis, warm=True), {"interior": s.rest}, {"basis": (13, 12)}),
        "Newton.internal_force": Call(n.internal_force, {}, {"x": (12,)}),
        "Newton.solve": Call(n.solve, {"wrench": LOADS[0], "previous": records[0]}, {"record": (SIZE,)}),
        "Newton.descend": Call(
            partial(n.descend, optimum=np.nan),
            {"wrench": np.eye(6)[0], "force": force},
            {"trace": (5,), "record": (SIZE,)},
            frozenset({"trace"}),
        ),
        "Newton.solve_many": Call(n.solve_many, {"wrenches": LOADS, "previous": records}, {"records": many}),
        "Newton.times": Call(partial(n.times, passes=1), {"wrenches": LOADS}, {"records": many, "best": (3,)}),
        "Newton.carry": Call(
            partial(n.carry, tangent=True), {"wrench": LOADS[0], "previous": force}, {"force": (COUNT, 3)}
        ),
        "Newton.repair": Call(n.repair, {"wrench": LOADS[0], "candidate": force}, {"force": (COUNT, 3)}),
        "Newton.inside": Call(n.inside, {"point": x, "ray": s.rest}, {}),
        "Newton.newton_step": Call(n.newton_step, {"wrench": LOADS[0], "x": x}, {"step": (12,), "multipliers": (6,)}),
        "Newton.segment": Call(lambda safe, x: n.segment(safe, x), {"safe": s.rest}, {"x": (12,)}),
        "Flow.on": Call(partial(_core.Flow.on, contacts(), form="paper", **made), {"rule": RULE}, {}),
        "Flow.repeat": Call(partial(flow().repeat, times=2), {"x": x}, {}),
        "Flow.solve": Call(flow().solve, {"wrench": LOADS[0], "previous": records[0]}, {"record": (SIZE,)}),
        "LimitedNewton.make": Call(
            partial(_core.LimitedNewton.make, contacts(), elastic=True, **made), rows() | basis, {}
        ),
        "LimitedNewton.solve": Call(bounded.solve, {"wrench": LOADS[0], "previous": records[0]}, {"record": (SIZE,)}),
        "LimitedNewton.descend": Call(bounded.descend, {"wrench": np.eye(6)[0], "force": force}, {"record": (SIZE,)}),
        "LimitedNewton.solve_many": Call(
            bounded.solve_many, {"wrenches": LOADS, "previous": records}, {"records": many}
        ),
        "LimitedNewton.times": Call(
            partial(bounded.times, passes=1), {"wrenches": LOADS}, {"records": many, "best": (3,)}
        ),
        "Conic.make": Call(partial(_core.Conic.make, contacts(), **made), {"interior": s.rest}, {}),
        "Conic.solve": Call(partial(c.solve, previous=None), {"wrench": LOADS[0]}, {"record": (SIZE,)}),
        "Conic.solve_many": Call(partial(c.solve_many, previous=None), {"wrenches": LOADS}, {"records": many}),
        "Conic.times": Call(partial(c.times, passes=1), {"wrenches": LOADS}, {"records": many, "best": (3,)}),
        "Network.make": Call(partial(_core.Network.make, [8, 6]), {"weights": np.full(54, 0.1)}, {}),
        "Learned.make": Call(partial(_core.Learned.make, contacts(), TOLERANCE, LIMIT, model=model()), basis, {}),
        "Learned.start": Call(start.start, {"wrench": LOADS[0], "previous": records[0]}, {"record": (SIZE,)}),
        "Learned.solve": Call(start.solve, {"wrench": LOADS[0], "previous": records[0]}, {"record": (SIZE,)}),
        "Learned.predict": Call(start.predict, {"wrench": LOADS[0]}, {"force": (COUNT, 3)}),
        "Learned.covers": Call(start.covers, {"wrench": LOADS[0]}, {}),
        "Learned.solve_many": Call(start.solve_many, {"wrenches": LOADS, "previous": records}, {"records": many}),
        "Learned.times": Call(partial(start.times, passes=1), {"wrenches": LOADS}, {"records": many, "best": (3,)}),
        "Program.make": Call(partial(_core.Program.make, elastic=True), program()[1], {}),
        "Program.least_force": Call(
            partial(program()[0].least_force, largest=True, **made),
            {"wrench": LOADS[0]},
            {"record": (SIZE,), "prices": (1,)},
        ),
        "Program.least_excess": Call(
            partial(program()[0].least_excess, limit=LIMIT),
            {"wrench": LOADS[0]},
            {"record": (SIZE,), "prices": (1,)},
        ),
        "Program.deepest": Call(
            partial(program()[0].deepest, tolerance=1e-7), {"wrench": LOADS[0]}, {"z": (COUNT, 4), "twist": (6,)}
        ),
        "Program.least_phi": Call(
            partial(program()[0].least_phi, optimum=np.nan, **made),
            {"wrench": LOADS[0], "weights": s.weights, "row_weights": np.ones(1), "z": deepest()},
            {"trace": (5,), "record": (SIZE,), "prices": (1,)},
            frozenset({"trace"}),
        ),
        "Pipeline.make": Call(
            partial(_core.Pipeline.make, contacts(), remembers=True, **made),
            basis | {"frames": s.frames, "reference": INTERNAL, "flows": RULE},
            {},
        ),
        "Pipeline.set_basis": Call(pipeline().set_basis, basis | {"frames": s.frames}, {}),
        "Pipeline.solve": Call(p.solve, moved | {"adjust": np.full(6, 0.1)}, {"record": (SIZE,)}),
        "Pipeline.carry": Call(begun().carry, moved, {"force": (COUNT, 3)}),
    }


CALLS = calls()
