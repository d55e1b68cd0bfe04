"""Contacts from joint sensors: by hand at rest, against the mass matrix in motion, and against the
engines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from engines import needs_bullet
from hands import gripper, mass_matrix
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from grasp_env.control import (
    ContactEstimator,
    ContactEstimatorSettings,
    HandControllerSettings,
    HandState,
)
from grasp_env.control.loop import critically_damped
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import InvalidInputError
from grasp_env.sim import HandDescription, HandKinematics, ObjectDescription, Scene
from grasp_env.sim.mjcf import OBJECT
from grasp_env.task.motion import resting_target

HAND = HandDescription.allegro()
KINEMATICS = HandKinematics(HAND)
HOME = np.array(KINEMATICS.home)
PERIOD = 1e-3
INWARD = np.tile([0.0, 1.0, 0.0], (4, 1))
AT_ONCE = ContactEstimatorSettings(time_constant=0.0)
BALL = ObjectDescription("sphere", (0.06,), mass=0.15, friction=0.7)
GRAVITY = np.array([0.0, -9.81, 0.0])


def at_rest(hand: HandDescription = HAND) -> HandState:
    """A state of a hand in its home posture, under gravity."""
    state = HandState(hand.joint_count, hand.finger_count)
    state.angles = np.array(hand.home)
    state.gravity = GRAVITY
    return state


def torques_of(
    state: HandState, forces: np.ndarray, kinematics: HandKinematics = KINEMATICS
) -> np.ndarray:
    """Torques (M,) of a hand at rest whose tips push with forces (N, 3), with normals INWARD."""
    angles = state.angles
    out = kinematics.gravity_torques(angles, state.gravity)
    points, _, _ = kinematics.contacts(angles, normals=INWARD[: len(forces)])
    for finger, force in enumerate(forces):
        out += kinematics.jacobian(angles, finger, points[finger]).T @ force
    return out


# --- at rest, without a simulator


def test_forces_at_rest():
    """Their torques come back as forces, but for what the smallest lever of 2 mm takes: a share
    (2 mm / lever)^2, for levers from 20 mm on at most 1 %."""
    estimator = ContactEstimator(HAND, normals=INWARD)
    state = at_rest()
    forces = np.random.default_rng(0).standard_normal((4, 3))
    torques = torques_of(state, forces)
    assert estimator.update(state, torques, PERIOD)
    assert_allclose(estimator.forces, forces, atol=0.01 * np.linalg.norm(forces, axis=1).max())
    assert_allclose(
        estimator.residual, KINEMATICS.gravity_torques(HOME, GRAVITY) - torques, atol=1e-12
    )
    assert np.isnan(estimator.gaps).all()


def test_contacts_are_those_of_the_kinematics():
    item = ObjectDescription("capsule", (0.05, 0.11))
    estimator = ContactEstimator(HAND, item)
    state = at_rest()
    place = np.array([0.0, 0.03, 0.01])
    turn = Rotation.from_rotvec([0.3, 0.5, -0.2])
    state.object[:7] = *place, *(1.005 * turn.as_quat())  # rounded data: taken for length 1
    assert estimator.update(state, torques_of(state, np.zeros((4, 3))), PERIOD)
    points, normals, gaps = KINEMATICS.contacts(HOME, item, state.object[:7])
    assert_allclose(place + turn.apply(state.positions), points, atol=1e-12)
    assert_allclose(turn.apply(state.normals), normals, atol=1e-12)
    assert_allclose(estimator.gaps, gaps, atol=1e-12)


def test_hysteresis():
    """From 0.2 N on, until less than 0.1 N: the force along the normal, not across it."""
    estimator = ContactEstimator(HAND, normals=INWARD, settings=AT_ONCE)
    state = at_rest()
    touched = []
    for size in (0.0, 0.15, 0.19, 0.22, 0.15, 0.12, 0.08, 0.15, 0.22):
        across = np.array([1.0, 0.0, 0.0])
        estimator.update(state, torques_of(state, size * INWARD + across), PERIOD)
        touched.append(state.touching.tolist())
    expected = [0, 0, 0, 1, 1, 1, 0, 0, 1]
    assert touched == [[float(one)] * 4 for one in expected]


def test_a_finger_far_from_the_surface_does_not_touch():
    """A force without an object near is another contact, or a pull."""
    estimator = ContactEstimator(HAND, BALL)
    state = at_rest()
    state.object[:3] = 1.0
    estimator.update(state, torques_of(state, 2.0 * INWARD), PERIOD)
    assert (np.linalg.norm(estimator.forces, axis=1) > 1.0).all()
    assert not state.touching.any()


def test_coupled_joints_count_for_their_drivers():
    """A finger of two motors in a plane feels forces in it, with the same 1 % of levers. Forces
    across it are not felt. What a coupled joint seems to deliver does not matter."""
    hand = gripper(3, 3, coupled=True)
    kinematics = HandKinematics(hand)
    estimator = ContactEstimator(hand, normals=INWARD[:3])
    state = at_rest(hand)
    turns = 2.0 * np.pi * np.arange(3) / 3
    within = np.column_stack([np.cos(turns), np.sin(turns), 0.0 * turns])
    across = np.column_stack([-np.sin(turns), np.cos(turns), 0.0 * turns])
    forces = 0.8 * within + np.array([0.0, 0.0, 0.5])
    state.angles = kinematics.coupled(np.full(9, 0.3))
    torques = torques_of(state, forces + 0.7 * across, kinematics)
    torques[2::3] = 5.0
    estimator.update(state, torques, PERIOD)
    assert_allclose(estimator.forces, forces, atol=0.02)


# --- motion, without a simulator


def test_the_residual_is_that_of_the_momentum():
    """Against the mass matrix of the tests: without filter, r = dp/dt - (torques - g)."""
    rng = np.random.default_rng(1)
    estimator = ContactEstimator(HAND, normals=INWARD, settings=AT_ONCE)
    state = at_rest()
    momenta = []
    torques = 0.1 * rng.standard_normal(16)
    for _ in range(2):
        state.angles = HOME + 0.1 * rng.standard_normal(16)
        state.rates = rng.standard_normal(16)
        estimator.update(state, torques, PERIOD)
        momenta.append(mass_matrix(KINEMATICS, state.angles) @ state.rates)
    known = torques - KINEMATICS.gravity_torques(state.angles, GRAVITY)
    assert_allclose(estimator.residual, np.subtract(*momenta[::-1]) / PERIOD - known, atol=1e-9)


@pytest.mark.parametrize("period", [1e-4, 1e-3, 0.05])
def test_the_time_constant_is_that_of_a_step(period):
    """1 - exp(-t / 10 ms) of a force that begins, for every period."""
    estimator = ContactEstimator(HAND, normals=INWARD)
    state = at_rest()
    estimator.update(state, torques_of(state, 0.0 * INWARD), period)
    torques = torques_of(state, 2.0 * INWARD)
    ticks = max(1, round(0.01 / period))
    for _ in range(ticks):
        estimator.update(state, torques, period)
    final = ContactEstimator(HAND, normals=INWARD)
    final.update(state, torques, period)
    share = 1.0 - np.exp(-ticks * period / 0.01)
    assert_allclose(estimator.forces, share * final.forces, atol=1e-9)


# --- broken and wrong input

BROKEN = {
    "angles": ("angles", 0, np.nan),
    "rates": ("rates", 0, np.inf),
    "gravity": ("gravity", 0, np.nan),
    "position of the object": ("object", 0, np.nan),
    "quaternion": ("object", 6, 2.0),
}


@pytest.mark.parametrize("name", [*BROKEN, "torques", "period", "negative period"])
def test_broken_numbers_keep_the_last_estimate(name):
    estimator = ContactEstimator(HAND, normals=INWARD)
    state = at_rest()
    forces = np.array([2.0, 0.0, 1.0, 0.5])[:, None] * INWARD
    torques = torques_of(state, forces)
    assert estimator.update(state, torques, PERIOD)
    before = [
        np.copy(part) for part in (estimator.forces, state.touching, state.positions, state.normals)
    ]
    broken = at_rest()
    broken.touching[:] = broken.positions[:] = broken.normals[:] = np.nan
    given, period = torques.copy(), PERIOD
    if name == "torques":
        given[3] = np.nan
    elif "period" in name:
        period = np.nan if name == "period" else -PERIOD
    else:
        part, index, value = BROKEN[name]
        getattr(broken, part)[index] = value
    assert not estimator.update(broken, given, period)
    after = estimator.forces, broken.touching, broken.positions, broken.normals
    for one, other in zip(before, after, strict=True):
        assert_array_equal(one, other)
    # the momentum of the gap is not known: the next update goes on from the last forces
    state.rates[:] = 0.5
    assert estimator.update(state, torques, PERIOD)
    assert_allclose(estimator.forces, before[0], atol=1e-12)


@pytest.mark.parametrize("settings", [None, AT_ONCE])
def test_numbers_stay_finite(settings):
    """Whatever the sensors say, up to the largest numbers that the core takes."""
    rng = np.random.default_rng(2)
    estimator = ContactEstimator(HAND, normals=INWARD, settings=settings)
    for _ in range(300):
        state = at_rest()
        size = 10.0 ** rng.uniform(-12.0, 12.0)
        state.rates = size * rng.uniform(-1.0, 1.0, 16)
        state.angles = 10.0 ** rng.uniform(-12.0, 12.0) * rng.uniform(-1.0, 1.0, 16)
        torques = size * rng.uniform(-1.0, 1.0, 16)
        assert estimator.update(state, torques, 10.0 ** rng.uniform(-320.0, 12.0))
        assert np.isfinite(estimator.forces).all()
        assert np.isfinite(estimator.residual).all()
        assert np.isfinite(state.positions).all()


def test_an_update_without_time_changes_no_force():
    estimator = ContactEstimator(HAND, normals=INWARD)
    state = at_rest()
    estimator.update(state, torques_of(state, INWARD), PERIOD)
    before = np.copy(estimator.forces)
    assert estimator.update(state, torques_of(state, 3.0 * INWARD), 0.0)
    assert_allclose(estimator.forces, before, atol=1e-12)


def test_reset_forgets():
    estimator = ContactEstimator(HAND, normals=INWARD)
    state = at_rest()
    estimator.update(state, torques_of(state, INWARD), PERIOD)
    estimator.reset()
    assert not np.any(estimator.forces)
    estimator.update(state, torques_of(state, 0.0 * INWARD), PERIOD)
    assert_allclose(estimator.forces, 0.0, atol=1e-12)
    assert not state.touching.any()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "give an item or normals, and not both"),
        ({"item": BALL, "normals": INWARD}, "give an item or normals, and not both"),
        ({"item": 3}, "item must be an ObjectDescription"),
        ({"normals": INWARD[:2]}, r"normals must have shape \(4, 3\)"),
        ({"normals": 0.5 * INWARD}, "normals must be finite and of length 1"),
    ],
)
def test_wrong_arguments_are_named(given, words):
    with pytest.raises(InvalidInputError, match=words):
        ContactEstimator(HAND, **given)


def test_wrong_hands_and_sizes_are_named():
    with pytest.raises(InvalidInputError, match="hand must be a HandDescription"):
        ContactEstimator("allegro", normals=INWARD)  # type: ignore[arg-type]
    estimator = ContactEstimator(HAND, normals=INWARD)
    with pytest.raises(InvalidInputError, match=r"torques must have shape \(16,\)"):
        estimator.update(at_rest(), np.zeros(3), PERIOD)
    with pytest.raises(InvalidInputError, match="16 joints and 4 fingertips, got 9 and 3"):
        estimator.update(at_rest(gripper(3, 3)), np.zeros(16), PERIOD)
    with pytest.raises(InvalidInputError, match="settings"):
        ContactEstimator(HAND, normals=INWARD, settings={"touch": 0.4})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"touch": 0.1}, "touch must be above release, got touch=0.1 N and release=0.1 N"),
        ({"release": -0.1}, "release"),
        ({"touch": 0.0}, "touch"),
        ({"time_constant": -1.0}, "time_constant"),
        ({"largest_gap": np.nan}, "largest_gap"),
    ],
)
def test_wrong_settings_are_named(given, words):
    with pytest.raises(InvalidInputError, match=words):
        ContactEstimatorSettings(**given)


# --- against engines


class Bench:
    """Fingertips of an Allegro on springs in an engine, each drawn to a place of its own, around a
    ball on a spring.

    Attributes:
        scene: the hand and the ball.
        kinematics: of the hand in its place at the ball.
        state: what the joints tell, the pose of the ball, and the estimated contacts.
        estimator: knows the ball.
    """

    stiffness, damping, joint_damping = 200.0, 4.0, 0.002
    push = 1.5  # [N] of each fingertip

    def __init__(self, engine: str = "mujoco") -> None:
        ball: dict[str, Any] = {"shape": "sphere", "size": (0.06,), "mass": 0.15, "friction": 0.7}
        rates: dict[str, Any] = {"engine.rate": 1000, "controller.rate": 1000, "agent.rate": 100}
        self.env = FourFingerGrasp(hand=HAND, engine=engine, **ball, **rates)
        self.env.reset(seed=0)
        self.scene: Scene = self.env.scene
        self.kinematics = self.scene.kinematics
        self.estimator = ContactEstimator(self.kinematics.hand, self.scene.config.object)
        self.state = HandState(16, 4)
        self.state.gravity = self.scene.gravity
        look = self.scene.look()
        self.inward = look.normals @ look.rotation.T
        self.places = look.tips + self.push / self.stiffness * self.inward
        self.fixture = critically_damped(self.scene.config.object, 100.0, 100.0)
        self.target = resting_target(1)[0]

    def step(self) -> np.ndarray:
        """Advance by 1 ms; return the errors of the forces (N,) [N]."""
        look = self.scene.look()
        torques = look.gravity_torques - self.joint_damping * look.rates
        for finger, place in enumerate(self.places):
            moves = self.kinematics.jacobian(look.angles, finger)
            force = self.stiffness * (place - look.tips[finger])
            torques += moves.T @ (force - self.damping * (moves @ look.rates))
        return self.step_with(torques)

    def step_with(self, torques: np.ndarray) -> np.ndarray:
        """The same with torques (M,) [N m]."""
        held = self.fixture.wrench(self.scene.core, self.target, self.scene.gravity)
        self.scene.step(torques, -np.array(held))
        look = self.scene.look()
        self.state.angles, self.state.rates = look.angles, look.rates
        self.state.object[:3] = look.position
        self.state.object[3:7] = Rotation.from_matrix(look.rotation).as_quat()
        assert self.estimator.update(self.state, torques, PERIOD)
        return np.linalg.norm(self.estimator.forces - look.forces @ look.rotation.T, axis=1)

    def run(self, ticks: int) -> np.ndarray:
        """Errors of the forces (ticks, N) [N]."""
        return np.array([self.step() for _ in range(ticks)])


@pytest.fixture
def bench(request):
    """A bench in the engine that a test asks for."""
    pytest.importorskip("mujoco")
    made = Bench(getattr(request, "param", "mujoco"))
    yield made
    made.env.close()


in_each_engine = pytest.mark.parametrize(
    "bench", ["mujoco", pytest.param("bullet", marks=needs_bullet)], indirect=True
)


@in_each_engine
def test_forces_at_rest_are_those_of_the_engine(bench):
    """Forces of 1.5 N to 10 mN: the smallest lever of 2 mm takes 0.25 % at levers of 40 mm."""
    errors = bench.run(600)[300:]
    assert errors.max() < 0.01
    assert bench.state.touching.all()


def test_points_and_normals_are_those_of_the_engine(bench):
    """To 0.1 mm: the engine puts a point in the middle of the overlap, and its step is over."""
    bench.run(300)
    data = bench.scene.simulator.data
    points = bench.state.object[:3] + Rotation.from_quat(bench.state.object[3:7]).apply(
        bench.state.positions
    )
    away = np.linalg.norm(points[:, None] - data.contact.pos, axis=2).min(axis=1)
    assert away.max() < 1e-4
    assert np.abs(bench.estimator.gaps).max() < 1e-4
    look = bench.scene.look()
    assert_allclose(bench.state.normals, look.normals, atol=1e-9)


def test_a_wrong_normal_moves_the_point_by_radius_times_angle(bench):
    """10 degrees and the tip's radius of 12 mm: 2.1 mm. The estimate of the force hardly changes."""
    bench.run(300)
    before = bench.estimator.forces.copy()
    look = bench.scene.look()
    turned = Rotation.from_rotvec([0.0, 0.0, np.deg2rad(10.0)]).apply(bench.inward)
    angles = np.arccos(np.einsum("ij,ij->i", turned, bench.inward))
    guess = ContactEstimator(bench.kinematics.hand, normals=turned)
    state = HandState(16, 4)
    state.angles, state.gravity = look.angles, bench.scene.gravity
    torques = look.gravity_torques - bench.estimator.residual
    guess.update(state, torques, PERIOD)
    moved = np.linalg.norm(state.positions - look.touch, axis=1)
    assert_allclose(moved, bench.kinematics.tip_radii * angles, rtol=0.05)
    assert np.linalg.norm(guess.forces - before, axis=1).max() < 0.15 * bench.push


@in_each_engine
def test_forces_in_motion_lag_by_the_time_constant(bench):
    """3 Hz and 0.6 N: at most 11.3 N/s, which are 0.113 N in 10 ms; and the 10 mN at rest."""
    bench.run(300)
    places = bench.places
    errors = []
    for tick in range(1000):
        wave = np.sin(2.0 * np.pi * 3.0 * PERIOD * tick)
        bench.places = places + 0.6 / bench.stiffness * wave * bench.inward
        errors.append(bench.step())
    assert np.max(errors) < 0.01 * 11.3 + 0.01
    assert np.median(errors) > 0.03  # it does lag


@in_each_engine
def test_a_finger_lifts_and_lands(bench):
    """Three times by 12 mm. Each change is seen once, at most 15 ms late: 1.5 time constants."""
    bench.run(300)
    place = bench.places[0].copy()
    seen, real = [], []
    for tick in range(3000):
        lift = 0.01 * (1.0 - np.cos(2.0 * np.pi * PERIOD * tick))
        bench.places[0] = place - lift * bench.inward[0]
        bench.step()
        seen.append(bench.state.touching[0])
        real.append(bench.scene.look().touching[0])
        assert bench.state.touching[1:].all()
    changes = np.flatnonzero(np.diff(seen))
    assert len(changes) == 6
    for change in changes:
        truth = np.flatnonzero(np.diff(real))
        assert np.abs(truth - change).min() <= 15
    assert np.not_equal(seen, real).mean() < 0.01


def test_a_finger_that_arrives_with_the_reach_force_is_found(bench):
    """With the defaults of estimator and controller."""
    bench.run(300)
    place = bench.places[2].copy()
    bench.places[2] = place - 0.02 * bench.inward[2]
    bench.run(300)
    assert not bench.state.touching[2]
    light = bench.push - HandControllerSettings().reach_force
    bench.places[2] = place - light / bench.stiffness * bench.inward[2]
    bench.run(500)
    assert bench.state.touching.all()


def test_a_free_hand_does_not_touch(bench):
    """Joints swing at up to 6 rad/s, away from their ends, which also push. The neglected torques
    are below 10 mN m, and their forces along the normals below 0.1 N, the half of `touch`."""
    bench.run(300)
    kinematics = bench.kinematics
    mass = kinematics.mass_matrix(kinematics.home)
    model, data = bench.scene.simulator.model, bench.scene.simulator.data
    place = model.jnt_qposadr[model.body(OBJECT).jntadr[0]]
    bench.target[1] = -0.5  # the ball is elsewhere
    data.qpos[place : place + 3] = bench.target[:3]
    guess = bench.estimator = ContactEstimator(kinematics.hand, normals=bench.inward)
    look = bench.scene.look()
    fastest = largest = neglected = 0.0
    start = look.angles.copy()
    middle = np.clip(kinematics.home, kinematics.lower + 0.4, kinematics.upper - 0.4)
    swing = np.where(np.arange(16) % 4 == 0, 0.0, 0.2)  # [rad] not sideways, where fingers collide
    for tick in range(2500):
        rise = min(1.0, tick / 500)
        phase = 2.0 * np.pi * 4.0 * PERIOD * tick + np.arange(16)
        goal = start + rise * (middle - start + swing * np.sin(phase))
        rate = rise * swing * 2.0 * np.pi * 4.0 * np.cos(phase)
        look = bench.scene.look()
        wanted = 900.0 * (goal - look.angles) + 60.0 * (rate - look.rates)
        bench.step_with(look.gravity_torques + mass @ wanted)
        if tick < 100:  # the fingers still spring back from the ball
            continue
        normal = np.einsum("ij,ij->i", guess.forces, bench.inward)
        fastest = max(fastest, np.abs(bench.state.rates).max())
        largest = max(largest, normal.max())
        assert not bench.state.touching.any()
        neglected = max(neglected, np.abs(guess.residual).max())
    assert fastest > 5.0
    assert neglected < 0.01
    assert largest < 0.1


def test_a_pull_at_a_finger_looks_like_contact(bench):
    """Unless the surface is known to less than what the finger moves: 3 N, less the 1.5 N of its
    spring of 200 N/m, move it by up to 7.5 mm."""
    strict = ContactEstimatorSettings(largest_gap=1e-3)
    close = ContactEstimator(bench.kinematics.hand, bench.scene.config.object, settings=strict)
    bench.run(300)
    data = bench.scene.simulator.data
    body = bench.scene.simulator.model.body(f"link{bench.kinematics.tip_links[1]}").id
    data.xfrc_applied[body, :3] = -3.0 * bench.inward[1]
    for _ in range(60):
        bench.step()
    look = bench.scene.look()
    torques = look.gravity_torques - bench.estimator.residual
    state = HandState(16, 4)
    state.numbers[:] = bench.state.numbers
    assert close.update(state, torques, PERIOD)
    assert not look.touching[1]
    assert bench.estimator.forces[1] @ bench.inward[1] > 1.0
    assert bench.estimator.gaps[1] > 1e-3
    assert state.touching.tolist() == [1.0, 0.0, 1.0, 1.0]


def test_joint_friction_hides_friction_over_lever(bench):
    """0.02 N m: each error stays below the sum of friction over lever of all joints of a finger."""
    bench.scene.set_joint_friction(0.02)
    errors = bench.run(600)[300:].max(axis=0)
    look = bench.scene.look()
    for finger, error in enumerate(errors):
        moves = bench.kinematics.jacobian(look.angles, finger, look.touch[finger])
        own = moves[:, bench.kinematics.carries[finger]]
        assert error < 0.02 * np.linalg.norm(np.abs(np.linalg.pinv(own.T)).sum(axis=1))
    assert errors.max() > 0.1  # it does hide
