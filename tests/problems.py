"""Named problems with known optima, random grasps, and linear programs that share no code with the
package."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy.optimize import linprog

from grasp_env.force.step_size import (
    AdaptiveStep,
    ArmijoStep,
    BarzilaiBorweinStep,
    ExactStep,
    FixedStep,
    StepRule,
)
from grasp_env.grasp import Grasp, presets, wrench

PAPER_WRENCH = np.array(wrench.PAPER_CONSTANT)
FACETS = 32


@dataclass(frozen=True)
class Problem:
    """A grasp, a wrench, the weights of Phi, min Phi (see `force/named.py`), and the known sum of
    the normal forces there [N]."""

    name: str
    grasp: Grasp
    wrench: np.ndarray
    force_weight: float
    barrier_weight: float
    optimum: float
    total_normal: float | None = None

    def __str__(self) -> str:
        return self.name


def uneven(preset: Grasp) -> Grasp:
    """The preset with its first finger moved by (1, 0.5, 2) mm: no symmetry that would hide an
    error."""
    positions = preset.positions.copy()
    positions[0] += (0.001, 0.0005, 0.002)
    return Grasp.from_contacts(positions, preset.normals, preset.friction)


GRASPS = {
    "tripod": presets.tripod(),
    "cuboid, 4": presets.paper_cuboid(),
    "cuboid, 5": presets.five_finger_cuboid(),
    "tripod, uneven": uneven(presets.tripod()),
    "cuboid, 5, uneven": uneven(presets.five_finger_cuboid()),
}
"""Grasps with force closure for every number of fingers that the paper allows."""

LIGHT = np.array([0.3, -0.2, 0.5, 0.01, -0.005, 0.008])
PAPER_FAMILIES = ("paper", "tripod", "five fingers")
"""Beginnings of the names of the paper's problems in the table of named problems."""


def _of_the_paper() -> Iterator[Problem]:
    """Hard contacts with one weight for all: what every method solves."""
    for entry in json.loads(
        (Path(__file__).parent / "force/problems.json").read_text(encoding="utf-8")
    ):
        if entry["name"].startswith(PAPER_FAMILIES):
            grasp = Grasp.from_contacts(entry["positions"], entry["normals"], entry["friction"])
            phi = {"force_weight": 1.0, "barrier_weight": 0.01} | entry.get("weights", {})
            best = entry["known"]["newton"]["objective"]
            known = {"optimum": best, "total_normal": entry.get("total_normal")}
            yield Problem(entry["name"], grasp, np.array(entry["wrench"]), **phi, **known)


PROBLEMS = tuple(_of_the_paper())
CONIC_LEAST = 8.58473
"""Least total normal force of the reference grasp under the paper's wrench, exact cones, no barrier
[N]."""


WEIGHTS = [(1.0, 0.01), (1.0, 1.0), (2.5, 0.3), (0.2, 1e-4)]
"""omega and lambda of Phi."""
OUTSIDE = ([1.0, 1.0, 0.0], [1.0, 0.8, 0.7], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 0.0])
"""Cone coordinates of one contact on its cone, outside, at the apex, and nan."""
STEP_RULES: dict[str, StepRule] = {
    "fixed": FixedStep(0.01),
    "armijo": ArmijoStep(),
    "adaptive": AdaptiveStep(),
    "short": BarzilaiBorweinStep(),
    "long": BarzilaiBorweinStep(variant="long"),
    "alternate": BarzilaiBorweinStep(variant="alternate"),
    "exact": ExactStep(),
    "rough": ExactStep(0.1),
}
"""Every step rule of the flows."""


def inside_cones(rng: np.random.Generator, count: int) -> np.ndarray:
    """Cone coordinates of `count` contacts, margins from 2 to 100 % of u, u over three decades."""
    u = np.exp(rng.uniform(-3.0, 3.0, count))
    s = u * rng.uniform(0.0, 0.98, count)
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    return np.stack([u, s * np.cos(angle), s * np.sin(angle)], axis=1).reshape(-1)


def random_grasp(rng: np.random.Generator, count: int, cap: float = -1.0) -> Grasp:
    """`count` contacts on an ellipsoid, friction 0.3 to 1; `cap`: least z of the direction to a
    contact."""
    axes = rng.uniform(0.03, 0.06, 3)
    directions: list[np.ndarray] = []
    while len(directions) < count:
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        if direction[2] >= cap:
            directions.append(direction)
    positions = np.array(directions) * axes
    normals = -positions / axes**2
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return Grasp.from_contacts(positions, normals, rng.uniform(0.3, 1.0, count))


@cache
def closure_grasps(number: int = 24, seed: int = 7) -> tuple[Grasp, ...]:
    """Random grasps of 3 to 7 contacts with force closure, judged by `pyramid_margin` and not by
    the package."""
    rng = np.random.default_rng(seed)
    grasps: list[Grasp] = []
    while len(grasps) < number:
        grasp = random_grasp(rng, 3 + len(grasps) % 5)
        # a tenth of the force as slack: far from losing closure, so that tolerances are about
        # rounding
        if pyramid_margin(grasp, np.zeros(6), inner=True, limited=True)[0] > 0.1:
            grasps.append(grasp)
    return tuple(grasps)


def pyramid_margin(
    grasp: Grasp, load: np.ndarray, inner: bool, limited: bool = False
) -> tuple[float, np.ndarray | None]:
    """(largest s <= 1, force): balance with pyramids of 32 facets in place of the cones, slack s on
    every facet.

    The inner pyramid lies inside its cone, the outer one contains it: s > 0 inside proves that a
    strictly feasible force exists; no s > 0 outside proves that none does. (-inf, None) when there
    is no force at all. `limited`: the mean of friction * normal is 1, so that s says how deep in
    the cones the best internal force lies.
    """
    count = grasp.n_contacts
    angles = 2.0 * np.pi * np.arange(FACETS) / FACETS
    apothem = np.cos(np.pi / FACETS) if inner else 1.0
    rows = np.zeros((FACETS * count, 3 * count + 1))
    for k in range(count):
        block = rows[FACETS * k : FACETS * (k + 1)]
        block[:, 3 * k] = -apothem * grasp.friction[k]
        block[:, 3 * k + 1] = np.cos(angles)
        block[:, 3 * k + 2] = np.sin(angles)
    rows[:, -1] = 1.0
    # moments by a length, for the solver's absolute tolerance
    scale = np.array([1.0, 1.0, 1.0] + [0.03] * 3)
    mean = np.append((np.array([1.0, 0.0, 0.0]) * grasp.friction[:, None]).reshape(-1) / count, 0.0)
    balance = np.vstack(
        [np.column_stack([grasp.matrix, np.zeros(6)]) / scale[:, None], *[mean] * limited]
    )
    equal = np.append(-load / scale, [1.0] * limited)
    bounds = [(None, None)] * (3 * count) + [(0.0, 1.0)]
    answer = linprog(
        -np.eye(3 * count + 1)[-1],
        rows,
        np.zeros(len(rows)),
        balance,
        equal,
        bounds,
        method="highs",
    )
    return (
        (float(answer.x[-1]), answer.x[:-1].reshape(-1, 3))
        if answer.status == 0
        else (-np.inf, None)
    )
