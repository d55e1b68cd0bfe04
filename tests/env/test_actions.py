"""Zero actions change nothing; all others keep the object balanced within the margin."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from episodes import NO_SPRINGS
from oracles.nearest import nearest_forces

from grasp_env.config.records import ACTION_MODES
from grasp_env.env.actions import MODES, TIGHTEST
from grasp_env.env.env import FourFingerGrasp
from grasp_env.force import optimize_force
from grasp_env.grasp import Grasp

CONTROLLER = {**NO_SPRINGS, "friction_margin": 0.7, "preload": 0.5}
SCALE = 5.0


def test_every_mode_has_a_meaning():
    assert tuple(MODES) == ACTION_MODES


def made(mode: str, **settings: Any) -> FourFingerGrasp:
    env = FourFingerGrasp(disturbance="random", action_mode=mode, **settings)
    env.reset(seed=3)
    return env


@pytest.mark.parametrize("settings", [{}, {"controller": {"friction_margin": 0.6, "preload": 0.3}}])
@pytest.mark.parametrize("mode", ["residual", "grip", "initial_force"])
def test_zero_actions_change_nothing(mode, settings):
    """To the last bit."""
    envs = [made(name, **settings) for name in (mode, "none")]
    for _ in range(20):
        (seen, *paid), (expected, *earned) = (
            env.step(np.zeros(env.action_space.shape or (), np.float32)) for env in envs
        )
        np.testing.assert_array_equal(seen[: len(expected)], expected)
        assert paid[:3] == earned[:3]
    for env in envs:
        env.close()


def margins(env: FourFingerGrasp, info: dict[str, Any], share: float, preload: float) -> np.ndarray:
    """Return the distances (N,) [N] of the commanded forces from the cones of a margin."""
    force = info["commanded_force"]
    sides = np.hypot(force[:, 1], force[:, 2])
    return share * info["object_friction"] * (force[:, 0] - preload) - sides


def balance(env: FourFingerGrasp, info: dict[str, Any]) -> tuple[Grasp, np.ndarray]:
    """Return the grasp at the last tick, and what the commanded forces leave of the wrench."""
    state = env._loop.controller.arrays()
    grasp = Grasp.from_contacts(
        state["positions"].copy(), state["normals"].copy(), info["object_friction"]
    )
    forces = np.einsum("nij,nj->ni", env._loop.frames, info["commanded_force"])
    moments = np.cross(state["positions"], forces)
    return grasp, np.concatenate([forces.sum(0), moments.sum(0)]) + info["wrench"]


def test_a_residual_moves_forces_to_the_nearest_balanced_ones():
    env = made("residual", controller=CONTROLLER, solver={"tolerance": 1e-10})
    rng = np.random.default_rng(0)
    moved = 0.0
    for _ in range(12):
        action = rng.uniform(-1.0, 1.0, 12).astype(np.float32)
        info = env.step(action)[4]
        assert info["is_success"]
        grasp, left = balance(env, info)
        assert np.abs(left).max() < 1e-8
        assert margins(env, info, 0.7, 0.5).min() > -1e-8
        narrow = Grasp.from_contacts(grasp.positions, grasp.normals, 0.7 * info["object_friction"])
        shift = np.tile([0.5, 0.0, 0.0], (4, 1))
        optimal = optimize_force(
            narrow, info["wrench"] + grasp.matrix @ shift.reshape(-1), tolerance=1e-10
        ).force
        given = optimal + shift + SCALE * action.reshape(4, 3)
        expected, _ = nearest_forces(narrow, info["wrench"], given, np.full(4, 0.5))
        np.testing.assert_allclose(info["commanded_force"], expected, atol=1e-4)
        moved = max(moved, np.abs(expected - optimal - shift).max())
    assert moved > 1.0
    env.close()


@pytest.mark.parametrize(
    ("action", "share", "preload"),
    [
        ((0.0, 0.0), 0.7, 0.5),
        ((1.0, 0.0), TIGHTEST, 0.5),
        ((-1.0, -1.0), 1.0, 0.0),
        ((0.5, 1.0), 0.45, 0.5 + SCALE),
    ],
)
def test_a_grip_sets_the_margin(action, share, preload):
    env = made("grip", controller=CONTROLLER)
    for _ in range(10):
        info = env.step(np.array(action, np.float32))[4]
    assert info["is_success"]
    _, left = balance(env, info)
    assert np.abs(left).max() < 1e-8
    nearest = margins(env, info, share, preload)
    assert -1e-8 < nearest.min() < 0.1  # N
    env.step(np.zeros(2, np.float32))
    for _ in range(5):
        info = env.step(np.zeros(2, np.float32))[4]
    assert -1e-8 < margins(env, info, 0.7, 0.5).min() < 0.1
    env.close()


def test_a_grip_is_felt():
    env = made("grip", observation="dict", controller={"friction_margin": 1.0})
    rng = np.random.default_rng(0)
    farthest = 0.0
    for _ in range(20):
        observed, _, _, _, info = env.step(rng.uniform(-1.0, 1.0, 2).astype(np.float32))
        force = info["measured_force"]
        share = np.hypot(force[:, 1], force[:, 2]) / force[:, 0]
        np.testing.assert_allclose(observed["tangential_share"], share, rtol=1e-5)
        farthest = max(farthest, float(observed["slid"].max()))
        assert farthest == pytest.approx(info["slip_distance"], rel=1e-4, abs=1e-7)
    env.close()


@pytest.mark.parametrize(("mode", "ends"), [("contact_force", True), ("residual", False)])
def test_episodes_end_at_a_fault_without_a_solver(mode, ends):
    """All fingers push as hard as they can."""
    env = made(
        mode, limits={"max_force": 5.0, "max_slide": 1.0, "max_overlap": 1.0, "max_stray": 1e3}
    )
    action = np.ones(env.action_space.shape or (), np.float32)
    _, reward, lost, over, info = env.step(action)
    assert env.config.limits.end_at_fault is ends
    assert info["fault"] == "crushed"
    assert (lost, over, info["failure"]) == (ends, False, "crushed" if ends else "")
    assert reward == -10.0
    env.close()
