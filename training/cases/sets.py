"""What the evaluation asks of every start: sets of cases, each a grasp, a wrench and the problem that came before it.

The generators here and in `grasps.py` and `recorded.py` are used by no training set, nor are their seeds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grasp_env._check import Array, Wrench
from grasp_env.grasp import Grasp, presets, wrench
from grasp_env.grasp.wrench import FORCE_RADIUS, MOMENT_RADIUS

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


@dataclass(frozen=True)
class SetInfo:
    """What a set is.

    Attributes:
        label: for tables.
        group: a key of `GROUPS`.
        grasp: "fixed", "near" (the fixed one with other friction or places), "random" or "recorded".
        note: what its "previous solution" is.
        share: of the number of cases asked for.
    """

    label: str
    group: str
    grasp: str
    note: str
    share: float = 1.0


GROUPS = {
    "paper": "The paper's two examples",
    "wrenches": "Wrenches on the fixed grasp",
    "jumps": "Jumps of the wrench on the fixed grasp",
    "grasps": "Friction, contact places and grasps that no training set holds",
    "rollouts": "Recorded from the simulated hand: moving contacts, impacts, changes of contact",
}
_DRAW = "the draw before it, an unrelated wrench"
_STEP = "the step before it"
_COLD = "none: every case is a cold start"
SETS: dict[str, SetInfo] = {
    "constant": SetInfo("the paper's constant wrench", "paper", "fixed", "the same wrench, 3 % smaller", 0.0),
    "paper_path": SetInfo("the paper's W_ext(t), full size, 2 s in 200 samples", "paper", "fixed", _STEP, 0.0),
    "ball": SetInfo("ball: force <= 2 N, moment <= 0.05 N m, independent draws", "wrenches", "fixed", _DRAW),
    "ball_double": SetInfo("the same ball, twice as large", "wrenches", "fixed", _DRAW),
    "ball_half": SetInfo("the same ball, half as large", "wrenches", "fixed", _DRAW),
    "smooth": SetInfo("random walk in the ball, 3 % of its radius per step", "wrenches", "fixed", _STEP),
    "trajectories": SetInfo("sums of sines through the ball, 100 samples per second", "wrenches", "fixed", _STEP),
    "directions": SetInfo(
        "18 directions: 6 axes both ways, 6 pairs; of 0.5, 1 and 2 N or 0.025, 0.05 and 0.1 N m", "wrenches", "fixed",
        "the solution for no wrench", 0.0,
    ),
    "jump_10": SetInfo("jumps of 10 % of the ball's radius", "jumps", "fixed", "the wrench before the jump", 0.6),
    "jump_50": SetInfo("jumps of 50 %", "jumps", "fixed", "the wrench before the jump", 0.6),
    "jump_100": SetInfo("jumps of 100 %", "jumps", "fixed", "the wrench before the jump", 0.6),
    "friction": SetInfo("friction 0.2, 0.7 and 0.8, the ball", "grasps", "near", _DRAW, 0.6),
    "positions": SetInfo("every contact up to 10 mm off on its face, the ball", "grasps", "near", _DRAW, 0.6),
    "random_4": SetInfo("random grasps of 4 contacts, the ball", "grasps", "random", _COLD),
    "random_3": SetInfo("random grasps of 3 contacts, the ball", "grasps", "random", _COLD, 0.4),
    "random_5": SetInfo("random grasps of 5 contacts, the ball", "grasps", "random", _COLD, 0.4),
    "rollout_cold": SetInfo("first optimisation of an episode, random object", "rollouts", "recorded", _COLD, 0.15),
    "rollout_moving": SetInfo("random wrench, moving contacts, 50 per second", "rollouts", "recorded", _STEP),
    "rollout_impulses": SetInfo(
        "impacts on random objects: the wrench moves by a quarter of the ball's radius or more in a step", "rollouts", "recorded", _STEP, 0.4
    ),
    "rollout_fixed": SetInfo(
        "the same impacts on the 0.1 m cuboid, contacts near the fixed grasp's", "rollouts", "recorded", _STEP, 0.4
    ),
    "rollout_changes": SetInfo(
        "changes of contact: a finger lost, landed or slipped 3 to 10 mm", "rollouts", "recorded",
        "the solution with the contacts before, the finger that lands with its own optimum of no load", 0.6,
    ),
}  # fmt: skip
"""All sets, in the order of the report."""
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
        scale = {"ball": 1.0, "ball_double": 2.0, "ball_half": 0.5}[name]
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
