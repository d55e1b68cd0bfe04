"""A margin within the friction cones: every method, start, limit and batch, against the same problem
with friction, wrench and limits shifted by hand."""

from __future__ import annotations

import itertools
import pickle

import numpy as np
import pytest
from scipy.optimize import linprog

from grasp_env.errors import InfeasibleStartError, InfeasibleWrenchError, InvalidInputError
from grasp_env.force import (
    ForceLimits,
    ForceOptimizer,
    Margin,
    OfflineBasis,
    Repair,
    Status,
    optimize_force,
    optimize_forces,
)
from grasp_env.grasp import Grasp, presets
from tests.oracles import margin as oracle
from tests.problems import GRASPS, PAPER_WRENCH, closure_grasps

CUBOID = presets.paper_cuboid()
LEVERS = 0.05 * np.random.default_rng(5).standard_normal((4, 3, 12))
OWN = np.einsum("nij,nj->nij", LEVERS, np.repeat(np.eye(4), 3, axis=1))
LIMITS = {
    "normal": {"max_normal": [30.0, 25.0, 40.0, 60.0], "min_normal": [0.1, 2.0, 0.0, 1.0]},
    "own": {"jacobian": OWN, "torque_limit": 1.9, "torque_bias": np.linspace(-0.1, 0.1, 12)},
    "shared": {"jacobian": LEVERS, "torque_limit": 2.5, "max_normal": 50.0},
}
SHARE, PRELOAD = 0.7, np.array([0.5, 0.0, 2.0, 1.0])
MARGIN = Margin(SHARE, PRELOAD)


def soft(friction: object = 0.4) -> Grasp:
    return Grasp.from_contacts(
        CUBOID.positions,
        CUBOID.normals,
        friction,
        contact_model=["soft", "hard", "soft", "soft"],
        torsional_friction=[0.004, 0.0, 0.01, 0.006],
    )


CONTACTS = {
    "hard": CUBOID,
    "elliptic": Grasp.from_contacts(
        CUBOID.positions, CUBOID.normals, [[0.3, 0.6], [0.5, 0.2], [0.4, 0.4], [0.7, 0.3]]
    ),
    "soft": soft(),
}


def narrowed(grasp: Grasp, share: float) -> Grasp:
    models = grasp.models
    gamma = models.torsional_friction
    return Grasp.from_contacts(
        grasp.positions,
        grasp.normals,
        share * models.friction,
        contact_model=models.names,
        torsional_friction=share * gamma if gamma.any() else None,
    )


def by_hand(grasp: Grasp, wrench: np.ndarray, limits: dict) -> tuple[Grasp, np.ndarray, dict]:
    """The problem of g = f - s n; least normal forces that the preload guarantees are left out."""
    load = np.asarray(wrench) + grasp.matrix[:, ::3] @ PRELOAD
    shifted = dict(limits)
    if "max_normal" in limits:
        shifted["max_normal"] = np.asarray(limits["max_normal"]) - PRELOAD
    if "min_normal" in limits:
        shifted["min_normal"] = np.maximum(np.asarray(limits["min_normal"]) - PRELOAD, 0.0)
    if "jacobian" in limits:
        pushed = np.einsum("nij,ni->nj", limits["jacobian"], grasp.normals)
        shifted["torque_bias"] = limits.get("torque_bias", 0.0) + PRELOAD @ pushed
    return narrowed(grasp, SHARE), load, shifted


def loads(count: int, size: float = 4.0) -> np.ndarray:
    rng = np.random.default_rng(11)
    return size * rng.standard_normal((count, 6)) * [1, 1, 1, 0.03, 0.03, 0.03]


def judge(grasp: Grasp, solution, margin: Margin = MARGIN) -> None:
    """Recompute what a solution says of its force."""
    force = np.column_stack([solution.force, solution.torsion])
    mu, gamma = grasp.models.friction, grasp.models.torsional_friction
    used = oracle.friction_used(force, mu, gamma)
    np.testing.assert_allclose(solution.friction_used, used, rtol=1e-9, atol=1e-12)
    preload = np.broadcast_to(margin.preload, (len(force),))
    assert (used * force[:, 0] <= margin.friction * (force[:, 0] - preload) + 1e-9).all()
    assert solution.cone_margin == pytest.approx(
        oracle.cone_margin(force, mu, gamma, margin.friction, preload), abs=1e-9
    )
    whole = np.asarray(solution.wrench) + grasp.matrix[:, ::3] @ preload
    np.testing.assert_allclose(solution.wrench_with_preload, whole, rtol=1e-12, atol=1e-12)
    made = grasp.matrix @ solution.force.reshape(-1) + grasp.torsion_matrix @ solution.torsion
    np.testing.assert_allclose(made, -solution.wrench, atol=1e-8)


@pytest.mark.parametrize(
    ("method", "contacts", "limit"),
    [
        *itertools.product(["newton", "conic"], CONTACTS, ["none", *LIMITS]),
        *itertools.product(["reduced_flow", "full_flow"], ["hard", "elliptic"], ["none"]),
    ],
)
def test_the_answer_is_that_of_the_shifted_problem(method, contacts, limit):
    flow = method.endswith("flow")
    grasp, limits = CONTACTS[contacts], LIMITS.get(limit, {})
    options = {"method": method, "tolerance": 1e-4 if flow else 1e-9}
    solver = ForceOptimizer(
        grasp, margin=MARGIN, limits=ForceLimits(**limits) if limits else None, **options
    )
    wrenches = loads(12)
    inner, _, shifted = by_hand(grasp, wrenches[0], limits)
    other = ForceOptimizer(inner, limits=ForceLimits(**shifted) if limits else None, **options)
    weight = np.ones(4) if method == "conic" else 3.0 * inner.models.cone_scale[:, 0]
    solved = 0
    for wrench in wrenches:
        _, load, _ = by_hand(grasp, wrench, limits)
        try:
            expected = other.solve(load)
        except InfeasibleWrenchError:
            with pytest.raises(InfeasibleWrenchError):
                solver.solve(wrench)
            continue
        solution = solver.solve(wrench)
        assert solution.status is expected.status is Status.OPTIMAL
        judge(grasp, solution)
        if limits:
            assert ForceLimits(**limits).violations(
                grasp, solution.force, solution.torsion
            ) == pytest.approx([])
        solved += 1
        if method == "newton" and "min_normal" in limits:
            continue  # here Phi has a barrier of limits that the preload guarantees
        assert solution.objective == pytest.approx(
            expected.objective + weight @ PRELOAD, rel=4e-4 if flow else 1e-8
        )
        assert solution.lower_bound <= solution.objective * (1.0 + 1e-12)
        if not flow and method != "conic":
            moved = solution.force - expected.force
            moved[:, 0] -= PRELOAD
            assert np.abs(moved).max() < 1e-3
    assert solved >= 4


@pytest.mark.parametrize("method", ["newton", "conic"])
@pytest.mark.parametrize("size", [0.05, 0.3, 1.0, 3.0, 10.0, 50.0])
def test_no_finger_uses_more_than_its_share(method, size):
    solver = ForceOptimizer(CUBOID, method=method, margin=0.8)
    for wrench in loads(50, size):
        assert solver.solve(wrench).friction_used.max() <= 0.8 + 1e-6


def test_the_largest_force_counts_preloads():
    """Linear programs with cones of 64 sides inside and around give both bounds of the optimum."""
    weights = np.array([1.0, 2.0, 0.5, 1.0])
    solver = ForceOptimizer(
        CUBOID, method="conic", criterion="max", margin=MARGIN, force_weight=weights
    )
    angles = 2.0 * np.pi * np.arange(64) / 64
    for wrench in loads(8):
        bounds = []
        for slope in (1.0 / np.cos(np.pi / 64), 1.0):
            rows, right = [], []
            for i in range(4):
                for angle in angles:
                    row = np.zeros(13)
                    row[3 * i : 3 * i + 3] = [
                        -SHARE * 0.4,
                        *(slope * np.array([np.cos(angle), np.sin(angle)])),
                    ]
                    rows.append(row)
                    right.append(-SHARE * 0.4 * PRELOAD[i])
                row = np.zeros(13)
                row[[3 * i, 12]] = weights[i], -1.0
                rows.append(row)
                right.append(0.0)
            program = linprog(
                np.eye(13)[12],
                rows,
                right,
                np.column_stack([CUBOID.matrix, np.zeros(6)]),
                -wrench,
                bounds=(None, None),
            )
            bounds.append(program.fun)
        solution = solver.solve(wrench)
        judge(CUBOID, solution)
        assert solution.objective == pytest.approx((weights * solution.force[:, 0]).max(), rel=1e-9)
        assert bounds[1] * (1.0 - 1e-9) <= solution.objective <= bounds[0] * (1.0 + 1e-6)
        assert solution.optimality_gap <= 1e-6


def test_preloads_alone_may_be_the_largest_force():
    """The preloads balance the load by themselves, so nothing is added."""
    grasp = presets.five_finger_cuboid()
    preload = 2.0 + np.arange(5.0)
    wrench = -grasp.matrix[:, ::3] @ preload
    solution = optimize_force(
        grasp, wrench, method="conic", criterion="max", margin=Margin(0.5, preload)
    )
    assert solution.objective == pytest.approx(6.0, rel=1e-5)
    assert solution.lower_bound == pytest.approx(6.0, rel=1e-5)


def same_optimum(one, other):
    """Assert that two solutions agree to 2e-9, and their forces to 1e-6."""
    assert one.objective == pytest.approx(other.objective, rel=2e-9)
    np.testing.assert_allclose(one.force, other.force, atol=1e-6 * np.abs(other.force).max())


def test_a_call_changes_the_margin_for_itself():
    solver = ForceOptimizer(CUBOID, tolerance=1e-12, margin=0.9)
    for wrench in loads(5):
        alone = {
            m: optimize_force(CUBOID, wrench, margin=m, tolerance=1e-12) for m in (MARGIN, 0.6)
        }
        for margin in (MARGIN, 0.6):
            same_optimum(solver.solve(wrench, margin=margin), alone[margin])
        none = solver.solve(wrench, margin=Margin())
        same_optimum(none, optimize_force(CUBOID, wrench, tolerance=1e-12))
        assert solver.solve(wrench).friction_used.max() <= 0.9
    solver.update(margin=MARGIN, friction=0.5)
    assert solver.margin == MARGIN
    expected = optimize_force(
        CUBOID.with_friction(0.5), PAPER_WRENCH, margin=MARGIN, tolerance=1e-12
    )
    np.testing.assert_array_equal(solver.solve(PAPER_WRENCH).force, expected.force)
    again = pickle.loads(pickle.dumps(solver))
    np.testing.assert_array_equal(again.solve(PAPER_WRENCH).force, expected.force)


def test_a_contact_that_does_not_touch_has_no_preload():
    touching = np.array([True, True, False, True, True])
    grasp = presets.five_finger_cuboid()
    preload = np.array([1.0, 2.0, 50.0, 0.5, 0.0])
    solver = ForceOptimizer(grasp, margin=Margin(0.9, preload))
    left = Grasp.from_contacts(
        grasp.positions[touching], grasp.normals[touching], grasp.friction[touching]
    )
    for wrench in loads(5):
        solution = solver.solve(wrench, contacts=touching)
        assert (solution.force[2] == 0.0).all()
        np.testing.assert_array_equal(np.isnan(solution.friction_used), ~touching)
        expected = optimize_force(left, wrench, margin=Margin(0.9, preload[touching]))
        np.testing.assert_allclose(solution.force[touching], expected.force, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("start", ["linear_combination", "single_value", "lagrange", "phase_one"])
@pytest.mark.parametrize("method", ["newton", "reduced_flow"])
def test_starts_keep_the_margin(method, start):
    solver = ForceOptimizer(CUBOID, method=method, initial=start, margin=MARGIN)
    for wrench in loads(6):
        first = solver.start(wrench)
        solution = solver.solve(wrench)
        np.testing.assert_allclose(solution.initial_force, first, rtol=1e-12)
        assert not solution.start_replaced
        inner = first - np.outer(PRELOAD, [1, 0, 0])
        assert narrowed(CUBOID, SHARE).cone_margin(inner) > 0.0
        assert CUBOID.residual(first, wrench) < 1e-9
        judge(CUBOID, solution)


def test_the_paper_s_start_is_that_of_the_shifted_problem():
    inner = narrowed(CUBOID, SHARE)
    solver = ForceOptimizer(CUBOID, method="reduced_flow", margin=MARGIN)
    for wrench in loads(6):
        load = wrench + CUBOID.matrix[:, ::3] @ PRELOAD
        expected = OfflineBasis.of(inner).combine(load) + np.outer(PRELOAD, [1, 0, 0])
        np.testing.assert_allclose(solver.start(wrench), expected, rtol=1e-9, atol=1e-12)


def test_the_previous_solution_starts_under_another_margin():
    solver = ForceOptimizer(CUBOID, initial="previous", margin=0.95)
    for wrench in loads(8):
        for margin in (0.95, MARGIN, Margin(0.5, 3.0), Margin()):
            solution = solver.solve(wrench, margin=margin)
            judge(CUBOID, solution, margin if isinstance(margin, Margin) else Margin(margin))
            assert solution.status is Status.OPTIMAL


def test_forces_and_rules_as_starts():
    wrench = loads(1)[0]
    optimum = optimize_force(CUBOID, wrench, margin=MARGIN, tolerance=1e-9)
    again = optimize_force(CUBOID, wrench, margin=MARGIN, initial=optimum.force)
    assert (again.iterations, again.initial) == (0, "given")
    free = optimize_force(CUBOID, wrench)
    with pytest.raises(InfeasibleStartError, match="within the optimizer's margin"):
        optimize_force(CUBOID, wrench, margin=MARGIN, initial=free.force)

    def rule(grasp: Grasp, load: np.ndarray) -> np.ndarray:
        np.testing.assert_allclose(grasp.friction, SHARE * 0.4)
        return Repair()(grasp, load, np.tile([5.0, 0.0, 0.0], (4, 1)))

    solution = optimize_force(CUBOID, wrench, margin=MARGIN, initial=rule)
    judge(CUBOID, solution)
    assert solution.initial == "rule"


@pytest.mark.parametrize("method", ["newton", "conic", "reduced_flow"])
def test_batches_are_single_solves(method):
    wrenches = loads(40)
    grasps = [grasp for grasp in closure_grasps() if grasp.n_contacts == 4][:5] * 8
    for given in (CUBOID, grasps):
        batch = optimize_forces(given, wrenches, method=method, margin=MARGIN)
        for k, wrench in enumerate(wrenches):
            grasp = given if isinstance(given, Grasp) else given[k]
            try:
                alone = optimize_force(grasp, wrench, method=method, margin=MARGIN)
            except InfeasibleWrenchError:
                assert batch[k].status is Status.INFEASIBLE
                continue
            assert batch[k].status is alone.status
            assert batch.objective[k] == pytest.approx(alone.objective, rel=3e-4)
            np.testing.assert_array_equal(batch.wrench[k], wrench)
            np.testing.assert_array_equal(batch.friction_used[k], batch[k].friction_used)
            if alone.status is Status.OPTIMAL:
                judge(grasp, batch[k])


def test_a_known_optimum_and_a_trace_are_those_of_the_force():
    wrench = loads(1)[0]
    best = optimize_force(CUBOID, wrench, margin=MARGIN, tolerance=1e-10)
    solution = optimize_force(
        CUBOID, wrench, margin=MARGIN, method="reduced_flow", optimum=best.objective, trace=True
    )
    assert solution.objective_trace[-1] == pytest.approx(solution.objective, rel=1e-12)
    assert (np.diff(solution.objective_trace) <= 0.0).all()
    assert 0.0 <= solution.objective / best.objective - 1.0 <= 1e-4
    assert solution.lower_bound == pytest.approx(best.objective, rel=1e-12)


@pytest.mark.parametrize("limit", ["none", *LIMITS])
@pytest.mark.parametrize("contacts", CONTACTS)
@pytest.mark.parametrize("method", ["newton", "conic"])
def test_proofs_hold_against_the_wrench_with_preload(method, contacts, limit):
    grasp = CONTACTS[contacts]
    limits = {**LIMITS.get(limit, {}), **({"max_normal": 9.0} if limit != "none" else {})}
    if limit == "none":  # pushed out of three fingers on one side
        grasp = Grasp.from_contacts(
            grasp.positions[1:] * [1, 1, 1], grasp.normals[1:], grasp.models.friction[1:]
        )
    n = grasp.n_contacts
    hand = ForceLimits(**limits) if limits else None
    margin = Margin(SHARE, PRELOAD[:n])
    solver = ForceOptimizer(grasp, method=method, limits=hand, margin=margin)
    mu, gamma = grasp.models.friction, grasp.models.torsional_friction
    matrix = np.zeros((6, n, 4))
    matrix[:, :, :3] = grasp.matrix.reshape(6, n, 3)
    matrix[:, :, 3] = grasp.torsion_matrix
    rows, bound = np.zeros((0, n, 4)), np.zeros(0)
    if hand is not None:
        rows, bound = hand.rows(grasp).matrix.reshape(-1, n, 4), hand.rows(grasp).bound
    proofs = 0
    for wrench in loads(30, 6.0):
        try:
            solver.solve(wrench)
        except InfeasibleWrenchError as error:
            solution = error.solution
            slacks = oracle.proof_slacks(
                (solution.certificate, solution.limit_multipliers),
                (rows, bound),
                matrix,
                wrench,
                (mu, gamma),
                (margin.friction, np.asarray(margin.preload)),
            )
            assert min(slacks) >= -1e-7
            proofs += 1
    assert proofs >= 5


def test_the_least_excess_within_a_margin():
    limits = ForceLimits(max_normal=4.0)
    wrench = np.array([0, 0, -10.0, 0, 0, 0])
    for margin in (None, 0.5, Margin(0.5, 1.0)):
        solution = optimize_force(CUBOID, wrench, limits=limits, elastic=True, margin=margin)
        assert solution.status is Status.LIMITS_EXCEEDED
        assert solution.limit_excess == pytest.approx(solution.force[:, 0].max() / 4.0 - 1.0)
        assert solution.lower_bound <= solution.objective == solution.limit_excess
        least = optimize_force(CUBOID, wrench, method="conic", criterion="max", margin=margin)
        assert solution.limit_excess == pytest.approx(least.objective / 4.0 - 1.0, rel=0.02)


def test_an_infeasible_margin_is_explained():
    limits = ForceLimits(max_normal=30.0)
    wrench = [0, 3, -10, 0, 0, 0]
    with pytest.raises(InfeasibleWrenchError) as caught:
        optimize_force(CUBOID, wrench, margin=0.1, limits=limits)
    text = str(caught.value)
    assert text.startswith(
        "no force keeps friction margin 0.1; with friction margin 0.15 one exists"
    )
    assert "(uses 0.15 of the friction)" in text
    optimize_force(CUBOID, wrench, margin=0.15, limits=limits)
    with pytest.raises(InfeasibleWrenchError):
        optimize_force(CUBOID, wrench, margin=0.14, limits=limits)
    with pytest.raises(
        InfeasibleWrenchError, match=r"friction margin 0.15 and no preload one exists"
    ):
        optimize_force(CUBOID, wrench, margin=Margin(0.12, 29.0), limits=limits)
    with pytest.raises(InfeasibleWrenchError, match=r"^no force strictly inside"):
        optimize_force(CUBOID, wrench, margin=0.5, limits=ForceLimits(max_normal=1.0))


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (lambda: Margin(0.0), "friction margin must .* 0.01 to 1"),
        (lambda: Margin(1.01), "friction margin must .* 0.01 to 1"),
        (lambda: Margin(np.nan), "friction margin must"),
        (lambda: Margin(0.8, -0.1), "preload must lie within 0 to 1e\\+06 N"),
        (lambda: Margin(0.8, [[1.0]]), "preload must lie within"),
        (lambda: Margin(0.8, [np.inf]), "preload"),
        (lambda: ForceOptimizer(CUBOID, margin=2.0), "friction margin must"),
        (lambda: ForceOptimizer(CUBOID, margin="0.8"), "friction margin must"),
        (lambda: ForceOptimizer(CUBOID, margin=Margin(1, [1, 2, 3])), "3 entries, the grasp 4"),
        (
            lambda: ForceOptimizer(
                CUBOID, margin=Margin(1, [1, 1, 7, 1]), limits=ForceLimits(max_normal=5.0)
            ),
            "at contact 2 they are 7 and 5 N",
        ),
    ],
)
def test_wrong_margins(made, message):
    with pytest.raises(InvalidInputError, match=message):
        made()


@pytest.mark.parametrize("margin", [0.0, 1.5, -1, "x", Margin(1, [1, 2, 3]), Margin(1, 5.0), [0.8]])
def test_wrong_margins_of_a_call(margin):
    solver = ForceOptimizer(CUBOID, limits=ForceLimits(max_normal=5.0))
    for call in (
        lambda: solver.solve(PAPER_WRENCH, margin=margin),
        lambda: solver.start(PAPER_WRENCH, margin=margin),
        lambda: solver.update(margin=margin),
    ):
        with pytest.raises(InvalidInputError, match=r"margin|preload"):
            call()
    assert solver.margin == Margin()


def test_margins_are_values():
    assert Margin(0.8, [1.0, 2.0]) == Margin(0.8, np.array([1.0, 2.0])) != Margin(0.8, 1.0)
    assert len({Margin(0.8), Margin(0.8), Margin(0.8, 1.0)}) == 2
    assert (bool(Margin()), bool(Margin(0.9)), bool(Margin(1.0, 0.1))) == (False, True, True)
    assert str(Margin(0.8, [1.0, 2.0])) == "friction margin 0.8 and preload [1.0, 2.0] N"


def test_shares_of_friction():
    grasp = soft()
    solution = optimize_force(grasp, [0, 0, -3, 0, 0, 0.02])
    judge(grasp, solution, Margin())
    turned = np.abs(solution.torsion[[0, 2, 3]]) / (
        [0.004, 0.01, 0.006] * solution.force[[0, 2, 3], 0]
    )
    assert (solution.friction_used[[0, 2, 3]] >= turned - 1e-12).all()
    assert turned.max() > 0.1
    frictionless = Grasp.from_contacts(
        CUBOID.positions,
        CUBOID.normals,
        0.4,
        contact_model=["frictionless", "hard", "hard", "hard"],
    )
    assert optimize_force(frictionless, [0, 0, -3, 0, 0, 0], margin=0.8).friction_used[0] == 0.0


@pytest.mark.parametrize("method", ["newton", "conic"])
@pytest.mark.parametrize("size", [0.0, 1e-14, 1e-10, 1e-8, 1e-3])
def test_a_pinch_balances_loads_that_its_preload_nearly_cancels(method, size):
    """The rank of two contacts is 5: rounding of G s n is not a wrench that they cannot make."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        axis = rng.standard_normal(3)
        axis /= np.linalg.norm(axis)
        side = np.cross(axis, rng.standard_normal(3))
        pinch = Grasp.from_contacts([0.02 * axis, -0.02 * axis], [-axis, axis], 0.5)
        solution = optimize_force(
            pinch, [*(size * side), 0, 0, 0], method=method, margin=Margin(0.8, 1.0)
        )
        assert solution.status is Status.OPTIMAL


def test_a_given_start_is_taken_after_a_call_without_an_answer():
    grasp = GRASPS["cuboid, 5"]
    solver = ForceOptimizer(grasp)
    force = solver.solve(PAPER_WRENCH).force
    with pytest.raises(InfeasibleWrenchError):  # all normals point up
        solver.solve([0, 0, 1.0, 0, 0, 0], normals=np.tile([0.0, 0.0, 1.0], (5, 1)))
    assert solver.solve(PAPER_WRENCH, initial=force).initial == "given"
