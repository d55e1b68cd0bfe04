"""Videos: frames go to the file one by one, and a file with the final name is a whole one."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo
from PIL import Image, ImageSequence

from grasp_env.errors import InvalidInputError
from training.cli import main
from training.demo import record

ENV = "test_demo/Squares-v0"


class Squares(gym.Env[np.ndarray, np.ndarray]):
    """A picture that gets brighter from its seed on; `stop_at` ends it with ctrl-C."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self, render_mode: str, duration: float, initial_force: Any = None, stop_at: int = -1, size: int = 64
    ) -> None:
        self.observation_space = gym.spaces.Box(-1.0, 1.0, (1,))
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,))
        self.render_mode, self._stop_at, self._size = render_mode, stop_at, size
        self._last = round(50 * duration)

    def reset(self, seed: int, **_: Any) -> tuple[np.ndarray, dict[str, Any]]:
        self._step, self._seed = 0, seed
        return np.zeros(1, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        assert action.shape == (2,)
        self._step += 1
        if self._step == self._stop_at:
            raise KeyboardInterrupt
        return np.zeros(1, np.float32), 0.0, False, self._step == self._last, {}

    def render(self) -> np.ndarray:
        return np.full((self._size, self._size, 3), 10 * self._step + self._seed, np.uint8)


@pytest.fixture(autouse=True)
def _registered() -> Any:
    gym.register(ENV, entry_point=Squares, disable_env_checker=True)
    yield
    del gym.registry[ENV]


@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp", ".png"])
def test_every_second_step_is_a_frame_and_a_stopped_film_leaves_an_older_one(tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"out{suffix}"
    out.write_text("older")
    with pytest.raises(KeyboardInterrupt):
        record(out, seconds=1.0, env_id=ENV, stop_at=9)
    assert out.read_text() == "older"
    record(out, seconds=0.2, seed=20, env_id=ENV)
    assert [path.name for path in tmp_path.iterdir()] == [out.name]
    if suffix == ".mp4":  # imageio's own reader leaves pipes open, and warnings are errors here
        ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", out, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
        done = subprocess.run(ffmpeg, capture_output=True, check=True)
        assert b"64x64" in done.stderr
        assert b" 25 fps" in done.stderr
        frames = np.frombuffer(done.stdout, np.uint8).reshape(-1, 64, 64, 3)
    else:
        with Image.open(out) as film:
            frames = [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
            assert film.info.get("duration", 40) == 40  # ms
    steps = [10] if suffix == ".png" else [1, 3, 5, 7, 9, 10]
    means = [np.mean(frame) for frame in frames]
    np.testing.assert_allclose(means, 10.0 * np.array(steps) + 20.0, atol=3.0)  # H.264 loses a little


def test_a_film_says_how_it_ended(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.png"
    settings = {
        "task": {"name": "move", "motion": "rotate"},
        "disturbance": {"name": "impulses", "force": 2.0},
        "mass": 0.25,
    }
    options = "--task move --motion rotate --disturbance impulses --setting disturbance.force=2 --setting mass=0.25"
    assert main(["demo", "--video", str(out), "--seconds", "0.2", "--size", "320", "240", *options.split()]) == 0
    assert re.fullmatch(r"held 0\.2 s, drift 0\.\d\d mm: .*out\.png", capsys.readouterr().out.replace("\n", ""))
    record(tmp_path / "again.png", 0.2, "linear_combination", pictures={"size": (320, 240)}, **settings)
    assert (tmp_path / "again.png").read_bytes() == out.read_bytes()
    lost = record(
        out,
        1.0,
        controller={"kind": "pd"},
        disturbance={"name": "paper_path", "scale": 1.0},
        pictures={"size": (160, 160)},
    )
    assert str(lost) == f"lost after {lost.seconds:.1f} s: the object left its place"
    assert lost.seconds < 1.0


def test_gymnasiums_recorder_films_it(tmp_path: Path) -> None:
    env = gym.make("grasp_env:FourFingerGrasp-v0", render_mode="rgb_array", duration=0.1, pictures={"size": (160, 160)})
    film = RecordVideo(env, str(tmp_path / "films"), episode_trigger=lambda episode: True, disable_logger=True)
    for _ in range(2):
        film.reset(seed=0)
        while not any(film.step(film.action_space.sample())[2:4]):
            pass
    film.close()
    assert sorted(path.name for path in (tmp_path / "films").iterdir()) == [f"rl-video-episode-{k}.mp4" for k in (0, 1)]


def test_refusals_name_the_argument(tmp_path: Path) -> None:
    for out, seconds, message in (
        ("a.avi", 1.0, "out must end"),
        ("a.mp4", 0.0, "seconds"),
        ("no/a.mp4", 1.0, "folder"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            record(tmp_path / out, seconds=seconds, env_id=ENV)
