"""What is asked of bare contacts and what is answered: forces, margins, certificates and plain words, without any page."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from grasp_env._check import Array
from grasp_env.errors import GraspError, InfeasibleWrenchError
from grasp_env.force import ForceLimits, ForceOptimizer, ForceSolution, InitialForceRule, Status
from grasp_env.grasp import Grasp
from grasp_env.grasp.advice import advise

STARTLESS = ("conic", "linear")
"""Methods that start from their own centre."""
_REPEATS, _MOST_TIME = 5, 2e-3
"""Solves that are timed, and the time after which no other one is [s]."""
_HIGHEST_FRICTION, _HALVINGS = 2.0, 7
"""Up to where friction that would do is looked for, and how often the interval is halved."""


class Mood(Enum):
    """How an answer is to be read at a glance."""

    GOOD = "good"
    WARNING = "warning"
    BAD = "bad"


@dataclass(frozen=True, eq=False)
class Question:
    """Contacts, the load on the object, and how to solve.

    Attributes:
        positions: (N, 3) contacts [m]. normals: (N, 3) unit, into the object.
        friction: coefficient of all contacts.
        wrench: (6,) external force [N] and moment [N m] on the object; all in the object's frame.
        method: of `grasp_env.force`. start: name of a start rule, of the methods that take one.
        barrier_weight: lambda [N^2].
        max_normal: most normal force of a contact [N]; inf: no limit.
    """

    positions: Array
    normals: Array
    friction: float
    wrench: Array
    method: str = "newton"
    start: str = "linear_combination"
    barrier_weight: float = 0.01
    max_normal: float = math.inf


@dataclass(frozen=True, eq=False)
class Answer:
    """What is to be shown.

    Attributes:
        mood: at a glance.
        status: a word or two.
        words: what it means, and what to change where there is something to change.
        forces: (N, 3) each finger's force on the object [N], object frame; zero where there are none.
        normal_forces, margins: (N,) normal force and friction * normal - |tangential| [N].
        iterations: accepted steps. gap: certified relative gap. objective, bound: of the method, its certified lower bound.
        microseconds: of one solve once the contacts are known, median of a few; nan: none ended.
        twist: (6,) velocity of the object's origin and angular velocity of an infeasible wrench's certificate, scaled to
            1 at the grasp's length; None: feasible.
        advice: what looks wrong about the contacts.
    """

    mood: Mood
    status: str
    words: str
    forces: Array
    normal_forces: Array
    margins: Array
    iterations: int = 0
    gap: float = math.nan
    objective: float = math.nan
    bound: float = math.nan
    microseconds: float = math.nan
    twist: Array | None = None
    advice: tuple[str, ...] = field(default=())


class Answers:
    """Answers questions one after the other; keeps the optimizer while only contacts and load change, as a control loop would.

    Args:
        rule: the start rule of a name.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp = presets.paper_cuboid()
        >>> ask = Answers()
        >>> load = np.array([1, 0.5, -0.6, -0.1, 0.2, 0])
        >>> answer = ask(Question(grasp.positions, grasp.normals, 0.4, load))
        >>> answer.status, answer.iterations, bool(answer.margins.min() > 0)
        ('held', 6, True)
        >>> one_side = Question(grasp.positions[1:], grasp.normals[1:], 0.4, load)
        >>> ask(one_side).status
        'cannot be held'
    """

    def __init__(self, rule: Callable[[str], str | InitialForceRule] = str) -> None:
        self._rule = rule
        self._rules: dict[str, str | InitialForceRule] = {}
        self._settings: tuple[object, ...] = ()
        self._optimizer: ForceOptimizer | None = None

    def __call__(self, question: Question) -> Answer:
        """The answer; every error of the project is one, in words."""
        try:
            grasp = Grasp.from_contacts(question.positions, question.normals, question.friction)
        except GraspError as error:
            return _nothing(question, "no grasp", f"{error}")
        advice = tuple(advise(grasp))
        try:
            optimizer = self._ready(grasp, question)
            solution, seconds = _timed(optimizer, question.wrench)
        except InfeasibleWrenchError as error:
            twist = _scaled(error.solution.certificate, grasp)
            words = f"{_separates(twist, grasp)} {_mend(question)}"
            return replace(_nothing(question, "cannot be held", words), twist=twist, advice=advice)
        except GraspError as error:
            self._optimizer = None
            return replace(_nothing(question, "not solved", _first_sentence(error)), advice=advice)
        return _told(question, grasp, solution, 1e6 * seconds, advice)

    def _ready(self, grasp: Grasp, question: Question) -> ForceOptimizer:
        """The optimizer of the last question, moved to these contacts, or a new one where more than contacts changed."""
        limited = math.isfinite(question.max_normal)
        start = None if question.method in STARTLESS else question.start
        settings = (question.method, start, question.barrier_weight, question.max_normal, grasp.n_contacts)
        if self._optimizer is None or settings != self._settings:
            self._optimizer = None
            self._optimizer = ForceOptimizer(
                grasp, method=question.method, initial=None if start is None else self._named(start),
                barrier_weight=question.barrier_weight, limits=ForceLimits(max_normal=question.max_normal) if limited else None,
                elastic=limited, max_iterations=5000,
            )  # fmt: skip
            self._settings = settings
        elif not _same(self._optimizer.grasp, grasp):
            self._optimizer.move_to(grasp)
        if start == "previous" and self._optimizer.previous is None:  # there is none yet: the paper's start, once
            self._optimizer.solve(question.wrench, initial="linear_combination")
        return self._optimizer

    def _named(self, start: str) -> str | InitialForceRule:
        if start not in self._rules:
            self._rules[start] = self._rule(start)
        return self._rules[start]


def _same(one: Grasp, other: Grasp) -> bool:
    return np.array_equal(one.matrix, other.matrix) and np.array_equal(one.friction, other.friction)


def _timed(optimizer: ForceOptimizer, wrench: Array) -> tuple[ForceSolution, float]:
    """The solution, and the median time of a few solves that all start alike [s]."""
    before, solution = optimizer.previous, None
    times: list[float] = []
    while len(times) < _REPEATS and sum(times) < _MOST_TIME:
        optimizer.previous = before
        begin = time.perf_counter()
        solution = optimizer.solve(wrench)
        times.append(time.perf_counter() - begin)
    assert solution is not None
    return solution, float(np.median(times))


def _told(question: Question, grasp: Grasp, solution: ForceSolution, microseconds: float, advice: tuple[str, ...]) -> Answer:  # fmt: skip
    force = solution.force
    margins = grasp.cone_margins(force)
    mood, status, words = Mood.GOOD, "held", "The fingers balance the load, every force inside its friction cone."
    if solution.status is Status.LIMITS_EXCEEDED:
        mood, status = Mood.BAD, "beyond the limit"
        most = float(force[:, 0].max())
        words = (
            f"No force within {question.max_normal:.3g} N a contact balances this load; the gentlest needs {most:.3g} N, "
            f"{100.0 * solution.limit_excess:.3g} % more. Lower the load, raise the limit, add friction or a contact."
        )
    elif solution.status is not Status.OPTIMAL:
        mood, status, words = Mood.WARNING, "held, not optimal", solution.status.help
    return Answer(
        mood, status, words, grasp.to_object_frame(force), force[:, 0].copy(), margins, solution.iterations,
        solution.optimality_gap, solution.objective, solution.lower_bound, microseconds, None, advice,
    )  # fmt: skip


def _nothing(question: Question, status: str, words: str) -> Answer:
    count = len(question.positions)
    return Answer(Mood.BAD, status, words, np.zeros((count, 3)), np.zeros(count), np.zeros(count))


def _first_sentence(error: GraspError) -> str:
    text = str(error)
    return text[:1].upper() + text[1:]


def _scaled(twist: Array, grasp: Grasp) -> Array:
    """The twist with a speed of 1 at the grasp's length from the contacts' centre."""
    away = twist[:3] + np.cross(twist[3:], grasp.centre)
    return twist / max(float(np.hypot(np.linalg.norm(away), grasp.length * np.linalg.norm(twist[3:]))), 1e-12)


def screw(twist: Array, centre: Array) -> tuple[Array, Array, float, float]:
    """A twist as a screw.

    Args:
        twist: (6,) velocity of the origin [m/s] and angular velocity [rad/s].
        centre: (3,) [m], which the returned point is near.

    Returns:
        Point of the axis nearest to `centre` [m], (3,); its unit direction, (3,); the turning about it [rad/s] >= 0; the sliding along it [m/s].

    Example:
        >>> point, axis, turns, slides = screw(np.array([0.0, 0.0, 0.5, 0.0, 0.0, 2.0]), np.zeros(3))
        >>> axis, turns, slides
        (array([0., 0., 1.]), 2.0, 0.5)
    """
    at, turning = twist[:3] + np.cross(twist[3:], centre), float(np.linalg.norm(twist[3:]))
    if turning < 1e-9:
        speed = float(np.linalg.norm(at))
        return centre.copy(), at / max(speed, 1e-12), 0.0, speed
    axis = twist[3:] / turning
    return centre + np.cross(twist[3:], at) / turning**2, axis, turning, float(axis @ at)


def _separates(twist: Array, grasp: Grasp) -> str:
    """What the certificate proves, in words."""
    _, axis, turning, sliding = screw(twist, grasp.centre)
    direction = "(" + ", ".join(f"{value + 0.0:.2f}" for value in axis) + ")"
    turns, slides = turning * grasp.length > 0.05, abs(sliding) > 0.05
    if not turns:
        motion = f"pushes the object along {direction}"
    else:
        motion = f"turns the object about {direction}{' and pushes it along that axis' if slides else ''}"
    return f"The load {motion} (the red screw), and no finger inside its friction cone can push against that."


def _mend(question: Question) -> str:
    """What would hold the object: the least friction that does, or other contacts."""

    def holds(friction: float) -> bool:
        try:
            grasp = Grasp.from_contacts(question.positions, question.normals, friction)
            ForceOptimizer(grasp, method="conic").solve(question.wrench)
        except GraspError:
            return False
        return True

    low, high = question.friction, _HIGHEST_FRICTION
    if low >= high or not holds(high):
        return "More friction alone does not help: drag a contact to the side that the object escapes to."
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if holds(middle) else (middle, high)
    return f"Friction {high:.2f} would hold it; or drag a contact to the side that the object escapes to."
