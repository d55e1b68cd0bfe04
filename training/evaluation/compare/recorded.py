"""Cases recorded from the simulated hand, step by step, and changes of contact in them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import GraspError
from grasp_env.force.initial import LinearCombination
from grasp_env.grasp import Grasp
from grasp_env.grasp.wrench import FORCE_RADIUS, MOMENT_RADIUS
from grasp_env.inputs.arguments import ContactForces, Wrench
from training.data.episodes import episode
from training.data.grasps import EVALUATION, slide_contacts
from training.evaluation.compare.case import Case, Problem

HANDS = ("three_finger", "four_finger", "five_finger")
STEPS = 100
"""Largest number of steps of a recorded episode, at 50 per second."""
IMPACT = 0.25
"""Change of the wrench between two steps, in radii of the ball, from which on it is an impact."""
SLIP = (0.003, 0.010)
"""Least and largest slip [m]."""
RANDOM_OBJECTS: dict[str, Any] = {"randomize": ("shape", "size", "mass", "friction")}


def record(
    episodes: int,
    rng: np.random.Generator,
    disturbance: str,
    hands: Sequence[str] = HANDS,
    steps: int = STEPS,
    **settings: Any,
) -> list[list[Problem]]:
    """Record the problems of episodes of at most `steps` steps; the hands take turns.

    Without further `settings` of the environment the objects are random.
    """
    seeds = rng.integers(0, 2**31, episodes).tolist()
    paper = LinearCombination()
    recording = list[Problem]()

    def rule(grasp: Grasp, wrench: Wrench) -> ContactForces:
        recording.append((grasp, np.array(wrench)))
        return paper(grasp, wrench)

    problems: list[list[Problem]] = [[] for _ in range(episodes)]
    keywords = {
        "disturbance": disturbance,
        "initial_force": rule,
        "duration": STEPS / 50,
        **(settings or RANDOM_OBJECTS),
    }
    for first, hand in enumerate(hands):
        with closing(FourFingerGrasp(hand=hand, **keywords)) as env:
            for k in range(first, episodes, len(hands)):
                running = episode(env, seeds[k], most=steps)
                recording = problems[k]
                deque(running, maxlen=0)
                recording = []  # for the problems of closing the fingers, which do not count
    return problems


def _cold(rng: np.random.Generator, count: int) -> list[Case]:
    episodes = record(count, rng, "random", steps=1)
    return [Case(*problems[0], None, k, "cold") for k, problems in enumerate(episodes) if problems]


def _moving(rng: np.random.Generator, count: int) -> list[Case]:
    return [
        Case(*problems[i + 1], problems[i], k, "moved")
        for k, problems in enumerate(record(-(-count // 20), rng, "random"))
        for i in range(0, len(problems) - 1, 5)
    ]


def _changes(rng: np.random.Generator, count: int) -> list[Case]:
    cases = list[Case]()
    for k, problems in enumerate(record(max(len(HANDS), -(-count // 8)), rng, "impulses")):
        pairs = len(problems) - 1
        for i in rng.choice(pairs, min(4, pairs), replace=False).tolist():
            cases += changes_of(rng, problems[i], problems[i + 1], k)
    return cases


def _impulses(rng: np.random.Generator, count: int, **keywords: Any) -> list[Case]:
    return [
        Case(*now, old, k, "impulse")
        for k, problems in enumerate(record(-(-count // 5), rng, "impulses", **keywords))
        for old, now in pairwise(problems)
        if _distance(old[1], now[1]) >= IMPACT
    ]


CASES: dict[str, Callable[[np.random.Generator, int], list[Case]]] = {
    "rollout_cold": _cold,
    "rollout_moving": _moving,
    "rollout_impulses": _impulses,
    "rollout_fixed": partial(_impulses, hands=("four_finger",), randomize=()),
    "rollout_changes": _changes,
}
"""Makers of the recorded sets.

They return fewer cases than requested only if the roll-outs have fewer.
"""


def changes_of(rng: np.random.Generator, old: Problem, now: Problem, group: int) -> list[Case]:
    """Return cases between two steps in which a finger is lost, lands or slips.

    Without the lost finger the others still have force closure; hands with three fingers only slip.
    """
    cases = []
    count = now[0].n_contacts
    for finger in rng.permutation(count).tolist():
        fewer = without(now[0], finger)
        fewer_before = without(old[0], finger)
        if fewer is not None and fewer_before is not None:
            cases.append(Case(fewer, now[1], old, group, "lost"))
            cases.append(Case(*now, (fewer_before, old[1]), group, "landed"))
            break
    try:
        slipped = slide_contacts(rng, now[0], *SLIP, only=int(rng.integers(count)))
        if EVALUATION.closes(slipped):
            cases.append(Case(slipped, now[1], old, group, "slipped"))
    except GraspError:
        pass
    return cases


def without(grasp: Grasp, finger: int) -> Grasp | None:
    """Return the grasp without one contact; None if the rest fails `EVALUATION.closes`."""
    keep = np.arange(grasp.n_contacts) != finger
    if keep.sum() < 3:
        return None
    try:
        rest = Grasp.from_contacts(grasp.positions[keep], grasp.normals[keep], grasp.friction[keep])
        return rest if EVALUATION.closes(rest) else None
    except GraspError:
        return None


def _distance(old: Wrench, now: Wrench) -> float:
    """Return the change of the wrench, in radii of the ball."""
    move = now - old
    return float(
        max(np.linalg.norm(move[:3]) / FORCE_RADIUS, np.linalg.norm(move[3:]) / MOMENT_RADIUS)
    )
