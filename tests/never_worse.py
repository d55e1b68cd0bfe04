"""Counts learned starts with more Phi than the start that they replace: python tests/never_worse.py --wrenches 10000000

Wrenches of 1e-4 to 1e4 N, friction from below the trained range to above it, every method's own start: Newton's internal force and the
flow's 12-basis. Phi is what the methods themselves have for the two starts; worse is what rounding of its sum does not explain.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[1])]

from grasp_env.force import optimize_forces
from grasp_env.grasp import Grasp, presets, wrench
from policies import LearnedInitialForce

OWN = {"newton": "internal_force", "reduced_flow": "linear_combination"}
"""Where a method starts that is told nothing."""
CHUNK = 50_000
FRICTIONS = (0.2, 0.7)
ROUNDING = 1e-15
"""Relative: four units of the last digit. The flow sums Phi in another order than the comparison within a call, which has no tolerance."""


def violations(rule: LearnedInitialForce, grasp: Grasp, wrenches: np.ndarray, method: str) -> np.ndarray:
    """Which of the starts (B,) have more Phi than the method's own."""
    starts, own = (
        optimize_forces(grasp, wrenches, method=method, initial=initial, max_iterations=0, tolerance=1e-13)
        for initial in (rule, OWN[method])
    )
    return ~(starts.objective <= own.objective * (1.0 + ROUNDING))


def trial(rule: LearnedInitialForce, count: int, seed: int, method: str, progress: bool = False) -> int:
    """How many of `count` wrenches have a start that is worse."""
    rng, found = np.random.default_rng(seed), 0
    for begin in range(0, count, CHUNK):
        grasp = presets.paper_cuboid().with_friction(float(rng.uniform(*FRICTIONS)))
        wrenches = wrench.sample_magnitudes(rng, min(CHUNK, count - begin), 1e-4, 1e4)
        found += int(violations(rule, grasp, wrenches, method).sum())
        if progress and begin // CHUNK % 20 == 19:
            print(f"{method}: {begin + CHUNK} wrenches, {found} worse", flush=True)
    return found


def main() -> None:
    """Prints how many starts of each method are worse."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--wrenches", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--model", type=Path, help="of a fit (default: the shipped one)")
    given = parser.parse_args()
    rule = LearnedInitialForce.load(given.model) if given.model else LearnedInitialForce.pretrained()
    for method, own in OWN.items():
        found = trial(rule, given.wrenches, given.seed, method, progress=True)
        print(f"{method}, against {own}: {found} violations in {given.wrenches} wrenches")


if __name__ == "__main__":
    main()
