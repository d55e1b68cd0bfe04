"""A picture or a video of the hand, without a display; and the warm-up of all compiled kernels."""

from __future__ import annotations

import os
import time
from pathlib import Path

import gymnasium as gym
import imageio.v3 as imageio
import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.force import ForceLimits, InitialForceRule, initial_rule, optimize_force, optimize_forces
from grasp_env.force.initial import RULES
from grasp_env.grasp import presets
from policies import LearnedInitialForce, ZeroPolicy

SUFFIXES = (".png", ".mp4", ".gif")
FRAME_RATE = 25


def record(out: Path, wrench: str, seconds: float, initial_force: str | InitialForceRule, seed: int) -> None:
    """Rolls out `FourFingerGrasp-v0` and saves its last frame (.png) or a video (.mp4, .gif) at 25 frames/s.

    Raises:
        InvalidInputError: another suffix, no time, a folder that does not exist, or .mp4 without the extra "video".
    """
    if out.suffix not in SUFFIXES:
        raise InvalidInputError(f"out must end in one of {', '.join(SUFFIXES)}, got {out}")
    if not seconds > 0.0 or not np.isfinite(seconds):
        raise InvalidInputError(f"seconds must be finite and > 0, got {seconds}")
    if not out.absolute().parent.is_dir():
        raise InvalidInputError(f"the folder {out.absolute().parent} does not exist: make it first")
    steps = max(1, round(seconds * 50))
    env = gym.make(
        "grasp_env:FourFingerGrasp-v0",
        render_mode="rgb_array",
        initial_force=initial_force,
        wrench=wrench,
        max_episode_steps=steps,
    )
    try:
        policy = ZeroPolicy()
        observation, _ = env.reset(seed=seed)
        frames = []
        for step in range(steps):
            observation, _, terminated, truncated, _ = env.step(policy.predict(observation)[0])
            last = terminated or truncated or step == steps - 1
            if last or (out.suffix != ".png" and step % (50 // FRAME_RATE) == 0):
                frames.append(np.asarray(env.render()))
            if last:
                break
    finally:
        env.close()
    temporary = out.with_name(f".{os.getpid()}.{out.name}")
    try:
        if out.suffix == ".png":
            imageio.imwrite(temporary, frames[-1])
        elif out.suffix == ".gif":
            imageio.imwrite(temporary, frames, duration=1000 // FRAME_RATE, loop=0)
        else:
            imageio.imwrite(temporary, frames, fps=FRAME_RATE, plugin="FFMPEG", macro_block_size=8)
        os.replace(temporary, out)
    except ImportError:
        raise InvalidInputError("writing .mp4 needs the extra: pip install 'grasp-force[video]', or use .gif") from None
    finally:
        temporary.unlink(missing_ok=True)


def warm_up() -> float:
    """Compiles and caches every kernel by calling each once; returns the seconds it took."""
    started = time.perf_counter()
    grasp, wrench = presets.paper_cuboid(), np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])
    for name in RULES:
        optimize_force(grasp, wrench, initial=initial_rule(name))
    first = optimize_force(grasp, wrench, initial=LearnedInitialForce.pretrained(), method="newton")
    optimize_force(grasp, wrench, initial=first)
    optimize_force(presets.five_finger_cuboid(), wrench)  # the flow's other form
    for method in ("newton", "conic"):
        optimize_force(grasp, wrench, method=method)
        optimize_force(grasp, wrench, method=method, limits=ForceLimits(max_normal=100.0))
        optimize_forces(grasp, wrench[None], method=method)
    env = gym.make("grasp_env:FourFingerGrasp-v0")
    env.reset(seed=0)
    env.step(np.zeros(6, dtype=np.float32))
    env.close()
    return time.perf_counter() - started
