"""The control loop of controller.cpp through the Python package: `python controller.py [TICKS]`; without TICKS at 1 kHz, 5 s.

Four fingers hold a cuboid that is turned, their contacts roll a little, one is lost and comes back, twelve joints have limits.
Beside it, how fast a learned start answers what is far from the last wrench.
"""

from __future__ import annotations

import sys
import time
from bisect import bisect_left
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from grasp_env.errors import NotConvergedError
from grasp_env.force import ForceLimits, ForceOptimizer, ForcePipeline, Status
from grasp_env.grasp import Grasp, presets
from policies import LearnedInitialForce

GRASP, LOST = presets.paper_cuboid(), 3  # a thumb below, three fingers above; which contact is lost
TORQUE, WEIGHT = 0.4, 6.0  # [N m], [N]
# of one finger: joint speeds -> velocity of its contact point, contact frame [m]; what its weight asks of the joints [N m]
LEVERS, BIAS = np.array([[0.06, 0.05, 0.03], [0.01, -0.02, -0.03], [0.05, 0.0, 0.0]]), np.array([0.02, 0.01, 0.005])


class Latency:
    """Microseconds of one kind of call."""

    def __init__(self, of: str) -> None:
        self.of, self.all = of, list[float]()

    def __call__(self, call: Callable[..., Any], *given: Any) -> Any:
        """What the call answers."""
        begin = time.perf_counter_ns()
        answer = call(*given)
        self.all.append((time.perf_counter_ns() - begin) / 1e3)
        return answer

    def print(self) -> None:
        """Median, tail and bars."""
        self.all.sort()
        count, parts = len(self.all), [self.all[int(p * (len(self.all) - 1))] for p in (0.5, 0.99, 0.999, 1.0)]
        print("\n{}: {} calls, median {:.2f} us, p99 {:.2f}, p99.9 {:.2f}, max {:.2f}".format(self.of, count, *parts))
        low, high = 0.0, 0.25
        while low < parts[-1]:
            if (inside := bisect_left(self.all, high) - bisect_left(self.all, low)) > 0:
                print(f"{high:8.2f} us |{'#' * (1 + 50 * inside // count)} {inside}")
            low, high = high, 2.0 * high


def world(seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Contact points, inward normals and wrench at a time."""
    phase = 6.0 * seconds + np.arange(4)
    tilt = 0.01 * np.sin(phase)  # rolling: a millimetre, a hundredth of a radian
    points = GRASP.positions + 0.001 * np.column_stack([np.sin(phase), np.cos(phase), np.zeros(4)])
    normals = np.column_stack([np.sin(tilt), np.zeros(4), GRASP.normals[:, 2] * np.cos(tilt)])
    turn = 2.0 * seconds  # the object's weight, as it turns; it hangs a little off its middle
    force = WEIGHT * np.array([0.5 * np.sin(turn), 0.3 * np.cos(turn), -np.cos(0.5 * turn)])
    return points, normals, np.array([*force, 0.01 * force[1], -0.01 * force[0], 0.02 * np.sin(turn)])


class Hand:
    """The solvers of the first `count` contacts."""

    def __init__(self, count: int) -> None:
        self.count = count
        grasp = Grasp.from_contacts(GRASP.positions[:count], GRASP.normals[:count], 0.4)
        jacobian = np.zeros((count, 3, 3 * count))
        for i in range(count):
            jacobian[i, :, 3 * i : 3 * i + 3] = LEVERS
        limits = ForceLimits(jacobian=jacobian, torque_limit=TORQUE, torque_bias=np.tile(BIAS, count))
        self.free = ForcePipeline(grasp, method="newton", initial="previous")
        self.limited = ForceOptimizer(grasp, method="newton", initial="previous", limits=limits, elastic=True)

    def within_limits(self, points: np.ndarray, normals: np.ndarray, wrench: np.ndarray) -> Any:
        """From the last solution, on the contacts of now."""
        self.limited.move_to(Grasp.unchecked(points, normals, self.limited.grasp.models))
        return self.limited.solve(wrench)


def main() -> None:
    """Runs the loop."""
    paced = len(sys.argv) < 2
    ticks = 5000 if paced else int(sys.argv[1])
    hands = {count: Hand(count) for count in (len(GRASP.positions), LOST)}
    learned = ForceOptimizer(GRASP, method="newton", initial=LearnedInitialForce.pretrained("four_finger"))
    free, limited, far = map(Latency, ("Newton, moving contacts", "Newton within torque limits", "learned start"))
    before, exceeded, unsolved, proven = hands[4], 0, 0, 0
    begin = time.perf_counter()
    for tick in range(ticks):
        points, normals, wrench = world(1e-3 * tick)
        hand = hands[LOST if 400 <= tick % 1000 < 600 else 4]
        now = points[: hand.count], normals[: hand.count], wrench
        if hand is not before:  # what was held then is not held now
            hand.limited.previous = None
            hand.free.reset()
        before = hand

        unsolved += free(hand.free.solve, *now).status is not Status.OPTIMAL
        kept = None
        with suppress(NotConvergedError):
            kept = limited(hand.within_limits, *now)
        # the joints get tau = J^T f + bias; where no force keeps the limits it is the one least beyond them
        exceeded += kept is not None and kept.limit_excess > 0.0
        unsolved += kept is None
        knock = np.array([5.0 * np.cos(7.0 * tick), 5.0 * np.sin(11.0 * tick), wrench[2], 0.0, 0.0, 0.1])
        proven += far(learned.solve, knock).status is Status.OPTIMAL
        if paced:
            time.sleep(max(0.0, begin + 1e-3 * (tick + 1) - time.perf_counter()))
    print(f"{ticks} ticks: {exceeded} beyond torque limits, {unsolved} unsolved, {proven} knocks answered")
    for latency in (free, limited, far):
        latency.print()


if __name__ == "__main__":
    main()
