"""Wrong input and faults: clear errors, named causes, and never a number that is none."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from engines import bullet, needs_bullet

from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import GraspError, InvalidInputError, SimulationError, UnknownNameError
from grasp_env.sim import FingerDescription, HandDescription
from grasp_env.sim.hand.urdf import hand_urdf

ZERO = np.zeros(6, dtype=np.float32)


def connections() -> int:
    return sum(bullet.isConnected(number) for number in range(64)) if bullet else 0


def obj(path: Path, faces: list[tuple[int, ...]], corners: list[tuple[float, ...]]) -> str:
    lines = [*("v {} {} {}".format(*c) for c in corners), *("f {} {} {}".format(*f) for f in faces)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return str(path)


def test_wrong_settings_open_nothing():
    """Every wrong setting is refused before anything is loaded; `tests/env/test_settings.py` has the settings themselves."""
    before = connections()
    for settings in (
        {"sensors": {"delay": -1.0}},
        {"render_mode": "ascii"},
        {"config": 3},
        {"colour": "red"},
        {"shape": "mesh"},
    ):
        with pytest.raises(GraspError) as caught:
            FourFingerGrasp(**settings)
        message, (name, value) = str(caught.value), next(iter(settings.items()))
        assert name in message or repr(value) in message
    assert connections() == before


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (((0.0, 0.0, 0.05),), "contact_points"),  # three fingers are left over
        (((0.0, 0.0, -0.05), (0.0, 0.03, 0.05), (-0.03, -0.02, 0.05), (0.03, -0.02, 0.04)), "surface"),
        (((0.0, 0.0, -0.05), (0.0, 0.03, 0.05), (-0.03, -0.02, 0.05), (0.0, -0.05, 0.0)), "reach|clear|unhindered"),
    ],
)
def test_impossible_contacts(points, message):
    before = connections()
    with pytest.raises(GraspError, match=message):
        FourFingerGrasp(contact_points=points)
    assert connections() == before


def test_an_object_out_of_reach():
    before = connections()
    with pytest.raises(InvalidInputError, match=r"cannot be grasped by the hand 'four_finger': finger .* out of reach"):
        FourFingerGrasp(hand=HandDescription.four_finger().moved((0.0, 0.5, 0.0)))
    with pytest.raises(GraspError, match=r"cannot be grasped|did not settle|cannot hold"):  # it lies under the fingers
        FourFingerGrasp(size=(0.5, 0.02, 0.5))
    with pytest.raises(GraspError, match="palm"):
        FourFingerGrasp(size=(0.1, 0.4, 0.1))
    assert connections() == before


def test_impossible_hands():
    one = HandDescription.of_fingers([FingerDescription("thumb", (0.0, 0.135, -0.09), (0.0, 0.0, 1.0))])
    two = HandDescription.of_fingers(
        [
            FingerDescription("thumb", (0.0, 0.135, -0.09), (0.0, 0.0, 1.0)),
            FingerDescription("front", (0.0, 0.135, 0.09), (0.0, 0.0, -1.0)),
        ]
    )
    for hand in (one, two):  # no force closure with fewer than three hard contacts
        with pytest.raises(GraspError):
            FourFingerGrasp(hand=hand)
    weak = HandDescription.of_fingers(
        [
            FingerDescription(name, base, press, torque_limit=0.01)
            for name, base, press in (
                ("thumb", (0.0, 0.135, -0.09), (0.0, 0.0, 1.0)),
                ("middle", (0.0, 0.135, 0.105), (0.0, 0.0, -1.0)),
                ("left", (-0.045, 0.135, 0.09), (0.0, 0.0, -1.0)),
                ("right", (0.045, 0.135, 0.09), (0.0, 0.0, -1.0)),
            )
        ]
    )
    with pytest.raises(GraspError):  # motors that do not even carry the fingers
        FourFingerGrasp(hand=weak)


def test_a_urdf_without_the_named_links(tmp_path):
    path = tmp_path / "hand.urdf"
    path.write_text(hand_urdf(HandDescription.three_finger()), encoding="utf-8")
    with pytest.raises(InvalidInputError, match=r"no link is called 'thumb_tip'; links are .*thumb_distal"):
        HandDescription.from_urdf(path, ["thumb_tip", "left_distal", "right_distal"])
    for fingertips in (0, [], [0], "thumb_distal", {}, {"thumb_distal": 1.0}, object()):
        with pytest.raises(InvalidInputError, match=r"fingertips=.* must be a list of one link name or more"):
            HandDescription.from_urdf(path, fingertips)  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match="nowhere"):
        HandDescription.from_urdf(tmp_path / "nowhere.urdf", ["thumb_distal"])


CUBE = [(x, y, z) for x in (-50.0, 50.0) for y in (-50.0, 50.0) for z in (-50.0, 50.0)]
SIDES: list[tuple[int, ...]] = [
    (1, 2, 4), (1, 4, 3), (5, 7, 8), (5, 8, 6), (1, 5, 6), (1, 6, 2),
    (3, 4, 8), (3, 8, 7), (1, 3, 7), (1, 7, 5), (2, 6, 8), (2, 8, 4),
]  # fmt: skip


def test_meshes_that_cannot_be_used(tmp_path):
    open_box = obj(tmp_path / "open.obj", SIDES[:-1], CUBE)
    dented = obj(
        tmp_path / "dented.obj",
        [*SIDES[:10], (2, 6, 9), (6, 8, 9), (8, 4, 9), (4, 2, 9)],
        [*CUBE, (0.0, 0.0, 10.0)],  # one side is pulled inwards
    )
    whole = obj(tmp_path / "whole.obj", SIDES, CUBE)
    (tmp_path / "text.obj").write_text("no mesh at all\n", encoding="utf-8")
    cases: list[tuple[dict[str, Any], str]] = [
        ({"mesh": open_box, "size": (0.001,)}, "not closed"),
        ({"mesh": dented, "size": (0.001,)}, "not convex"),
        ({"mesh": whole}, "millimetres"),  # 100 m each way
        ({"mesh": str(tmp_path / "nowhere.obj"), "size": (0.001,)}, "nowhere.obj"),
        ({"mesh": str(tmp_path / "text.obj"), "size": (0.001,)}, "text.obj"),
        ({"mesh": str(tmp_path / "whole.step"), "size": (0.001,)}, "type"),
    ]
    before = connections()
    for settings, message in cases:
        with pytest.raises(InvalidInputError, match=message):
            FourFingerGrasp(object={"shape": "mesh", **settings})
    with pytest.raises(InvalidInputError, match="mesh"):
        FourFingerGrasp(object={"shape": "cuboid", "mesh": whole})
    assert connections() == before


@pytest.mark.parametrize(
    "action",
    [
        np.array([np.nan, 0, 0, 0, 0, 0]), np.array([0, 0, np.inf, 0, 0, 0]), np.array([0, 0, 0, 0, 0, -np.inf]),
        np.zeros(5), np.zeros((1, 6)), np.float32(0.0), "x", None, {}, [None] * 6, [object()],
    ],
    ids=lambda action: re.sub(" at 0x.*", "", str(action)),  # the same in every process
)  # fmt: skip
def test_wrong_actions_change_nothing(action):
    env = FourFingerGrasp(disturbance="random")
    env.reset(seed=0)
    env.step(ZERO)
    with pytest.raises(InvalidInputError, match="action must be 6 finite numbers"):
        env.step(action)
    after = env.step(ZERO)[0]
    env.reset(seed=0)
    env.step(ZERO)
    assert env.step(ZERO)[0].tobytes() == after.tobytes()
    env.close()


def test_calls_in_the_wrong_order():
    env = FourFingerGrasp()
    with pytest.raises(SimulationError, match="reset"):
        env.step(ZERO)
    env.reset(seed=0)
    with pytest.raises(UnknownNameError, match="wrench"):
        env.reset(options={"wrnch": 1})
    for options in ("x", 5, [("wrench", np.zeros(6))]):
        with pytest.raises(InvalidInputError, match="options must be a dict"):
            env.reset(options=options)  # type: ignore[arg-type]
    for wrench in ([1, 2, np.inf, 0, 0, 0], [1, 2], "push", [1e300] * 6):
        with pytest.raises(GraspError, match="wrench"):
            env.reset(options={"wrench": wrench})
    env.reset(seed=0)
    env.close()
    env.close()
    for call in (lambda: env.step(ZERO), env.render, lambda: env.scene):
        with pytest.raises(SimulationError, match="closed"):
            call()


def test_a_refused_reset_leaves_no_half_episode():
    """What was running goes on, or asks for a reset; it never runs with parts of the next episode."""
    env = FourFingerGrasp(disturbance="random")
    env.reset(seed=0)
    with pytest.raises(GraspError):
        env.reset(seed=1, options={"wrench": [np.nan] * 6})
    first = env.reset(seed=0)[0]
    rows = [env.step(ZERO)[0] for _ in range(3)]
    env.close()
    other = FourFingerGrasp(disturbance="random")
    assert other.reset(seed=0)[0].tobytes() == first.tobytes()
    assert np.array([other.step(ZERO)[0] for _ in range(3)]).tobytes() == np.array(rows).tobytes()
    other.close()


def test_stepping_after_the_end():
    env = FourFingerGrasp(duration=0.1)
    env.reset(seed=0)
    for _ in range(5):
        truncated = env.step(ZERO)[3]
    assert truncated
    with pytest.raises(SimulationError, match=r"time is up.*reset"):
        env.step(ZERO)
    env.close()


def test_a_lost_object_ends_the_episode_with_its_cause():
    env = FourFingerGrasp()
    env.reset(seed=0, options={"wrench": [0, 0, 0, 0, 0, 3.0]})  # far beyond the joint torques
    for _ in range(100):
        obs, reward, terminated, truncated, info = env.step(ZERO)
        assert np.isfinite(obs).all()
        assert env.observation_space.contains(obs)
        if terminated:
            break
    assert terminated
    assert not truncated
    assert info["failure"] in ("dropped", "closure_lost")
    assert reward < -90.0
    assert not info["is_success"]
    with pytest.raises(SimulationError, match=re.escape(info["failure"])):
        env.step(ZERO)
    env.reset(seed=0)
    assert not env.step(ZERO)[2]
    env.close()


@pytest.mark.parametrize("push", [1e5, 1e9, 1e12])
def test_a_diverging_simulation_ends_the_episode_with_its_cause(push):
    env = FourFingerGrasp(limits={"max_drift": 1e9, "max_tilt": 10.0, "max_contact_gap": 1e9})
    calm = env.reset(seed=0)[0]
    env.reset(seed=0, options={"wrench": [push, push, 0, 0, 0, push]})
    for _ in range(100):
        obs, reward, terminated, _, info = env.step(ZERO)
        assert np.isfinite(obs).all()
        assert env.observation_space.contains(obs)
        assert np.isfinite(reward)
        for key, value in info.items():
            if not isinstance(value, str):
                assert np.isfinite(value).all(), key
        if terminated:
            break
    assert terminated
    assert info["failure"] == "simulation_diverged"
    assert not info["is_success"]
    with pytest.raises(SimulationError, match="simulation_diverged"):
        env.step(ZERO)
    assert env.reset(seed=0)[0].tobytes() == calm.tobytes()  # whole again, to the last bit
    assert not env.step(ZERO)[2]
    env.close()


@needs_bullet
def test_numbers_that_bullet_makes_none(monkeypatch):
    """Contact forces that are NaN, as Bullet gives after a divergence."""
    env = FourFingerGrasp()
    env.reset(seed=0)
    env.step(ZERO)
    real, broken = bullet.getContactPoints, []

    def contacts(*args: Any, **kwargs: Any) -> Any:
        rows = real(*args, **kwargs)
        broken.append(len(rows))
        return tuple((*row[:9], float("nan"), *row[10:]) for row in rows)

    monkeypatch.setattr(bullet, "getContactPoints", contacts)
    obs, reward, terminated, _, info = env.step(ZERO)
    monkeypatch.undo()
    assert sum(broken) > 0
    assert terminated
    assert info["failure"] == "simulation_diverged"
    assert np.isfinite(obs).all()
    assert np.isfinite(reward)
    assert all(np.isfinite(value).all() for value in info.values() if not isinstance(value, str))
    env.reset(seed=0)
    assert env.step(ZERO)[4]["status"] == "optimal"
    env.close()


@needs_bullet
def test_human_mode_without_a_display_is_a_clear_error(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    before = connections()
    with pytest.raises(SimulationError, match=r"display.*rgb_array"):
        FourFingerGrasp(render_mode="human")
    with pytest.raises(SimulationError, match="display"):
        gym.make("grasp_env:FourFingerGrasp-v0", render_mode="human")
    assert connections() == before


def test_objects_that_none_can_hold_are_not_drawn_for_ever():
    env = FourFingerGrasp(randomize={"mass": (0.1, 0.3), "friction": True})
    env.reset(seed=0)
    env.close()
    slippery = FourFingerGrasp(randomize={"mass": (60.0, 90.0), "friction": (0.011, 0.012)})
    with pytest.raises(SimulationError, match="random objects could be held"):
        slippery.reset(seed=0)
    slippery.close()
