"""Soft contacts: friction and torsion in one cone. Known pinches, what solutions claim computed again,
limits and margins against Clarabel, and torsional friction that is zero or vanishes."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from force.clarabel_reference import Reference
from force.generators import own_joints, random_wrench, some_grasp
from oracles import margin as margin_oracle
from oracles import newton
from oracles import phi as oracle

from grasp_env.errors import GraspError, InfeasibleWrenchError
from grasp_env.force import (
    ForceLimits,
    ForceOptimizer,
    ForceSolution,
    Margin,
    Objective,
    Status,
    optimize_force,
    optimize_forces,
)
from grasp_env.grasp import Grasp, presets, transformed
from grasp_env.quality import feasibility, force_closure, worst_case

FIVE = presets.five_finger_cuboid()
LOAD = np.array([0.4, -0.3, 0.7, 0.01, -0.008, 0.005])
LEVERS = 0.03 * np.random.default_rng(8).standard_normal((5, 6, 4))


def five(models: str | list[str], gamma: Any, friction: Any = 0.4) -> Grasp:
    return Grasp.from_contacts(
        FIVE.positions,
        FIVE.normals,
        friction,
        contact_model=models,
        torsional_friction=gamma,
        tangents=np.random.default_rng(3).standard_normal((5, 3)),
    )


# --- soft contacts with torsional friction 0 are hard ones

SOME = ["soft", "soft", "frictionless", "hard", "soft"]
GAMMA = np.array([0.004, 0.0, 0.0, 0.0, 0.01])
ELLIPTIC = np.linspace([0.3, 0.5], [0.6, 0.4], 5)
PAIRS = {
    "all": (five("hard", None), five("soft", 0.0)),
    "elliptic": (five("hard", None, ELLIPTIC), five(["soft"] * 5, np.zeros(5), ELLIPTIC)),
    "some": (
        five(["soft", *["hard"] * 4], GAMMA * [1, 0, 0, 0, 0]),
        five("soft", GAMMA * [1, 0, 0, 0, 0]),
    ),
    "every model": (five([SOME[0], "hard", *SOME[2:]], GAMMA), five(SOME, GAMMA)),
}
"""The same contacts, those without torsion once called hard and once soft."""
OWN = ForceLimits(jacobian=own_joints(np.random.default_rng(7), 5, rows=6), torque_limit=0.5)
SHARED = ForceLimits(jacobian=LEVERS, torque_limit=1.5, max_normal=40.0)
OPTIONS: dict[str, dict[str, Any]] = {
    "newton": {},
    "newton, weights": {"force_weight": [1.0, 2.0, 0.5, 1.0, 3.0], "barrier_weight": 0.2},
    "newton, normal limits": {"limits": ForceLimits(min_normal=0.05, max_normal=30.0)},
    "newton, own joints": {"limits": OWN},
    "newton, shared joints": {"limits": SHARED},
    "newton, exceeded": {"limits": ForceLimits(max_normal=0.2), "elastic": True},
    "newton, infeasible": {"limits": ForceLimits(max_normal=0.2)},
    "newton, margin": {"margin": Margin(0.8, preload=[0.3, 0.0, 0.1, 0.2, 0.5])},
    "newton, phase one": {"initial": "phase_one"},
    "conic": {"method": "conic"},
    "conic, largest": {"method": "conic", "criterion": "max"},
    "conic, shared joints": {"method": "conic", "limits": SHARED},
    "conic, exceeded": {"method": "conic", "limits": ForceLimits(max_normal=0.2), "elastic": True},
    "conic, infeasible": {"method": "conic", "limits": ForceLimits(max_normal=0.2)},
    "conic, margin": {"method": "conic", "margin": 0.7},
    "reduced_flow": {"method": "reduced_flow", "max_iterations": 500},
    "full_flow": {"method": "full_flow", "max_iterations": 100},
}
MASK = [True, True, True, True, False]
MOVED = {
    "positions": FIVE.positions + 1e-3 * np.random.default_rng(4).standard_normal((5, 3)),
    "friction": 0.5,
}


def said(call: Any) -> tuple[np.ndarray | None, str]:
    """The record of a solution or of a proof, and the words of an error."""
    try:
        found = call()
    except GraspError as error:
        solution = getattr(error, "solution", None)
        return None if solution is None else solution._record.copy(), str(error)
    return found._record.copy(), repr(found)


@pytest.mark.parametrize("kind", OPTIONS)
@pytest.mark.parametrize("pair", PAIRS)
def test_without_torsional_friction_it_is_a_hard_contact_bit_for_bit(pair, kind):
    options = OPTIONS[kind]
    answers = []
    for grasp in PAIRS[pair]:
        if "flow" in kind and not grasp.hard:
            pytest.skip("flows know no torsion")
        solver = ForceOptimizer(grasp, **options)
        calls = [
            lambda on=solver: on.solve(LOAD),
            lambda on=solver: on.solve(1.1 * LOAD, initial="previous"),
            lambda on=solver: on.solve(LOAD, **MOVED),
            lambda on=solver: on.solve(LOAD, contacts=MASK),
            lambda on=solver: pickle.loads(pickle.dumps(on)).solve(-LOAD),
        ]
        if "conic" in kind or "flow" in kind:
            calls.pop(1)
        plain = {name: value for name, value in options.items() if name != "initial"}
        batch = optimize_forces([grasp] * 3, np.array([LOAD, -LOAD, 0.0 * LOAD]), **plain)
        answers.append([*map(said, calls), (batch.force, ""), (batch.lower_bound, "")])
    for (one, words), (other, others) in zip(*answers, strict=True):
        assert words == others
        np.testing.assert_array_equal(one, other)
    assert any(one is not None and np.isfinite(one).any() for one, _ in answers[0])


def test_a_grasp_keeps_contacts_without_torsional_friction():
    """Whatever makes another grasp of one knows that soft contacts may have none."""
    hard, soft = PAIRS["all"]
    assert soft.hard
    assert soft.rank == 6
    np.testing.assert_array_equal(soft.models.tangential, 2.0)
    np.testing.assert_array_equal(soft.models.torsion_scale, 0.0)
    np.testing.assert_array_equal(soft.torsion_matrix, 0.0)
    turned = transformed(soft, np.eye(3), np.array([0.1, 0.0, 0.0]))
    for other in (soft.with_friction(0.3), turned, pickle.loads(pickle.dumps(soft))):
        assert other.models.names == ("soft",) * 5
        np.testing.assert_array_equal(other.models.torsional_friction, 0.0)
    assert (soft.with_friction(0.3, 0.01).models.torsional_friction == 0.01).all()
    assert force_closure(soft).margin == force_closure(hard).margin
    assert feasibility(soft, LOAD).margin == feasibility(hard, LOAD).margin
    loads = np.random.default_rng(0).standard_normal((5, 6)) * 0.1
    one, other = worst_case(soft, loads), worst_case(hard, loads)
    np.testing.assert_array_equal(one.wrench, other.wrench)


# --- pinches with known optima

SHEAR, MU, PATCH = 5.0, 0.5, 0.005


def pinch(gamma: float = PATCH) -> Grasp:
    return Grasp.from_contacts(
        [[-0.02, 0.0, 0.0], [0.02, 0.0, 0.0]],
        [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]],
        MU,
        contact_model="soft",
        torsional_friction=gamma,
    )


def eccentric(offset: float) -> np.ndarray:
    """A weight `offset` beside the axis of the pinch."""
    return np.array([0.0, 0.0, -SHEAR, -SHEAR * offset, 0.0, 0.0])


@pytest.mark.parametrize("offset", [0.0, 1e-4, 0.002, 0.005, 0.01, 0.02, 0.3])
def test_a_pinch_presses_with_the_root_of_the_sum_of_squares(offset):
    """Each finger bears half of the weight and half of its moment: mu N and gamma N are the legs of
    a right triangle, N its hypotenuse. Where torsion and friction had cones of their own, N would
    be the larger leg."""
    normal = np.hypot(SHEAR / 2.0 / MU, SHEAR * offset / 2.0 / PATCH)
    for criterion, least in (("sum", 2.0 * normal), ("max", normal)):
        found = optimize_force(
            pinch(), eccentric(offset), method="conic", criterion=criterion, tolerance=1e-9
        )
        assert found.objective == pytest.approx(least, rel=2e-9)
        assert found.lower_bound <= least * (1.0 + 1e-12)
        np.testing.assert_allclose(found.force[:, 0], normal, rtol=1e-6)
        np.testing.assert_allclose(np.abs(found.torsion), SHEAR * offset / 2.0, atol=1e-9)
        np.testing.assert_allclose(found.friction_used, 1.0, rtol=1e-6)
    # Phi of both fingers is one of a number
    found = optimize_force(pinch(), eccentric(offset), tolerance=1e-10)
    legs = np.array([SHEAR / 2.0, 0.0, MU / PATCH * SHEAR * offset / 2.0])
    u = MU * found.force[0, 0]
    assert u > np.hypot.reduce(legs)
    pull = oracle.gradient(np.array([u, *legs]), np.array([[1.0, 0.01, 2.0]]))
    assert abs(pull[0]) < 1e-3
    assert found.objective == pytest.approx(
        2.0 * float(oracle.phi(np.array([u, *legs]), np.array([[1.0, 0.01, 2.0]]))), rel=1e-9
    )
    np.testing.assert_allclose(found.friction_used, np.hypot.reduce(legs) / u, rtol=1e-9)


@pytest.mark.parametrize("method", ["newton", "conic"])
@pytest.mark.parametrize("elastic", [False, True])
@pytest.mark.parametrize("offset", [0.002, 0.005, 0.02])
def test_a_pinch_within_limits_holds_up_to_that_and_no_further(offset, method, elastic):
    normal = np.hypot(SHEAR / 2.0 / MU, SHEAR * offset / 2.0 / PATCH)
    wrench = eccentric(offset)
    enough = ForceLimits(max_normal=normal * (1.0 + 1e-4))
    options = {"method": method, "elastic": elastic}
    found = optimize_force(pinch(), wrench, limits=enough, **options)
    assert found.status is Status.OPTIMAL
    assert (found.force[:, 0] < normal * (1.0 + 1e-4)).all()
    assert found.friction_used.max() <= 1.0
    short = ForceLimits(max_normal=normal * (1.0 - 1e-3))
    if elastic:
        found = optimize_force(pinch(), wrench, limits=short, **options)
        assert found.status is Status.LIMITS_EXCEEDED
        assert found.limit_excess == pytest.approx(1.0 / (1.0 - 1e-3) - 1.0, rel=0.011, abs=1e-6)
        assert found.friction_used.max() <= 1.0
        return
    with pytest.raises(InfeasibleWrenchError) as error:
        optimize_force(pinch(), wrench, limits=short, **options)
    proof = error.value.solution
    assert proof is not None
    assert Reference(pinch(), short).proof(proof.certificate, wrench, proof.limit_multipliers) >= (
        -1e-9
    )
    assert "friction cones of contacts 0, 1" in str(error.value)


# --- what solutions claim, computed again


def weights_of(grasp: Grasp, omega: float = 1.0, lam: float = 0.01) -> np.ndarray:
    """(N, 3) the weights of `oracles.phi`, from the models' names."""
    parts = {"hard": 2.0, "frictionless": 0.0, "soft": 3.0}
    return np.array([[omega, lam, parts[name] - 1.0] for name in grasp.models.names])


def cone_coordinates(grasp: Grasp, force: np.ndarray, torsion: np.ndarray) -> np.ndarray:
    """(4N,) of friction and torsional friction."""
    rows = []
    for f, turn, (mu_o, mu_t), gamma in zip(
        force, torsion, grasp.models.friction, grasp.models.torsional_friction, strict=True
    ):
        mu = np.sqrt(mu_o * mu_t)
        if mu == 0.0:
            rows.append([f[0], 0.0, 0.0, 0.0])
            continue
        v = mu / gamma * turn if gamma > 0.0 else 0.0
        rows.append([mu * f[0], mu / mu_o * f[1], mu / mu_t * f[2], v])
    return np.array(rows).reshape(-1)


def cone_matrix(grasp: Grasp, reference: Reference) -> np.ndarray:
    """(6, 4N) G of cone coordinates about the centre, moments per length."""
    units = cone_coordinates(grasp, np.ones((grasp.n_contacts, 3)), np.ones(grasp.n_contacts))
    flat = reference.matrix.reshape(6, -1)
    return np.where(units > 0.0, flat / np.where(units > 0.0, units, 1.0), 0.0)


KINDS = ("soft", "mixed")


@pytest.mark.parametrize("kind", KINDS)
def test_phi_and_its_bound_are_those_of_the_coupled_cone(kind):
    rng = np.random.default_rng(5)
    most = 0.0
    for _ in range(25):
        grasp = some_grasp(rng, kind, most=8)
        wrench = random_wrench(rng, grasp, 1e-2, 1e2)
        omega, lam = 10.0 ** rng.uniform(-1, 1), 10.0 ** rng.uniform(-4, 0)
        objective = Objective(omega, lam)
        try:
            found = optimize_force(grasp, wrench, force_weight=omega, barrier_weight=lam)
        except InfeasibleWrenchError as error:
            proof = error.solution
            assert proof is not None
            if grasp.rank == 6:  # else it moves no contact
                assert Reference(grasp).proof(proof.certificate, wrench) >= -1e-7
            continue
        assert found.status is Status.OPTIMAL
        reference = Reference(grasp)
        x = cone_coordinates(grasp, found.force, found.torsion)
        weights = weights_of(grasp, omega, lam)
        value = float(oracle.phi(x, weights))
        assert found.objective == pytest.approx(value, rel=1e-9)
        assert objective.of(grasp, found.force, found.torsion) == pytest.approx(value, rel=1e-12)
        np.testing.assert_allclose(grasp.to_cone(found.force, found.torsion), x, rtol=1e-14)
        tangential = weights[:, 2] + 1.0
        np.testing.assert_array_equal(grasp.models.tangential, tangential)
        assert objective.value(x, tangential) == pytest.approx(value, rel=1e-12)
        np.testing.assert_allclose(
            objective.gradient(x, tangential), oracle.gradient(x, weights), rtol=1e-9, atol=1e-9
        )
        blocks = objective.hessian(x, tangential)
        full = oracle.hessian(x, weights)
        for k, block in enumerate(blocks):
            each = full[4 * k : 4 * k + 4, 4 * k : 4 * k + 4]
            np.testing.assert_allclose(block, each, rtol=0, atol=1e-9 * np.abs(each).max())
        # the bound
        matrix = cone_matrix(grasp, reference)
        nu = reference._at_centre(found.multipliers)
        load = reference.load(wrench)
        bound = oracle.lower_bound(nu, matrix, load, weights)
        assert objective.lower_bound(nu, matrix, load, tangential) == pytest.approx(bound, rel=1e-9)
        assert found.lower_bound <= bound * (1.0 + 1e-9)
        assert found.lower_bound == pytest.approx(bound, rel=1e-7)
        assert value <= bound * (1.0 + 1.01e-4)
        # the cone
        force = np.column_stack([found.force, found.torsion])
        models = grasp.models
        used = margin_oracle.friction_used(force, models.friction, models.torsional_friction)
        np.testing.assert_allclose(found.friction_used, used, rtol=1e-9)
        assert used.max() <= 1.0
        most = max(most, used[models.torsional_friction > 0.0].max(initial=0.0))
        assert found.cone_margin == pytest.approx(reference.cone_margin(*_parts(found)), rel=1e-6)
        np.testing.assert_allclose(
            grasp.cone_margins(found.force, found.torsion),
            x[::4] - np.hypot.reduce(x.reshape(-1, 4)[:, 1:], axis=1),
            atol=1e-12 * np.abs(x).max(),
        )
        assert grasp.cone_margin(found.force, found.torsion) > 0.0
    assert most > 0.9  # some are close to the surface


def _parts(found: ForceSolution) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(found.force), np.asarray(found.torsion)


def test_no_share_of_friction_is_left_to_torsion_where_both_are_used():
    """A force may be inside of the cones of friction and of torsion, and outside of theirs
    together."""
    force = np.array([[2.0, 0.8, 0.0], [2.0, -0.8, 0.0]])
    torsion = np.array([0.008, -0.008])  # 0.8 of friction and of torsion
    grasp = pinch()
    assert Objective().of(grasp, force, torsion) == np.inf
    assert grasp.cone_margin(force, torsion) == pytest.approx(MU * 2.0 * (1.0 - np.hypot(0.8, 0.8)))
    assert Objective().of(grasp, force, 0.7 * torsion) < np.inf
    wrench = -grasp.wrench(force, 0.7 * torsion)
    solver = ForceOptimizer(grasp)
    first = solver.solve(wrench)
    assert first.status is Status.OPTIMAL
    # without torsion Phi of soft contacts still counts three tangential parts
    inside = np.array([[2.0, 0.3, 0.1], [2.0, -0.2, 0.0]])
    x = cone_coordinates(grasp, inside, np.zeros(2))
    weights = weights_of(grasp)
    assert Objective().of(grasp, inside) == pytest.approx(float(oracle.phi(x, weights)), rel=1e-13)


# --- limits with torsion, and margins


def limits_with_torsion(
    rng: np.random.Generator, what: str, count: int, size: float, least: float
) -> ForceLimits:
    """Joints of one finger each, or of all; (N, 6, J), so that torsions load them.

    least: normal force, if all share the joints.
    """
    given: dict[str, Any] = {}
    if what == "own":
        jacobian = own_joints(rng, count, 2, rows=6)
    else:
        jacobian = 0.05 * rng.standard_normal((count, 6, 5))
        given["max_normal"] = 20.0 * size
        given["min_normal"] = least * size
    jacobian[:, 3:] *= 60.0  # a torsion counts as much as a force
    most = size * rng.uniform(0.2, 1.0, jacobian.shape[2])
    bias = 0.1 * most * rng.uniform(-1.0, 1.0, len(most))
    return ForceLimits(jacobian=jacobian, torque_limit=most, torque_bias=bias, **given)


def shifted(
    grasp: Grasp, wrench: np.ndarray, limits: ForceLimits, margin: Margin
) -> tuple[Grasp, np.ndarray, ForceLimits]:
    """The problem of g = f - s n by hand."""
    preload = np.asarray(margin.preloads(grasp.n_contacts))
    models = grasp.models
    inner = Grasp.from_contacts(
        grasp.positions,
        grasp.normals,
        margin.friction * np.where(models.friction > 0.0, models.friction, 0.5),
        contact_model=models.names,
        torsional_friction=margin.friction * models.torsional_friction,
        tangents=grasp.frames[:, :, 1],
    )
    made = np.concatenate([grasp.normals, np.cross(grasp.positions, grasp.normals)], axis=1)
    pushed = np.einsum("nij,ni->nj", np.asarray(limits.jacobian)[:, :3], grasp.normals)
    count = grasp.n_contacts
    least = np.broadcast_to(limits.min_normal, count) - preload
    return (
        inner,
        wrench + preload @ made,
        ForceLimits(
            jacobian=limits.jacobian,
            torque_limit=limits.torque_limit,
            torque_bias=np.asarray(limits.torque_bias) + preload @ pushed,
            max_normal=np.broadcast_to(limits.max_normal, count) - preload,
            min_normal=np.maximum(least, 0.0),
        ),
    )


@pytest.mark.parametrize("method", ["newton", "sum", "max"])
@pytest.mark.parametrize("narrow", [False, True])
@pytest.mark.parametrize("what", ["own", "shared"])
def test_limits_count_torsion_and_margins_narrow_it(what, narrow, method):
    pytest.importorskip("clarabel")
    rng = np.random.default_rng(17)
    solved = judged = refuted = turned = 0
    for draw in range(24):
        grasp = closed_soft(rng, KINDS[draw % 2])
        count = grasp.n_contacts
        wrench = rng.standard_normal(6) * np.repeat([1.0, 0.5 * grasp.length], 3)
        # Phi has a barrier for least normal forces that a preload guarantees, its twin has none
        least = 0.0 if narrow and method == "newton" else 0.02
        limits = limits_with_torsion(rng, what, count, 10.0 ** rng.uniform(-0.2, 0.7), least)
        margin = Margin(0.8, 0.01 * rng.random(count)) if narrow else Margin()
        inner, load, within = shifted(grasp, wrench, limits, margin)
        reference = Reference(inner, within)
        options: dict[str, Any] = {"limits": limits, "margin": margin}
        if method != "newton":
            options |= {"method": "conic", "criterion": method}
        try:
            found = optimize_force(grasp, wrench, **options)
        except InfeasibleWrenchError as error:
            proof = error.solution
            assert proof is not None
            assert reference.margin(load) < 1e-7
            prices = proof.limit_multipliers
            kept = np.ones(len(prices), bool)
            if np.any(limits.min_normal):  # those that the preload guarantees have no row
                kept[:count] = np.asarray(within.min_normal) > 0.0
            assert reference.proof(proof.certificate, load, prices[kept]) >= -1e-7
            refuted += 1
            continue
        solved += 1
        assert found.status is Status.OPTIMAL
        preload = np.asarray(margin.preloads(count))
        g = found.force - np.outer(preload, [1.0, 0.0, 0.0])
        assert reference.violation(g, found.torsion) <= 1e-12 * np.abs(found.force).max()
        assert reference.residual(g, found.torsion, load) <= 1e-9 * np.abs(found.force).max()
        models = grasp.models
        used = margin_oracle.friction_used(
            np.column_stack([found.force, found.torsion]),
            models.friction,
            models.torsional_friction,
        )
        np.testing.assert_allclose(found.friction_used, used, rtol=1e-9)
        assert used.max() <= margin.friction * (1.0 + 1e-12)
        moment = found.torsion[:, None] * grasp.normals
        torques = np.einsum(
            "nij,ni->j",
            np.asarray(limits.jacobian),
            np.concatenate([found.object_force, moment], axis=1),
        )
        np.testing.assert_allclose(found.torques, torques + limits.torque_bias, atol=1e-12)
        active = np.abs(found.torques) > 0.5 * np.asarray(limits.torque_limit)
        part = np.einsum("nij,ni->j", np.asarray(limits.jacobian)[:, 3:], moment)
        turned += (np.abs(part[active]) > 0.05 * np.abs(torques[active])).any()
        if method == "newton":
            value = reference.phi(g, found.torsion)
            least, error = reference.least_phi(load)
            constant = 3.0 * float(inner.models.cone_scale[:, 0] @ preload)
            tolerance = 1e-4
        else:
            normal = found.force[:, 0]
            value = float(normal.sum() if method == "sum" else normal.max())
            constant, tolerance = 0.0, 1e-6
            if method == "max" and narrow:
                continue  # Clarabel's twin counts g alone
            best = reference.solve(load, method)
            least, error = best.objective + float(preload.sum()), best.error
        assert found.objective == pytest.approx(value + constant, rel=1e-9)
        if not error < 1e-6:
            continue
        judged += 1
        assert value == pytest.approx(least, rel=1.01 * tolerance + 10.0 * error)
        assert found.lower_bound <= (least + constant) * (1.0 + 10.0 * error + 1e-8)
    assert solved >= 8
    assert turned >= 2
    assert refuted >= 1
    assert judged >= 6 or (narrow and method == "max")


def closed_soft(rng: np.random.Generator, kind: str) -> Grasp:
    """Contacts with force closure, some of them soft, with torsional friction to speak of."""
    while True:
        grasp = some_grasp(rng, kind, most=5)
        wide = grasp.length * rng.uniform(0.1, 0.4, grasp.n_contacts)
        grasp = grasp.with_friction(grasp.models.friction, wide)
        if force_closure(grasp) and "soft" in grasp.models.names and 0.02 < grasp.length < 0.5:
            return grasp


# --- torsional friction that vanishes


def vanishing(gamma: float) -> Grasp:
    return five(["soft", "hard", "soft", "soft", "hard"], gamma * np.array([1.0, 0, 2.0, 0.5, 0]))


def test_the_exact_problem_is_continuous_where_torsional_friction_vanishes():
    hard = five("hard", None)
    for criterion in ("sum", "max"):
        options = {"method": "conic", "criterion": criterion, "tolerance": 1e-9}
        limit = optimize_force(hard, 3.0 * LOAD, **options)
        before = None
        for gamma in (1e-2, 1e-4, 1e-6, 1e-9, 1e-14):
            found = optimize_force(vanishing(gamma), 3.0 * LOAD, **options)
            assert found.objective <= limit.objective * (1.0 + 1e-8)
            # a torsion of gamma N does no more than a moment of it
            lost = 1.0 - found.objective / limit.objective
            assert lost <= 500.0 * gamma + 2e-9
            assert before is None or lost <= before + 2e-9
            before = lost
            assert (np.abs(found.torsion) <= 2.0 * gamma * found.force[:, 0]).all()
    assert feasibility(vanishing(1e-13), LOAD).margin == pytest.approx(
        feasibility(hard, LOAD).margin, rel=1e-6
    )


def test_phi_jumps_by_a_tangential_part_where_torsional_friction_vanishes():
    """Its limit is the least of 3 omega u + lambda (2/u + 2u/d) over forces without torsion; a hard
    contact has 1/u."""
    hard = five("hard", None)
    reference = Reference(hard)
    flat = reference.matrix[:, :, :3].reshape(6, -1) / np.tile([0.4, 1.0, 1.0], 5)
    load = reference.load(LOAD)
    limits = {}
    for axial in (1.0, 2.0):
        weights = np.tile([1.0, 0.01, 1.0], (5, 1))
        weights[[0, 2, 3], 2] = axial
        rest = newton.internal_force(flat, weights)
        x, _ = newton.minimum(rest, flat, load, weights)
        limits[axial] = float(oracle.phi(x, weights)), x.reshape(-1, 3)
    options = {"tolerance": 1e-10}
    found = optimize_force(hard, LOAD, **options)
    assert found.objective == pytest.approx(limits[1.0][0], rel=2e-10)
    same = optimize_force(vanishing(0.0), LOAD, **options)
    np.testing.assert_array_equal(same._record, found._record)
    jump = limits[2.0][0] - limits[1.0][0]
    u = limits[1.0][1][[0, 2, 3], 0]
    assert 0.5 * (0.01 / u).sum() < jump < (0.01 / u).sum()
    for gamma in (1e-3, 1e-5, 1e-8, 1e-13):
        soft = optimize_force(vanishing(gamma), LOAD, **options)
        # torsion lowers it by a part of its moment
        away = soft.objective - limits[2.0][0]
        assert -1e3 * gamma * limits[2.0][0] <= away <= 2e-10 * limits[2.0][0]
        assert (np.abs(soft.torsion) <= 2.0 * gamma * soft.force[:, 0]).all()
    np.testing.assert_allclose(
        soft.force * [0.4, 1.0, 1.0], limits[2.0][1], rtol=0, atol=1e-4 * np.abs(soft.force).max()
    )
