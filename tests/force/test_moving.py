"""What a call is given holds for that call: other places, frictions, Jacobians, fewer contacts, and one frame for all of it."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
import pytest
from force.generators import own_joints

from grasp_env.errors import GraspError, InfeasibleWrenchError, InvalidInputError, RankDeficientGraspError
from grasp_env.force import RULES, ForceLimits, ForceOptimizer, Status, optimize_force
from grasp_env.grasp import Grasp, presets

FIVE = presets.five_finger_cuboid()
LOAD = np.array([0.4, -0.3, 0.7, 0.01, -0.008, 0.005])


SOFT = Grasp.from_contacts(FIVE.positions, FIVE.normals, 0.4, contact_model="soft", torsional_friction=0.005)
ELLIPTIC = Grasp.from_contacts(FIVE.positions, FIVE.normals, np.tile([0.4, 0.6], (5, 1)))
JOINTS = own_joints(np.random.default_rng(7), 5)
OWN = ForceLimits(jacobian=JOINTS, torque_limit=0.5, torque_bias=np.linspace(-0.05, 0.05, 15))
SPUN = ForceLimits(jacobian=own_joints(np.random.default_rng(7), 5, rows=6), torque_limit=0.5)
SHARED = ForceLimits(jacobian=0.03 * np.random.default_rng(8).standard_normal((5, 3, 4)), torque_limit=0.9)
KINDS: dict[str, tuple[Grasp, dict[str, Any]]] = {
    "newton": (FIVE, {}), "newton, elliptic": (ELLIPTIC, {}), "newton, soft": (SOFT, {}),
    "newton, normal limits": (FIVE, {"limits": ForceLimits(min_normal=0.05, max_normal=8.0)}),
    "newton, own joints": (FIVE, {"limits": OWN}), "newton, shared joints": (FIVE, {"limits": SHARED}),
    "newton, soft, own joints": (SOFT, {"limits": SPUN}),
    "newton, elastic": (FIVE, {"limits": ForceLimits(max_normal=0.4), "elastic": True}),
    "reduced_flow": (FIVE, {"method": "reduced_flow"}), "full_flow": (FIVE, {"method": "full_flow"}),
    "conic": (FIVE, {"method": "conic"}), "conic, largest": (FIVE, {"method": "conic", "criterion": "max"}),
    "conic, own joints": (FIVE, {"method": "conic", "limits": OWN}), "conic, soft": (SOFT, {"method": "conic"}),
}  # fmt: skip


def moved(k: int) -> dict[str, np.ndarray]:
    """Places and normals a little off."""
    rng = np.random.default_rng([11, k])
    normals = FIVE.normals + 0.03 * rng.standard_normal((5, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return {"positions": FIVE.positions + 2e-3 * rng.standard_normal((5, 3)), "normals": normals}


def part_of(limits: ForceLimits | None, chosen: np.ndarray) -> ForceLimits | None:
    """The limits of those contacts; joints stay."""
    if limits is None:
        return None
    each = {name: getattr(limits, name) for name in ("min_normal", "max_normal", "torque_limit", "torque_bias")}
    each |= {name: value[chosen] for name, value in each.items() if name.endswith("normal") and np.ndim(value)}
    jacobian = limits.jacobian
    return ForceLimits(**each) if jacobian is None else ForceLimits(**each, jacobian=np.asarray(jacobian)[chosen])


@pytest.mark.parametrize("kind", KINDS)
def test_the_order_of_calls_does_not_matter(kind: str) -> None:
    """To the bit, whatever the calls between had."""
    grasp, options = KINDS[kind]
    optimizer = ForceOptimizer(grasp, **options)
    rough = 0.5 if grasp is not ELLIPTIC else np.tile([0.5, 0.5], (5, 1))
    some, others = [True, True, True, True, False], [True, False, True, True, True]
    changes = {"friction": rough}, {"contacts": some}, {**moved(1), "contacts": others}
    calls: list[dict[str, Any]] = [{}, moved(0), *changes, {}]
    if kind in ("newton", "reduced_flow"):
        calls += [{"initial": name} for name in RULES]
        calls.append(calls[0])
    limits = options.get("limits")
    if limits is not None and limits.jacobian is not None:
        calls.insert(2, {"jacobian": 0.9 * np.asarray(limits.jacobian)})
        calls.insert(4, {"torque_bias": np.full(limits.joints, 0.01)})
    forward = [optimizer.solve(LOAD, **call)._record.copy() for call in calls]
    backward = [optimizer.solve(LOAD, **call)._record.copy() for call in calls[::-1]][::-1]
    alone = [ForceOptimizer(grasp, **options).solve(LOAD, **call)._record.copy() for call in calls]
    np.testing.assert_array_equal(forward, backward)
    np.testing.assert_array_equal(forward, alone)
    np.testing.assert_array_equal(forward[0], forward[-1])
    if options.get("method", "").endswith("flow"):  # which the named problems do not ask
        there = Grasp.from_contacts(**moved(0), friction=0.4)
        want = optimize_force(there, LOAD, **options)
        assert optimizer.solve(LOAD, **moved(0)).objective == pytest.approx(want.objective, rel=3e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_any_contacts_that_touch_are_a_grasp_of_those(kind: str) -> None:
    """The same verdict and optimum as a grasp of that subset, and no force elsewhere: all 31 subsets of five."""
    grasp, options = KINDS[kind]
    optimizer = ForceOptimizer(grasp, **options)
    close = 0.02 if options.get("elastic") else 3e-6 if "conic" in kind else 3e-4
    solved, twist = 0, 0.005 if grasp is SOFT else None
    for bits in range(1, 32):
        touching = np.array([bool(bits >> k & 1) for k in range(5)])
        places = grasp.positions[touching], grasp.normals[touching], grasp.models.friction[touching]
        chosen = {**options, "limits": part_of(options.get("limits"), touching)}
        try:
            part = Grasp.from_contacts(*places, contact_model=grasp.models.names[0], torsional_friction=twist)
            want = optimize_force(part, LOAD, **chosen)
        except GraspError as error:
            with pytest.raises(type(error)):
                optimizer.solve(LOAD, contacts=touching)
            continue
        found = optimizer.solve(LOAD, contacts=touching)
        solved += 1
        assert found.status is want.status, (bits, found, want)
        assert found.objective == pytest.approx(want.objective, rel=close), (bits, found, want)
        for nothing in (found.force, found.torsion, found.object_force):
            assert (nothing[~touching] == 0.0).all()
        assert part.residual(found.force[touching], LOAD, found.torsion[touching]) < 1e-9
    assert solved > 3


def test_no_contact_and_lists_of_bits() -> None:
    optimizer = ForceOptimizer(FIVE)
    with pytest.raises(RankDeficientGraspError):
        optimizer.solve(LOAD, contacts=[False] * 5)
    whole = optimizer.solve(LOAD).force
    for every in ((True,) * 5, np.ones(5, dtype=bool)):
        np.testing.assert_array_equal(optimizer.solve(LOAD, contacts=every).force, whole)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"positions": np.zeros((4, 3))}, r"positions must have shape \(5, 3\), got \(4, 3\)"), ({"positions": "here"}, "positions must be numbers"),
        ({"positions": np.full((5, 3), np.nan)}, "positions must be finite"), ({"normals": np.ones(3)}, r"normals must have shape \(5, 3\)"),
        ({"normals": 2.0 * FIVE.normals}, "normal"), ({"normals": np.zeros((5, 3))}, "normal"),
        *(({"friction": odd}, "friction") for odd in (-0.1, [0.4, 0.4], np.nan, "rough")),
        ({"jacobian": np.zeros((5, 3, 4))}, "jacobian must be that of 15 joints"), ({"jacobian": np.zeros((4, 3, 15))}, "jacobian"),
        ({"jacobian": np.full((5, 3, 15), np.inf)}, "jacobian"),
        *(({"torque_bias": odd}, "torque_bias") for odd in (np.zeros(4), np.full(15, np.nan), "none")),
        *(({"contacts": odd}, r"contacts must be \(5,\) of true and false")
          for odd in ([True] * 4, 3, "11111", [1, 1, 1, 1, 1], np.ones(5), [[True] * 5])),
        ({"jacobian": JOINTS, "without": 1}, "torque|jacobian"), ({"torque_bias": np.zeros(15), "without": 1}, "torque"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_named(given: dict[str, Any], told: str) -> None:
    """Torques need limits: "without" them is wrong, too."""
    given = dict(given)
    optimizer = ForceOptimizer(FIVE, limits=None if given.pop("without", None) else OWN)
    before = optimizer.solve(LOAD)
    for call in (partial(optimizer.solve, LOAD), optimizer.update)[: 1 if "contacts" in given else 2]:
        with pytest.raises(InvalidInputError, match=told):
            call(**given)
    np.testing.assert_array_equal(optimizer.solve(LOAD).force, before.force)


@pytest.mark.parametrize("method", ["newton", "conic"])
@pytest.mark.parametrize("limits", [None, ForceLimits(jacobian=np.full((3, 3, 1), 0.01), torque_limit=5.0)])
def test_contacts_on_a_line_lose_their_rank(method: str, limits: ForceLimits | None) -> None:
    """Also where joints that fingers share send them to the general program."""
    optimizer = ForceOptimizer(presets.tripod(), method=method, limits=limits)
    line = {"positions": [[0, 0, 0], [0, 0, 0.1], [0, 0, 0.2]], "normals": [[1.0, 0, 0]] * 3}
    with pytest.raises(RankDeficientGraspError):
        optimizer.solve(LOAD, **line)
    with pytest.raises(RankDeficientGraspError):
        optimizer.update(**line)
    assert optimizer.solve(0.1 * LOAD).status is Status.OPTIMAL


@pytest.mark.parametrize("options", [{}, {"method": "reduced_flow"}, {"limits": ForceLimits(max_normal=8.0)}], ids=str)
def test_previous_never_fails_where_no_start_is_named(options: dict[str, Any]) -> None:
    """An object that lies on three tips: there is no force closure, and what was before fits or is replaced."""
    rng = np.random.default_rng(17)
    tips = np.array([[0.03, 0.0, 0.0], [-0.02, 0.03, 0.0], [-0.02, -0.03, 0.0]])
    floor = Grasp.from_contacts(tips, [[0.0, 0.0, 1.0]] * 3, 0.5)
    cold, warm = (ForceOptimizer(floor, **options, initial=start) for start in (None, "previous"))
    solved = replaced = 0
    for k in range(200):
        load = np.array([0.0, 0.0, -3.0, 0.0, 0.0, 0.0]) + rng.standard_normal(6) * [0.6, 0.6, 1.5, 0.02, 0.02, 0.002]
        now = {"positions": tips + 2e-3 * rng.standard_normal((3, 3))} if k % 3 else {}
        want = None
        with suppress(InfeasibleWrenchError):
            want = cold.solve(load, **now)
        if want is None:
            with pytest.raises(InfeasibleWrenchError):
                warm.solve(load, **now)
            continue
        found = warm.solve(load, **now)
        solved += 1
        replaced += found.start_replaced
        assert found.status is want.status is Status.OPTIMAL
        assert found.objective == pytest.approx(want.objective, rel=3e-4)
    assert solved > 100
    assert replaced > 0
