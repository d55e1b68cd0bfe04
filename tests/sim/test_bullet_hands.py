"""What Bullet makes of coupled joints and hulls: they hold, pass on their load, and lie where they should."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from engines import Bullet, bullet, needs_bullet
from hands import gripper

from grasp_env.sim import BulletEngine, HandKinematics, ObjectDescription, SceneConfig
from grasp_env.sim.hand.description import Fingertip, Geometry, HandDescription, Link, Mimic, Palm
from grasp_env.sim.picture.portrait import portrait

pytestmark = needs_bullet

RATE = 250
CUBE = tuple((x, y, z) for x in (-0.01, 0.01) for y in (-0.01, 0.01) for z in (-0.01, 0.01))
STILL = (0.0, 0.0, 0.0)


def light(name: str, origin: tuple[float, float, float] = STILL, **fields: Any) -> Link:
    """A link of 20 g that turns about z."""
    given = {"center": STILL, "inertia": (1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6), **fields}
    return Link(name, "palm", origin, STILL, (0.0, 0.0, 1.0), -1.0, 1.0, 1.0, 0.02, **given)


def one_link(link: Link, tip: float) -> HandDescription:
    """A hand whose tip is at height `tip` on its link [m]."""
    return HandDescription("one", Palm(), (link,), (Fingertip("f", "a", (0.0, 0.0, tip), 0.001),))


def coupled_finger(mass: float, count: int = 3, heavy_end: float = 0.0) -> HandDescription:
    """Links of one motor about -y: the second turns 1.3 q + 0.2, the third 0.7 q - 0.1; the last with more inertia."""
    shape = Geometry("capsule", (0.006, 0.02), (0.02, 0.0, 0.0), (0.0, np.pi / 2, 0.0))
    inertia = (5e-5 * mass, 0.0, 0.0, 2e-4 * mass, 0.0, 2e-4 * mass)

    def link(name: str, parent: str, x: float, upper: float, mimic: Mimic | None = None) -> Link:
        return Link(
            name, parent, (x, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), -0.5, upper, 2.0, mass, (0.02, 0.0, 0.0), inertia,
            collision=(shape,), mimic=mimic,
        )  # fmt: skip

    links = (
        link("a", "palm", 0.3, 1.5), link("b", "a", 0.04, 2.2, Mimic("a_joint", 1.3, 0.2)), link("c", "b", 0.04, 1.2, Mimic("a_joint", 0.7, -0.1)),
    )  # fmt: skip
    last = links[count - 1]
    xx, _, _, yy, _, zz = (value + heavy_end for value in last.inertia)
    links = (*links[: count - 1], replace(last, inertia=(xx, 0.0, 0.0, yy, 0.0, zz)))
    tip = Fingertip("f", last.name, (0.04, 0.0, 0.0), 0.008)
    return HandDescription("coupled", Palm(), links, (tip,), home=(0.4, 0.0, 0.0)[:count])


def loaded(hand: HandDescription) -> Bullet:
    points = ((0.0, 0.0, 0.03), (0.0, 0.0, -0.03))[: hand.finger_count]
    item, engine = ObjectDescription("sphere", (0.06,)), BulletEngine(rate=RATE)
    made = Bullet(hand)
    made.load(SceneConfig(hand, item, points, engine=engine, gravity=STILL), np.array(hand.home))
    return made


@pytest.mark.parametrize(
    ("hand", "sweeps"),
    [(HandDescription.four_finger(), 20), (HandDescription.allegro(), 40), (HandDescription.leap(), 40), (gripper(3, 2), 800),
     (gripper(3, 3), 20), (gripper(3, 3, True), 800), (gripper(3, 5, True), 40)],
)  # fmt: skip
def test_fingers_with_fewer_than_three_motors_have_more_sweeps(hand: HandDescription, sweeps: int) -> None:
    made = Bullet(hand)
    points = ((0.0, 0.0, 0.03),) * hand.finger_count
    made.load(
        SceneConfig(hand, ObjectDescription("sphere", (0.06,)), points, engine=BulletEngine()), np.array(hand.home)
    )
    found = bullet.getPhysicsEngineParameters(physicsClientId=made.client.number)["numSolverIterations"]
    assert found == max(sweeps, 100 if any(link.mimic for link in hand.links) else 0)
    made.close()


def states(simulator: Bullet) -> np.ndarray:
    """Angles and speeds of the joints, (M, 2)."""
    rows = bullet.getJointStates(simulator.world.hand, simulator.world.joints, simulator.client.number)
    return np.array([row[:2] for row in rows])


@pytest.mark.parametrize(("mass", "count", "heavy_end"), [(0.02, 3, 0.0), (0.002, 3, 0.0), (0.002, 2, 1e-4)])
def test_coupled_joints_hold_and_their_load_reaches_the_motor(mass: float, count: int, heavy_end: float) -> None:
    """0.5 N m on the last link; the motor holds it with 1 + 1.3, or 1 + 1.3 + 0.7 times as much, the virtual work."""
    simulator = loaded(coupled_finger(mass, count, heavy_end))
    worst, held, load = 0.0, [], {2: 0.5 * 2.3, 3: 0.5 * 3.0}[count]
    inertia = (0.02 if count == 3 else 0.002) * mass + 5.0 * heavy_end
    for _ in range(RATE):
        world, number = simulator.world, simulator.client.number
        bullet.applyExternalTorque(world.hand, world.joints[-1], (0.0, 0.5, 0.0), bullet.WORLD_FRAME, number)
        angle, speed = states(simulator)[0]
        torque = load - inertia * (1000.0 * (angle - 0.4) + 60.0 * speed)
        held.append(torque)
        simulator.advance([torque, *[0.0] * (count - 1)], None)
        a, b, *rest = states(simulator)[:, 0]
        worst = max(worst, abs(b - 1.3 * a - 0.2), *(abs(c - 0.7 * a + 0.1) for c in rest), 0.0)
    simulator.close()
    assert worst < 1e-4  # measured 1e-9; 0.02 and more after 20 sweeps of the solver
    assert np.mean(held[-20:]) == pytest.approx(load, rel=0.02)


def test_a_force_at_a_coupled_tip_is_held_by_the_torque_of_the_jacobian() -> None:
    hand = coupled_finger(0.02)
    simulator, kinematics = loaded(hand), HandKinematics(hand)
    force, torque, expected = np.array([5.0, 0.0, 10.0]), 0.0, np.zeros(3)
    for _ in range(2 * RATE):
        now = states(simulator)
        tip = kinematics.tips(now[:, 0])[0]
        expected = -(kinematics.jacobian(now[:, 0], 0).T @ force)
        bullet.applyExternalForce(
            simulator.world.hand, simulator.world.joints[2], force.tolist(), tip.tolist(), bullet.WORLD_FRAME, simulator.client.number
        )  # fmt: skip
        torque = expected[0] - 5.0 * (now[0, 0] - 0.4) - 0.02 * now[0, 1]
        simulator.advance([torque, 0.0, 0.0], None)
    simulator.close()
    assert expected[1:].tolist() == [0.0, 0.0]
    assert torque == pytest.approx(expected[0], rel=0.02)


@pytest.fixture
def cube() -> Iterator[Bullet]:
    """A hull of 20 mm on a link, its centre at (0, 0, 0.2)."""
    shapes = Geometry("hull", (), corners=CUBE), Geometry("sphere", (0.001,), (0.0, 0.0, 0.3))
    simulator = loaded(one_link(light("a", (0.0, 0.0, 0.2), collision=shapes), 0.3))
    yield simulator
    simulator.close()


@pytest.mark.parametrize("gap", [0.005, 0.0005, 0.0, -0.0005, -0.003])
def test_hulls_lie_where_they_should(cube: Bullet, gap: float) -> None:
    """Bullet adds 1 mm around hulls; those it is given are as much smaller, so that their faces are right."""
    number = cube.client.number
    ball, box = {"radius": 0.01}, {"halfExtents": [0.01] * 3}
    for kind, size in ((bullet.GEOM_SPHERE, ball), (bullet.GEOM_BOX, box)):
        shape = bullet.createCollisionShape(kind, **size, physicsClientId=number)
        body = bullet.createMultiBody(1.0, shape, physicsClientId=number)
        bullet.resetBasePositionAndOrientation(body, (0.02 + gap, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0), number)
        rows = bullet.getClosestPoints(
            cube.world.hand, body, 0.05, linkIndexA=cube.world.joints[0], physicsClientId=number
        )
        assert min(row[8] for row in rows) == pytest.approx(gap, abs=1e-4)
        bullet.removeBody(body, number)


def test_links_that_always_overlap_do_not_push_each_other_apart() -> None:
    """Two fingers whose first links share a place: nothing moves without torque."""
    shapes = Geometry("sphere", (0.01,)), Geometry("sphere", (0.005,), (0.0, 0.1, 0.0))
    links = tuple(
        light(name, (x, 0.0, 0.2), center=(0.0, 0.01, 0.0), collision=shapes)
        for name, x in (("a", -0.004), ("b", 0.004))
    )
    tips = tuple(Fingertip(name, name, (0.0, 0.1, 0.0), 0.005) for name in ("a", "b"))
    simulator = loaded(HandDescription("pair", Palm(), links, tips, home=(0.3, -0.3)))
    for _ in range(20):
        simulator.advance([0.0, 0.0], None)
    np.testing.assert_allclose(states(simulator), ((0.3, 0.0), (-0.3, 0.0)), atol=1e-9)
    simulator.close()


def test_a_visual_mesh_is_drawn(tmp_path: Path) -> None:
    trimesh.creation.box((0.02, 0.02, 0.02)).export(tmp_path / "box.obj")
    look = Geometry("mesh", (1.0, 1.0, 1.0), file=str(tmp_path / "box.obj"))
    drawn = portrait(one_link(light("a", visual=(look,)), 0.1), 64)
    assert drawn.shape == (64, 128, 3)
    assert drawn[:, :64].min() < 150  # grey before a light ground
    assert drawn[:, 64:].min() > 200  # it touches nothing
