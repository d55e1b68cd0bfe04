"""The learned start: balance and the guarantee in every call, training ranges, other weights of
Phi, memory, the shipped scores."""

from __future__ import annotations

import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from never_worse import OWN, trial, violations

from grasp_env.errors import InfeasibleStartError, InvalidInputError
from grasp_env.force import (
    BarzilaiBorweinStep,
    ForceOptimizer,
    Margin,
    Objective,
    OfflineBasis,
    optimize_force,
)
from grasp_env.force.repair import carry_over, start_replaced
from grasp_env.grasp import Grasp, presets, wrench
from grasp_env.grasp.null_space import reference_basis
from policies import LearnedInitialForce
from policies.places import Places
from training.data.grasps import EVALUATION, slide_contacts

W = np.array(wrench.PAPER_CONSTANT)
both = pytest.mark.parametrize("method", ["reduced_flow", "newton"])


@pytest.fixture(scope="module")
def rule():
    return LearnedInitialForce.pretrained()


@pytest.mark.parametrize(
    ("shift", "friction"), [(0.0, 0.34), (0.003, 0.4), (0.01, 0.2), (0.0, 1.1)]
)
def test_balanced_strictly_feasible_never_worse_than_the_basis(rule, shift, friction):
    grasp = presets.paper_cuboid()
    rng = np.random.default_rng(2)
    offset = np.random.default_rng(1).uniform(-shift, shift, grasp.positions.shape) * [1, 1, 0]
    grasp = Grasp.from_contacts(grasp.positions + offset, grasp.normals, friction)
    objective = rule.objective
    basis = OfflineBasis.of(grasp, rule.objective)
    far = wrench.sample_magnitudes(rng, 200, 1e-9, 1e4)
    path = 100 * wrench.paper_path(np.linspace(0, 2, 20))
    for w in (*wrench.sample_ball(rng, 200), *far, np.zeros(6), *path):
        force = rule(grasp, w)
        scale = np.abs(force).max() + np.abs(w).max()
        # rounding of a 12-term sum, moments over 5 cm
        assert grasp.residual(force, w) < 1e-11 * scale
        assert grasp.cone_margin(force) > 0
        paper = objective.value(grasp.to_cone(basis.combine(w)))
        assert objective.value(grasp.to_cone(force)) <= paper * (1 + 1e-12)


@pytest.mark.parametrize("size", [1.0, 1e5, 3e38])
def test_never_worse_whatever_the_weights_say(rule, size):
    rng = np.random.default_rng(10)
    wrenches = wrench.sample_magnitudes(rng, 300, 1e-3, 1000.0)
    for _ in range(3):
        tensors = {
            name: value
            if name == "reference"
            else (size * rng.uniform(-1.0, 1.0, value.shape)).astype(np.float32)
            for name, value in rule.checkpoint.tensors.items()
        }
        wild = LearnedInitialForce(replace(rule.checkpoint, tensors=tensors))
        for method in OWN:
            assert not violations(wild, presets.paper_cuboid(), wrenches, method).any()
        optimizer = ForceOptimizer(presets.paper_cuboid(), method="newton", initial=wild)
        for w in wrenches[:30]:
            assert optimizer.solve(w).status.name == "OPTIMAL"


@pytest.mark.parametrize("count", [3, 4, 5, 8])
def test_never_worse_wherever_the_contacts_are(rule, count):
    """Weights that depend on displacements, at random: random grasps, moved by up to 12 mm, 0.3 to
    50 N."""
    rng = np.random.default_rng(count)
    shipped = rule.checkpoint
    grasp = EVALUATION.closed(rng, count)
    outputs = 3 * count - 6
    sizes = (rule.sizes[0], 16, outputs)
    terms = shipped.numbers["friction_degree"] + 1 + 2 * count
    tensors = {
        "reference": reference_basis(grasp),
        "pairs": shipped.tensors["pairs"],
        **vars(Places.of(grasp, 0.003)),
    }
    for layer, (a, b) in enumerate(pairwise(sizes)):
        for name, shape in (("weight", (terms, b, a)), ("bias", (terms, b))):
            tensors[f"layers.{layer}.{name}"] = rng.uniform(-0.2, 0.2, shape).astype(np.float32)
    numbers = {**shipped.numbers, "sizes": list(sizes), "n_contacts": count}
    model = LearnedInitialForce(replace(shipped, tensors=tensors, numbers=numbers))
    wrenches = wrench.sample_magnitudes(rng, 100, 0.3, 50.0)
    tried = 0
    seen = []
    for _ in range(20):
        there = slide_contacts(rng, grasp, 0.0, 0.012)
        if not EVALUATION.closes(there):
            continue
        tried += 1
        for method in OWN:
            assert not violations(model, there, wrenches, method).any()
        for w in wrenches[:5]:
            force = model(there, w)
            assert there.residual(force, w) < 1e-11 * (np.abs(force).max() + np.abs(w).max())
            assert there.cone_margin(force) > 0
        seen.append(model.raw(there, wrenches[0]))
    assert tried >= 5
    assert np.std(seen, axis=0).max() > 1e-3  # the weights do change


@pytest.mark.parametrize("count", [10_000, pytest.param(10_000_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("method", OWN)
def test_never_worse(rule, method, count):
    assert trial(rule, count, 9, method) == 0


def test_scores_of_the_shipped_model_hold_on_the_standard_ball(rule):
    """Iterations of the flow with its best steps, friction varied: 24 / 47 from the basis (median /
    p99). Newton mostly takes one."""
    rng = np.random.default_rng(77)
    counts = list[int]()
    newton = list[int]()
    for friction in np.linspace(0.25, 0.6, 10):
        grasp = presets.paper_cuboid(float(friction))
        flow = ForceOptimizer(
            grasp, method="reduced_flow", step_rule=BarzilaiBorweinStep(), initial=rule
        )
        second = ForceOptimizer(grasp, initial=rule)
        for w in wrench.sample_ball(rng, 100):
            counts.append(flow.solve(w).iterations)
            newton.append(second.solve(w).iterations)
    assert np.median(counts) <= 3
    # the ends of the range count more here than in the comparison
    assert np.percentile(counts, 99) <= 20
    assert np.mean(np.array(newton) <= 1) > 0.85


@both
def test_the_compiled_call_starts_from_the_force_of_the_rule(rule, method):
    grasp = presets.paper_cuboid()
    optimizer = ForceOptimizer(grasp, initial=rule, method=method)
    for w in wrench.sample_magnitudes(np.random.default_rng(5), 50, 0.1, 10.0):
        solution = optimizer.solve(w)
        assert solution.status.name == "OPTIMAL"
        assert solution.initial == optimizer.solve(w, initial=rule).initial
    stopped = ForceOptimizer(
        grasp, method=method, initial=rule, max_iterations=0, tolerance=1e-13
    ).solve(W)
    np.testing.assert_allclose(stopped.force, stopped.initial_force, rtol=1e-12)


@pytest.mark.parametrize("barrier_weight", [0.001, 1.0])
def test_with_another_phi_it_is_as_good_in_that_one(rule, barrier_weight):
    """Phi knows forces in units of sqrt(lambda / omega) only, so the model is exact up to that
    scale."""
    grasp = presets.paper_cuboid()
    optimizer = ForceOptimizer(
        grasp, method="reduced_flow", initial=rule, barrier_weight=barrier_weight
    )
    basis = OfflineBasis.of(grasp, optimizer.objective)
    counts = []
    for w in wrench.sample_ball(np.random.default_rng(5), 100) * np.sqrt(barrier_weight / 0.01):
        start = optimizer.objective.value(grasp.to_cone(optimizer.start(w)))
        assert start <= optimizer.objective.value(grasp.to_cone(basis.combine(w))) * (1 + 1e-12)
        counts.append(optimizer.solve(w).iterations)
    assert np.median(counts) <= 8


@both
def test_solutions_name_a_wrench_outside_the_training_range(rule, method):
    grasp = presets.paper_cuboid()
    far = np.array([100.0, 0, 0, 0, 0, 0])
    cases = [(grasp, W), (grasp, far), (presets.paper_cuboid(friction=1.5), W)]
    assert [rule.covers(*case) for case in cases] == [True, False, False]
    optimizer = ForceOptimizer(grasp, initial=rule, method=method)
    assert optimizer.solve(far).initial == f"{rule.name} (outside its training range)"
    assert optimizer.solve(W).initial == rule.name


def test_with_memory_it_is_never_worse_than_the_previous_start(rule):
    """Along a smooth path little is left to do; after jumps the carried force may leave the cones
    and is repaired."""
    grasp = presets.paper_cuboid()
    objective = Objective()
    optimizer = ForceOptimizer(
        grasp, method="reduced_flow", initial=LearnedInitialForce.pretrained(remembers=True)
    )
    path = wrench.sample_path(np.random.default_rng(6), 100)
    assert max([optimizer.solve(w).iterations for w in path][1:]) <= 7
    for w in wrench.sample_magnitudes(np.random.default_rng(11), 200, 0.1, 20.0):
        carried = carry_over(grasp, w, optimizer.previous.force, objective)
        start, *others = (
            objective.value(grasp.to_cone(f)) for f in (optimizer.start(w), carried, rule(grasp, w))
        )
        assert start <= min(others) * (1 + 1e-12)
        solution = optimizer.solve(w)
        if solution.iterations == 0:  # the certificate belongs to the carried force
            bound = objective.lower_bound(solution.multipliers, grasp.cone_matrix, w)
            assert solution.objective <= bound * (1 + 1.001e-4)


@both
def test_another_number_of_contacts_starts_as_without_the_rule(rule, method):
    for grasp in (presets.tripod(), presets.five_finger_cuboid()):
        solution, plain = (
            optimize_force(grasp, W, method=method, initial=initial) for initial in (rule, None)
        )
        assert (solution.initial, solution.start_replaced) == (
            f"{OWN[method]} ({rule.name} was replaced)",
            True,
        )
        np.testing.assert_allclose(solution.initial_force, plain.initial_force, atol=1e-12)
        assert solution.iterations == plain.iterations
    optimizer = ForceOptimizer(presets.paper_cuboid(), initial=rule, method=method)
    lost = optimizer.solve(0.3 * W, contacts=[True, True, True, False])
    assert lost.initial.endswith(f"({rule.name} was replaced)")
    assert optimizer.solve(0.3 * W).initial == rule.name


@both
def test_the_learned_force_moves_with_the_contacts(rule, method):
    """In the same call; its Phi is never above that of the method's own start."""
    grasp = presets.paper_cuboid()
    rng = np.random.default_rng(12)
    learned, plain = (
        ForceOptimizer(grasp, initial=initial, method=method) for initial in (rule, None)
    )
    kept = 0
    for w in wrench.sample_ball(rng, 50):
        places = grasp.positions + 2e-3 * rng.standard_normal((4, 3)) * [1, 1, 0]
        there = Grasp.from_contacts(places, grasp.normals, grasp.friction)
        one = learned.solve(w, positions=places)
        other = plain.solve(w, positions=places)
        assert one.objective == pytest.approx(other.objective, rel=2e-4)
        phi = [learned.objective.value(there.to_cone(s.initial_force)) for s in (one, other)]
        assert phi[0] <= phi[1] * (1 + 1e-12)
        kept += one.initial == rule.name
    assert kept > 40


@pytest.mark.parametrize(("part", "replaced"), [(1.0, False), (-1.0, True)])
@both
def test_a_start_without_anything_of_the_network_is_named(rule, method, part, replaced):
    """With its last layer reversed the network leads away from the optimum; in the compiled call
    and as a rule of one call."""
    weights = {
        **rule.checkpoint.tensors,
        "layers.2.weight": part * rule.checkpoint.tensors["layers.2.weight"],
    }
    wild = LearnedInitialForce(replace(rule.checkpoint, tensors=weights))
    grasp = presets.paper_cuboid()
    optimizer = ForceOptimizer(grasp, method=method, initial=wild)
    for w in wrench.sample_ball(np.random.default_rng(0), 20):
        one_call = optimizer.solve(w, initial=wild)
        assert start_replaced(grasp, w, one_call.initial_force) is replaced
        for solution, own in ((optimizer.solve(w), OWN[method]), (one_call, OWN["reduced_flow"])):
            assert solution.start_replaced is replaced
            assert solution.initial == (
                f"{own} ({wild.name} was replaced)" if replaced else wild.name
            )


def test_what_a_model_does_not_know_is_an_error(rule):
    grasp = presets.paper_cuboid()
    soft = Grasp.from_contacts(
        grasp.positions, grasp.normals, 0.4, contact_model="soft", torsional_friction=0.01
    )
    wrong = [
        (soft, W, "hard contacts"),
        (presets.tripod(), W, "4 contacts"),
        (grasp, np.full(6, np.nan), "finite"),
    ]
    for contacts, load, words in wrong:
        with pytest.raises(InfeasibleStartError, match=words):
            rule(contacts, load)
    for load in ([1.0, 2.0], "wrench", None, np.zeros(7)):
        with pytest.raises(InvalidInputError, match="wrench"):
            rule.covers(grasp, load)


def test_a_margin_is_another_friction_and_another_wrench(rule):
    """The network predicts for the shifted problem, which training covers down to a share of 0.8."""
    grasp = presets.paper_cuboid()
    inner = grasp.with_friction(0.8 * 0.4)
    margin = Margin(0.8, 0.5)
    optimizer = ForceOptimizer(grasp, method="reduced_flow", initial=rule, margin=margin)
    other = ForceOptimizer(inner, method="reduced_flow", initial=rule)
    paper = ForceOptimizer(grasp, method="reduced_flow", margin=margin)
    iterations, of_paper = [], []
    for load in wrench.sample_ball(np.random.default_rng(8), 40):
        solution = optimizer.solve(load)
        expected = other.solve(load + grasp.matrix[:, ::3] @ np.full(4, 0.5))
        assert solution.initial == expected.initial == rule.name
        moved = solution.initial_force - [0.5, 0.0, 0.0]
        np.testing.assert_allclose(moved, expected.initial_force, rtol=1e-9, atol=1e-9)
        iterations.append(solution.iterations)
        of_paper.append(paper.solve(load).iterations)
    assert np.median(iterations) <= 3 < 0.2 * np.median(of_paper)
    far = ForceOptimizer(grasp, initial=rule, margin=0.4).solve(W)
    assert far.initial == f"{rule.name} (outside its training range)"


def test_pickle_keeps_every_bit(rule):
    optimizer = ForceOptimizer(presets.paper_cuboid(), initial=rule)
    again = pickle.loads(pickle.dumps(optimizer))
    np.testing.assert_array_equal(again.solve(W).force, optimizer.solve(W).force)
