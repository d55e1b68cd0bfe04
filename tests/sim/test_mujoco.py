"""MuJoCo as a simulator: kinematics, dynamics, contact forces and pictures."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import trimesh
from hands import make_link, mass_matrix
from numpy.testing import assert_allclose

from grasp_env.config import EnvConfig
from grasp_env.errors import GraspError, InvalidInputError, MissingExtraError, SimulationError
from grasp_env.inputs import extras
from grasp_env.sim import (
    BulletEngine,
    HandDescription,
    HandKinematics,
    MujocoEngine,
    ObjectDescription,
    Scene,
)
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.engine import _log_mujoco, engine_of
from grasp_env.sim.hand.solids import hull_shape
from grasp_env.sim.hand.tree import Fingertip, Geometry, Mimic, Palm
from grasp_env.sim.picture.camera import Camera, CameraConfig
from grasp_env.sim.picture.painter import BACKGROUND_DEPTH
from grasp_env.sim.picture.view import View

mujoco = pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")
from grasp_env.sim.mujoco import Mujoco  # noqa: E402
from grasp_env.sim.picture.mujoco import MujocoPainter  # noqa: E402

GRAVITY = np.array([1.0, -9.0, 3.0])
STILL = (0.0, 0.0, 0.0)
FAST = {"engine": MujocoEngine()}
VIEW = View((0.35, 0.1, 0.35), (0.0, 0.05, 0.0), 40.0, 200, 200)


HEAVY: dict[str, Any] = {
    "inertia": (6e-6, 1e-7, 2e-7, 3e-6, 1e-7, 5e-6),
    "center": (0.01, -0.02, 0.003),
}


def crooked_hand() -> HandDescription:
    """Turned frames, a joint without limits, a sliding joint, one that turns with another, and one
    that slides with it."""
    ball = Geometry("sphere", (0.01,), (0.0, -0.04, 0.0))
    links = (
        make_link(
            "a",
            origin=(0.02, 0.1, 0.0),
            rotation=(0.3, -0.2, 0.5),
            axis=(0.0, 0.6, 0.8),
            lower=-math.inf,
            upper=math.inf,
            **HEAVY,
        ),
        make_link(
            "b",
            "a",
            origin=(0.0, -0.04, 0.0),
            rotation=(0.1, 0.0, -0.4),
            axis=(1.0, 0.0, 0.0),
            lower=-0.05,
            upper=0.05,
            sliding=True,
            **HEAVY,
        ),
        make_link("c", "b", origin=(0.0, -0.05, 0.01), collision=(ball,), **HEAVY),
        make_link(
            "d",
            "c",
            origin=(0.0, -0.04, 0.0),
            rotation=(0.0, 0.2, 0.0),
            collision=(ball,),
            mimic=Mimic("c_joint", 0.8, 0.1),
            **HEAVY,
        ),
        make_link(
            "e",
            "a",
            origin=(0.05, 0.0, 0.0),
            axis=(0.0, 1.0, 0.0),
            sliding=True,
            mimic=Mimic("c_joint", -0.02, 0.01),
            **HEAVY,
        ),
    )
    tip = Fingertip("tip", "d", (0.0, -0.04, 0.0), 0.01)
    return HandDescription("crooked", Palm(), links, (tip,), (0.2, 0.01, 0.3, 0.0, 0.0))


def alone(hand: HandDescription, item: ObjectDescription | None = None, **fields: Any) -> Mujoco:
    """The engine with a hand in its rest posture and an object that do not touch."""
    item = item or ObjectDescription()
    point = tuple(item.surface.nearest(np.array([0.0, 0.3, 0.0]))[0].tolist())
    made = Mujoco(hand)
    made.load(
        SceneConfig(hand, item, (point,) * hand.finger_count, **FAST, **fields), np.array(hand.home)
    )
    return made


def on_a_table(kind: Geometry, item: ObjectDescription) -> Mujoco:
    """An object on a palm that is a table."""
    return alone(
        dataclasses.replace(crooked_hand().moved((0.0, 0.5, 0.0)), palm=Palm(collision=(kind,))),
        item,
    )


def place(simulator: Mujoco) -> np.ndarray:
    """Position (3,) [m], quaternion (4,) and velocities (6,) of the object."""
    return simulator.read()[2 * 5 : 2 * 5 + 13]


@pytest.mark.parametrize(
    "maker", [HandDescription.four_finger, crooked_hand], ids=["four_finger", "crooked"]
)
def test_kinematics_and_dynamics_are_the_cores(maker):
    """Frames, Jacobians, gravity torques and mass matrix, to rounding."""
    hand = maker()
    kinematics = HandKinematics(hand)
    simulator = alone(hand, gravity=tuple(GRAVITY))
    _, ends = coupled(hand)
    model, data = simulator.model, simulator.data
    joints = [model.joint(f"link{index}") for index in range(hand.joint_count)]
    places = [joint.qposadr[0] for joint in joints]
    speeds = [joint.dofadr[0] for joint in joints]
    rng = np.random.default_rng(3)
    for _ in range(3):
        angles = np.array(hand.home) + rng.uniform(-0.04, 0.04, hand.joint_count)
        data.qpos[places] = angles
        mujoco.mj_forward(model, data)
        frames, origins = kinematics.links(angles)
        for index in range(hand.joint_count):
            body = model.body(f"link{index}").id
            assert_allclose(data.xpos[body], origins[index], atol=1e-15)
            assert_allclose(data.xmat[body].reshape(3, 3), frames[index], atol=1e-14)
        carrying = np.zeros((3, model.nv))
        for finger, (link, tip) in enumerate(
            zip(kinematics.tip_links.tolist(), kinematics.tips(angles), strict=True)
        ):
            mujoco.mj_jac(model, data, carrying, None, tip, model.body(f"link{link}").id)
            assert_allclose(
                carrying[:, speeds] @ ends, kinematics.jacobian(angles, finger), atol=1e-14
            )
        whole = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, whole)
        ours = mass_matrix(kinematics, angles)
        weight = kinematics.gravity_torques(angles, GRAVITY)
        assert_allclose(ends.T @ whole[np.ix_(speeds, speeds)] @ ends, ours, atol=1e-15)
        assert_allclose(ends.T @ data.qfrc_bias[speeds], weight, atol=1e-14)


def coupled(hand: HandDescription) -> tuple[np.ndarray, np.ndarray]:
    """Angles (M,) with the drivers at 0, and derivatives (M, M) of all angles by the drivers'."""
    ends = np.zeros((hand.joint_count, hand.joint_count))
    shift = np.zeros(hand.joint_count)
    for index, (link, driver) in enumerate(zip(hand.links, hand.drivers, strict=True)):
        ends[index, driver] = 1.0 if link.mimic is None else link.mimic.ratio
        shift[index] = 0.0 if link.mimic is None else link.mimic.offset
    return shift, ends


def test_drivers_hold_coupled_and_sliding_joints():
    """Gravity torques, none on coupled joints, hold the hand, and coupled joints follow their
    drivers."""
    hand = crooked_hand()
    kinematics = HandKinematics(hand)
    simulator = alone(hand, gravity=tuple(GRAVITY))
    shift, ends = coupled(hand)

    def pushed(steps: int, more: list[float]) -> np.ndarray:
        for _ in range(steps):
            torques = kinematics.gravity_torques(simulator.read()[:5], GRAVITY)
            assert torques[3] == torques[4] == 0.0
            simulator.advance((torques + more).tolist(), None)
        return simulator.read()[:5]

    # it starts before the couplings are stretched
    assert_allclose(pushed(200, [0.0] * 5), kinematics.home, atol=1e-3)
    angles = pushed(100, [0.0, 0.02, 0.005, 0.0, 0.0])
    assert angles[1] > 0.011
    assert angles[2] > 0.35
    assert_allclose(angles, shift + ends @ angles, atol=1e-4)


@pytest.mark.parametrize("shape", ["cuboid", "sphere", "cylinder", "capsule", "mesh"])
def test_shapes_and_hulls_touch_where_they_are(shape, tmp_path):
    """Each object rests on a table, a hull or a box, within 0.2 mm."""
    corners = tuple((x, y, z) for x in (-0.2, 0.2) for y in (-0.01, 0.01) for z in (-0.2, 0.2))
    mesh = {"size": (0.04,), "mesh": str(tmp_path / "cube.obj")} if shape == "mesh" else {}
    trimesh.creation.box((2.0, 2.0, 2.0)).export(tmp_path / "cube.obj")
    item = ObjectDescription(shape, **mesh)
    where = (0.0, -0.01 - 0.5 * item.extent[1], 0.0), (0.0, 0.4, 0.0)
    for kind in (
        Geometry("hull", (), *where, corners=corners),
        Geometry("box", (0.4, 0.02, 0.4), *where),
    ):
        simulator = on_a_table(kind, item)
        for _ in range(200):
            simulator.advance([0.0] * 5, None)
        contacts = simulator.read()[23:].reshape(-1, 7)
        assert (contacts[:, 0] == -1.0).all()
        assert_allclose(contacts[:, 4:].sum(axis=0), [0.0, 0.2 * 9.81, 0.0], atol=0.02)
        assert_allclose(place(simulator)[:3], 0.0, atol=2e-4)


def test_changed_mass_friction_and_gravity():
    simulator = alone(crooked_hand())
    simulator.set_object(ObjectDescription(mass=0.4, friction=0.9))
    assert simulator.model.geom_friction[-1, 0] == 0.9  # the object comes last
    simulator.set_gravity(np.array([2.0, 0.0, 0.0]))
    simulator.advance([0.0] * 5, [0.0, 0.4, 0.0, 0.0, 0.0, 0.002])
    assert_allclose(place(simulator)[7:10], [2e-3, 1e-3, 0.0], rtol=1e-12)
    assert_allclose(place(simulator)[12], 0.002e-3 / (0.4 * 0.1**2 / 6.0), rtol=1e-6)
    # wrenches are in the object frame, velocities in the world frame: turned by 90 degrees about x,
    # z becomes -y
    simulator = alone(crooked_hand(), gravity=STILL)
    simulator.data.qpos[-4:] = math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0
    simulator.advance([0.0] * 5, [0.0, 0.0, 0.2, 0.0, 0.0, 0.002])
    assert_allclose(place(simulator)[7:10], [0.0, -1e-3, 0.0], atol=1e-9)
    assert_allclose(place(simulator)[10:], [0.0, -0.002e-3 / (0.2 * 0.1**2 / 6.0), 0.0], atol=1e-9)


def test_bullet_is_the_default_if_installed(monkeypatch, caplog):
    installed = {"pybullet", "mujoco"}
    monkeypatch.setattr(
        "grasp_env.sim.engine.find_spec", lambda name: name if name in installed else None
    )
    _log_mujoco.cache_clear()
    assert [engine_of(), SceneConfig().engine, EnvConfig().resolved().engine] == [
        BulletEngine()
    ] * 3
    installed.remove("pybullet")
    EnvConfig().override(engine="mujoco").resolved()
    assert not caplog.messages  # it was named
    assert [engine_of(), SceneConfig().engine, EnvConfig().resolved().engine] == [
        MujocoEngine()
    ] * 3
    assert caplog.messages == ["pybullet is not installed, so the default engine is MuJoCo"]


def test_invalid_settings_and_a_missing_extra(monkeypatch):
    with pytest.raises(GraspError, match=r"impedance must .*; tolerance must"):
        MujocoEngine(impedance=(0.9, 0.5, 1e-3, 0.5, 2), tolerance=math.nan)
    with pytest.raises(InvalidInputError, match=r"opens no window: use render_mode='rgb_array'"):
        Mujoco(crooked_hand(), gui=True)
    found = extras.find_spec
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name == "mujoco" else found(name))
    with pytest.raises(
        MissingExtraError, match=r'this needs mujoco: pip install "grasp-force\[mujoco\]"'
    ):
        gym.make("grasp_env:FourFingerGrasp-v0", engine="mujoco")


@pytest.fixture
def opengl():
    """Skip if MuJoCo cannot draw."""
    try:
        MujocoPainter().close()
    except SimulationError as error:
        pytest.skip(str(error))


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize("shape", ["cuboid", "capsule"])
def test_pictures_show_the_object_where_it_is(shape):
    """A turned object before a hand."""
    item = ObjectDescription(shape)
    top = ((0.0, 0.5 * item.extent[1], 0.0),) * 4
    home = HandDescription.four_finger().home
    config = SceneConfig(object=item, contact_points=top, start_angles=home, gravity=STILL, **FAST)
    scene = Scene(config, visuals=True)
    for _ in range(100):
        scene.step(np.zeros(12), np.array([0.0, -0.5, 0.2, 0.02, 0.03, -0.02]))
    painter = Camera(scene, CameraConfig(width=16, height=16)).painter
    s = scene.look()
    assert np.linalg.norm(s.rotation - np.eye(3)) > 0.1
    _, depth = painter.shoot(VIEW)
    with painter.object_hidden():
        _, without = painter.shoot(VIEW)
    seen = (VIEW.unproject(depth)[depth != without] - s.position) @ s.rotation
    away = [scene.config.object.surface.nearest(point)[2] for point in seen[::10]]
    assert len(seen) > 1500
    # round ones are drawn with corners
    assert np.percentile(np.abs(away), 95) < (1e-5 if shape == "cuboid" else 1e-3)
    scene.close()


@pytest.mark.usefixtures("opengl")
def test_visual_meshes_and_hulls_are_drawn(tmp_path):
    """A red mesh file in millimetres and a green hull; both boxes of 2 cm, 5 cm beside the middle."""
    trimesh.creation.box((20.0, 20.0, 20.0)).export(tmp_path / "box.stl")
    corners = trimesh.creation.box((2.0, 2.0, 2.0)).vertices
    mesh = Geometry(
        "mesh", (1e-3,) * 3, (0.05, 0.0, 0.0), color=(1.0, 0.0, 0.0), file=str(tmp_path / "box.stl")
    )
    hull = hull_shape(0.01 * corners, (-0.05, 0.0, 0.0), color=(0.0, 1.0, 0.0))
    hand = dataclasses.replace(
        HandDescription.four_finger().without_visuals(), palm=Palm(visual=(mesh, hull))
    )
    painter = MujocoPainter.of_hand(hand, np.array(hand.home))
    view = View((0.0, 0.0, 0.5), (0.0, 0.0, 0.0), 30.0, 120, 120)
    picture, depth = painter.shoot(view)
    painter.close()
    colors = np.asarray(picture).astype(int)
    seen = depth < BACKGROUND_DEPTH
    points = view.unproject(depth)
    for channel, side in ((0, 1.0), (1, -1.0)):
        own = seen & (side * points[..., 0] > 0.0)
        assert np.ptp(points[own], axis=0)[:2] == pytest.approx(0.02, abs=0.005)
        assert points[own].mean(axis=0) == pytest.approx([0.05 * side, 0.0, 0.01], abs=2e-3)
        assert (colors[own][:, channel] > 120).all()
        assert (colors[own][:, 1 - channel] < 40).all()


@pytest.mark.usefixtures("opengl")
def test_pictures_beside_pytorch():
    """Mesa's LLVM loaded before triton's crashes Python."""
    pytest.importorskip("triton", reason="PyTorch's builds without CUDA do not bring triton")
    code = "from grasp_env.sim.picture.mujoco import MujocoPainter; painter = MujocoPainter(); import triton"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_without_opengl(monkeypatch, make_scene):
    monkeypatch.setitem(sys.modules, "mujoco.osmesa", None)
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(
        SimulationError, match=r"osmesa gives none here .*apt-get install libosmesa6"
    ):
        Camera(make_scene(**FAST))


def test_torsional_friction():
    """A moment about its vertical axis turns a ball on a table by M t / I, unless the contact
    carries it."""
    turned = []
    for torsion in (0.0, 0.02):
        table = Geometry("box", (0.2, 0.02, 0.2), (0.0, -0.06, 0.0))
        simulator = on_a_table(
            table, ObjectDescription("sphere", (0.1,), torsional_friction=torsion)
        )
        for _ in range(100):
            simulator.advance([0.0] * 5, [0.0, 0.0, 0.0, 0.0, 0.01, 0.0])
        turned.append(place(simulator)[11])
    assert_allclose(turned, [0.01 * 0.1 / (0.4 * 0.2 * 0.05**2), 0.0], atol=1e-2)
