"""Pictures and videos of the hand, without a display.

This command made the picture of the README and the site:
grasp demo --video docs/static/hand.webp --task move --motion rotate --disturbance paper_path
--seconds 4 --size 600 600
"""

from __future__ import annotations

import errno
import io
import os
import shutil
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any
from warnings import catch_warnings, simplefilter

import gymnasium as gym
import numpy as np
from PIL import Image
from rich.console import Console

from grasp_env.env.annotate import FAILURES
from grasp_env.errors import GraspWarning, InvalidInputError
from grasp_env.force.initial import InitialForceRule
from grasp_env.inputs.arguments import positive
from grasp_env.inputs.extras import need
from grasp_env.inputs.files import replacing
from policies import Policy
from training.data.episodes import episode
from training.evaluation.results.bars import progress

FULL = 1_000_000
"""Free space below which a disk counts as full [bytes]."""
SUFFIXES = (".png", ".mp4", ".gif", ".webp")
FRAME_RATE = 25


@dataclass
class Ending:
    """Outcome of an episode.

    Attributes:
        seconds: simulated time.
        drift: largest distance [m] of the object from its target.
        failure: reason why the object was lost, in words; "" if it was held.

    Example:
        >>> print(Ending(4.0, 1.2e-3), Ending(1.24, 0.03, "no force closure"), sep="; ")
        held 4.0 s, drift 1.20 mm; lost after 1.2 s: no force closure
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
    """Roll out the hand, save a picture or a video at 25 frames/s, and return the outcome.

    Frames are written one by one, those of .webp at the end. The file gets its name when it is
    complete: if ctrl-C stops the recording, an older file stays unchanged.

    Args:
        out: the file.
        seconds: simulated time; None: the task's own. The video is shorter if the object is lost.
        initial_force: the start rule; None: that of the settings.
        seed: seed of the episode.
        env_id: the environment.
        policy: the agent; None: zero actions.
        **settings: further keywords of the environment: config, task, shape, disturbance, pictures.

    Raises:
        InvalidInputError: another suffix, no time, or a folder that does not exist.
        MissingExtraError: .mp4 without the extra "video"; .gif and .webp need none.
    """
    if out.suffix not in SUFFIXES:
        raise InvalidInputError(f"out must end in one of {', '.join(SUFFIXES)}, got {out}")
    if out.suffix == ".mp4":
        need("video")
    if seconds is not None:
        settings["duration"] = positive(seconds, "seconds")
    if initial_force is not None:
        settings["initial_force"] = initial_force
    if not out.absolute().parent.is_dir():
        raise InvalidInputError(f"the folder {out.absolute().parent} does not exist: make it first")
    ending = Ending()
    with catch_warnings():
        if policy is None:
            simplefilter("ignore", GraspWarning)
        env = gym.make(env_id, render_mode="rgb_array", **settings)
    frames = _frames(env, seed, policy, out.suffix == ".png", ending)
    with closing(env), closing(frames), replacing(out) as temporary:
        _write(temporary, frames)
    return ending


def _frames(
    env: gym.Env[Any, Any], seed: int, policy: Policy | None, only_last: bool, ending: Ending
) -> Generator[np.ndarray]:
    """Yield the pictures of one episode, update `ending`, and show a progress bar."""
    rate = int(env.metadata["render_fps"])
    every = max(1, round(rate / FRAME_RATE))
    with progress(Console(stderr=True)) as bar:
        steps = getattr(env.unwrapped.spec, "max_episode_steps", None)
        task = bar.add_task("recording", total=steps)
        for k, step in enumerate(episode(env, seed, policy)):
            ending.seconds = (k + 1) / rate
            ending.drift = max(ending.drift, float(step.info.get("drift", 0.0)))
            ending.failure = FAILURES.get(step.info.get("failure", ""), "")
            if step.last or (k % every == 0 and not only_last):
                yield np.asarray(env.render())
            bar.advance(task)


def _write(path: Path, frames: Iterator[np.ndarray]) -> None:
    first = next(frames)
    if path.suffix == ".mp4":
        _write_film(path, first, frames)
        return
    rest: Any = map(Image.fromarray, frames)
    options: dict[str, Any] = {}
    if path.suffix != ".png":
        options = {"save_all": True, "duration": 1000 // FRAME_RATE, "loop": 0}
        options["append_images"] = rest
    if path.suffix == ".webp":
        options |= {"append_images": list(rest), "quality": 65, "method": 4}
    picture = io.BytesIO()  # writing to a file, an encoder would not tell why it failed
    Image.fromarray(first).save(picture, path.suffix[1:], **options)
    path.write_bytes(picture.getbuffer())


def _write_film(path: Path, first: np.ndarray, frames: Iterator[np.ndarray]) -> None:
    """Write an .mp4; raise an OSError if ffmpeg has not finished it."""
    import imageio_ffmpeg  # pyright: ignore[reportMissingImports]

    size = (first.shape[1], first.shape[0])
    # H.264 stores colours in blocks of two pixels
    options: dict[str, Any] = {"fps": FRAME_RATE, "quality": 8, "macro_block_size": 2}
    ended = False
    with closing(imageio_ffmpeg.write_frames(path, size, **options)) as writer:
        writer.send(None)
        for frame in chain([first], frames):
            try:
                writer.send(frame)
            except OSError:
                ended = True
                break
    if ended or not _is_whole(path):
        if shutil.disk_usage(path.parent).free < FULL:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        message = "ffmpeg did not finish the film, for a reason that it printed"
        raise OSError(errno.EIO, message, str(path))


def _is_whole(path: Path) -> bool:
    """Return True if the boxes of an .mp4 fill the file, with the index that is written last."""
    names = set[bytes]()
    offset = 0
    size = os.path.getsize(path) if path.exists() else 0
    while offset < size:
        with path.open("rb") as file:
            file.seek(offset)
            head = file.read(16)
        length = int.from_bytes(head[:4], "big")
        name = head[4:8]
        if length == 1:  # the length of a large box follows its name
            length = int.from_bytes(head[8:], "big")
        if length < 8:
            return False
        names.add(name)
        offset += length
    return offset == size and b"moov" in names
