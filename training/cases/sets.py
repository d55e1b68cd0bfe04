"""What the evaluation asks of every start: sets of cases, each a grasp, a wrench and the problem that came before it.

The generators here and in `grasps.py` and `recorded.py` are used by no training set, nor are their seeds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grasp_env._check import Array, Wrench
from grasp_env.errors import InvalidInputError
from grasp_env.grasp import Grasp, presets, wrench
from grasp_env.grasp.wrench import FORCE_RADIUS, MOMENT_RADIUS
from training.cases.set_table import SETS

Problem = tuple[Grasp, Wrench]
"""A grasp and the wrench on the object (6,) [N, N m]."""
HELD_OUT = 0x5EED
"""First word of the generators' seeds, with which no training set draws."""


@dataclass(frozen=True, eq=False)
class Case:
    """One optimisation.

    Attributes:
        grasp: the contacts.
        wrench: (6,) [N, N m].
        before: what was solved before it; None: nothing was, a cold start.
        group: which path, episode or grasp it belongs to.
        event: what happened since `before`, or which variant it is; "": nothing to tell.
    """

    grasp: Grasp
    wrench: Wrench
    before: Problem | None = None
    group: int = 0
    event: str = ""


DIRECTION_SIZES = (0.5, 1.0, 2.0)
_AXES = ("x", "y", "z", "mx", "my", "mz")
_PAIRS = ((0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3))
_RADII = np.repeat([FORCE_RADIUS, MOMENT_RADIUS], 3)


def generator(seed: int, name: str) -> np.random.Generator:
    """The generator of a set."""
    return np.random.default_rng([HELD_OUT, seed, list(SETS).index(name)])


def fixed_cases(name: str, count: int, seed: int) -> list[Case]:
    """The cases of a set on the fixed grasp, `presets.paper_cuboid()`.

    Args:
        name: a key of `SETS` whose grasp is "fixed".
        count: about how many; sets with a share of 0 have their own number.
        seed: of the evaluation.
    """
    grasp, rng = presets.paper_cuboid(), generator(seed, name)
    if name == "constant":
        load = np.array(wrench.PAPER_CONSTANT)
        return [Case(grasp, load, (grasp, 0.97 * load))]
    if name == "directions":
        return [
            Case(grasp, size * load, (grasp, np.zeros(6)), k, event)
            for k, (event, load) in enumerate(directions())
            for size in DIRECTION_SIZES
        ]
    if name.startswith("jump"):
        size = float(name.split("_")[1]) / 100.0
        return [
            Case(grasp, now, (grasp, old), k)
            for k, (old, now) in enumerate(_jump(rng, size) for _ in range(count))
        ]  # fmt: skip
    if name == "trajectories":
        paths = [trajectory(rng, 200) for _ in range(max(1, count // 200))]
    elif name == "smooth":
        paths = [wrench.sample_path(rng, count)]
    elif name == "paper_path":
        paths = [wrench.paper_path(np.arange(200) * 0.01)]
    else:
        scale = {"ball": 1.0, "ball_double": 2.0, "ball_half": 0.5}.get(name)
        if scale is None:
            raise InvalidInputError(f"no wrenches are known for the set {name!r}: say in fixed_cases how they are made")
        paths = [scale * wrench.sample_ball(rng, count)]
    return [case for group, path in enumerate(paths) for case in along(grasp, path, group)]


def along(grasp: Grasp, path: Array, group: int = 0, event: str = "") -> list[Case]:
    """Cases of wrenches (n, 6) on one grasp, each with the one before it; the first is cold."""
    return [Case(grasp, load, (grasp, path[k - 1]) if k else None, group, event) for k, load in enumerate(path)]


def directions() -> list[tuple[str, Array]]:
    """18 named wrenches (6,) of 1 N or 0.05 N m: every axis both ways, and six pairs of axes.

    Example:
        >>> [name for name, _ in directions()][::5]
        ['+x', '-z', '+mz', '+mx+my']
    """
    unit = np.diag([1.0, 1.0, 1.0, MOMENT_RADIUS, MOMENT_RADIUS, MOMENT_RADIUS])
    single = [(f"{sign}{_AXES[k]}", (1.0 if sign == "+" else -1.0) * unit[k]) for k in range(6) for sign in "+-"]
    return single + [(f"+{_AXES[a]}+{_AXES[b]}", (unit[a] + unit[b]) / np.sqrt(2.0)) for a, b in _PAIRS]


def trajectory(rng: np.random.Generator, samples: int, rate: float = 100.0) -> Array:
    """(samples, 6) wrenches: per component two sines of 0.2 to 2 Hz, inside the standard ball.

    Args:
        rng: draws frequencies, phases and amplitudes.
        samples: how many.
        rate: [Hz].
    """
    time = np.arange(samples)[:, None, None] / rate
    frequency, phase = rng.uniform(0.2, 2.0, (2, 6)), rng.uniform(0.0, 2.0 * np.pi, (2, 6))
    size = rng.uniform(0.2, 1.0, (2, 6))
    waves = (size * np.sin(2.0 * np.pi * frequency * time + phase)).sum(axis=1) / size.sum(axis=0)
    return waves * _RADII / np.sqrt(3.0)


def _jump(rng: np.random.Generator, size: float) -> tuple[Array, Array]:
    """Two wrenches of the ball, `size` of its radius apart, in force and in moment."""
    while True:
        old = wrench.sample_ball(rng, 1)[0]
        direction = rng.standard_normal((2, 3))
        direction /= np.sqrt((direction**2).sum(axis=1))[:, None]
        now = old + size * _RADII * direction.reshape(-1)
        if np.linalg.norm(now[:3]) <= FORCE_RADIUS and np.linalg.norm(now[3:]) <= MOMENT_RADIUS:
            return old, now
