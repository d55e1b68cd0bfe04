"""The cases are what they are said to be, held out, and the same for the same seed."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from grasp_env.config import EnvConfig
from grasp_env.force import Objective
from grasp_env.grasp import presets
from grasp_env.grasp.wrench import FORCE_RADIUS, MOMENT_RADIUS
from grasp_env.quality import feasibility
from grasp_env.task import Impulses, RandomWrench, SixDirections
from training.compare.cases import (
    DIRECTION_SIZES,
    DISPLACEMENT,
    FRICTIONS,
    MAGNITUDES,
    SETS,
    directions,
    make_cases,
    scaled,
)
from training.compare.recorded import IMPACT, SLIP, record, without
from training.compare.scenarios import HOLDS_OF_STARTS, LABELS
from training.compare.starts import STARTS, STORED, DoesNotApply, carry_force, require_near_fixed
from training.data.grasps import BENCH, EVALUATION, HALF, SOLIDS

RADII = np.repeat([FORCE_RADIUS, MOMENT_RADIUS], 3)


@pytest.mark.parametrize("name", [name for name in SETS if not name.startswith("rollout")])
def test_cases_repeat_and_depend_on_the_seed(name):
    first, again = make_cases(name, 12, 3), make_cases(name, 12, 3)
    assert len(first) == len(again) >= 1
    for one, two in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.wrench, two.wrench)
        np.testing.assert_array_equal(one.grasp.matrix, two.grasp.matrix)
    if name not in ("constant", "paper_path", "directions"):
        assert not np.array_equal(first[-1].wrench, make_cases(name, 12, 4)[-1].wrench)


@pytest.mark.parametrize(("name", "size"), [("jump_10", 0.1), ("jump_50", 0.5), ("jump_100", 1.0)])
def test_jumps_have_their_size_and_stay_in_the_ball(name, size):
    for case in make_cases(name, 30, 0):
        assert case.before is not None
        move = case.wrench - case.before[1]
        assert np.linalg.norm(move[:3]) == pytest.approx(size * FORCE_RADIUS)
        assert np.linalg.norm(move[3:]) == pytest.approx(size * MOMENT_RADIUS)
        assert np.linalg.norm(case.wrench[:3]) <= FORCE_RADIUS
        assert np.linalg.norm(case.wrench[3:]) <= MOMENT_RADIUS


def test_paths_are_chained_and_end_at_their_ends():
    cases = make_cases("trajectories", 400, 0)
    assert len(cases) == 400
    assert [k for k, case in enumerate(cases) if case.before is None] == [0, 200]
    for old, now in pairwise(cases):
        assert now.before is None or np.array_equal(now.before[1], old.wrench)
    assert all(np.linalg.norm(case.wrench[:3]) <= FORCE_RADIUS for case in cases)
    assert {case.group for case in cases} == {0, 1}


def test_directions():
    named = dict(directions())
    assert len(named) == 18
    assert all(
        np.linalg.norm(w[:3]) + np.linalg.norm(w[3:]) / MOMENT_RADIUS == pytest.approx(1.0) for w in named.values()
    )
    assert np.linalg.matrix_rank(np.stack(list(named.values()))) == 6


@pytest.mark.parametrize("shape", SOLIDS)
@pytest.mark.parametrize("base", [EVALUATION, BENCH])
def test_contacts_lie_on_a_solid_and_press_into_it(base, shape):
    recipe, rng = replace(base, shapes=(shape,)), np.random.default_rng(0)
    for _ in range(20):
        places, inward = recipe.points(rng, 6)
        np.testing.assert_allclose(np.linalg.norm(inward, axis=1), 1.0, rtol=1e-12)
        assert ((places * inward).sum(axis=1) < 0.0).all()  # the centre of a convex solid lies behind every face
        assert np.linalg.norm(places, axis=1).min() >= HALF[0] * 0.99
        assert np.abs(places).max() <= HALF[1]
    grasp = recipe.closed(rng, 4)
    assert recipe.friction[0] <= grasp.friction.min() <= grasp.friction.max() <= recipe.friction[1]
    assert feasibility(grasp, np.zeros(6)).margin > recipe.margin / 4


def test_near_grasps_are_near_and_random_ones_close():
    fixed = presets.paper_cuboid()
    assert {case.event for case in make_cases("friction", 10, 0)} == {f"{mu:g}" for mu in FRICTIONS}
    for case in make_cases("positions", 32, 0):
        moved = case.grasp.positions - fixed.positions
        assert np.abs((moved * fixed.normals).sum(axis=1)).max() < 1e-12  # along the faces
        assert 0.0 < np.linalg.norm(moved, axis=1).max() <= DISPLACEMENT
        require_near_fixed(case.grasp)
    for count in (3, 4, 5):
        grasp = EVALUATION.closed(np.random.default_rng(count), count)
        assert grasp.n_contacts == count
        assert feasibility(grasp, np.zeros(6)).margin > 0.0
        with pytest.raises(DoesNotApply):
            require_near_fixed(grasp)


@pytest.fixture(scope="module")
def changes():
    return make_cases("rollout_changes", 40, 0)


def test_changes_of_contact(changes):
    assert {case.event for case in changes} == {"lost", "landed", "slipped"}
    for case in changes:
        assert case.before is not None
        difference = case.grasp.n_contacts - case.before[0].n_contacts
        assert difference == {"lost": -1, "landed": 1, "slipped": 0}[case.event]


def test_forces_are_carried_by_place(changes):
    """Persisting fingers keep their force as a vector; one that lands is inside its cone."""
    for case in changes:
        old, now = case.before[0], case.grasp
        force = np.random.default_rng(0).uniform(0.5, 1.0, (old.n_contacts, 3))
        new = carry_force(old, force, now, Objective())
        vectors, before = now.to_object_frame(new), old.to_object_frame(force)
        apart = np.linalg.norm(now.positions[:, None] - old.positions, axis=2)
        for finger in range(now.n_contacts):
            if apart[finger].min() < 0.012:
                np.testing.assert_allclose(vectors[finger], before[apart[finger].argmin()], atol=1e-12)
            else:
                assert case.event == "landed"
                assert new[finger, 0] == pytest.approx(0.1 / now.friction[finger])
                assert not new[finger, 1:].any()


def test_recordings_move_and_impacts_are_impacts():
    (problems,) = record(1, np.random.default_rng(0), "random", ("four_finger",), 5)
    assert len(problems) == 5
    assert not np.array_equal(problems[0][0].positions, problems[-1][0].positions)
    for case in make_cases("rollout_fixed", 12, 0):
        assert case.before is not None
        move = np.abs(case.wrench - case.before[1]) / RADII
        assert np.linalg.norm(move) >= IMPACT
        require_near_fixed(case.grasp)
    assert all(case.before is None for case in make_cases("rollout_cold", 20, 0))


def test_too_few_fingers_are_no_grasp():
    assert without(presets.tripod(), 0) is None
    rest = without(presets.five_finger_cuboid(), 1)
    assert rest is not None
    assert rest.n_contacts == 4


def test_what_sets_scenarios_and_starts_are_called_is_what_is_done():
    """Their labels are texts of tables that import nothing: the numbers in them are held against the code here."""
    labels = {name: info.label for name, info in SETS.items()}
    ball = f"force <= {FORCE_RADIUS:g} N, moment <= {MOMENT_RADIUS:g} N m"
    forces, moments = ([size * unit for size in DIRECTION_SIZES] for unit in (1.0, MOMENT_RADIUS))
    few = ["{:g}, {:g} and {:g}".format(*sizes) for sizes in (FRICTIONS, forces, moments)]
    moved = f"slipped {1e3 * SLIP[0]:g} to {1e3 * SLIP[1]:g} mm"
    for name, part in (
        ("ball", ball), ("friction", few[0]), ("positions", f"up to {1e3 * DISPLACEMENT:g} mm"), ("rollout_changes", moved),
        ("directions", f"{len(directions())} directions"), ("directions", f"of {few[1]} N or {few[2]} N m"),
    ):  # fmt: skip
        assert part in labels[name], (name, part)
    assert IMPACT == 0.25  # "a quarter of the ball's radius"
    assert all(f"{STORED:,} stored" in STARTS[f"nearest_{kind}"].label for kind in ("tangent", "pseudoinverse"))
    config, wind, impacts, pushes = EnvConfig(), RandomWrench(), Impulses(), SixDirections()
    for name, part in (
        ("hold_random", f"{wind.force:g} N / {wind.moment:g} N m"),
        ("hold_late", f"{1e3 * HOLDS_OF_STARTS['late']['sensors.wrench_delay'] / config.controller.rate:g} ms late"),
        ("hold_impulses", f"{impacts.force:g} N / {impacts.moment:g} N m, {impacts.time:g} s"),
    ):  # fmt: skip
        assert part in LABELS[name], (name, part)
    assert f"six pushes of {pushes.push_per_mass:g} N/kg, {pushes.push_time:g} s each" in LABELS["six_directions"]
    sizes = np.linalg.norm([scaled(case.wrench) for case in make_cases("six_decades", 100, 0)], axis=1)
    assert MAGNITUDES[0] <= sizes.min() < 0.01
    assert 100.0 < sizes.max() <= MAGNITUDES[1]
    for line in (make_cases("lines", 500, 0),):
        assert len(line) == 2 * 401
        assert (np.sign(line[0].wrench) == -np.sign(line[400].wrench)).all()
        assert line[401].before is None
