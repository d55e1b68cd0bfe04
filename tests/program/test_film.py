"""Videos have the right frames; progress bars fit a terminal."""

from __future__ import annotations

import io
import re
import shutil
import subprocess
from collections.abc import Generator
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image, ImageSequence
from rich.console import Console

from grasp_env.errors import InvalidInputError
from training.evaluation.results.bars import progress
from training.program.cli import main
from training.program.film import _is_whole, record

ENV = "test_demo/Squares-v0"
with_video = pytest.mark.skipif(
    not find_spec("imageio_ffmpeg"), reason="the extra 'video' is not installed"
)


class Squares(gym.Env[np.ndarray, np.ndarray]):
    """A picture that gets brighter from its seed on; `stop_at` ends it with ctrl-C."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(self, render_mode: str, duration: float, stop_at: int = -1) -> None:
        self.observation_space = gym.spaces.Box(-1.0, 1.0, (1,))
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,))
        self.render_mode, self._stop_at, self._last = render_mode, stop_at, round(50 * duration)

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
        return np.full((64, 64, 3), 10 * self._step + self._seed, np.uint8)


@pytest.fixture(autouse=True)
def _registered():
    gym.register(ENV, entry_point=Squares, disable_env_checker=True)
    yield
    del gym.registry[ENV]


@pytest.mark.parametrize(
    "suffix", [pytest.param(".mp4", marks=with_video), ".gif", ".webp", ".png"]
)
def test_every_second_step_is_a_frame(tmp_path, suffix):
    out = tmp_path / f"out{suffix}"
    out.write_text("older")
    with pytest.raises(KeyboardInterrupt):
        record(out, seconds=1.0, env_id=ENV, stop_at=9)
    assert out.read_text() == "older"
    record(out, seconds=0.2, seed=20, env_id=ENV)
    assert [path.name for path in tmp_path.iterdir()] == [out.name]
    if suffix == ".mp4":  # imageio's own reader leaves pipes open, and warnings are errors here
        import imageio_ffmpeg

        ffmpeg = f"{imageio_ffmpeg.get_ffmpeg_exe()} -i {out} -f rawvideo -pix_fmt rgb24 -"
        done = subprocess.run(ffmpeg.split(), capture_output=True, check=True)
        assert all(text in done.stderr for text in (b"64x64", b" 25 fps"))
        frames = np.frombuffer(done.stdout, np.uint8).reshape(-1, 64, 64, 3)
    else:
        with Image.open(out) as film:
            frames = [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
            assert film.info.get("duration", 40) == 40  # ms
    steps = [10] if suffix == ".png" else [1, 3, 5, 7, 9, 10]
    # H.264 loses a little
    np.testing.assert_allclose(
        [np.mean(frame) for frame in frames], 10.0 * np.array(steps) + 20.0, atol=3.0
    )


@with_video
def test_unfinished_films_leave_older_ones(tmp_path, monkeypatch):
    """On a full disk ffmpeg writes no index, and imageio says nothing."""
    import imageio_ffmpeg

    out = tmp_path / "out.mp4"
    whole = tmp_path / "whole.mp4"
    record(whole, seconds=0.2, env_id=ENV)
    blob = whole.read_bytes()
    cut = tmp_path / "cut.mp4"
    for size in range(len(blob)):
        cut.write_bytes(blob[:size])
        assert not _is_whole(cut)
    assert _is_whole(whole)
    assert not _is_whole(tmp_path / "missing.mp4")

    def ends(path: Path, *_: Any, **__: Any) -> Generator[None, np.ndarray, None]:
        yield
        path.write_bytes(blob[: len(blob) // 2])
        while True:
            yield

    def breaks(path: Path, *_: Any, **__: Any) -> Generator[None, np.ndarray, None]:
        yield
        raise OSError("[Errno 32] Broken pipe FFMPEG COMMAND ...")

    for written in (ends, breaks):
        monkeypatch.setattr(imageio_ffmpeg, "write_frames", written)
        for free, message in (
            (0, "No space left on device: "),
            (10**9, "ffmpeg did not finish the film, for a reason .*: "),
        ):
            monkeypatch.setattr(
                shutil, "disk_usage", lambda path, free=free: SimpleNamespace(free=free)
            )
            out.write_text("older")
            with pytest.raises(OSError, match=f"{message}'{re.escape(str(out))}'"):
                record(out, seconds=0.2, env_id=ENV)
            assert out.read_text() == "older"
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_a_film_shows_the_settings_and_the_outcome(tmp_path, capsys):
    out = tmp_path / "out.png"
    options = "--task move --motion rotate --disturbance impulses --setting disturbance.force=2 --setting mass=0.25"
    assert main(f"demo --video {out} --seconds 0.1 --size 160 120 {options}".split()) == 0
    assert re.fullmatch(
        r"held 0\.1 s, drift 0\.\d\d mm: .*out\.png", capsys.readouterr().out.replace("\n", "")
    )
    task = {"name": "move", "motion": "rotate"}
    impulses = {"name": "impulses", "force": 2.0}
    pictures = {"size": (160, 120)}
    again = tmp_path / "again.png"
    record(
        again,
        0.1,
        "linear_combination",
        pictures=pictures,
        task=task,
        disturbance=impulses,
        mass=0.25,
    )
    assert again.read_bytes() == out.read_bytes()
    path = {"name": "paper_path", "scale": 1.0}
    lost = record(out, 1.0, controller={"kind": "pd"}, disturbance=path, pictures=pictures)
    assert str(lost) == f"lost after {lost.seconds:.1f} s: the object left its place"
    assert lost.seconds < 1.0
    for name, seconds, message in (
        ("a.avi", 1.0, "must end"),
        ("a.gif", 0.0, "seconds"),
        ("no/a.gif", 1.0, "folder"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            record(tmp_path / name, seconds=seconds, env_id=ENV)


def test_long_names_leave_room_for_numbers():
    for name in ("episodes: six_directions/constant_squeeze/00000", "x" * 300):
        out = io.StringIO()
        console = Console(
            file=out, width=80, force_terminal=True, color_system=None, legacy_windows=False
        )
        bars = progress(console)
        bars.update(
            bars.add_task(name, total=10_000_000, note="gaps: " + "1e-02 " * 20),
            completed=5_000_000,
        )
        console.print(bars.get_renderable())
        line, note = out.getvalue().splitlines()
        assert max(len(line), len(note)) <= 80
        assert "5000000/10000000" in line
        assert line.endswith("0:00:00 -:--:--")
        assert "━" in line
        assert note.startswith("gaps:")
    with progress(Console(file=(out := io.StringIO()))) as bars:  # no terminal
        bars.advance(bars.add_task("work", total=1))
    assert out.getvalue() == ""
