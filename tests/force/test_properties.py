"""What must hold for every grasp and wrench, tried by hypothesis; every strategy draws from fixed seeds."""

from __future__ import annotations

import numpy as np
import pytest
from force.generators import random_grasp, random_wrench
from scipy.spatial.transform import Rotation

from grasp_env.errors import GraspError, InfeasibleWrenchError
from grasp_env.force import ForceLimits, ForceSolution, Status, optimize_force
from grasp_env.grasp import Grasp

hypothesis = pytest.importorskip("hypothesis")
given, strategies = hypothesis.given, hypothesis.strategies

hypothesis.settings.register_profile("grasp", derandomize=True, deadline=None, max_examples=30, database=None)
properties = hypothesis.settings(hypothesis.settings.get_profile("grasp"))

SEEDS = strategies.integers(0, 2**32 - 1)
CONIC = 3e-6
"""Two objectives of the same problem, each within 1e-6 of the optimum."""


def case(seed: int, kind: str = "hard", most: int = 8) -> tuple[Grasp, np.ndarray, np.random.Generator]:
    """A grasp of about 0.1 m that holds a wrench of about 1 N; other draws are not tried."""
    rng = np.random.default_rng(seed)
    try:
        grasp = random_grasp(rng, kind, most=most)
        hypothesis.assume(1e-2 < grasp.length < 10.0)
        wrench = random_wrench(rng, grasp, 0.1, 10.0)
        optimize_force(grasp, wrench, method="conic")
    except GraspError:
        hypothesis.reject()
    return grasp, wrench, rng


def remade(grasp: Grasp, **changes) -> Grasp:
    """The same contacts but for `changes`; frames are kept by giving their tangents."""
    models = grasp.models
    same = {
        "positions": grasp.positions,
        "normals": grasp.normals,
        "friction": np.where(models.friction > 0.0, models.friction, 0.5),
        "contact_model": models.names,
        "torsional_friction": np.where(models.torsional_friction > 0.0, models.torsional_friction, 1.0),
        "tangents": grasp.frames[:, :, 1],
    }
    return Grasp.from_contacts(**(same | changes))


def least(grasp: Grasp, wrench: np.ndarray, **options) -> ForceSolution:
    found = optimize_force(grasp, wrench, method=options.pop("method", "conic"), **options)
    assert found.status is Status.OPTIMAL, found
    assert found.cone_margin >= 0.0
    return found


KINDS = strategies.sampled_from(["hard", "elliptic", "soft", "mixed"])
CRITERIA = strategies.sampled_from(["sum", "max"])


@properties
@given(SEEDS, KINDS, strategies.sampled_from(["sum", "max", "newton"]))
def test_rotating_or_mirroring_the_frame_changes_no_contact_force(seed: int, kind: str, what: str) -> None:
    """In a mirror a moment turns the other way, and so does the tangent t."""
    grasp, wrench, rng = case(seed, kind)
    side = rng.choice([-1.0, 1.0])
    turn = side * Rotation.random(random_state=np.random.RandomState(seed % 2**31)).as_matrix()
    turned = remade(
        grasp,
        positions=grasp.positions @ turn.T,
        normals=grasp.normals @ turn.T,
        tangents=grasp.frames[:, :, 1] @ turn.T,
    )
    load = np.concatenate([turn @ wrench[:3], side * turn @ wrench[3:]])
    check(grasp, wrench, turned, load, what, side=side)


@properties
@given(SEEDS, KINDS, strategies.sampled_from(["sum", "max", "newton"]), strategies.floats(0.0, 3.0))
def test_moving_the_origin_changes_no_contact_force(seed: int, kind: str, what: str, far: float) -> None:
    grasp, wrench, rng = case(seed, kind)
    shift = far * grasp.length * rng.standard_normal(3)
    moved = remade(grasp, positions=grasp.positions + shift)
    load = np.concatenate([wrench[:3], wrench[3:] + np.cross(shift, wrench[:3])])
    check(grasp, wrench, moved, load, what)


@properties
@given(SEEDS, KINDS, strategies.sampled_from(["sum", "max", "newton"]))
def test_the_order_of_contacts_does_not_matter(seed: int, kind: str, what: str) -> None:
    grasp, wrench, rng = case(seed, kind)
    order = rng.permutation(grasp.n_contacts)
    models = grasp.models
    other = Grasp.from_contacts(
        grasp.positions[order], grasp.normals[order], np.where(models.friction > 0.0, models.friction, 0.5)[order],
        contact_model=[models.names[k] for k in order],
        torsional_friction=np.where(models.torsional_friction > 0.0, models.torsional_friction, 1.0)[order],
        tangents=grasp.frames[order, :, 1],
    )  # fmt: skip
    check(grasp, wrench, other, wrench, what, order)


@properties
@given(SEEDS, KINDS, strategies.floats(1e-3, 1e3))
def test_another_unit_of_length_changes_no_force(seed: int, kind: str, unit: float) -> None:
    grasp, wrench, _ = case(seed, kind)
    gamma = np.where(grasp.models.torsional_friction > 0.0, grasp.models.torsional_friction, 1.0)
    other = remade(grasp, positions=unit * grasp.positions, torsional_friction=unit * gamma)
    check(grasp, wrench, other, wrench * [1, 1, 1, unit, unit, unit], "sum")


def check(
    grasp: Grasp, wrench, other: Grasp, load, what: str, order: np.ndarray | None = None, side: float = 1.0
) -> None:
    """The same objective; the same force where the optimum is unique: Phi's."""
    options = {"method": "newton", "tolerance": 1e-9} if what == "newton" else {"criterion": what}
    if what == "newton":
        # the 12-basis needs force closure
        options["initial"] = "phase_one"
    one, two = least(grasp, wrench, **options), least(other, load, **options)
    if what == "newton":
        assert two.objective == pytest.approx(one.objective, rel=3e-9)
        want = (one.force if order is None else one.force[order]) * [1.0, 1.0, side]
        np.testing.assert_allclose(two.force, want, rtol=0, atol=1e-3 * float(np.abs(want).max()))
    else:
        assert two.objective == pytest.approx(one.objective, rel=CONIC)


@properties
@given(SEEDS, KINDS, CRITERIA, strategies.integers(-30, 30))
def test_powers_of_two_scale_every_bit(seed: int, kind: str, criterion: str, power: int) -> None:
    grasp, wrench, _ = case(seed, kind)
    one, other = (least(grasp, wrench * k, criterion=criterion) for k in (1.0, 2.0**power))
    np.testing.assert_array_equal(other.force, 2.0**power * one.force)
    np.testing.assert_array_equal(other.torsion, 2.0**power * one.torsion)
    np.testing.assert_array_equal(other.multipliers, one.multipliers)
    assert other.iterations == one.iterations


@properties
@given(SEEDS, KINDS, CRITERIA, strategies.floats(1e-6, 1e4))
def test_force_scales_with_the_wrench(seed: int, kind: str, criterion: str, factor: float) -> None:
    grasp, wrench, _ = case(seed, kind)
    one, other = (least(grasp, wrench * k, criterion=criterion) for k in (1.0, factor))
    assert other.objective == pytest.approx(factor * one.objective, rel=CONIC)


@properties
@given(SEEDS, KINDS, strategies.floats(1e-2, 1e2))
def test_phi_scales_with_the_wrench_and_lambda(seed: int, kind: str, factor: float) -> None:
    grasp, wrench, _ = case(seed, kind)
    options = {"method": "newton", "initial": "phase_one", "tolerance": 1e-9}
    one = least(grasp, wrench, barrier_weight=0.01, **options)
    other = least(grasp, wrench * factor, barrier_weight=0.01 * factor**2, **options)
    assert other.objective == pytest.approx(factor * one.objective, rel=3e-9)


@properties
@given(SEEDS, KINDS, CRITERIA, strategies.floats(1.0, 3.0))
def test_more_friction_never_costs_more(seed: int, kind: str, criterion: str, factor: float) -> None:
    grasp, wrench, _ = case(seed, kind)
    friction = np.where(grasp.models.friction > 0.0, grasp.models.friction, 0.5)
    rougher = remade(grasp, friction=factor * friction)
    assert least(rougher, wrench, criterion=criterion).objective <= least(
        grasp, wrench, criterion=criterion
    ).objective * (1.0 + CONIC)


@properties
@given(SEEDS, CRITERIA)
def test_an_added_contact_never_costs_more(seed: int, criterion: str) -> None:
    grasp, wrench, rng = case(seed)
    normal = rng.standard_normal(3)
    normal /= np.linalg.norm(normal)
    more = Grasp.from_contacts(
        [*grasp.positions, grasp.positions.mean(axis=0) - grasp.length * normal], [*grasp.normals, normal],
        [*grasp.friction, 0.5],
    )  # fmt: skip
    assert least(more, wrench, criterion=criterion).objective <= least(grasp, wrench, criterion=criterion).objective * (
        1.0 + CONIC
    )


@properties
@given(SEEDS, strategies.sampled_from(["sum", "max", "newton"]))
def test_an_elliptic_cone_of_equal_axes_is_round(seed: int, what: str) -> None:
    grasp, wrench, _ = case(seed)
    same = Grasp.from_contacts(grasp.positions, grasp.normals, np.column_stack([grasp.friction, grasp.friction]))
    check(grasp, wrench, same, wrench, what)


@properties
@given(SEEDS, CRITERIA, strategies.floats(-9.0, 3.0))
def test_soft_contacts_lie_between_hard_ones_and_rigid_discs(seed: int, criterion: str, power: float) -> None:
    """More torsional friction never costs more; none to speak of is a hard contact."""
    grasp, wrench, _ = case(seed)
    hard = least(grasp, wrench, criterion=criterion).objective

    def cost(gamma: float) -> float:
        soft = remade(grasp, contact_model="soft", torsional_friction=gamma * grasp.length)
        return least(soft, wrench, criterion=criterion).objective

    assert cost(10.0**power) <= hard * (1.0 + CONIC)
    assert cost(2.0 * 10.0**power) <= cost(10.0**power) * (1.0 + CONIC)
    assert cost(1e-9) == pytest.approx(hard, rel=1e-4)


@properties
@given(SEEDS, KINDS, CRITERIA)
def test_limits_that_do_not_bind_change_nothing(seed: int, kind: str, criterion: str) -> None:
    grasp, wrench, rng = case(seed, kind)
    free = least(grasp, wrench, criterion=criterion)
    jac = grasp.length * rng.standard_normal((grasp.n_contacts, 3, 4))
    torque = np.abs(np.einsum("nij,ni->j", jac, grasp.to_object_frame(free.force))).max()
    limits = ForceLimits(
        max_normal=2.0 * float(free.force[:, 0].max()), jacobian=jac, torque_limit=2.0 * torque + 1e-3 * grasp.length
    )
    held = least(grasp, wrench, criterion=criterion, limits=limits)
    assert held.objective == pytest.approx(free.objective, rel=CONIC)


@properties
@given(SEEDS, KINDS, strategies.floats(0.3, 0.999))
def test_a_limit_is_kept_and_never_saves_force(seed: int, kind: str, share: float) -> None:
    grasp, wrench, _ = case(seed, kind)
    free = least(grasp, wrench)
    most = share * float(free.force[:, 0].max())
    try:
        held = least(grasp, wrench, limits=ForceLimits(max_normal=most))
    except InfeasibleWrenchError:
        assert most <= least(grasp, wrench, criterion="max").objective * (1.0 + 1e-5)
        return
    assert held.force[:, 0].max() <= most
    assert held.objective >= free.objective * (1.0 - CONIC)


@properties
@given(SEEDS, KINDS)
def test_the_criteria_bound_each_other(seed: int, kind: str) -> None:
    grasp, wrench, _ = case(seed, kind)
    total, largest = least(grasp, wrench), least(grasp, wrench, criterion="max")
    assert largest.objective <= total.force[:, 0].max() * (1.0 + CONIC)
    assert total.objective <= largest.force[:, 0].sum() * (1.0 + CONIC)


@properties
@given(SEEDS, KINDS, CRITERIA, strategies.floats(0.0, 1.0))
def test_the_cost_is_convex_in_the_wrench(seed: int, kind: str, criterion: str, part: float) -> None:
    grasp, wrench, rng = case(seed, kind)
    other = random_wrench(rng, grasp, 0.1, 10.0)
    try:
        ends = [least(grasp, w, criterion=criterion).objective for w in (wrench, other)]
    except InfeasibleWrenchError:
        hypothesis.reject()
    between = least(grasp, (1.0 - part) * wrench + part * other, criterion=criterion).objective
    assert between <= ((1.0 - part) * ends[0] + part * ends[1]) * (1.0 + CONIC)


@properties
@given(SEEDS, KINDS, CRITERIA)
def test_multipliers_support_the_cost_everywhere(seed: int, kind: str, criterion: str) -> None:
    """cost(w') >= cost(w) - nu . (w' - w): the subgradient's inequality, without a derivative that may not exist."""
    grasp, wrench, rng = case(seed, kind)
    here = least(grasp, wrench, criterion=criterion, tolerance=1e-8)
    for factor in (1e-3, 0.1, 1.0):
        other = wrench + factor * random_wrench(rng, grasp, 0.5, 2.0)
        try:
            there = least(grasp, other, criterion=criterion).objective
        except InfeasibleWrenchError:
            continue
        line = -float(here.multipliers @ other)
        assert there >= line - 3e-6 * max(abs(there), here.objective)


@properties
@given(SEEDS, strategies.sampled_from(["hard", "soft"]))
def test_newton_tends_to_conic_as_lambda_vanishes(seed: int, kind: str) -> None:
    grasp, wrench, _ = case(seed, kind)
    same = remade(grasp, friction=0.5)
    try:
        want = least(same, wrench).objective
    except InfeasibleWrenchError:
        hypothesis.reject()
    last = np.inf
    for lam in (1e-2, 1e-4, 1e-6):
        found = least(
            same, wrench, method="newton", initial="phase_one", tolerance=1e-7, barrier_weight=lam * want**2
        ).total_normal_force
        assert want * (1.0 - CONIC) <= found <= last * (1.0 + 1e-6)
        last = found
    assert last == pytest.approx(want, rel=3e-2)
