"""Sets of cases of the comparison of starts, one entry of `SETS` each.

Training uses neither these generators nor their seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np

from grasp_env.grasp import Grasp, presets, wrench
from grasp_env.grasp.wrench import FORCE_RADIUS, MAGNITUDE_LENGTH, MOMENT_RADIUS
from grasp_env.inputs.arguments import Array, unit_vectors
from training.data.grasps import EVALUATION, slide_contacts
from training.evaluation.compare.case import Case

HELD_OUT = 0x5EED
"""First word of the generators' seeds; training does not use it."""
MAGNITUDES = (1e-3, 1e3)
"""Range of |(force, moment / 0.05 m)| of the set "six_decades" [N], log-uniform."""
DIRECTION_SIZES = (0.5, 1.0, 2.0)
TRAINED, _LEVELS = (0.25, 0.6), 20
"""Friction range in which the shipped model is trained, and number of frictions compared in it."""
FRICTIONS = (0.2, 0.7, 0.8)
"""Frictions outside that range."""
DISPLACEMENT = 0.010
"""Largest displacement of a contact on its face [m]."""
_PER_GRASP = 4
_LINE = 401  # points of a straight path
_AXES = ("x", "y", "z", "mx", "my", "mz")
_PAIRS = ((0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3))
_RADII = np.repeat([FORCE_RADIUS, MOMENT_RADIUS], 3)


Maker = Callable[[np.random.Generator, int], list[Case]]
"""Function (generator, approximate number of cases) -> cases."""


@dataclass(frozen=True)
class CaseSet:
    """Set of cases.

    Attributes:
        label: name in tables.
        note: meaning of "previous solution" in this set.
        make: function that makes the cases; sets with a share of 0 have a fixed number of cases.
        share: share of the requested number of cases.
        fixed: True if the contacts are those of `presets.paper_cuboid()`, or near them.
        solved: True if the methods run; otherwise only the starts are evaluated.
        starts: the only starts evaluated, besides those of a user; empty: all.
        cost: time of a case relative to one of "ball", for the order of the work.
    """

    label: str
    note: str
    make: Maker
    share: float = 1.0
    fixed: bool = True
    solved: bool = True
    starts: tuple[str, ...] = ()
    cost: float = 1.0


def make_cases(name: str, count: int, seed: int) -> list[Case]:
    """Make the cases of a set of `SETS`, about `count` times its share."""
    rng = np.random.default_rng([HELD_OUT, seed, list(SETS).index(name)])
    return SETS[name].make(rng, max(2, round(count * SETS[name].share)))


def path_cases(grasp: Grasp, path: Array, group: int = 0, event: str = "") -> list[Case]:
    """Return the cases of a path of wrenches (n, 6), each with its predecessor."""
    return [
        Case(grasp, load, (grasp, path[k - 1]) if k else None, group, event)
        for k, load in enumerate(path)
    ]


def directions() -> list[tuple[str, Array]]:
    """Return 18 named wrenches (6,) of 1 N or 0.05 N m: +- each axis, and six pairs of axes.

    Example:
        >>> [name for name, _ in directions()][::5]
        ['+x', '-z', '+mz', '+mx+my']
    """
    unit = np.diag([1.0, 1.0, 1.0, MOMENT_RADIUS, MOMENT_RADIUS, MOMENT_RADIUS])
    signs = (("+", 1.0), ("-", -1.0))
    single = [(f"{sign}{_AXES[k]}", factor * unit[k]) for k in range(6) for sign, factor in signs]
    pairs = [(f"+{_AXES[a]}+{_AXES[b]}", (unit[a] + unit[b]) / np.sqrt(2.0)) for a, b in _PAIRS]
    return single + pairs


def trajectory(rng: np.random.Generator, samples: int, rate: float = 100.0) -> Array:
    """Return wrenches (samples, 6) in the standard ball, each component a sum of two sines.

    Args:
        rng: draws frequencies, phases and amplitudes.
        samples: number of samples.
        rate: sampling rate [Hz].
    """
    time = np.arange(samples)[:, None, None] / rate
    frequency = rng.uniform(0.2, 2.0, (2, 6))
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, 6))
    size = rng.uniform(0.2, 1.0, (2, 6))
    waves = (size * np.sin(2.0 * np.pi * frequency * time + phase)).sum(axis=1) / size.sum(axis=0)
    return waves * _RADII / np.sqrt(3.0)


def scaled(loads: Array) -> Array:
    """Return wrenches (..., 6) with moments divided by 0.05 m [N]."""
    return loads / np.repeat([1.0, MAGNITUDE_LENGTH], 3)


def _paths(paths: Callable[[np.random.Generator, int], Iterable[Array]]) -> Maker:
    """Return a maker of cases along paths of wrenches on the fixed grasp; each path is a group."""

    def make(rng: np.random.Generator, count: int) -> list[Case]:
        grasp = presets.paper_cuboid()
        return [
            case
            for group, path in enumerate(paths(rng, count))
            for case in path_cases(grasp, path, group)
        ]

    return make


def _ball(scale: float) -> Maker:
    return _paths(lambda rng, count: [scale * wrench.sample_ball(rng, count)])


def _constant(rng: np.random.Generator, count: int) -> list[Case]:
    grasp = presets.paper_cuboid()
    load = np.array(wrench.PAPER_CONSTANT)
    return [Case(grasp, load, (grasp, 0.97 * load))]


def _directions(rng: np.random.Generator, count: int) -> list[Case]:
    grasp = presets.paper_cuboid()
    return [
        Case(grasp, size * load, (grasp, np.zeros(6)), k, event)
        for k, (event, load) in enumerate(directions())
        for size in DIRECTION_SIZES
    ]


def _jumps(size: float, rng: np.random.Generator, count: int) -> list[Case]:
    """Make pairs of wrenches in the ball, `size` times its radius apart in force and in moment."""
    grasp = presets.paper_cuboid()
    cases = list[Case]()
    while len(cases) < count:
        old = wrench.sample_ball(rng, 1)[0]
        direction = unit_vectors(rng.standard_normal((2, 3)))
        now = old + size * _RADII * direction.reshape(-1)
        if np.linalg.norm(now[:3]) <= FORCE_RADIUS and np.linalg.norm(now[3:]) <= MOMENT_RADIUS:
            cases.append(Case(grasp, now, (grasp, old), len(cases)))
    return cases


def _lines(rng: np.random.Generator, count: int) -> list[Array]:
    """Make straight lines through the ball along which every component changes its sign once."""
    ends = wrench.sample_ball(rng, 2 * max(1, count // _LINE)).reshape(2, -1, 6)
    ends[1] = -np.sign(ends[0]) * np.abs(ends[1])
    share = np.linspace(0.0, 1.0, _LINE)[:, None]
    return [a + share * (b - a) for a, b in zip(ends[0], ends[1], strict=True)]


def _frictions(rng: np.random.Generator, count: int) -> list[Case]:
    cases = list[Case]()
    fixed = presets.paper_cuboid()
    for group, mu in enumerate(FRICTIONS):
        path = wrench.sample_ball(rng, max(2, count // len(FRICTIONS)))
        cases += path_cases(fixed.with_friction(mu), path, group, f"{mu:g}")
    return cases


def _ball_frictions(rng: np.random.Generator, count: int) -> list[Case]:
    """Make cold starts on the ball; their frictions are stratified over the trained range."""
    low, high = TRAINED
    frictions = low + (high - low) * (np.arange(_LEVELS) + rng.random(_LEVELS)) / _LEVELS
    grasps = [presets.paper_cuboid().with_friction(mu) for mu in frictions.tolist()]
    levels = np.arange(count) % _LEVELS
    return [
        Case(grasps[level], load, None, level, f"{frictions[level]:.3f}")
        for level, load in zip(levels.tolist(), wrench.sample_ball(rng, count), strict=True)
    ]


def _positions(rng: np.random.Generator, count: int) -> list[Case]:
    cases = list[Case]()
    fixed = presets.paper_cuboid()
    for group in range(max(1, count // _PER_GRASP)):
        grasp = slide_contacts(rng, fixed, 0.0, DISPLACEMENT)
        cases += path_cases(grasp, wrench.sample_ball(rng, _PER_GRASP), group)
    return cases


def _random(contacts: int, rng: np.random.Generator, count: int) -> list[Case]:
    return [
        Case(EVALUATION.closed(rng, contacts), wrench.sample_ball(rng, 1)[0], None, group)
        for group in range(count)
    ]


def _recorded(name: str) -> Maker:
    def make(rng: np.random.Generator, count: int) -> list[Case]:
        from training.evaluation.compare import recorded  # loads the simulator

        return recorded.CASES[name](rng, count)[:count]

    return make


_DRAW = "the draw before it, an unrelated wrench"
_STEP = "the step before it"
_COLD = "none: every case is a cold start"
_JUMP = "the wrench before the jump"
SETS: dict[str, CaseSet] = {
    "constant": CaseSet(
        "the paper's constant wrench", "the same wrench, 3 % smaller", _constant, 0.0
    ),
    "paper_path": CaseSet(
        "the paper's W_ext(t), full size, 2 s in 200 samples",
        _STEP,
        _paths(lambda rng, count: [wrench.paper_path(np.arange(200) * 0.01)]),
        0.0,
    ),
    "ball": CaseSet("ball: force <= 2 N, moment <= 0.05 N m, independent draws", _DRAW, _ball(1.0)),
    "ball_double": CaseSet("the same ball, twice as large", _DRAW, _ball(2.0)),
    "ball_half": CaseSet("the same ball, half as large", _DRAW, _ball(0.5)),
    "smooth": CaseSet(
        "random walk in the ball, 3 % of its radius per step",
        _STEP,
        _paths(lambda rng, count: [wrench.sample_path(rng, count)]),
    ),
    "trajectories": CaseSet(
        "sums of sines through the ball, 100 samples per second",
        _STEP,
        _paths(lambda rng, count: (trajectory(rng, 200) for _ in range(max(1, count // 200)))),
    ),
    "directions": CaseSet(
        "18 directions: 6 axes both ways, 6 pairs; of 0.5, 1 and 2 N or 0.025, 0.05 and 0.1 N m",
        "the solution for no wrench",
        _directions,
        0.0,
    ),
    "jump_10": CaseSet("jumps of 10 % of the ball's radius", _JUMP, partial(_jumps, 0.1), 0.6),
    "jump_50": CaseSet("jumps of 50 %", _JUMP, partial(_jumps, 0.5), 0.6),
    "jump_100": CaseSet("jumps of 100 %", _JUMP, partial(_jumps, 1.0), 0.6),
    "friction": CaseSet("friction 0.2, 0.7 and 0.8, the ball", _DRAW, _frictions, 0.6),
    "positions": CaseSet(
        "every contact up to 10 mm off on its face, the ball", _DRAW, _positions, 0.6
    ),
    **{
        f"random_{contacts}": CaseSet(
            f"random grasps of {contacts} contacts, the ball",
            _COLD,
            partial(_random, contacts),
            share,
            fixed=False,
        )
        for contacts, share in ((4, 1.0), (3, 0.4), (5, 0.4))
    },
    "rollout_cold": CaseSet(
        "first optimisation of an episode, random object",
        _COLD,
        _recorded("rollout_cold"),
        0.15,
        fixed=False,
        cost=6.0,
    ),
    "rollout_moving": CaseSet(
        "random wrench, moving contacts, 50 per second",
        _STEP,
        _recorded("rollout_moving"),
        fixed=False,
        cost=2.0,
    ),
    "rollout_impulses": CaseSet(
        "impacts on random objects: the wrench moves by a quarter of the ball's radius or more in a step",
        _STEP,
        _recorded("rollout_impulses"),
        0.4,
        fixed=False,
        cost=5.0,
    ),
    "rollout_fixed": CaseSet(
        "the same impacts on the 0.1 m cuboid, contacts near the fixed grasp's",
        _STEP,
        _recorded("rollout_fixed"),
        0.4,
        fixed=False,
        cost=4.0,
    ),
    "rollout_changes": CaseSet(
        "changes of contact: a finger lost, landed or slipped 3 to 10 mm",
        "the solution with the contacts before, the finger that lands with its own optimum of no load",
        _recorded("rollout_changes"),
        0.6,
        fixed=False,
        cost=4.0,
    ),
    "six_decades": CaseSet(
        "wrenches of 0.001 to 1000 N, the starts alone",
        _COLD,
        lambda rng, count: [
            Case(grasp, load)
            for grasp in [presets.paper_cuboid()]
            for load in wrench.sample_magnitudes(rng, count, *MAGNITUDES)
        ],
        10.0,
        solved=False,
        starts=("linear_combination", "learned_fixed"),
        cost=0.02,
    ),
    "lines": CaseSet(
        "straight lines through the ball in 401 points, the starts alone",
        _STEP,
        _paths(_lines),
        2.0,
        solved=False,
        cost=0.4,
    ),
    "ball_frictions": CaseSet(
        "the ball, friction 0.25 to 0.6",
        _COLD,
        _ball_frictions,
        4.0,  # so that 40 wrenches lie above its p99
        starts=("internal_force", "linear_combination", "network", "learned_fixed"),
    ),
}
"""All sets, in the order of the tables.

Add a new set at the end, since the position is part of its seed.
"""
