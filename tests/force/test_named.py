"""Every named problem through every entry point: one status, one objective, and claims that hold
for its force."""

from __future__ import annotations

import json
import pickle
from typing import Any

import numpy as np
import pytest
from force.clarabel_reference import Reference
from force.named import CASES, METHODS, NAMED, Named, attempt, judged, value

from grasp_env.force import (
    ForceLimits,
    ForceOptimizer,
    ForceSolution,
    Status,
    optimize_force,
    optimize_forces,
)
from grasp_env.grasp import Grasp

EACH = pytest.mark.parametrize(("name", "method"), CASES)
SMOOTH = (
    "pinch",
    "soft",
    "mixed",
    "hard, largest normal",
    "hard, normals",
    "soft, normals",
    "hard, torques",
    "hard, torques, bias",
    "soft, torsion in the torques",
    "all",
    "own joints",
    "paper, lambda 0.01",
)
"""Problems of about one newton, whose least objective has derivatives."""


def check(p: Named, method: str, found: ForceSolution, entry: str) -> None:
    """Recompute everything that a solution claims from the geometry."""
    known = p.known[method]
    reference = p.reference()
    assert found.status.value == known["status"], (entry, found)
    np.testing.assert_array_equal(found.wrench, p.wrench)
    if found.status is Status.INFEASIBLE:
        assert not found.force.any(), entry
        assert (found.objective, found.lower_bound) == (np.inf, np.inf), entry
        p.assert_infeasible(found)
        return
    size = float(np.abs(reference.load(p.wrench)).max())
    most = float(np.abs(found.force).max())
    exceeded = found.status is Status.LIMITS_EXCEEDED
    # balance is known to rounding of the largest force, at an arm that is itself known to rounding
    # of where the origin is
    away = 1.0 + float(np.abs(p.grasp.positions).max()) / reference.length
    rounding = 1e-14 * away * max(size, most)
    residual = reference.residual(found.force, found.torsion, p.wrench)
    assert residual <= 1e-9 * size + rounding, entry
    assert found.equilibrium_residual == pytest.approx(residual, abs=10.0 * rounding), entry
    np.testing.assert_array_equal(found.force[reference.transmits[:, 1] == 0.0, 1:], 0.0)
    np.testing.assert_array_equal(found.torsion[reference.gamma == 0.0], 0.0)
    held = Reference(p.grasp) if exceeded else reference
    assert held.violation(found.force, found.torsion) <= 1e-14 * max(size, most), entry
    known_to = 1e-14 * float((p.grasp.models.cone_scale * np.abs(found.force)).max()) + rounding
    assert (
        0.0
        <= found.cone_margin
        == pytest.approx(reference.cone_margin(found.force, found.torsion), abs=known_to)
    ), entry
    assert found.limit_excess == pytest.approx(
        reference.excess(found.force, found.torsion), rel=1e-9
    ), entry
    # the objective: of this force, no more than the tolerance and the digits written above the
    # least
    digits = known["digits"]
    tolerance = p.options(method)["tolerance"]
    assert found.objective == pytest.approx(
        value(p, method, found, reference), rel=1e-9, abs=1e-14
    ), entry
    assert found.lower_bound <= known["objective"] * (1.0 + digits + 1e-9), entry
    # an excess is least to a hundredth, see `digits`
    least = known["objective"] * (1.0 - (1e-6 if exceeded else digits + 1e-11))
    assert (
        least <= found.objective <= known["objective"] * (1.0 + tolerance + digits + 1e-11) + 1e-11
    ), entry
    assert exceeded or found.optimality_gap <= tolerance, entry
    prices = found.limit_multipliers
    assert (prices >= 0.0).all(), entry
    if method != "newton" and not exceeded:
        bound, theta = reference.dual_bound(found.multipliers, prices, p.wrench, method)
        assert theta > 1.0 - 1e-8, entry
        assert found.lower_bound <= bound * (1.0 + 1e-8), entry
        room = reference.bound - np.einsum(
            "kna,na->k", reference.rows, np.column_stack([found.force, found.torsion])
        )
        assert float(room @ prices) <= 1e-6 * found.objective, entry
    # vectors along the axes of the positions
    np.testing.assert_allclose(found.frames, reference.frames, atol=1e-13)
    pushed = np.einsum("nij,nj->ni", reference.frames, found.force)
    np.testing.assert_allclose(found.object_force, pushed, atol=1e-13 * most)
    limits = p.limits
    if limits is not None and limits.jacobian is not None:
        jac = np.asarray(limits.jacobian)
        torques = np.einsum("nrj,nr->j", jac[:, :3], pushed) + np.asarray(limits.torque_bias)
        torques += np.einsum(
            "nrj,nr->j",
            jac[:, 3:],
            (found.torsion[:, None] * p.grasp.normals)[:, : jac.shape[1] - 3],
        )
        np.testing.assert_allclose(found.torques, torques, atol=1e-13 * (1.0 + most))


def elsewhere(p: Named) -> tuple[Grasp, ForceLimits | None, dict[str, Any]]:
    """Return other contacts, limits with another Jacobian, and the arguments of a call that restore
    the problem."""
    rng = np.random.default_rng(1)
    grasp = p.grasp
    models = p.grasp.models
    normals = grasp.normals + 0.05 * rng.standard_normal(grasp.normals.shape)
    friction = np.where(models.friction > 0.0, models.friction, 0.7)
    gamma = np.where(models.torsional_friction > 0.0, models.torsional_friction, 1.0)
    positions = (
        grasp.positions
        - grasp.centre
        + 0.05 * grasp.length * rng.standard_normal(grasp.positions.shape)
    )
    normals = normals / np.linalg.norm(normals, axis=1)[:, None]
    rough = np.minimum(1.3 * friction, 1e4)
    same = {"contact_model": models.names, "torsional_friction": gamma}
    tangents = grasp.contacts.tangents if len(grasp.contacts.tangents) else None
    there = Grasp.from_contacts(positions, normals, rough, tangents=tangents, **same)
    now: dict[str, Any] = {
        "positions": grasp.positions,
        "normals": grasp.normals,
        "friction": friction,
    }
    limits = p.limits
    if limits is not None and limits.jacobian is not None:
        jac = np.asarray(limits.jacobian)
        now |= {"jacobian": jac, "torque_bias": np.asarray(limits.torque_bias)}
        other = 0.7 * jac + 0.01 * rng.standard_normal(jac.shape)
        limits = ForceLimits(limits.min_normal, limits.max_normal, other, limits.torque_limit)
    return there, limits, now


@EACH
def test_every_entry_point(name, method):
    """They agree to their tolerance; only starts and the order of sums differ."""
    p = NAMED[name]
    grasp = p.grasp
    wrench = p.wrench
    options = p.options(method)
    there, limits, now = elsewhere(p)
    other = {**options, "limits": limits}
    three = np.array([0.7 * wrench, wrench, -wrench])
    moved = ForceOptimizer(there, **other)
    updated = ForceOptimizer(there, **other)
    attempt(lambda: moved.solve(0.1 * wrench))
    updated.update(**now)
    optimizer = ForceOptimizer(grasp, **options)
    first = attempt(lambda: optimizer.solve(wrench))
    found = {
        "function": attempt(lambda: optimize_force(grasp, wrench, **options)),
        "optimizer": first,
        "again": attempt(lambda: pickle.loads(pickle.dumps(optimizer)).solve(wrench.tolist())),
        "moved": attempt(lambda: moved.solve(wrench, **now)),
        "updated": attempt(lambda: updated.solve(wrench)),
        "many": optimizer.solve_many(three)[1],
        "batch": optimize_forces(grasp, three, workers=2, **options)[1],
        "grasps": optimize_forces([grasp] * 3, three, **options)[1],
    }
    if method == "newton":
        remembers = ForceOptimizer(grasp, initial="previous", **options)
        attempt(lambda: remembers.solve(0.95 * wrench))
        found["previous"] = attempt(lambda: remembers.solve(wrench))
    for entry, solution in found.items():
        check(p, method, solution, entry)
    for entry in ("function", "again"):
        np.testing.assert_array_equal(found[entry]._record, first._record)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(first))._record, first._record)
    # an optimum and a proof have prices, an excess has none
    labels = optimizer.limit_labels
    prices = first.limit_multipliers
    assert len(labels) == len(p.reference().bound)
    assert len(prices) == (0 if first.status is Status.LIMITS_EXCEEDED else len(labels))


@EACH
def test_objectives_are_those_of_an_outside_judge(name, method):
    pytest.importorskip("clarabel")
    found = judged(NAMED[name], method)
    known = NAMED[name].known[method]
    assert (found["status"], found.get("by")) == (known["status"], known.get("by"))
    if "objective" in known:
        near = (
            1e-6
            if found["status"] == "limits_exceeded"
            else found["digits"] + known["digits"] + 1e-11
        )
        assert found["objective"] == pytest.approx(known["objective"], rel=near)
    json.dumps(found)


@pytest.mark.parametrize("name", SMOOTH)
@pytest.mark.parametrize("method", METHODS)
def test_multipliers_and_prices_are_derivatives(name, method):
    p = NAMED[name]
    options = {**p.options(method), "tolerance": 1e-10 if method == "newton" else 1e-9}

    def cost(wrench: np.ndarray, limits: ForceLimits | None) -> float:
        return optimize_force(p.grasp, wrench, **{**options, "limits": limits}).objective

    found = optimize_force(p.grasp, p.wrench, **options)
    for axis in range(6):
        unit = 1.0 if axis < 3 else p.grasp.length
        step = 1e-4 * unit * np.eye(6)[axis]
        slope = (cost(p.wrench + step, p.limits) - cost(p.wrench - step, p.limits)) / 2e-4
        # a kink of the conic value, or 1e-9 of it, over the step
        assert slope == pytest.approx(
            -found.multipliers[axis] * unit, abs=2e-3 * found.objective
        ), axis
    if p.limits is None or not np.isfinite(p.limits.max_normal).any():
        return
    labels = ForceOptimizer(p.grasp, **options).limit_labels
    most = np.broadcast_to(p.limits.max_normal, p.grasp.n_contacts)
    keys = (
        ("min_normal",)
        if p.limits.jacobian is None
        else ("min_normal", "jacobian", "torque_limit", "torque_bias")
    )
    given = {key: getattr(p.limits, key) for key in keys}
    for k in range(p.grasp.n_contacts):
        step = 1e-4 * np.eye(p.grasp.n_contacts)[k]
        up, down = (
            cost(p.wrench, ForceLimits(max_normal=most + s * step, **given)) for s in (1.0, -1.0)
        )
        price = found.limit_multipliers[
            [text.startswith(f"contact {k}: normal <=") for text in labels].index(True)
        ]
        assert (up - down) / 2e-4 == pytest.approx(-price, abs=1e-3 * found.objective)


@pytest.mark.parametrize(
    ("name", "method"), [(name, method) for name, method in CASES if NAMED[name].elastic]
)
def test_multipliers_of_an_excess_bound_that_of_every_wrench(name, method):
    pytest.importorskip("clarabel")
    p = NAMED[name]
    rng = np.random.default_rng(2)
    found = optimize_force(p.grasp, p.wrench, **p.options(method))
    for part in (0.3, 0.6, 0.9, 1.0, 1.1, 2.0):
        other = part * p.wrench + 0.1 * rng.standard_normal(6) * np.abs(p.wrench).max() * [
            1,
            1,
            1,
            0.03,
            0.03,
            0.03,
        ]
        bound = found.lower_bound - found.multipliers @ (other - p.wrench)
        least = p.reference().least_excess(other)  # nan: no force in the cones balances that one
        assert bound <= (np.inf if np.isnan(least) else least) + 1e-6 * found.limit_excess
