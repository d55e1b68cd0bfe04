"""The wrench estimate on a free body; delayed and noisy measurements."""

from __future__ import annotations

import numpy as np
import pytest
from hands import hand_alone, scene_alone
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from grasp_env import core
from grasp_env.config import EnvConfig
from grasp_env.control.sensing import NoiseRows, keep_factor
from grasp_env.sim import Scene
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.snapshot import Snapshot
from grasp_env.task import RandomWrench
from grasp_env.task.motion import resting_target

TICK = 0.004
MASS = 0.2
INERTIA = np.diag([3e-4, 4e-4, 2e-4]) + 2e-5 * (np.ones((3, 3)) - np.eye(3))
GRAVITY = np.array([0.0, -9.81, 0.0])
TARGET = resting_target(1)[0]
POINTS = np.array([[0.0, 0.0, -0.05], [0.0, 0.03, 0.05], [-0.03, -0.02, 0.05], [0.03, -0.02, 0.05]])
GRASP = np.concatenate(
    [
        np.tile(np.eye(3), 4),
        np.concatenate([np.cross(p, np.eye(3), axisb=0, axisc=0) for p in POINTS], axis=1),
    ]
)
SQUEEZE = np.array([[0, 0, 6.0], [0, 0, -2.4], [0, 0, -1.8], [0, 0, -1.8]])
Trial = list[tuple[np.ndarray, ...]]


def hold(
    wrench: np.ndarray, seed: int, mass: float = MASS, spin: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> Trial:
    """A rigid body under `wrench` (T, 6), pushed back by contact forces with a soft pose feedback.

    Returns rotation, linear and angular velocity and contact forces, at the start and after each
    tick.
    """
    rng = np.random.default_rng(seed)
    h = TICK / 4
    position = np.zeros(3)
    linear = np.zeros(3)
    turn = Rotation.identity()
    angular = np.array(spin)
    inertia = INERTIA * mass / MASS
    spread = np.linalg.pinv(GRASP)
    trial = [(turn.as_matrix(), linear, angular, SQUEEZE)]
    for row in wrench:
        rotation = turn.as_matrix()
        feedback = np.concatenate(
            [
                rotation.T @ (MASS * GRAVITY + 50.0 * position + 4.0 * linear),
                rotation.T @ (0.5 * turn.as_rotvec() + 0.01 * (angular - spin)),
            ]
        )
        forces = SQUEEZE - (spread @ feedback).reshape(4, 3) + 0.05 * rng.standard_normal((4, 3))
        acting = GRASP @ forces.reshape(-1) + row
        for _ in range(4):  # the wrenches are constant in the object frame within a tick
            middle = turn * Rotation.from_rotvec(0.5 * h * turn.inv().apply(angular))
            linear = linear + h * (middle.apply(acting[:3]) / mass + GRAVITY)
            position = position + h * linear
            body = middle.inv().apply(angular)
            angular = angular + h * middle.apply(
                np.linalg.solve(inertia, acting[3:] - np.cross(body, inertia @ body))
            )
            turn = Rotation.from_rotvec(h * angular) * turn
        trial.append((turn.as_matrix(), linear, angular, forces))
    return trial


def estimates(trial: Trial, time: float = 0.0, noise: float = 0.0) -> np.ndarray:
    """(T + 1, 6) estimates of the external wrench along a trial of `hold`."""
    scene, views = scene_alone()
    sensors = core.SensorSettings()
    body = core.Body()
    body.mass, body.inertia = MASS, INERTIA.reshape(-1).tolist()
    sensors.wrench = core.WrenchSource.estimated
    sensors.tick = TICK
    sensors.tactile_noise = noise
    sensors.keep = keep_factor(time, TICK)
    made, controller = hand_alone(scene, 4, sensors=sensors, body=body)
    made.reset()
    rows = NoiseRows(np.random.default_rng(0), 15)
    out = []
    for rotation, linear, angular, forces in trial:
        views.rotation[:], views.linear[:], views.angular[:] = rotation, linear, angular
        views.points[:], views.forces[:] = POINTS, forces
        made.see(None, np.full(6, 9.0), GRAVITY, TARGET, rows())  # it must not use the true wrench
        out.append(controller.arrays()["wrench"] - body.wrench(scene, TARGET, GRAVITY))
    return np.array(out)


def test_constant_wrenches_are_found_at_once():
    wrench = np.tile([1.0, 0.5, -0.6, -0.01, 0.02, 0.005], (100, 1))
    trial = hold(wrench, 0)
    raw = estimates(trial)
    assert not raw[0].any()
    # the body turns by less than 0.1 rad/s, 4e-4 rad per tick: forces of 8 N are misplaced by some
    # mN
    assert_allclose(raw[1:, :3], wrench[:, :3], atol=0.02)
    assert_allclose(raw[1:, 3:], wrench[:, 3:], atol=2e-4)
    slow = estimates(trial, time=0.05)
    assert_allclose(slow[:, 0], 1.0 - np.exp(-np.arange(101) * TICK / 0.05), atol=0.02)


def test_spin_is_no_wrench_and_payload_a_weight():
    """Without the change of R I R^T omega the gyroscopic moment would be taken for a wrench."""
    quiet = estimates(hold(np.zeros((100, 6)), 0, spin=(6.0, 5.0, 0.0)))
    gyroscopic = np.cross([6.0, 5.0, 0.0], INERTIA @ [6.0, 5.0, 0.0])
    assert np.abs(quiet[1:, 3:]).max() < 0.1 * np.abs(gyroscopic).max()
    heavy = estimates(hold(np.zeros((250, 6)), 0, mass=1.5 * MASS))
    assert_allclose(heavy[150:, :3].mean(axis=0), 0.5 * MASS * GRAVITY, atol=0.03)


def test_filters_trade_noise_for_lag():
    """5 % of the thumb's 6 N and the fingers' 2 N is 0.34 N per axis; the best filter is between
    none and a slow one."""
    wrench = RandomWrench()(TICK * np.arange(500), np.random.default_rng(1), EnvConfig())
    trial = hold(wrench, 1)
    error = {}
    exact = estimates(trial)[1:] - wrench
    assert np.sqrt((exact[:, :3] ** 2).mean()) < 0.02
    assert np.sqrt((exact[:, 3:] ** 2).mean()) < 5e-4
    for time in (0.0, 0.02, 0.3):
        late = estimates(trial, time=time, noise=0.05)[1:] - wrench
        error[time] = np.sqrt((late[:, :3] ** 2).mean())
    assert error[0.0] == pytest.approx(0.05 * np.sqrt((SQUEEZE**2).sum()), rel=0.15)
    assert error[0.02] < 0.7 * error[0.0]
    assert error[0.02] < 0.7 * error[0.3]


def look(made: core.SimulatedHand, wrench: np.ndarray, noise: np.ndarray) -> Snapshot:
    """The scene as the controller measures it at the next tick."""
    made.see(None, wrench, GRAVITY, TARGET, noise)
    return Snapshot(**made.seen())


def test_noise_statistics():
    scene, truth = scene_alone(fingers=2)
    truth.forces[:] = forces = np.array([[3.0, 0.0, 4.0], [0.0, 0.0, 0.0]])
    sensors = core.SensorSettings()
    sensors.tactile_noise, sensors.pose_noise = 0.1, 1e-3
    made, _ = hand_alone(scene, 2, sensors=sensors)
    noise = NoiseRows(np.random.default_rng(0), 9)
    samples = np.empty((4000, 2, 3))
    places = np.empty((4000, 3))
    for k in range(4000):
        seen = look(made, np.zeros(6), noise())
        samples[k], places[k] = seen.forces, seen.position
    # 10 % of 5 N on every axis
    assert_allclose(samples[:, 0].std(axis=0), 0.5, rtol=0.06)
    assert_allclose(samples[:, 0].mean(axis=0), forces[0], atol=0.04)
    assert not samples[:, 1].any()
    assert_allclose(places.std(axis=0), 1e-3, rtol=0.06)
    assert_array_equal(truth.forces, forces)  # the scene itself is unchanged
    rows = NoiseRows(np.random.default_rng(5), 7)
    expected = np.random.default_rng(5).standard_normal((200, 7))
    assert_array_equal([rows().copy() for _ in range(200)], expected)


@pytest.mark.parametrize(("late", "later"), [(0, 2), (1, 0), (5, 2)])
def test_delays(late, later):
    """The scene and forces come `late` ticks late, measured wrenches `later` ticks more; before the
    first tick it stood still."""
    scene, truth = scene_alone()
    sensors = core.SensorSettings()
    sensors.joint_delay = sensors.delay = late
    sensors.wrench_delay = later
    made, controller = hand_alone(scene, sensors=sensors)
    for _ in range(2):  # a reset forgets
        truth.forces[:] = -1.0
        made.reset()
        for k in range(20):
            truth.forces[:] = k
            seen = look(made, np.full(6, 1.0 + k), np.zeros(15))
            assert (seen.forces == (-1.0 if k < late else k - late)).all()
            known = 0.0 if k < late + later else 1.0 + k - late - later
            assert_array_equal(controller.arrays()["wrench"], known)  # of a body without mass


@pytest.mark.parametrize(("joints", "rest"), [(2, 0), (0, 3), (1, 4), (5, 2)])
def test_joints_have_a_delay_of_their_own(joints, rest):
    """Rates are those of `joints` ticks ago, forces those of `rest` ticks ago."""
    scene, truth = scene_alone()
    sensors = core.SensorSettings()
    sensors.joint_delay, sensors.delay = joints, rest
    made, controller = hand_alone(scene, sensors=sensors)
    made.reset()
    for k in range(12):
        truth.forces[:] = truth.rates[:] = k
        seen = look(made, np.zeros(6), np.zeros(15))
        assert (seen.forces == max(k - rest, 0)).all()
        assert (seen.rates == max(k - joints, 0)).all()
    assert controller.status != "inactive"


def test_late_measurements_are_extrapolated():
    """A free object turns and drifts at constant speed, one joint moves slowly; measurements are 20
    ms late."""
    late = 5
    scene = Scene(SceneConfig(clearance=0.03, gravity=(0.0, 0.0, 0.0)))
    joints = scene.config.hand.joint_count
    sensors = core.SensorSettings()
    sensors.tick = scene.timestep
    sensors.joint_delay = sensors.delay = late
    controller, _ = hand_alone(scene.core, sensors=sensors)
    controller.reset()
    torques = np.zeros(joints)
    still = (np.zeros(6), np.zeros(3), TARGET, np.zeros(15))
    torques[2] = 1e-4  # [N m]
    scene.step(torques, [0.5, -0.2, 0.3, 0.01, 0.02, -0.03])
    before = scene.look().points.copy()
    for _ in range(late):
        controller.see(None, *still)
        scene.step(np.zeros(joints))
        scene.look()
    controller.see(None, *still)
    seen = Snapshot(**controller.seen())
    now = scene.look()
    # the cube's three moments of inertia are equal: it turns at constant velocity; Bullet's
    # quaternion steps are exact to 1e-6
    assert_allclose(seen.rotation, now.rotation, atol=1e-6)
    assert_allclose(seen.position, now.position, atol=1e-12)
    # the joint's own speed changes by Coriolis torques only: (0.05 rad/s)^2 * 0.02 s
    for name in ("angles", "points", "touch", "gaps"):
        assert_allclose(getattr(seen, name), getattr(now, name), atol=1e-5)
    assert np.abs(now.points - before).max() > 1e-4
    scene.close()


@pytest.mark.parametrize(("joints", "rest"), [(2, 0), (0, 3), (1, 4), (5, 2)])
def test_what_is_late_is_moved_on_by_its_own_delay(joints, rest):
    """Joints by theirs, at the rates of then; the object by that of the rest."""
    scene, truth = scene_alone()
    sensors = core.SensorSettings()
    sensors.tick = TICK
    sensors.joint_delay, sensors.delay = joints, rest
    made, _ = hand_alone(scene, sensors=sensors)

    def place(k: int) -> None:
        truth.angles[:], truth.rates[:] = 0.5 + 0.01 * k, 0.1 + 0.02 * k
        truth.position[:], truth.linear[:] = 0.001 * k, 0.2 - 0.01 * k

    place(0)
    made.reset()
    for k in range(12):
        place(k)
        seen = look(made, np.zeros(6), np.zeros(15))
        then, there = max(k - joints, 0), max(k - rest, 0)
        # sums and products of three numbers
        moved = 0.01 * then + joints * TICK * (0.1 + 0.02 * then)
        assert_allclose(seen.angles, 0.5 + moved, rtol=1e-12)
        assert_allclose(
            seen.position, 0.001 * there + rest * TICK * (0.2 - 0.01 * there), rtol=1e-12
        )


def test_an_estimate_begins_anew_after_a_reset():
    """The first tick has nothing to compare its momentum with."""
    scene, truth = scene_alone()
    sensors, body = core.SensorSettings(), core.Body()
    body.mass, body.inertia = MASS, INERTIA.reshape(-1).tolist()
    sensors.wrench, sensors.tick = core.WrenchSource.estimated, TICK
    made, controller = hand_alone(scene, sensors=sensors, body=body)
    for speed in (0.0, 1.0, -1.0):
        truth.linear[:] = truth.angular[:] = speed
        made.reset()
        for _ in range(2):
            made.see(None, np.zeros(6), np.zeros(3), TARGET, None)
            estimate = controller.arrays()["wrench"] - body.wrench(scene, TARGET, np.zeros(3))
            assert_allclose(estimate, 0.0, atol=1e-12)


@pytest.mark.parametrize(("joints", "rest", "wrench"), [(3, 1, 0), (1, 3, 0), (1, 1, 2)])
@pytest.mark.parametrize("allowed", [2.5, 3.5])
def test_the_controller_knows_how_late_its_sensors_are(joints, rest, wrench, allowed):
    """One of joints, contacts and wrench is three ticks old."""
    scene, _ = scene_alone()
    sensors, settings = core.SensorSettings(), core.HandControllerSettings()
    sensors.tick = TICK
    sensors.joint_delay, sensors.delay, sensors.wrench_delay = joints, rest, wrench
    settings.stale = settings.stale_wrench = allowed * TICK
    made, controller = hand_alone(scene, settings=settings, sensors=sensors)
    made.reset()
    look(made, np.zeros(6), np.zeros(15))
    controller.hold = core.Hold.place
    controller.act(False)
    assert controller.status == ("given" if allowed > 3.0 else "released")
