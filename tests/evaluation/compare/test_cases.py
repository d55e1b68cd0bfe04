"""Cases repeat and keep what their sets promise."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from grasp_env.force import Objective
from grasp_env.grasp import presets
from grasp_env.grasp.wrench import FORCE_RADIUS, MOMENT_RADIUS
from grasp_env.quality import feasibility
from training.data.grasps import BENCH, EVALUATION, HALF, SOLIDS
from training.evaluation.compare.cases import (
    DISPLACEMENT,
    FRICTIONS,
    MAGNITUDES,
    SETS,
    directions,
    make_cases,
    scaled,
)
from training.evaluation.compare.recorded import IMPACT, changes_of, record, without
from training.evaluation.compare.starts import DoesNotApply, carry_force, require_near_fixed

RADII = np.repeat([FORCE_RADIUS, MOMENT_RADIUS], 3)


@pytest.mark.parametrize("name", [name for name in SETS if not name.startswith("rollout")])
def test_cases_repeat_and_depend_on_the_seed(name):
    first = make_cases(name, 12, 3)
    again = make_cases(name, 12, 3)
    assert len(first) == len(again) >= 1
    for one, two in zip(first, again, strict=True):
        assert_array_equal(one.wrench, two.wrench)
        assert_array_equal(one.grasp.matrix, two.grasp.matrix)
    if name not in ("constant", "paper_path", "directions"):
        assert not np.array_equal(first[-1].wrench, make_cases(name, 12, 4)[-1].wrench)


@pytest.mark.parametrize(("name", "size"), [("jump_10", 0.1), ("jump_50", 0.5), ("jump_100", 1.0)])
def test_jumps_have_their_size(name, size):
    for case in make_cases(name, 30, 0):
        now, move = (
            (each / RADII).reshape(2, 3) for each in (case.wrench, case.wrench - case.before[1])
        )
        assert_allclose(np.linalg.norm(move, axis=1), size)
        assert np.linalg.norm(now, axis=1).max() <= 1.0


def test_paths_are_chained():
    cases = make_cases("trajectories", 400, 0)
    assert [k for k, case in enumerate(cases) if case.before is None] == [0, 200]
    assert {case.group for case in cases} == {0, 1}
    for old, now in pairwise(cases):
        assert now.before is None or np.array_equal(now.before[1], old.wrench)
    assert all(np.linalg.norm(case.wrench[:3]) <= FORCE_RADIUS for case in cases)
    line = make_cases("lines", 500, 0)
    assert len(line) == 2 * 401
    assert (np.sign(line[0].wrench) == -np.sign(line[400].wrench)).all()
    sizes = np.linalg.norm(
        [scaled(case.wrench) for case in make_cases("six_decades", 100, 0)], axis=1
    )
    assert MAGNITUDES[0] <= sizes.min() < 0.01
    assert 100.0 < sizes.max() <= MAGNITUDES[1]
    named = np.array([wrench for _, wrench in directions()])
    assert len(named) == 18
    assert_allclose(np.linalg.norm(named / [1, 1, 1, 0.05, 0.05, 0.05], axis=1), 1.0)
    assert np.linalg.matrix_rank(named) == 6


@pytest.mark.parametrize("shape", SOLIDS)
@pytest.mark.parametrize("base", [EVALUATION, BENCH])
def test_contacts_lie_on_a_solid_and_press_into_it(base, shape):
    recipe = replace(base, shapes=(shape,))
    rng = np.random.default_rng(0)
    for _ in range(20):
        places, inward = recipe.points(rng, 6)
        assert_allclose(np.linalg.norm(inward, axis=1), 1.0, rtol=1e-12)
        # the centre of a convex solid lies behind every face
        assert ((places * inward).sum(axis=1) < 0.0).all()
        assert np.linalg.norm(places, axis=1).min() >= HALF[0] * 0.99
        assert np.abs(places).max() <= HALF[1]
    grasp = recipe.closed(rng, 4)
    assert recipe.friction[0] <= grasp.friction.min() <= grasp.friction.max() <= recipe.friction[1]
    assert feasibility(grasp, np.zeros(6)).margin > recipe.margin / 4


def test_near_grasps_are_near():
    fixed = presets.paper_cuboid()
    far = list[float]()
    assert {case.event for case in make_cases("friction", 10, 0)} == {f"{mu:g}" for mu in FRICTIONS}
    for case in make_cases("positions", 100, 0):
        moved = case.grasp.positions - fixed.positions
        assert np.abs((moved * fixed.normals).sum(axis=1)).max() < 1e-12  # along the faces
        far += np.linalg.norm(moved, axis=1).tolist()
        require_near_fixed(case.grasp)
    # uniform over the disc: half of its area lies within 0.71 of its radius; three standard
    # deviations
    assert max(far) <= DISPLACEMENT
    assert np.median(far) == pytest.approx(
        DISPLACEMENT / np.sqrt(2.0), abs=3 * DISPLACEMENT / np.sqrt(2 * len(far))
    )
    for count in (3, 4, 5):
        with pytest.raises(DoesNotApply):
            require_near_fixed(EVALUATION.closed(np.random.default_rng(count), count))


def test_changes_of_contact_carry_forces():
    """Persisting fingers keep their force as a vector; a finger that lands is inside its cone."""
    rng = np.random.default_rng(0)
    events = set[str]()
    (problems,) = record(1, rng, "impulses", ("five_finger",), 6)
    for old_problem, new_problem in pairwise(problems):
        for case in changes_of(rng, old_problem, new_problem, 0):
            old = case.before[0]
            now = case.grasp
            events.add(case.event)
            assert (
                now.n_contacts - old.n_contacts
                == {"lost": -1, "landed": 1, "slipped": 0}[case.event]
            )
            force = rng.uniform(0.5, 1.0, (old.n_contacts, 3))
            new = carry_force(old, force, now, Objective())
            vectors = now.to_object_frame(new)
            before = old.to_object_frame(force)
            apart = np.linalg.norm(now.positions[:, None] - old.positions, axis=2)
            for finger in range(now.n_contacts):
                if apart[finger].min() < 0.012:
                    assert_allclose(vectors[finger], before[apart[finger].argmin()], atol=1e-12)
                else:
                    assert case.event == "landed"
                    assert_allclose(new[finger], [0.1 / now.friction[finger], 0.0, 0.0])
    assert events == {"lost", "landed", "slipped"}
    assert without(presets.tripod(), 0) is None


def test_recordings_move_and_impacts_are_impacts():
    problems, *others = record(
        4, np.random.default_rng(0), "random", ("four_finger", "three_finger"), 5
    )
    # one for each step, none of closing the fingers
    assert [len(each) for each in (problems, *others)] == [5] * 4
    assert not np.array_equal(problems[0][0].positions, problems[-1][0].positions)
    for case in make_cases("rollout_fixed", 5, 0):
        assert np.linalg.norm((case.wrench - case.before[1]) / RADII) >= IMPACT
        require_near_fixed(case.grasp)
