"""A picture or a video of the hand, without a display."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
from PIL import Image
from rich.console import Console

from grasp_env._extras import need
from grasp_env._files import replacing
from grasp_env.env.annotate import FAILURES
from grasp_env.errors import InvalidInputError
from grasp_env.force import InitialForceRule
from policies import Policy
from training.data.episodes import episode
from training.results.bars import progress

SUFFIXES = (".png", ".mp4", ".gif", ".webp")
FRAME_RATE = 25


@dataclass
class Ending:
    """How an episode ended.

    Attributes:
        seconds: simulated.
        drift: largest [m] of the object from where it should be.
        failure: why the object was lost, in words; "" where it was held.

    Example:
        >>> print(Ending(4.0, 1e-5), Ending(1.24, 0.03, "no force closure"), sep="; ")
        held 4.0 s, drift 0.01 mm; lost after 1.2 s: no force closure
    """

    seconds: float = 0.0
    drift: float = 0.0
    failure: str = ""

    def __str__(self) -> str:
        if self.failure:
            return f"lost after {self.seconds:.1f} s: {self.failure}"
        return f"held {self.seconds:.1f} s, drift {1e3 * self.drift:.2f} mm"


def record(
    out: Path,
    seconds: float | None = None,
    initial_force: str | InitialForceRule | None = None,
    seed: int = 0,
    *,
    env_id: str = "grasp_env:FourFingerGrasp-v0",
    policy: Policy | None = None,
    **settings: Any,
) -> Ending:
    """Rolls out the hand and saves the last frame (.png) or a video (.mp4, .gif, .webp) at 25 frames/s of simulated time.

    Frames go to the file one by one (of .webp, the smallest that a page shows without a player, all at the end). The file gets its name when it is complete: stopped with ctrl-C, nothing is left.

    Args:
        out: the file.
        seconds: simulated time; None: the task's own. The video is shorter where the object is lost.
        initial_force: the start rule; None: the environment's default.
        seed: of the episode.
        env_id: the environment.
        policy: the agent; None: no adjustment.
        **settings: more keywords of the environment: task, shape, disturbance, render_size.

    Returns:
        How the episode ended.

    Raises:
        InvalidInputError: another suffix, no time, or a folder that does not exist.
        MissingExtraError: .mp4 without the extra "video"; .gif and .webp need none.
    """
    if out.suffix not in SUFFIXES:
        raise InvalidInputError(f"out must end in one of {', '.join(SUFFIXES)}, got {out}")
    if out.suffix == ".mp4":
        need("video")
    if seconds is not None:
        if not seconds > 0.0 or not np.isfinite(seconds):
            raise InvalidInputError(f"seconds must be finite and > 0, got {seconds}")
        settings["duration"] = seconds
    if not out.absolute().parent.is_dir():
        raise InvalidInputError(f"the folder {out.absolute().parent} does not exist: make it first")
    ending = Ending()
    with replacing(out) as temporary:
        env = gym.make(env_id, render_mode="rgb_array", initial_force=initial_force, **settings)
        with closing(env), closing(_frames(env, seed, policy, out.suffix == ".png", ending)) as frames:
            _write(temporary, frames)
    return ending


def _frames(
    env: gym.Env[Any, Any], seed: int, policy: Policy | None, only_last: bool, ending: Ending
) -> Generator[np.ndarray]:
    """The pictures of one episode, which tells `ending` how it goes; a bar on a terminal shows how far it is."""
    rate = int(env.metadata["render_fps"])
    every = max(1, round(rate / FRAME_RATE))
    duration = getattr(getattr(env.unwrapped, "config", None), "duration", None)
    steps = None if duration is None else max(1, round(duration * rate))
    with progress(Console(stderr=True)) as bar:
        task = bar.add_task("recording", total=steps)
        for place, step in enumerate(episode(env, seed, policy)):
            info = step.info
            ending.seconds = (place + 1) / rate
            ending.drift = max(ending.drift, float(info.get("drift", 0.0)))
            ending.failure = FAILURES.get(info.get("failure", ""), "")
            if step.last or (place % every == 0 and not only_last):
                yield np.asarray(env.render())
            bar.advance(task)


def _write(path: Path, frames: Iterator[np.ndarray]) -> None:
    if path.suffix != ".mp4":
        pictures = map(Image.fromarray, frames)
        first = next(pictures)
        settings: dict[str, Any] = {}
        if path.suffix != ".png":
            settings = {"append_images": pictures, "duration": 1000 // FRAME_RATE, "loop": 0}
        if path.suffix == ".webp":
            settings |= {"append_images": list(pictures), "quality": 65, "method": 4}
        with path.open("wb") as file:
            first.save(file, format=path.suffix[1:], save_all=bool(settings), **settings)
        return
    # pixels in blocks of two: what the colours of H.264 are stored in
    writer = imageio.get_writer(path, format="FFMPEG", mode="I", fps=FRAME_RATE, macro_block_size=2, quality=8)
    try:
        for frame in frames:
            writer.append_data(frame)
    except BaseException:
        with suppress(Exception):  # ctrl-C has stopped ffmpeg too: it cannot finish the file
            writer.close()
        raise
    writer.close()
