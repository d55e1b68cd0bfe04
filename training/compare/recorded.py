"""Cases from the simulated hand: what its solver was asked, step by step, and what a change of contact makes of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from grasp_env._check import ContactForces, Wrench
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import GraspError
from grasp_env.force import LinearCombination
from grasp_env.grasp import Grasp
from grasp_env.grasp.wrench import FORCE_RADIUS, MOMENT_RADIUS
from training.compare.case import Case, Problem
from training.data.episodes import episode
from training.data.grasps import EVALUATION, slid

HANDS = ("three_finger", "four_finger", "five_finger")
STEPS = 100
"""Most steps of a recorded episode, at 50 per second."""
IMPACT = 0.25
"""Of the ball's radius: a wrench that moves by more between two steps is an impact."""
SLIP = (0.003, 0.010)
"""[m] least and largest slip."""
RANDOM_OBJECTS: dict[str, Any] = {"randomize": ("shape", "size", "mass", "friction")}


class Recorder:
    """The paper's start rule, which notes every problem that it is asked."""

    def __init__(self) -> None:
        self.problems: list[Problem] = []
        self._rule = LinearCombination()

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """See `InitialForceRule`."""
        self.problems.append((grasp, np.array(wrench)))
        return self._rule(grasp, wrench)


def record(
    episodes: int,
    rng: np.random.Generator,
    disturbance: str,
    hands: Sequence[str] = HANDS,
    steps: int = STEPS,
    **settings: Any,
) -> list[list[Problem]]:
    """Episodes of some hands in turn: the problems of each, in order.

    Args:
        episodes: how many in all.
        rng: draws the episodes' seeds.
        disturbance: of the environment.
        hands: which.
        steps: most steps of an episode.
        settings: of the environment; none: random objects.
    """
    recorder, seeds = Recorder(), rng.integers(0, 2**31, episodes).tolist()
    found: list[list[Problem]] = [[] for _ in range(episodes)]
    for place, hand in enumerate(hands):
        env = FourFingerGrasp(
            hand=hand,
            disturbance=disturbance,
            initial_force=recorder,
            duration=STEPS / 50,
            **(settings or RANDOM_OBJECTS),
        )
        try:
            for k in range(place, episodes, len(hands)):
                running = episode(env, seeds[k], most=steps)
                recorder.problems = found[k]  # what closing the fingers asked is none of them
                deque(running, maxlen=0)
        finally:
            env.close()
    return found


def _cold(rng: np.random.Generator, count: int) -> list[Case]:
    found = record(count, rng, "random", steps=1)
    return [Case(*problems[0], None, k, "cold") for k, problems in enumerate(found) if problems]


def _moving(rng: np.random.Generator, count: int) -> list[Case]:
    return [
        Case(*problems[i + 1], problems[i], k, "moved")
        for k, problems in enumerate(record(-(-count // 20), rng, "random"))
        for i in range(0, len(problems) - 1, 5)
    ]


def _changes(rng: np.random.Generator, count: int) -> list[Case]:
    cases = list[Case]()
    for k, problems in enumerate(record(max(len(HANDS), -(-count // 8)), rng, "impulses")):
        for i in rng.choice(len(problems) - 1, min(4, len(problems) - 1), replace=False).tolist():
            cases += changes_of(rng, problems[i], problems[i + 1], k)
    return cases


def _impulses(rng: np.random.Generator, count: int, **own: Any) -> list[Case]:
    return [
        Case(*now, old, k, "impulse")
        for k, problems in enumerate(record(-(-count // 5), rng, "impulses", **own))
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
"""Makers of the recorded sets; they make fewer cases than asked only where the roll-outs hold fewer."""


def changes_of(rng: np.random.Generator, old: Problem, now: Problem, group: int) -> list[Case]:
    """What the solver is asked when a finger is lost, when it lands again, and when one slips, between two recorded steps.

    A finger without which the others still have force closure is taken away; hands of three fingers only slip.
    """
    cases, count = [], now[0].n_contacts
    for finger in rng.permutation(count).tolist():
        fewer, fewer_before = without(now[0], finger), without(old[0], finger)
        if fewer is not None and fewer_before is not None:
            cases.append(Case(fewer, now[1], old, group, "lost"))
            cases.append(Case(*now, (fewer_before, old[1]), group, "landed"))
            break
    try:
        slipped = slid(rng, now[0], *SLIP, only=int(rng.integers(count)))
        if EVALUATION.closes(slipped):
            cases.append(Case(slipped, now[1], old, group, "slipped"))
    except GraspError:
        pass
    return cases


def without(grasp: Grasp, finger: int) -> Grasp | None:
    """The grasp without one contact; None where the rest has no force closure worth the name."""
    keep = np.arange(grasp.n_contacts) != finger
    if keep.sum() < 3:
        return None
    try:
        rest = Grasp.from_contacts(grasp.positions[keep], grasp.normals[keep], grasp.friction[keep])
        return rest if EVALUATION.closes(rest) else None
    except GraspError:
        return None


def _distance(old: Wrench, now: Wrench) -> float:
    """How far the wrench moved, in radii of the ball."""
    move = now - old
    return float(max(np.linalg.norm(move[:3]) / FORCE_RADIUS, np.linalg.norm(move[3:]) / MOMENT_RADIUS))
