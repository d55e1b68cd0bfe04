"""The learned start: balance and the guarantee for every call, training ranges, other Phis, memory, the shipped scores."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from never_worse import OWN, trial, violations

from grasp_env.errors import InfeasibleStartError, InvalidInputError
from grasp_env.force import BarzilaiBorweinStep, ForceOptimizer, Objective, OfflineBasis, optimize_force, start_replaced
from grasp_env.grasp import Grasp, presets, wrench
from policies import LearnedInitialForce
from policies.learned import PRETRAINED


@pytest.fixture(scope="module")
def rule() -> LearnedInitialForce:
    return LearnedInitialForce.pretrained()


def moved(shift: float, friction: float) -> Grasp:
    grasp = presets.paper_cuboid()
    rng = np.random.default_rng(1)
    offset = rng.uniform(-shift, shift, grasp.positions.shape) * [1, 1, 0]
    return Grasp.from_contacts(grasp.positions + offset, grasp.normals, friction)


@pytest.mark.parametrize(("shift", "friction"), [(0.0, 0.4), (0.0, 0.34), (0.003, 0.4), (0.01, 0.2), (0.0, 1.1)])
def test_balanced_strictly_feasible_never_worse_than_the_basis(rule, shift, friction):
    """Also on moved contacts, unseen friction and wrenches far outside the training range."""
    grasp = moved(shift, friction)
    objective = rule.objective
    basis = OfflineBasis.of(grasp, objective)
    rng = np.random.default_rng(2)
    wrenches = np.concatenate(
        [
            wrench.sample_ball(rng, 500),
            wrench.sample_magnitudes(rng, 500, 1e-9, 1e4),
            np.zeros((1, 6)),
            100 * wrench.paper_path(np.linspace(0, 2, 50)),
        ]
    )
    for w in wrenches:
        force = rule(grasp, w)
        scale = np.abs(force).max() + np.abs(w).max()
        assert grasp.residual(force, w) < 1e-11 * scale  # rounding of a 12-term sum, moments over 5 cm
        assert grasp.cone_margin(force) > 0
        paper = objective.value(grasp.to_cone(basis.combine(w)))
        assert objective.value(grasp.to_cone(force)) <= paper * (1 + 1e-12)


def test_scores_of_the_shipped_model_hold_on_the_standard_ball(rule):
    """Iterations of the flow with its best steps, friction varied: 24 / 47 from the basis (median / p99). Newton takes one step mostly."""
    rng, counts, newton = np.random.default_rng(77), list[int](), list[int]()
    for friction in np.linspace(0.25, 0.6, 10):
        grasp = presets.paper_cuboid(float(friction))
        flow = ForceOptimizer(grasp, method="reduced_flow", step_rule=BarzilaiBorweinStep(), initial=rule)
        second = ForceOptimizer(grasp, initial=rule)
        for w in wrench.sample_ball(rng, 100):
            counts.append(flow.solve(w).iterations)
            newton.append(second.solve(w).iterations)
    assert np.median(counts) <= 3
    assert np.percentile(counts, 99) <= 20  # the ends of the range count more here than in the comparison
    assert np.mean(np.array(newton) <= 1) > 0.85


def test_one_compiled_call_gives_what_start_and_solve_give(rule):
    grasp = presets.paper_cuboid()
    for method in ("reduced_flow", "newton"):
        optimizer = ForceOptimizer(grasp, initial=rule, method=method)
        for w in wrench.sample_magnitudes(np.random.default_rng(5), 50, 0.1, 10.0):
            solution, general = optimizer.solve(w), optimizer.solve(w, initial=rule)
            assert solution.status.name == "OPTIMAL"
            assert solution.optimality_gap <= 1e-4
            assert solution.initial == general.initial
            # both are certified to 1e-4, on the way from nearly the same start
            assert solution.objective == pytest.approx(general.objective, rel=1.1e-4)
            np.testing.assert_allclose(grasp.residual(solution.force, w), 0, atol=1e-11 * np.abs(solution.force).max())


def test_a_start_is_kept_where_the_flow_is_cut_short(rule):
    grasp, w = presets.paper_cuboid(), 20 * np.array(wrench.PAPER_CONSTANT)
    solution = ForceOptimizer(grasp, method="reduced_flow", initial=rule, max_iterations=0, tolerance=1e-13).solve(w)
    assert (solution.status.name, solution.initial) == ("ITERATION_LIMIT", f"{rule.name} (outside its training range)")
    np.testing.assert_allclose(solution.force, rule(grasp, w), rtol=1e-12)


def test_certificates_of_the_compiled_call(rule):
    """The bound is a bound, and the multipliers are the slopes of the optimum in the wrench."""
    grasp, w = presets.paper_cuboid(), np.array(wrench.PAPER_CONSTANT)
    exact = ForceOptimizer(grasp, method="newton", tolerance=1e-12).solve(w)
    solution = ForceOptimizer(grasp, initial=rule).solve(w)
    assert solution.objective * (1 - solution.optimality_gap) <= exact.objective * (1 + 1e-12) <= solution.objective
    np.testing.assert_allclose(solution.multipliers, exact.multipliers, atol=0.02 * np.abs(exact.multipliers).max())


@pytest.mark.parametrize("barrier_weight", [0.001, 0.1, 1.0])
def test_with_another_phi_it_is_as_good_in_that_one(rule, barrier_weight):
    """Phi knows forces in units of sqrt(lambda / omega) only, so the model is exact up to that scale."""
    grasp = presets.paper_cuboid()
    optimizer = ForceOptimizer(grasp, method="reduced_flow", initial=rule, barrier_weight=barrier_weight)
    basis = OfflineBasis.of(grasp, optimizer.objective)
    counts = []
    for w in wrench.sample_ball(np.random.default_rng(5), 100) * np.sqrt(barrier_weight / 0.01):
        start = optimizer.objective.value(grasp.to_cone(optimizer.start(w)))
        assert start <= optimizer.objective.value(grasp.to_cone(basis.combine(w))) * (1 + 1e-12)
        counts.append(optimizer.solve(w).iterations)
    assert np.median(counts) <= 8


def test_solutions_say_when_the_wrench_was_outside_the_training_range(rule):
    grasp, far = presets.paper_cuboid(), np.array([100.0, 0, 0, 0, 0, 0])
    assert rule.covers(grasp, np.array(wrench.PAPER_CONSTANT))
    assert not rule.covers(grasp, far)
    assert not rule.covers(presets.paper_cuboid(friction=1.5), np.array(wrench.PAPER_CONSTANT))
    for method in ("reduced_flow", "newton"):
        optimizer = ForceOptimizer(grasp, initial=rule, method=method)
        assert optimizer.solve(far).initial == f"{rule.name} (outside its training range)"
        assert optimizer.solve(np.array(wrench.PAPER_CONSTANT)).initial == rule.name


def test_memory_is_never_worse_than_either(rule):
    """Along a smooth path nothing is left to do; after a jump it is at least as good as the model alone."""
    grasp = presets.paper_cuboid()
    remembering = LearnedInitialForce.pretrained(remembers=True)
    optimizer = ForceOptimizer(grasp, method="reduced_flow", initial=remembering)
    path = wrench.sample_path(np.random.default_rng(6), 200)
    counts = [optimizer.solve(w).iterations for w in path][1:]
    assert max(counts) <= 7
    jump = np.random.default_rng(7).normal(size=6) * [5, 5, 5, 0.2, 0.2, 0.2]
    value = optimizer.objective.value(grasp.to_cone(optimizer.start(jump)))
    assert value <= optimizer.objective.value(grasp.to_cone(rule(grasp, jump))) * (1 + 1e-4)


def test_a_remembering_start_is_never_worse_than_the_previous_start_and_keeps_its_certificate(rule):
    """Also after jumps, where the carried force leaves the cones and is repaired."""
    from grasp_env.force.repair import carry_over

    grasp, objective = presets.paper_cuboid(), Objective()
    remembering = LearnedInitialForce(rule.checkpoint, remembers=True)
    optimizer = ForceOptimizer(grasp, method="reduced_flow", initial=remembering)
    rng = np.random.default_rng(11)
    for w in wrench.sample_magnitudes(rng, 300, 0.1, 20.0):
        before = optimizer.previous
        if before is not None:
            classical = objective.value(grasp.to_cone(carry_over(grasp, w, before.force, objective)))
            assert objective.value(grasp.to_cone(optimizer.start(w))) <= classical * (1 + 1e-12)
        solution = optimizer.solve(w)
        bound = objective.lower_bound(solution.multipliers, grasp.cone_matrix, w)
        if solution.iterations == 0:
            assert solution.objective <= bound * (1 + 1.001e-4)


def test_an_episode_in_the_environment(rule):
    from grasp_env.env.env import FourFingerGrasp

    env = FourFingerGrasp(initial_force=rule, disturbance="random")
    env.reset(seed=0)
    try:
        counts = [env.step(np.zeros(6, np.float32))[4]["iterations"] for _ in range(20)]
    finally:
        env.close()
    assert np.median(counts) <= 8


@pytest.mark.parametrize("grasp", [presets.tripod(), presets.five_finger_cuboid()])
@pytest.mark.parametrize("method", ["reduced_flow", "newton"])
def test_another_number_of_contacts_starts_from_the_methods_own_and_says_so(rule, grasp, method):
    """The rule itself, asked for a force, does not know these contacts."""
    w = np.array(wrench.PAPER_CONSTANT)
    solution, plain = (optimize_force(grasp, w, method=method, initial=initial) for initial in (rule, None))
    assert (solution.initial, solution.start_replaced) == (f"{OWN[method]} ({rule.name} was replaced)", True)
    np.testing.assert_allclose(solution.initial_force, plain.initial_force, atol=1e-12)
    assert solution.iterations == plain.iterations
    for call in (rule, rule.raw, rule.covers):
        with pytest.raises(InfeasibleStartError, match="4 contacts"):
            call(grasp, w)


@pytest.mark.parametrize("method", ["reduced_flow", "newton"])
def test_a_lost_finger_starts_from_one_internal_force_and_says_so(rule, method):
    grasp, w = presets.paper_cuboid(), 0.3 * np.array(wrench.PAPER_CONSTANT)
    optimizer = ForceOptimizer(grasp, initial=rule, method=method)
    assert optimizer.solve(w).initial == rule.name
    three = optimizer.solve(w, contacts=[True, True, True, False])
    assert three.initial.endswith(f"({rule.name} was replaced)")
    assert optimizer.solve(w).initial == rule.name


@pytest.mark.parametrize("method", ["reduced_flow", "newton"])
def test_the_learned_force_moves_with_the_contacts(rule, method):
    """In the same call; never more Phi than the method's own start has there."""
    grasp, rng = presets.paper_cuboid(), np.random.default_rng(12)
    learned, plain = (ForceOptimizer(grasp, initial=initial, method=method) for initial in (rule, None))
    kept = 0
    for w in wrench.sample_ball(rng, 50):
        places = grasp.positions + 2e-3 * rng.standard_normal((4, 3)) * [1, 1, 0]
        there = Grasp.from_contacts(places, grasp.normals, grasp.friction)
        one, other = learned.solve(w, positions=places), plain.solve(w, positions=places)
        assert one.objective == pytest.approx(other.objective, rel=2e-4)
        phi = [learned.objective.value(there.to_cone(s.initial_force)) for s in (one, other)]
        assert phi[0] <= phi[1] * (1 + 1e-12)
        kept += one.initial == rule.name
    assert kept > 40


def test_what_a_model_does_not_know(rule):
    grasp = presets.paper_cuboid()
    soft = Grasp.from_contacts(grasp.positions, grasp.normals, 0.4, contact_model="soft", torsional_friction=0.01)
    with pytest.raises(InfeasibleStartError, match="hard contacts"):
        rule(soft, np.zeros(6))
    with pytest.raises(InfeasibleStartError, match="finite"):
        rule(grasp, np.full(6, np.nan))
    for wrong in ([1.0, 2.0], [[1.0], [2.0, 3.0]], "wrench", None, np.zeros(7)):
        for call in (rule, rule.raw, rule.covers):
            with pytest.raises(InvalidInputError, match="wrench"):
                call(grasp, wrong)


@pytest.mark.parametrize(("part", "replaced"), [(1.0, False), (-1.0, True)])
@pytest.mark.parametrize("method", ["reduced_flow", "newton"])
def test_a_network_of_which_nothing_is_kept_is_told(rule, method, part, replaced):
    """In the compiled call and in the general path; with its last stage reversed it leads away from the optimum."""
    weights = {**rule.checkpoint.tensors, "layers.2.weight": part * rule.checkpoint.tensors["layers.2.weight"]}
    wild, grasp = LearnedInitialForce(replace(rule.checkpoint, tensors=weights)), presets.paper_cuboid()
    optimizer = ForceOptimizer(grasp, method=method, initial=wild)
    for w in wrench.sample_ball(np.random.default_rng(0), 20):
        # a rule of one call is asked for a force, which is never worse than the combination
        for solution, own in (
            (optimizer.solve(w), OWN[method]),
            (optimizer.solve(w, initial=wild), OWN["reduced_flow"]),
        ):
            assert solution.start_replaced is replaced
            assert solution.initial == (f"{own} ({wild.name} was replaced)" if replaced else wild.name)
            if own == OWN["reduced_flow"]:
                assert start_replaced(grasp, w, solution.initial_force) is replaced


def test_pickle_keeps_every_bit(rule):
    grasp, w = presets.paper_cuboid(), np.array(wrench.PAPER_CONSTANT)
    optimizer = ForceOptimizer(grasp, initial=rule)
    again = pickle.loads(pickle.dumps(optimizer))
    np.testing.assert_array_equal(again.solve(w).force, optimizer.solve(w).force)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(rule))(grasp, w), rule(grasp, w))


def test_model_card_and_size_of_the_shipped_model(rule):
    card = rule.checkpoint.card
    assert card["command"].startswith("grasp fit")
    assert {"data", "config", "seconds", "machine", "versions", "held_out_gap", "limits"} <= card.keys()
    assert isinstance(card["config"]["seed"], int)
    assert sum(file.stat().st_size for file in PRETRAINED.glob("four_finger.*")) < 2_000_000


@pytest.mark.parametrize("size", [1.0, 30.0, 1e5, 1e20, 3e38])
def test_never_worse_whatever_the_weights_say(rule, size):
    """Wild networks: nothing that they were trained on, up to the largest numbers of float32."""
    rng = np.random.default_rng(10)
    wrenches = wrench.sample_magnitudes(rng, 500, 1e-3, 1000.0)
    for _ in range(6):
        tensors = {
            name: value if name == "reference" else (size * rng.uniform(-1.0, 1.0, value.shape)).astype(np.float32)
            for name, value in rule.checkpoint.tensors.items()
        }
        wild = LearnedInitialForce(replace(rule.checkpoint, tensors=tensors))
        for method in OWN:
            assert not violations(wild, presets.paper_cuboid(), wrenches, method).any()
        optimizer = ForceOptimizer(presets.paper_cuboid(), method="newton", initial=wild)
        for w in wrenches[:50]:
            assert optimizer.solve(w).status.name == "OPTIMAL"


@pytest.mark.parametrize("count", [20_000, pytest.param(10_000_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("method", OWN)
def test_never_worse(rule, method, count):
    """Wrenches of 1e-4 to 1e4 N, frictions inside and outside the trained range."""
    assert trial(rule, count, 9, method) == 0
