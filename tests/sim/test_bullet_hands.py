"""Coupled joints, hulls and overlapping links in Bullet."""

from __future__ import annotations

import numpy as np
import pytest
from engines import Bullet, bullet, needs_bullet
from hands import make_link

from grasp_env.sim import BulletEngine, HandKinematics, ObjectDescription
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.hand.description import Fingertip, Geometry, HandDescription, Link, Mimic, Palm

pytestmark = needs_bullet

RATE = 250
CUBE = tuple((x, y, z) for x in (-0.01, 0.01) for y in (-0.01, 0.01) for z in (-0.01, 0.01))


def one_link(link: Link, tip: float) -> HandDescription:
    """Return a hand of one link with its tip at height `tip` [m]."""
    return HandDescription("one", Palm(), (link,), (Fingertip("f", "a", (0.0, 0.0, tip), 0.001),))


def coupled_finger(mass: float, count: int, heavy_end: float) -> HandDescription:
    """Return links of one motor about -y: the second turns 1.3 q + 0.2, the third 0.7 q - 0.1; the
    last has more inertia."""
    shape = Geometry("capsule", (0.006, 0.02), (0.02, 0.0, 0.0), (0.0, np.pi / 2, 0.0))
    links = list[Link]()
    for name, mimic in (
        ("a", None),
        ("b", Mimic("a_joint", 1.3, 0.2)),
        ("c", Mimic("a_joint", 0.7, -0.1)),
    )[:count]:
        along, across = (
            part * mass + heavy_end * (len(links) == count - 1) for part in (5e-5, 2e-4)
        )
        links.append(
            make_link(
                name,
                links[-1].name if links else "palm",
                origin=(0.04 if links else 0.3, 0.0, 0.0),
                axis=(0.0, -1.0, 0.0),
                lower=-0.5,
                upper=2.2,
                mass=mass,
                center=(0.02, 0.0, 0.0),
                inertia=(along, 0.0, 0.0, across, 0.0, across),
                collision=(shape,),
                mimic=mimic,
            )
        )
    tip = Fingertip("f", links[-1].name, (0.04, 0.0, 0.0), 0.008)
    return HandDescription("coupled", Palm(), tuple(links), (tip,), home=(0.4, 0.0, 0.0)[:count])


def loaded(hand: HandDescription) -> Bullet:
    """Load the hand around a ball, without gravity."""
    made = Bullet(hand)
    points = ((0.0, 0.0, 0.03), (0.0, 0.0, -0.03))[: hand.finger_count]
    ball = ObjectDescription("sphere", (0.06,))
    engine = BulletEngine(rate=RATE)
    made.load(
        SceneConfig(hand, ball, points, engine=engine, gravity=(0.0, 0.0, 0.0)), np.array(hand.home)
    )
    return made


def states(simulator: Bullet) -> np.ndarray:
    """Return angles and speeds of the joints, (M, 2)."""
    rows = bullet.getJointStates(
        simulator.world.hand, simulator.world.joints, simulator.client.number
    )
    return np.array([row[:2] for row in rows])


@pytest.mark.parametrize(("mass", "count", "heavy_end"), [(0.02, 3, 0.0), (0.002, 2, 1e-4)])
def test_the_load_of_coupled_joints_reaches_motors(mass, count, heavy_end):
    """By virtual work the motor needs 1 + 1.3, or 1 + 1.3 + 0.7, times the 0.5 N m on the last
    link."""
    hand = coupled_finger(mass, count, heavy_end)
    simulator = loaded(hand)
    kinematics = HandKinematics(hand)
    worst = 0.0
    held = []
    load = {2: 0.5 * 2.3, 3: 0.5 * 3.0}[count]
    inertia = (0.02 if count == 3 else 0.002) * mass + 5.0 * heavy_end
    for _ in range(RATE):
        world, number = simulator.world, simulator.client.number
        bullet.applyExternalTorque(
            world.hand, world.joints[-1], (0.0, 0.5, 0.0), bullet.WORLD_FRAME, number
        )
        angle, speed = states(simulator)[0]
        held.append(load - inertia * (1000.0 * (angle - 0.4) + 60.0 * speed))
        simulator.advance([held[-1], *[0.0] * (count - 1)], None)
        angles = states(simulator)[:, 0]
        worst = max(worst, np.abs(angles - kinematics.coupled(angles)).max())
    simulator.close()
    assert worst < 1e-4  # measured 1e-9; 0.02 and more after 20 sweeps of the solver
    assert np.mean(held[-20:]) == pytest.approx(load, rel=0.02)


def test_hulls_lie_where_they_should():
    """Bullet adds 1 mm around hulls, so they are shrunk by that much."""
    shapes = Geometry("hull", (), corners=CUBE), Geometry("sphere", (0.001,), (0.0, 0.0, 0.3))
    cube = loaded(one_link(make_link(origin=(0.0, 0.0, 0.2), collision=shapes), 0.3))
    number = cube.client.number
    finger = cube.world.joints[0]
    for gap in (0.005, 0.0005, 0.0, -0.0005, -0.003):
        for kind, size in (
            (bullet.GEOM_SPHERE, {"radius": 0.01}),
            (bullet.GEOM_BOX, {"halfExtents": [0.01] * 3}),
        ):
            shape = bullet.createCollisionShape(kind, **size, physicsClientId=number)
            body = bullet.createMultiBody(1.0, shape, physicsClientId=number)
            bullet.resetBasePositionAndOrientation(
                body, (0.02 + gap, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0), number
            )
            rows = bullet.getClosestPoints(
                cube.world.hand, body, 0.05, linkIndexA=finger, physicsClientId=number
            )
            assert min(row[8] for row in rows) == pytest.approx(gap, abs=1e-4)
            bullet.removeBody(body, number)
    cube.close()


def test_overlapping_links_do_not_push():
    """Two fingers with overlapping first links do not move without torque."""
    shapes = Geometry("sphere", (0.01,)), Geometry("sphere", (0.005,), (0.0, 0.1, 0.0))
    places = {"a": (-0.004, 0.0, 0.2), "b": (0.004, 0.0, 0.2)}
    links = tuple(
        make_link(name, origin=places[name], center=(0.0, 0.01, 0.0), collision=shapes)
        for name in places
    )
    tips = tuple(Fingertip(name, name, (0.0, 0.1, 0.0), 0.005) for name in places)
    simulator = loaded(HandDescription("pair", Palm(), links, tips, home=(0.3, -0.3)))
    for _ in range(20):
        simulator.advance([0.0, 0.0], None)
    np.testing.assert_allclose(states(simulator), ((0.3, 0.0), (-0.3, 0.0)), atol=1e-9)
    simulator.close()
