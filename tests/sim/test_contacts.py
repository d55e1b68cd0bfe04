"""Contact forces, their signs and the friction cone, and the contact geometry against Bullet's."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from grasp_env.sim import Scene
from grasp_env.sim.client import bullet

WRENCH = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])


def test_forces_carry_the_weight(held: Scene) -> None:
    contacts, weight = held.contacts(), held.config.weight
    total = held.state().rotation @ contacts.forces.sum(axis=0)
    np.testing.assert_allclose(total, -weight, atol=0.01 * np.linalg.norm(weight))
    assert contacts.touching.all()
    assert (np.einsum("ni,ni->n", contacts.forces, contacts.normals) > 1.0).all()


def test_measured_forces_are_the_commanded_ones(held: Scene, make_holder: Callable) -> None:
    holder = make_holder(squeeze=12.0, wrench=WRENCH)
    for _ in range(200):
        held.step(holder(held), WRENCH)
    contacts = held.contacts()
    np.testing.assert_allclose(contacts.forces, holder.forces, atol=1e-6)
    np.testing.assert_allclose(contacts.forces.sum(axis=0), -(WRENCH[:3] + held.config.weight), atol=1e-6)
    moment = np.cross(contacts.points, contacts.forces).sum(axis=0)
    np.testing.assert_allclose(moment, -WRENCH[3:], atol=1e-6)
    assert np.abs(held.state().position).max() < 1e-6


def test_equilibrium_in_a_turned_object_frame(held: Scene, make_holder: Callable) -> None:
    wrench = np.array([1.0, -0.5, 0.4, 0.1, 0.1, -0.1])  # unknown to the controller: the pose yields
    holder = make_holder(squeeze=12.0)
    for _ in range(600):
        held.step(holder(held), wrench)
    state, contacts = held.state(), held.contacts()
    assert np.linalg.norm(state.quaternion[:3]) > 0.01
    # the wrench is given in the object frame, gravity in the world's
    total = contacts.forces.sum(axis=0) + wrench[:3] + held.config.weight @ state.rotation
    np.testing.assert_allclose(total, 0.0, atol=2e-3)
    moment = np.cross(contacts.points, contacts.forces).sum(axis=0) + wrench[3:]
    np.testing.assert_allclose(moment, 0.0, atol=2e-4)


def test_geometry_matches_pybullet(held: Scene, make_holder: Callable) -> None:
    holder = make_holder()
    for _ in range(300):
        held.step(holder(held), np.array([0.3, 0.2, 0.0, 0.05, 0.05, 0.05]))
    state, contacts, client = held.state(), held.contacts(), held.client.number
    hand, cuboid = held.bodies
    for finger in range(4):
        rows = bullet.getClosestPoints(hand, cuboid, 0.01, linkIndexA=3 * finger + 2, physicsClientId=client)
        point = (np.array(rows[0][6]) - state.position) @ state.rotation
        normal = -np.array(rows[0][7]) @ state.rotation
        np.testing.assert_allclose(contacts.points[finger], point, atol=1e-6)
        np.testing.assert_allclose(contacts.normals[finger], normal, atol=1e-5)
        np.testing.assert_allclose(contacts.gaps[finger], rows[0][8], atol=1e-6)


def test_open_fingers_keep_their_geometry(make_scene: Callable[..., Scene]) -> None:
    contacts = make_scene(clearance=0.02).contacts()
    assert not contacts.touching.any()
    np.testing.assert_array_equal(contacts.forces, 0.0)
    np.testing.assert_allclose(contacts.gaps, 0.02, atol=2e-5)
    np.testing.assert_allclose(contacts.points, make_scene().config.contact_points, atol=1e-12)


def test_slip_of_a_falling_object(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene(clearance=0.02)
    for _ in range(20):
        scene.step(scene.gravity_torques())
    np.testing.assert_allclose(scene.contacts().slip, 9.81 * 20 * scene.timestep, rtol=1e-3)


@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0, 200.0])
def test_friction_cone_is_round_and_not_squared(
    make_scene: Callable[..., Scene], make_holder: Callable, angle: float
) -> None:
    scene = make_scene(gravity=(0.0, 0.0, 0.0))
    scene.settle(make_holder(squeeze=6.0))
    direction = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0, 0.0, 0.0, 0.0])
    squeeze = scene.contacts().forces
    start, ratios, push = scene.kinematics.tips(scene.joints()[0]), [], 0.0
    while len(ratios) < 20:  # held back at their places, the tips slide once the push is large enough
        push += 5.0 * scene.timestep
        assert push < 6.0, "the object should slide at 2 * 0.4 * 6 N = 4.8 N"
        angles, rates = scene.joints()
        speed = np.einsum("nij,nj->ni", scene.jacobians(), rates.reshape(-1, 3))
        spring = -1000.0 * (scene.kinematics.tips(angles) - start) - 4.0 * speed
        spring[:, 2] = 0.0
        scene.step(scene.grasp_torques(squeeze + spring), push * direction)
        contacts = scene.contacts()
        if contacts.slip.min() > 1e-3:
            normal = np.einsum("ni,ni->n", contacts.forces, contacts.normals)
            tangential = np.linalg.norm(contacts.forces - normal[:, None] * contacts.normals, axis=1)
            ratios.append(tangential / normal)
    assert push > 4.6
    np.testing.assert_allclose(np.median(ratios, axis=0), 0.4, rtol=0.03)
