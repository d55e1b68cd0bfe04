"""`ForceOptimizer` over many calls: other contacts, fewer of them, previous solutions; and what
solutions and proofs say."""

from __future__ import annotations

import gc
import itertools
import pickle
import weakref
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from force.clarabel_reference import Reference
from force.generators import own_joints
from problems import PAPER_WRENCH

from grasp_env.errors import (
    GraspError,
    InfeasibleStartError,
    InfeasibleWrenchError,
    InvalidInputError,
    RankDeficientGraspError,
)
from grasp_env.force import (
    ForceLimits,
    ForceOptimizer,
    OfflineBasis,
    Status,
    optimize_force,
    optimize_forces,
)
from grasp_env.force.rules import RULES
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp import wrench as wrenches

CUBOID = presets.paper_cuboid()
FIVE = presets.five_finger_cuboid()
LOAD = np.array([0.4, -0.3, 0.7, 0.01, -0.008, 0.005])
SOFT = Grasp.from_contacts(
    FIVE.positions, FIVE.normals, 0.4, contact_model="soft", torsional_friction=0.005
)
ELLIPTIC = Grasp.from_contacts(FIVE.positions, FIVE.normals, np.tile([0.4, 0.6], (5, 1)))
OWN = ForceLimits(
    jacobian=own_joints(np.random.default_rng(7), 5),
    torque_limit=0.5,
    torque_bias=np.linspace(-0.05, 0.05, 15),
)
SPUN = ForceLimits(jacobian=own_joints(np.random.default_rng(7), 5, rows=6), torque_limit=0.5)
SHARED = ForceLimits(
    jacobian=0.03 * np.random.default_rng(8).standard_normal((5, 3, 4)), torque_limit=0.9
)
KINDS: dict[str, tuple[Grasp, dict[str, Any]]] = {
    "newton": (FIVE, {}),
    "newton, elliptic": (ELLIPTIC, {}),
    "newton, soft": (SOFT, {}),
    "newton, normal limits": (FIVE, {"limits": ForceLimits(min_normal=0.05, max_normal=8.0)}),
    "newton, own joints": (FIVE, {"limits": OWN}),
    "newton, shared joints": (FIVE, {"limits": SHARED}),
    "newton, soft, own joints": (SOFT, {"limits": SPUN}),
    "newton, elastic": (FIVE, {"limits": ForceLimits(max_normal=0.4), "elastic": True}),
    "reduced_flow": (FIVE, {"method": "reduced_flow"}),
    "full_flow": (FIVE, {"method": "full_flow"}),
    "conic": (FIVE, {"method": "conic"}),
    "conic, largest": (FIVE, {"method": "conic", "criterion": "max"}),
    "conic, own joints": (FIVE, {"method": "conic", "limits": OWN}),
    "conic, soft": (SOFT, {"method": "conic"}),
}


def moved(seed: int) -> dict[str, np.ndarray]:
    """Positions and normals a little off."""
    rng = np.random.default_rng([11, seed])
    normals = FIVE.normals + 0.03 * rng.standard_normal((5, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return {"positions": FIVE.positions + 2e-3 * rng.standard_normal((5, 3)), "normals": normals}


def part_of(limits: ForceLimits | None, chosen: np.ndarray) -> ForceLimits | None:
    """The limits of those contacts; joints stay."""
    if limits is None:
        return None
    each: dict[str, Any] = {
        name: getattr(limits, name)
        for name in ("min_normal", "max_normal", "torque_limit", "torque_bias")
    }
    jacobian = limits.jacobian
    return ForceLimits(**each, jacobian=None if jacobian is None else np.asarray(jacobian)[chosen])


@pytest.mark.parametrize("kind", KINDS)
def test_the_order_of_calls_does_not_matter(kind):
    grasp, options = KINDS[kind]
    rough = 0.5 if grasp is not ELLIPTIC else np.tile([0.5, 0.5], (5, 1))
    some = [True, True, True, True, False]
    others = [True, False, True, True, True]
    calls: list[dict[str, Any]] = [
        {},
        moved(0),
        {"friction": rough},
        {"contacts": some},
        {**moved(1), "contacts": others},
        {},
    ]
    if kind in ("newton", "reduced_flow"):
        calls += [*({"initial": name} for name in RULES), {}]
    limits = options.get("limits")
    if limits is not None and limits.jacobian is not None:
        calls.insert(2, {"jacobian": 0.9 * np.asarray(limits.jacobian)})
        calls.insert(4, {"torque_bias": np.full(limits.joints, 0.01)})
    optimizer = ForceOptimizer(grasp, **options)
    forward = [optimizer.solve(LOAD, **call)._record.copy() for call in calls]
    backward = [optimizer.solve(LOAD, **call)._record.copy() for call in calls[::-1]][::-1]
    alone = [ForceOptimizer(grasp, **options).solve(LOAD, **call)._record.copy() for call in calls]
    np.testing.assert_array_equal(forward, backward)
    np.testing.assert_array_equal(forward, alone)
    np.testing.assert_array_equal(forward[0], forward[-1])


@pytest.mark.parametrize("kind", KINDS)
def test_any_contacts_that_touch_are_a_grasp_of_those(kind):
    grasp, options = KINDS[kind]
    optimizer = ForceOptimizer(grasp, **options)
    solved = 0
    close = 0.02 if options.get("elastic") else 3e-6 if "conic" in kind else 3e-4
    for bits in range(1, 32):
        touching = np.array([bool(bits >> k & 1) for k in range(5)])
        places = grasp.positions[touching], grasp.normals[touching], grasp.models.friction[touching]
        models = {
            "contact_model": grasp.models.names[0],
            "torsional_friction": 0.005 if grasp is SOFT else None,
        }
        try:
            part = Grasp.from_contacts(*places, **models)
            want = optimize_force(
                part, LOAD, **{**options, "limits": part_of(options.get("limits"), touching)}
            )
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
    with pytest.raises(RankDeficientGraspError):
        optimizer.solve(LOAD, contacts=[False] * 5)


def test_an_update_replaces_the_contacts():
    optimizer = ForceOptimizer(FIVE, limits=SHARED, initial="linear_combination")
    there = moved(2)
    first = optimizer.solve(LOAD)
    optimizer.update(**there, friction=0.35, torque_bias=np.full(4, 0.01))
    now = Grasp.from_contacts(**there, friction=0.35)
    np.testing.assert_array_equal(optimizer.grasp.matrix, now.matrix)
    np.testing.assert_array_equal(optimizer.limits.torque_bias, 0.01)  # type: ignore[union-attr]
    limits = ForceLimits(jacobian=SHARED.jacobian, torque_limit=0.9, torque_bias=np.full(4, 0.01))
    want = optimize_force(now, LOAD, limits=limits, initial="linear_combination")
    np.testing.assert_allclose(optimizer.solve(LOAD).force, want.force, rtol=1e-9, atol=1e-9)
    optimizer.update(
        positions=FIVE.positions, normals=FIVE.normals, friction=0.4, torque_bias=np.zeros(4)
    )
    np.testing.assert_allclose(optimizer.solve(LOAD).force, first.force, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "limits", [None, ForceLimits(jacobian=np.full((3, 3, 1), 0.01), torque_limit=5.0)]
)
def test_contacts_on_a_line_lose_their_rank(limits):
    """Also in the general program, which shared joints need."""
    line = {"positions": [[0, 0, 0], [0, 0, 0.1], [0, 0, 0.2]], "normals": [[1.0, 0, 0]] * 3}
    for method in ("newton", "conic"):
        optimizer = ForceOptimizer(presets.tripod(), method=method, limits=limits)
        with pytest.raises(
            InfeasibleWrenchError, match=r"out of reach: rank\(G\) = 5 < 6 with 3 contacts"
        ):
            optimizer.solve(LOAD, **line)
        assert optimizer.solve(0.1 * LOAD).status is Status.OPTIMAL
        optimizer.update(**line)
        with pytest.raises(InfeasibleWrenchError, match="out of reach"):
            optimizer.solve(LOAD)


# previous solutions


@pytest.mark.parametrize(
    ("method", "own"), [("newton", "internal_force"), ("reduced_flow", "linear_combination")]
)
def test_previous_starts_with_the_methods_own_and_then_remembers(method, own):
    optimizer = ForceOptimizer(CUBOID, method=method, initial="previous")
    first = optimizer.solve(PAPER_WRENCH)
    again = optimizer.solve(PAPER_WRENCH)
    assert (first.initial, again.initial, again.iterations) == (own, "previous", 0)
    # a solution given to a function or a call is carried over in the same way
    other = optimize_force(CUBOID, 1.03 * PAPER_WRENCH, method=method, initial=again)
    np.testing.assert_array_equal(other.force, optimizer.solve(1.03 * PAPER_WRENCH).force)
    far = optimize_force(CUBOID, -2.0 * PAPER_WRENCH, method=method)
    other = ForceOptimizer(CUBOID, method=method).solve(PAPER_WRENCH, initial=far)
    np.testing.assert_array_equal(optimizer.solve(PAPER_WRENCH, initial=far).force, other.force)
    optimizer.forget()
    assert optimizer.previous is None
    np.testing.assert_array_equal(optimizer.solve(PAPER_WRENCH).force, first.force)


def test_a_solution_that_was_kept_is_the_previous_one():
    optimizer = ForceOptimizer(FIVE, initial="previous")
    kept = ForceOptimizer(FIVE, limits=OWN).solve(LOAD)
    optimizer.previous = kept
    assert optimizer.previous is not None
    np.testing.assert_array_equal(optimizer.previous._record, kept._record)
    warm = optimizer.solve(LOAD)
    again = optimizer.solve(LOAD)
    assert (warm.initial, again.initial, again.iterations) == ("previous", "previous", 0)
    np.testing.assert_array_equal(warm.force, optimize_force(FIVE, LOAD, initial=kept).force)
    with pytest.raises(InfeasibleStartError, match="4 contacts, the grasp 5"):
        optimizer.previous = optimize_force(CUBOID, LOAD)
    with pytest.raises(InfeasibleWrenchError) as caught:
        optimize_force(FIVE, LOAD, limits=ForceLimits(max_normal=0.1))
    with pytest.raises(
        InvalidInputError, match="must be a solution with a force, got status infeasible"
    ):
        optimizer.previous = caught.value.solution
    with pytest.raises(
        InvalidInputError, match="must be a solution with a force, got status infeasible"
    ):
        optimizer.solve(LOAD, initial=caught.value.solution)
    np.testing.assert_array_equal(optimizer.previous._record, again._record)


def test_the_previous_solution_has_its_own_names():
    def mine(grasp: Grasp, wrench: np.ndarray) -> np.ndarray:
        return optimize_force(grasp, wrench).force

    optimizer = ForceOptimizer(FIVE)
    solution = optimizer.solve(LOAD, initial=mine)
    assert optimizer.previous is not None
    assert (solution.initial, optimizer.previous.initial) == ("mine", "mine")
    optimizer.solve(LOAD)
    assert optimizer.previous.initial == "internal_force"
    optimizer.previous = optimize_force(FIVE, LOAD, method="conic")
    assert (optimizer.previous.method, optimizer.previous.initial) == ("conic", "central")


def test_a_start_belongs_to_the_caller():
    start = ForceOptimizer(FIVE).start(LOAD)
    start *= 2.0
    assert start.base is None


def test_torsions_of_the_touching_contacts_are_carried_over():
    touching = np.array([True, False, True, True, True])
    optimizer = ForceOptimizer(SOFT, initial="previous")
    first = optimizer.solve(LOAD, contacts=touching)
    again = optimizer.solve(LOAD, contacts=touching, trace=True)
    assert np.abs(first.torsion[touching]).min() > 1e-4
    assert again.initial == "previous"
    assert again.objective_trace[0] == pytest.approx(first.objective, rel=1e-9)


def test_a_mask_of_all_contacts_is_none():
    """A start that belongs to the constructor's contacts is found."""
    optimizer = ForceOptimizer(FIVE, initial="lagrange")
    assert optimizer.solve(LOAD, contacts=np.ones(5, bool)).initial == "lagrange"


def test_friction_in_pairs_belongs_to_the_touching_contacts():
    friction = np.full((5, 2), np.nan)
    friction[2:] = [0.4, 0.6]
    touching = np.arange(5) >= 2
    load = -FIVE.wrench(np.tile([1.0, 0.0, 0.0], (5, 1)) * touching[:, None])
    found = ForceOptimizer(ELLIPTIC).solve(load, friction=friction, contacts=touching)
    alone = ForceOptimizer(ELLIPTIC).solve(load, contacts=touching)
    np.testing.assert_array_equal(found.force, alone.force)


def test_the_deepest_force_is_that_of_the_constructors_contacts():
    def deepest(optimizer: ForceOptimizer) -> np.ndarray:
        force = np.zeros((5, 3))
        optimizer.core.deepest(LOAD, force, np.zeros(5), np.zeros(6))
        return force

    used = ForceOptimizer(FIVE)
    with suppress(InfeasibleWrenchError):
        used.solve(LOAD, contacts=np.arange(5) > 0)
    np.testing.assert_array_equal(deepest(used), deepest(ForceOptimizer(FIVE)))


def test_a_force_that_exceeds_its_limits_has_no_prices():
    """A row in C++ does not keep those of the solve before."""
    grasp, options = KINDS["newton, elastic"]
    optimizer = ForceOptimizer(grasp, **options)
    priced = optimizer.solve(0.1 * LOAD)
    exceeded = optimizer.solve(LOAD)
    assert priced.limit_multipliers.any()
    assert exceeded.status is Status.LIMITS_EXCEEDED
    assert not exceeded._record[-len(optimizer.limit_labels) :].any()


@pytest.mark.parametrize("allowed", range(7))
def test_few_steps_leave_the_least_excess(allowed):
    grasp, options = KINDS["newton, elastic"]
    least = ForceOptimizer(grasp, **options).solve(LOAD).limit_excess
    for initial in (None, "previous"):
        optimizer = ForceOptimizer(grasp, **options, initial=initial, max_iterations=allowed)
        optimizer.solve(0.1 * LOAD)
        exceeded = optimizer.solve(LOAD)
        assert exceeded.status is Status.LIMITS_EXCEEDED
        assert exceeded.limit_excess == pytest.approx(least, rel=0.02)


def test_a_start_at_rest_lies_inside():
    assert ForceOptimizer(FIVE, initial="lagrange").solve(np.zeros(6)).initial == "lagrange"


def test_the_gap_is_a_part_of_the_bound():
    loose = optimize_force(FIVE, LOAD, tolerance=0.9)
    assert loose.objective > 1.01 * loose.lower_bound > 0.0
    assert loose.optimality_gap == (loose.objective - loose.lower_bound) / loose.lower_bound


def test_a_rule_cannot_change_the_wrench():
    def rule(grasp: Grasp, wrench: np.ndarray) -> np.ndarray:
        start = optimize_force(grasp, wrench).force
        wrench[:] = 0.0
        return start

    load = LOAD.copy()
    solution = ForceOptimizer(FIVE, initial=rule).solve(load)
    np.testing.assert_array_equal(solution.wrench, LOAD)
    np.testing.assert_array_equal(load, LOAD)


@pytest.mark.parametrize(
    "kind", ["newton", "newton, own joints", "newton, shared joints", "newton, soft, own joints"]
)
def test_no_start_takes_more_steps_than_allowed(kind):
    """Also when a start fails and the method's own takes its place, and when a solve without limits
    gives the start."""
    grasp, options = KINDS[kind]
    loads = 3.0 * np.random.default_rng(4).standard_normal((12, 6)) * np.repeat([1.0, 0.03], 3)
    most = 0
    for initial, allowed in itertools.product(
        (None, "previous", "phase_one", "lagrange"), range(1, 7)
    ):
        optimizer = ForceOptimizer(grasp, **options, initial=initial, max_iterations=allowed)
        for load in loads:
            for trace in (False, True):
                with suppress(InfeasibleWrenchError, InfeasibleStartError):
                    solution = optimizer.solve(load, trace=trace)
                    assert solution.iterations <= allowed
                    most = max(most, solution.iterations)
    assert most == 6


def test_warm_starts_on_the_papers_path_save_steps():
    path = wrenches.paper_path(np.linspace(0.0, 2.0, 200)) * np.repeat([1.0, 0.05], 3)
    warm, cold = (
        ForceOptimizer(CUBOID, method="reduced_flow", initial=start) for start in ("previous", None)
    )
    steps = np.array([(warm.solve(w).iterations, cold.solve(w).iterations) for w in path])
    assert np.median(steps[:, 0]) <= 1
    assert steps[:, 0].sum() < 0.2 * steps[:, 1].sum()


@pytest.mark.parametrize(
    "options", [{}, {"method": "reduced_flow"}, {"limits": ForceLimits(max_normal=8.0)}], ids=str
)
def test_previous_never_fails_where_no_start_is_named(options):
    """An object on three tips, without force closure: the previous solution fits or is replaced."""
    rng = np.random.default_rng(17)
    solved = 0
    replaced = 0
    tips = np.array([[0.03, 0.0, 0.0], [-0.02, 0.03, 0.0], [-0.02, -0.03, 0.0]])
    floor = Grasp.from_contacts(tips, [[0.0, 0.0, 1.0]] * 3, 0.5)
    cold, warm = (ForceOptimizer(floor, **options, initial=start) for start in (None, "previous"))
    for k in range(120):
        load = np.array([0.0, 0.0, -3.0, 0.0, 0.0, 0.0]) + rng.standard_normal(6) * [
            0.6,
            0.6,
            1.5,
            0.02,
            0.02,
            0.002,
        ]
        now = {"positions": tips + 2e-3 * rng.standard_normal((3, 3))} if k % 3 else {}
        want = None
        with suppress(InfeasibleWrenchError):
            want = cold.solve(load, **now)
        if want is None:
            with pytest.raises(InfeasibleWrenchError):
                warm.solve(load, **now)
            continue
        found = warm.solve(load, **now)
        solved = solved + 1
        replaced = replaced + found.start_replaced
        assert found.status is want.status is Status.OPTIMAL
        assert found.objective == pytest.approx(want.objective, rel=3e-4)
    assert solved > 60
    assert replaced > 0


# solutions


@pytest.mark.parametrize("method", ["conic", "newton", "reduced_flow"])
def test_numbers_in_any_form_are_the_same_and_answers_are_copies(method):
    load = LOAD.astype(np.float32).astype(float)
    optimizer = ForceOptimizer(CUBOID, method=method)
    frozen = load.copy()
    frozen.flags.writeable = False
    want = optimizer.solve(load)
    for given in (
        load.tolist(),
        frozen,
        np.repeat(load, 2)[::2],
        load[::-1].copy()[::-1],
        load.astype(np.float32),
    ):
        np.testing.assert_array_equal(optimizer.solve(given)._record, want._record)
    kept = load.copy()
    force = want.force.copy()
    load[:] = 7.0
    optimizer.solve(load)
    np.testing.assert_array_equal(want.force, force)
    np.testing.assert_array_equal(want.wrench, kept)
    loads = np.random.default_rng(0).standard_normal((5, 6)) * np.repeat([1.0, 0.03], 3)
    rows = optimize_forces(CUBOID, loads, method=method)
    np.testing.assert_array_equal(
        optimize_forces(CUBOID, np.asfortranarray(loads), method=method).force, rows.force
    )


def test_a_cached_basis_does_not_keep_its_grasp_alive():
    grasp = presets.tripod()
    OfflineBasis.of(grasp)
    alive = weakref.ref(grasp)
    del grasp
    gc.collect()
    assert alive() is None


# proofs

PALM = Grasp.from_contacts(CUBOID.positions, [[0.0, 0.0, 1.0]] * 4, 0.4)
ANGLE = 2.0 * np.pi * np.arange(12) / 12
INWARD = -np.column_stack([np.cos(ANGLE), np.sin(ANGLE), np.zeros(12)])
RING = Grasp.from_contacts(-0.05 * INWARD, INWARD, 0.5)


def test_a_proof_of_the_cones_alone_has_no_prices():
    optimizer = ForceOptimizer(PALM, limits=ForceLimits(max_normal=2.0))
    with pytest.raises(InfeasibleWrenchError) as by_limits:
        optimizer.solve([0.0, 0.0, -50.0, 0.0, 0.0, 0.0])
    with pytest.raises(InfeasibleWrenchError) as by_cones:
        optimizer.solve([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    assert by_limits.value.solution.limit_multipliers.any()
    assert not by_cones.value.solution.limit_multipliers.any()


def test_a_proof_uses_the_limits_of_the_call():
    jacobian = 0.08 * np.random.default_rng(3).standard_normal((4, 3, 5))
    positions = CUBOID.positions + 1e-3
    optimizer = ForceOptimizer(CUBOID, limits=ForceLimits(jacobian=jacobian, torque_limit=0.4))
    with pytest.raises(InfeasibleWrenchError, match=r"joint \d: torque") as caught:
        optimizer.solve(PAPER_WRENCH, positions=positions, jacobian=10.0 * jacobian)
    now = Grasp.from_contacts(positions, CUBOID.normals, CUBOID.friction)
    reference = Reference(now, ForceLimits(jacobian=10.0 * jacobian, torque_limit=0.4))
    solution = caught.value.solution
    assert reference.proof(solution.certificate, PAPER_WRENCH, solution.limit_multipliers) >= -2e-7


def test_words_name_what_the_proof_needs():
    limits = ForceLimits(max_normal=[0.3, 90.0, 90.0, 90.0])
    for method in ("conic", "newton"):
        needed = r"needs the limits contact 0: normal <= 0.3 N.*elastic=True"
        with pytest.raises(InfeasibleWrenchError, match=needed):
            ForceOptimizer(CUBOID, method=method, limits=limits).solve(PAPER_WRENCH)
    with pytest.raises(
        InfeasibleWrenchError, match=r"inside the friction cones balances"
    ) as caught:
        ForceOptimizer(PALM).solve([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    assert "limits" not in str(caught.value)
    with pytest.raises(InfeasibleWrenchError) as caught:  # it slides
        ForceOptimizer(PALM).solve([2.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    q = (caught.value.solution.certificate @ PALM.matrix).reshape(-1, 3)
    least = 0.4 * np.hypot(*q[:, 1:].T)
    slipping = [str(k) for k in range(4) if q[k, 0] - least[k] <= 1e-3 * (q[k, 0] + least[k])]
    assert len(slipping) > 1
    assert f"what the cones of contacts {', '.join(slipping)} can make" in str(caught.value)
    heavy = [0.0, 0.0, 5.0, 0.0, 0.0, 0.0]
    many = ForceLimits(max_normal=0.1)
    exceeded = ForceOptimizer(RING, limits=many, elastic=True).solve(heavy)
    with pytest.raises(
        InfeasibleWrenchError,
        match=rf"excess is {100.0 * exceeded.limit_excess:.3g} % .* elastic=False names",
    ):
        exceeded.raise_for_status()
    proven = optimize_forces(RING, [heavy], limits=many)[0]
    with pytest.raises(InfeasibleWrenchError, match=r"The error of optimize_force names") as caught:
        proven.raise_for_status()
    assert f"The twist is {[round(v, 6) for v in proven.certificate.tolist()]}." in str(
        caught.value
    )
    positions = RING.positions.copy()
    with pytest.raises(InfeasibleWrenchError, match="and 6 more") as caught:
        ForceOptimizer(RING, limits=many).solve(heavy)
    again = pickle.loads(pickle.dumps(caught.value))
    assert str(again) == str(caught.value)
    np.testing.assert_array_equal(again.solution.certificate, caught.value.solution.certificate)
    with pytest.raises(InfeasibleWrenchError) as caught:
        ForceOptimizer(RING, limits=many).solve(heavy, positions=positions)
    positions[:] = np.nan  # the caller overwrites its array before the message is read
    assert "normal <= 0.1 N" in str(caught.value)
