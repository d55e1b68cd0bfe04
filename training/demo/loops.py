"""The moving pictures of a report: the simulated hand under one disturbance, from the paper's start and from a learned one."""

from __future__ import annotations

import io

import imageio.v3 as imageio
import numpy as np
from PIL import Image

from grasp_env.force import InitialForceRule
from training.demo.record import record
from training.results import Run

ANIMATIONS = {"hand_paper.webp": "from the paper's 12-basis", "hand_learned.webp": "from the learned start"}
"""Files in a run's figures/ and which start they show."""
STILL = "hand.png"
"""The picture without motion: for print, for readers who asked for less motion, for pages that are saved as text."""


def record_animations(run: Run, learned: str | InitialForceRule | None, *, quick: bool = False, seed: int = 0) -> None:
    """Rolls out the hand once per start under the same wrench and saves short loops and a still picture.

    Every frame shows forces, friction cones, the wrench, and the iterations of the tick. 2 s at 480 pixels, each below
    0.7 MB and about ten seconds of work; quick: 0.6 s at 320 pixels, two seconds of work.

    Args:
        run: where figures/ lies.
        learned: the learned start rule; None: only the paper's.
        quick: smaller and shorter.
        seed: of the disturbance.
    """
    seconds, size = (0.6, (320, 320)) if quick else (2.0, (480, 480))
    rules = {"hand_paper.webp": "linear_combination", "hand_learned.webp": learned}
    for name, rule in rules.items():
        if rule is not None:
            run.write(
                f"figures/{name}",
                lambda path, rule=rule: record(
                    path, seconds, rule, seed, task="hold", disturbance="random", render_size=size
                ),
            )
    run.write(f"figures/{STILL}", lambda path: imageio.imwrite(path, _middle(run), extension=".png"))


def _middle(run: Run) -> np.ndarray:
    """The frame in the middle of the first animation, (height, width, 3) uint8."""
    with Image.open(run.path("figures/hand_paper.webp")) as loop:
        loop.seek(getattr(loop, "n_frames", 1) // 2)
        return np.asarray(loop.convert("RGB"))


def still_of(data: bytes, width: int = 480) -> bytes:
    """The first frame of a picture as a small JPEG, which everything shows."""
    with Image.open(io.BytesIO(data)) as picture:
        small = picture.convert("RGB")
    small.thumbnail((width, width))
    out = io.BytesIO()
    small.save(out, format="jpeg", quality=82, optimize=True)
    return out.getvalue()
