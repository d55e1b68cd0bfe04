"""Other people's code: Gymnasium, stable-baselines3, torchrl, videos."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env as gym_check
from stable_baselines3.common.env_checker import check_env as sb3_check

from grasp_env.env.env import FourFingerGrasp
from grasp_env.env.stage import Stage
from grasp_env.errors import GraspWarning, SimulationError

ID = "grasp_env:FourFingerGrasp-v0"
ZERO = np.zeros(6, dtype=np.float32)


class Headless(FourFingerGrasp):
    """Gymnasium's checker opens every mode, and "human" needs a display."""

    metadata = {**FourFingerGrasp.metadata, "render_modes": ["rgb_array"]}  # noqa: RUF012


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("check", [gym_check, sb3_check], ids=["gymnasium", "stable-baselines3"])
@pytest.mark.parametrize(
    "settings",
    [
        {"render_mode": "rgb_array", "pictures": {"size": (64, 48)}, "disturbance": "random"},
        {
            "randomize": ("shape", "size", "mass", "friction"),
            "observation": "dict",
            "action_mode": "contact_force",
        },
    ],
    ids=["pictures", "dict"],
)
def test_checkers(check, settings):
    gym.register("Headless-v0", entry_point=Headless, max_episode_steps=100)
    env = gym.make("Headless-v0", **settings).unwrapped
    check(env, skip_render_check="render_mode" not in settings)
    env.close()
    del gym.registry["Headless-v0"]


SMALL: dict[str, Any] = {"pictures": {"size": (64, 48)}, "duration": 0.1}


def test_pictures_without_a_render_mode():
    env = gym.make(ID, **SMALL)
    bare: Any = env.unwrapped

    def warned(render: Any) -> str:
        with pytest.warns(UserWarning, match="without specifying any render mode") as caught:
            assert render() is None
        return str(caught[0].message)

    expected = warned(lambda: gym.make("CartPole-v1").unwrapped.render())
    # before the first reset
    assert warned(bare.render) == expected.replace("CartPole-v1", "FourFingerGrasp-v0")
    with pytest.raises(ResetNeeded):
        env.render()
    env.reset(seed=0)
    warned(env.render)
    env.step(ZERO)
    warned(env.render)
    env.close()
    warned(env.render)
    env.reset(seed=0)
    warned(env.render)
    env.close()
    direct = FourFingerGrasp()
    assert warned(direct.render) == warned(bare.render)  # without a specification
    direct.close()


def test_pictures_before_a_reset_and_after_close():
    env = gym.make(ID, render_mode="rgb_array", **SMALL)
    bare: Any = env.unwrapped
    assert bare.render().shape == (48, 64, 3)
    env.reset(seed=0)
    assert env.render().shape == (48, 64, 3)
    env.close()
    with pytest.raises(SimulationError, match=r"closed: call reset\(\)"):
        env.render()
    env.reset(seed=0)
    assert env.render().shape == (48, 64, 3)
    env.close()


def test_a_window_is_drawn_at_every_reset_and_step(monkeypatch):
    """A window needs a display, so a list takes its pictures."""
    shown: list[Any] = []
    window = SimpleNamespace(of_scene=lambda scene: SimpleNamespace(show=shown.append))
    monkeypatch.setattr("grasp_env.env.env.class_of", lambda engine, role: window)
    monkeypatch.setattr(
        FourFingerGrasp, "_new_stage", lambda env: Stage(env.config, env._loop, False, True)
    )
    env = FourFingerGrasp(render_mode="human", **SMALL)
    assert env.render() is None
    assert not shown  # nothing is known of an episode yet
    counts = []
    for _ in range(2):
        env.reset(seed=0)
        counts.append(len(shown))
        env.step(ZERO)
        counts.append(len(shown))
    assert counts == [1, 2, 3, 4]
    env.close()


def test_lists_of_pictures():
    env = gym.make(ID, render_mode="rgb_array_list", **SMALL)
    env.reset(seed=0)
    env.step(ZERO)
    pictures: Any = env.render()
    assert [picture.shape for picture in pictures] == [(48, 64, 3)] * 2
    env.close()
    for mode in ("sync", "async"):
        many = gym.make_vec(ID, 2, mode, render_mode="rgb_array", **SMALL)
        many.reset(seed=0)
        pictures = many.render()
        assert [picture.shape for picture in pictures] == [(48, 64, 3)] * 2
        many.close()
    many = gym.make_vec(ID, 2, "sync", **SMALL)
    many.reset(seed=0)
    with pytest.warns(UserWarning, match="without specifying any render mode"):
        assert many.render() == (None, None)
    many.close()


@pytest.mark.parametrize(
    ("settings", "steps"),
    [
        ({}, 100),
        ({"task": "payload"}, 200),
        ({"max_episode_steps": 7, "duration": 0.1}, 7),  # longer than the settings say
        ({"max_episode_steps": -1, "duration": 0.1}, 5),
    ],
)
def test_an_episode_lasts_as_long_as_its_spec_says(settings, steps):
    planned: list[float] = []

    def still(times: np.ndarray, rng: np.random.Generator, settings: object) -> np.ndarray:
        planned.append(times[-1])
        return np.zeros((len(times), 6))

    env = gym.make(ID, disturbance=still, **settings)
    for made in (env, gym.make(env.spec)):
        assert made.spec is not None
        assert made.spec.max_episode_steps == steps
        if steps < 20:
            made.reset(seed=0)
            assert planned[-1] == pytest.approx(steps / 50)
            assert [made.step(ZERO)[3] for _ in range(steps)] == [False] * (steps - 1) + [True]
        made.close()


REASONS = [
    ({"method": "newton"}, "Newton|newton"),
    ({"method": "conic"}, "no start"),
    ({"controller": {"kind": "pd"}}, "does not optimise"),
    ({"object": {"torsional_friction": 0.01}}, "soft contacts"),
    ({"controller": {"kind": "pd"}, "action_mode": "grip"}, "does not optimise"),
    ({"initial_force": "previous"}, ""),
    ({"method": "newton", "action_mode": "residual"}, ""),
    ({"method": "newton", "action_mode": "none"}, ""),
    ({"action_mode": "contact_force"}, ""),
]


@pytest.mark.parametrize(("settings", "reason"), REASONS)
def test_actions_without_effect_are_warned_of(settings, reason, recwarn):
    gym.make(ID, **settings).close()
    assert len(recwarn) == bool(reason)
    if reason:
        warning = recwarn.pop(GraspWarning)
        assert warning.filename == __file__  # the line that made it
        assert any(part in str(warning.message) for part in reason.split("|"))
        assert "action_mode='none'" in str(warning.message)


def test_videos(tmp_path):
    pytest.importorskip("moviepy", reason="the extra 'video' is not installed")
    env = gym.make(ID, duration=0.1, render_mode="rgb_array", pictures={"size": (64, 48)})
    env = gym.wrappers.RecordVideo(env, str(tmp_path / "videos"), disable_logger=True)
    env.reset(seed=0)
    for _ in range(5):
        env.step(ZERO)
    env.close()
    (video,) = (tmp_path / "videos").glob("*.mp4")
    assert video.stat().st_size > 500


def test_torchrl():
    gym_env = pytest.importorskip("torchrl.envs.libs.gym").GymEnv
    env = gym_env(ID, frame_skip=2, duration=0.2)
    assert env.rollout(20).batch_size[0] == 5
    env.close()
