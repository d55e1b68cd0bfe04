"""Hard problems and a trial of the solvers on them: python tests/force/hard_problems.py --seed 7 --problems 10000 --method newton

Contacts clustered, in a plane, with nearly parallel normals, hardly closed, slippery or sticky; of 1 mm to 10 m away from the origin;
wrenches of 1e-6 to 1e5 N; weights over decades. Every problem is one seed's, so that a seed nobody has seen is a blind trial. The
answers are held against Clarabel's, and against what can be computed from the force alone.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

from force.clarabel_reference import Reference, _run, own_error

from grasp_env.errors import (
    GraspError,
    InfeasibleWrenchError,
    InvalidInputError,
    RankDeficientGraspError,
)
from grasp_env.force import Objective, Status, optimize_force
from grasp_env.grasp import Grasp

Array = np.ndarray
TROUBLES = ("plain", "clustered", "flat", "parallel", "edge", "friction")
MODELS = ("hard", "elliptic", "frictionless", "soft", "mixed")
METHODS = {"newton": {"method": "newton"}, "sum": {"method": "conic"}, "max": {"method": "conic", "criterion": "max"}}
FAR = 1e-3
"""An objective this much above the least is far from it, relative."""
SURE = 1e-4
"""Clarabel's own relative error (`own_error`) up to which it is believed."""
EDGE = 1e-6
"""The margin, of forces that sum to one, from which a wrench counts as feasible."""
BALANCE = 1e-8
"""What an optimal force may miss of balance, relative to wrench and forces up to 1 N."""


@dataclass(frozen=True)
class Problem:
    """A grasp, a wrench and the weights of Phi; what makes it hard."""

    trouble: str
    model: str
    grasp: Grasp
    wrench: Array
    weights: tuple[float, float]


def problem(seed: int, index: int) -> Problem:
    """The problem of that number of a seed."""
    rng = np.random.default_rng([seed, index])
    while True:
        trouble, model = str(rng.choice(TROUBLES)), str(rng.choice(MODELS, p=(0.4, 0.2, 0.05, 0.25, 0.1)))
        with suppress(RankDeficientGraspError, InvalidInputError):  # contacts on one line, or out of range: another
            grasp = hard_grasp(rng, trouble, model)
            size = 10.0 ** rng.uniform(-6.0, 5.0)
            force = rng.standard_normal(3) * (rng.random() < 0.9)
            moment = grasp.length * rng.choice([0.0, 1e-3, 1.0], p=(0.3, 0.2, 0.5)) * rng.standard_normal(3)
            middle = grasp.positions.mean(axis=0)
            wrench = size * np.concatenate([force, moment + np.cross(middle, force)])
            weights = (1.0, 0.01) if rng.random() < 0.5 else (10.0 ** rng.uniform(-4, 4), 10.0 ** rng.uniform(-8, 4))
            return Problem(trouble, model, grasp, wrench, weights)


def hard_grasp(rng: np.random.Generator, trouble: str, model: str) -> Grasp:
    """Contacts on an ellipsoid or a box, 3 to 50 of them, mostly few, made hard."""
    count = int(min(50, (9 if model == "frictionless" else 3) + rng.geometric(0.2) - 1 + 40 * (rng.random() < 0.02)))
    axes = rng.uniform(0.4, 1.0, 3)
    if trouble == "flat":
        axes[2] = 10.0 ** rng.uniform(-6.0, -2.0)
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points = directions * axes
    normals = -directions / axes if trouble != "flat" else -directions * (1.0, 1.0, 0.01)
    if trouble == "parallel":  # two faces and what tilts them apart
        normals = np.where(directions[:, 2:] > 0.0, -1.0, 1.0) * (0.0, 0.0, 1.0)
        normals = normals + 10.0 ** rng.uniform(-6.0, -1.0) * rng.standard_normal((count, 3))
    if trouble == "clustered":
        groups, apart = int(rng.integers(1, 4)), 10.0 ** rng.uniform(-6.0, -3.0)
        of = rng.integers(0, groups, count)
        points = points[of] + apart * rng.standard_normal((count, 3))
        normals = normals[of if rng.random() < 0.5 else np.arange(count)] + apart * rng.standard_normal((count, 3))
    normals += 0.05 * rng.standard_normal((count, 3)) * (trouble in ("plain", "flat"))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    size = 10.0 ** rng.uniform(-3.0, 1.0)
    shape = (count, 2) if model in ("elliptic", "mixed") else count
    friction = 10.0 ** rng.uniform(-3.0, 1.0, shape) if trouble == "friction" else rng.uniform(0.2, 1.2, shape)
    names = {"mixed": list(rng.choice(["hard", "soft", "frictionless"], count)), "elliptic": "hard"}
    points = size * (points + rng.choice([0.0, 1.0, 10.0]) * rng.standard_normal(3))
    torsional = size * 10.0 ** rng.uniform(-4.0, 0.0, count)

    def made(part: float) -> Grasp:
        return Grasp.from_contacts(
            points, normals, part * friction, contact_model=names.get(model, model), torsional_friction=torsional
        )

    if trouble != "edge" or model == "frictionless":
        return made(1.0)
    low, high = 1e-3, 10.0  # friction a little above that of which no wrench is safe
    for _ in range(20):
        middle = np.sqrt(low * high)
        low, high = (low, middle) if Reference(made(middle)).margin(np.zeros(6)) > 1e-9 else (middle, high)
    return made(high * (1.0 + 10.0 ** rng.uniform(-6.0, -1.0)))


def least_phi(reference: Reference, wrench: Array, weights: tuple[float, float]) -> tuple[float, float]:
    """(min Phi, Clarabel's own relative error; inf: unsolved): 1/u + 2u/(u^2 - s^2), soft: + 2u/(u^2 - v^2), as second-order cones.

    2u/(u^2 - s^2) <= y where u (u - z) >= s^2 and y z >= 2.
    """
    clarabel = import_module("clarabel")
    count, (omega, lam) = reference.count, weights
    load = reference.load(wrench)
    unit = max(float(np.abs(load).max()), np.sqrt(lam / omega))  # forces are about that, and Phi omega times it
    share = lam / (omega * unit**2)
    mu = np.where(reference.mu[:, 0] > 0.0, np.sqrt(reference.mu.prod(axis=1)), 1.0)
    soft = np.flatnonzero(reference.gamma > 0.0)
    # variables: (n, o, t, tau) of each contact, then (r, y, z) of each, then (y, z) of soft ones
    width = 7 * count + 2 * len(soft)
    cost = np.zeros(width)
    cost[: 4 * count : 4] = 3.0 * mu
    fixed = np.flatnonzero(reference.transmits.reshape(-1) == 0.0)
    zero = np.zeros((6 + len(fixed), width))
    zero[:6, : 4 * count] = reference.matrix.reshape(6, -1)
    zero[np.arange(6, len(zero)), fixed] = 1.0
    blocks, right, cones = (
        [zero],
        [np.concatenate([-load / unit, np.zeros(len(fixed))])],
        [clarabel.ZeroConeT(len(zero))],
    )
    root = np.sqrt(share)

    def rotated(a: Array, b: Array, others: list[Array], constant: float = 0.0) -> None:
        """A b >= |others|^2 (+ constant^2)."""
        rows = [-(a + b), -(a - b), *(-2.0 * c for c in others)]
        offset = np.zeros(len(rows) + (constant > 0.0))
        if constant:
            rows.append(np.zeros(width))
            offset[-1] = 2.0 * constant
        blocks.append(np.array(rows))
        right.append(offset)
        cones.append(clarabel.SecondOrderConeT(len(rows)))

    unit_row = np.eye(width)
    for k in range(count):
        u, (r, y, z) = mu[k] * unit_row[4 * k], (unit_row[4 * count + 3 * k + a] for a in range(3))
        cost[4 * count + 3 * k] = cost[4 * count + 3 * k + 1] = root
        rotated(u, r, [], np.sqrt(root))
        tangential = (
            [mu[k] / reference.mu[k, a] * unit_row[4 * k + 1 + a] for a in range(2)] if reference.mu[k, 0] else []
        )
        rotated(u, u - z, tangential)
        rotated(y, z, [], np.sqrt(2.0 * root))
    for j, k in enumerate(soft):
        u, y, z = mu[k] * unit_row[4 * k], unit_row[7 * count + 2 * j], unit_row[7 * count + 2 * j + 1]
        cost[7 * count + 2 * j] = root
        rotated(u, u - z, [mu[k] / reference.gamma[k] * unit_row[4 * k + 3]])
        rotated(y, z, [], np.sqrt(2.0 * root))
    matrix, sides = np.vstack(blocks), np.concatenate(right)
    found = _run(cost, matrix, sides, cones, 1e-10)
    # almost solved, it may miss balance by 1e-6 of the wrench, which between contacts 1e-6 apart is worth a hundredth of Phi
    error = own_error(found, cost, matrix, sides) if str(found.status) == "Solved" else np.inf
    return omega * unit * found.obj_val, error


def outcome(p: Problem, method: str) -> str:
    """What came of a problem in one word or two; those of `WRONG` must not happen."""
    reference = Reference(p.grasp, None, p.grasp.frames[:, :, 1])
    options = dict(METHODS[method])
    if method == "newton":
        options.update(force_weight=p.weights[0], barrier_weight=p.weights[1])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = optimize_force(p.grasp, p.wrench, **options)
    except InfeasibleWrenchError:
        return "wrong: infeasible" if reference.margin(p.wrench) > EDGE else "infeasible"
    except GraspError as error:
        return "error" if not reference.margin(p.wrench) > EDGE else f"no answer: {type(error).__name__}"
    except RuntimeWarning:
        return "wrong: warning"
    if found.status is Status.INFEASIBLE:
        return "wrong: an answer that is none"
    size = float(np.abs(reference.load(p.wrench)).max())
    most = float(np.abs(found.force).max())
    # torsion is known to digits of its limit, and arms about the contacts' centre to those of how far away they are
    bearable = float((reference.gamma * found.force[:, 0]).max()) / reference.length
    away = float(np.abs(p.grasp.positions).max()) / reference.length
    rounding = 1e-13 * most + 4e-15 * bearable + 1e-15 * away * most
    if not np.isfinite(found.force).all():
        return "wrong: not finite"
    if found.cone_margin < 0.0 or reference.violation(found.force, found.torsion) > 1e-13 * most:
        return "wrong: outside a cone"
    residual = reference.residual(found.force, found.torsion, p.wrench)
    if found.status is Status.OPTIMAL and residual > BALANCE * max(size, min(most, 1.0)) + rounding:
        return "wrong: optimal without balance"
    if method == "newton":
        least, error = least_phi(reference, p.wrench, p.weights)
        value = phi(p, reference, found.force, found.torsion)
    else:
        best = reference.solve(p.wrench, method)
        least, error = best.objective, best.error if best.solved else np.inf
        normals = found.force[:, 0]
        value = float(normals.sum() if method == "sum" else normals.max())
    far = error < SURE and not abs(value - least) <= FAR * abs(least)
    if found.status is Status.OPTIMAL:
        return "wrong: optimal but far" if far else "optimal"
    return f"far: {found.status.value}" if far else f"near or unknown: {found.status.value}"


def phi(p: Problem, reference: Reference, force: Array, torsion: Array) -> float:
    """Phi of a force, soft contacts' terms included."""
    x = p.grasp.to_cone(force)
    value, u = Objective(*p.weights).value(x), x[0::3]
    soft = reference.gamma > 0.0
    v = u[soft] * torsion[soft] / (reference.gamma[soft] * force[soft, 0])
    return value + p.weights[1] * float((1.0 / (u[soft] - v) + 1.0 / (u[soft] + v)).sum())


def trial(seed: int, problems: int, method: str, first: int = 0) -> tuple[Counter[tuple[str, str]], list[str]]:
    """How often each (trouble, outcome) came, and which problems went wrong."""
    counts: Counter[tuple[str, str]] = Counter()
    notes: list[str] = []
    for index in range(first, first + problems):
        p = problem(seed, index)
        came = outcome(p, method)
        counts[p.trouble, came] += 1
        if came.startswith(("wrong", "far", "no answer")):
            notes.append(
                f"{method} seed {seed} problem {index}: {p.trouble}, {p.model}, {p.grasp.n_contacts} contacts: {came}"
            )
    return counts, notes


def main() -> None:
    """Prints how often what came."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--problems", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--method", choices=METHODS, default="newton")
    given = parser.parse_args()
    counts, notes = trial(given.seed, given.problems, given.method, given.first)
    print("\n".join(notes[:60]))
    for came in sorted({came for _, came in counts}):
        print(f"{came:40s}" + "".join(f"{trouble} {counts[trouble, came]:6d}  " for trouble in TROUBLES))


if __name__ == "__main__":
    main()
