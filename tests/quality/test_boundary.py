"""Wrenches at the boundary of what contacts can balance: one rule for Newton, conic, batches and
`feasibility`.

Within 1e-9 of the wrench, in the unit frame, the answer is a force that balances it to that
accuracy; beyond, a proof with v . w > 0. A sample always, 10,000 problems under `slow`;
GRASP_TRIAL_SEED gives those another seed.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from force.clarabel_reference import Reference

from grasp_env.errors import GraspError, InfeasibleWrenchError
from grasp_env.force import (
    ForceLimits,
    ForceOptimizer,
    ForceSolution,
    Status,
    optimize_force,
    optimize_forces,
)
from grasp_env.force.record import INFEASIBLE
from grasp_env.grasp import Grasp
from grasp_env.quality import feasibility, force_closure

pytest.importorskip("clarabel")

SEED = int(os.environ.get("GRASP_TRIAL_SEED", "20261128"))
BAND = 1e-9
"""Half width of the boundary, as a fraction of the wrench."""
STEPS = (1e-15, 1e-13, 1e-11, 1e-10, 3e-10, 1e-9, 3e-9, 1e-8, 1e-6, 1e-4)
"""Distances from the boundary that was found, in units of a wrench that crosses it."""
CLEAR = 1e-6
"""Step from which Clarabel's verdict is compared: it knows the boundary to a hundredth of that."""
METHODS: dict[str, dict[str, Any]] = {
    "newton": {},
    "sum": {"method": "conic"},
    "max": {"method": "conic", "criterion": "max"},
}
Generator = np.random.Generator
Array = np.ndarray


def grasp_without_closure(rng: Generator) -> Grasp | None:
    """Contacts that push one way, into half of space, along axes, or anywhere; None: rank lost, or
    force closure."""
    kind = str(
        rng.choice(
            ["hard", "elliptic", "soft", "mixed", "frictionless"], p=[0.45, 0.15, 0.15, 0.15, 0.1]
        )
    )
    count = int(rng.integers(6, 9) if kind == "frictionless" else rng.integers(3, 9))
    size = 10.0 ** rng.uniform(-2.0, 0.0)
    points = size * rng.uniform(-1.0, 1.0, (count, 3))
    normals = rng.standard_normal((count, 3))
    shape = str(rng.choice(["palm", "half", "axes", "any"]))
    if shape == "palm":
        points[:, 2] *= 0.1
        normals = np.tile([0.0, 0.0, 1.0], (count, 1)) + 0.3 * normals * (kind == "frictionless")
    elif shape == "half":
        normals[:, 2] = np.abs(normals[:, 2]) + 0.3
    elif shape == "axes":
        normals = np.eye(3)[rng.integers(0, 3, count)]
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    friction = (
        rng.uniform(0.2, 1.0, (count, 2))
        if kind in ("elliptic", "mixed")
        else rng.uniform(0.2, 1.0, count)
    )
    names = {"mixed": list(rng.choice(["hard", "soft", "frictionless"], count)), "elliptic": "hard"}
    gamma = size * 10.0 ** rng.uniform(-2.0, 0.0, count)
    try:
        made = Grasp.from_contacts(
            points, normals, friction, contact_model=names.get(kind, kind), torsional_friction=gamma
        )
        return None if force_closure(made) else made
    except GraspError:
        return None


def across(rng: Generator, grasp: Grasp) -> tuple[Array, Array] | None:
    """A wrench at the boundary and a step out of it, of its size; None: the step stays inside."""
    reference = Reference(grasp)
    count = grasp.n_contacts
    force = np.zeros((count, 4))
    force[:, 0] = rng.uniform(0.0, 1.0, count)
    force[:, 1:3] = 0.6 * force[:, :1] * reference.mu * rng.uniform(-1.0, 1.0, (count, 2))
    force[:, 3] = 0.8 * force[:, 0] * reference.gamma * rng.uniform(-1.0, 1.0, count)
    inside = -grasp.wrench(force[:, :3], force[:, 3])
    step = np.abs(inside[:3]).max() * rng.standard_normal(6) * np.repeat([1.0, grasp.length], 3)
    if not reference.margin(inside + step) < -1e-5:
        return None
    low, high = 0.0, 1.0
    while high - low > 1e-15:
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        low, high = (
            (middle, high) if feasibility(grasp, inside + middle * step).feasible else (low, middle)
        )
    scale = 10.0 ** rng.uniform(-2.0, 3.0)
    return scale * (inside + low * step), scale * step


def verdict(call: Callable[[], Any]) -> tuple[str, ForceSolution | None]:
    try:
        found = call()
    except InfeasibleWrenchError as error:
        return "proof", error.solution
    except GraspError as error:
        return type(error).__name__, None
    return "force", found


def fault(reference: Reference, wrench: Array, found: ForceSolution) -> str:
    """Return the first fault of a force or a proof, and "" if there is none."""
    load = float(np.abs(reference.load(wrench)).max())
    most = float(np.abs(found.force).max())
    if found.status is Status.INFEASIBLE:
        twist, prices = found.certificate, found.limit_multipliers
        assert twist is not None
        if not twist @ wrench - (prices @ reference.bound if len(prices) else 0.0) > 0.0:
            return "a proof that is not positive"
        return "" if reference.proof(twist, wrench, prices) >= -1e-6 else "no proof"
    if (
        reference.residual(found.force, found.torsion, wrench)
        > 1.001 * BAND * max(load, min(most, 1.0)) + 1e-13 * most
    ):
        return "no balance"
    return (
        "outside"
        if reference.violation(found.force, found.torsion) > 1e-13 * max(most, load)
        else ""
    )


def trial(seed: int, problems: int) -> tuple[Counter[str], list[str]]:
    """Number of each verdict, and the problems on which methods disagree or an answer is wrong."""
    counts = Counter()
    notes = []
    index = 0
    while counts["problems"] < problems:
        rng = np.random.default_rng([seed, index])
        index = index + 1
        grasp = grasp_without_closure(rng)
        found = None if grasp is None else across(rng, grasp)
        if grasp is None or found is None:
            continue
        edge, step = found
        parts = np.array([0.0, *(sign * part for part in STEPS for sign in (1.0, -1.0))])
        wrenches = edge + parts[:, None] * step
        limits = (
            ForceLimits(max_normal=1e5 * float(np.abs(edge[:3]).max()))
            if rng.random() < 0.15
            else None
        )
        reference = Reference(grasp, limits)
        batches = [
            optimize_forces(grasp, wrenches, limits=limits, **options)
            for options in METHODS.values()
        ]
        batches += [] if limits else [optimize_forces([grasp] * len(wrenches), wrenches)]
        for k, (part, wrench) in enumerate(zip(parts, wrenches, strict=True)):
            said = {"feasibility": verdict(partial(feasibility, grasp, wrench, limits))[0]}
            if said["feasibility"] == "force" and not feasibility(grasp, wrench, limits).feasible:
                said["feasibility"] = "proof"
            for name, options in METHODS.items():
                said[name], answer = verdict(
                    partial(optimize_force, grasp, wrench, limits=limits, **options)
                )
                if answer is None:
                    continue
                counts[f"{name} {answer.status.value}"] += 1
                if why := fault(reference, wrench, answer):
                    notes.append(f"seed {seed}, grasp {index - 1}, {part:g}, {name}: {why}")
            said |= {
                f"batch {b}": "proof" if batch.codes[k] == INFEASIBLE else "force"
                for b, batch in enumerate(batches)
            }
            counts["problems"] += 1
            if len(set(said.values())) > 1 or not set(said.values()) <= {"force", "proof"}:
                notes.append(f"seed {seed}, grasp {index - 1}, {part:g}: {said}")
            elif abs(part) >= CLEAR and said["sum"] != ("proof" if part > 0.0 else "force"):
                notes.append(f"seed {seed}, grasp {index - 1}, {part:g}: all say {said['sum']}")
    return counts, notes


@pytest.mark.parametrize("problems", [400, pytest.param(10_000, marks=pytest.mark.slow)])
def test_all_methods_agree(problems):
    counts, notes = trial(SEED, problems)
    print("\n".join(notes[:50]), *sorted(counts.items()), sep="\n")
    assert not notes
    for name in METHODS:
        assert counts[f"{name} optimal"] > problems / 3
        assert counts[f"{name} infeasible"] > problems / 3
    # at a depth of 1e-9 Phi has few digits left
    assert counts["newton stalled"] <= 0.02 * problems
    assert counts["sum stalled"] + counts["max stalled"] <= 0.002 * problems


def test_a_load_over_the_edge_of_its_supports():
    """A weight above the line between two supports, a nanometre inside or outside, is held; a
    micrometre outside it is not."""
    supports = np.array([[0.05, 0.0, 0.0], [-0.05, 0.05, 0.0], [-0.05, -0.05, 0.0]])
    tray = Grasp.from_contacts(supports, [[0.0, 0.0, 1.0]] * 3, 0.5)
    for beyond in (-1e-6, -1e-12, 0.0, 1e-12):
        weight = np.array([0.0, 0.0, -5.0, 0.0, -5.0 * (0.05 + beyond), 0.0])
        for options in METHODS.values():
            found = optimize_force(tray, weight, **options)
            assert found.status is Status.OPTIMAL
            assert found.equilibrium_residual <= BAND * 5.0
            assert found.force[:, 0].sum() == pytest.approx(5.0, rel=1e-6)
    for options in METHODS.values():
        with pytest.raises(InfeasibleWrenchError) as caught:
            optimize_force(tray, [0.0, 0.0, -5.0, 0.0, -5.0 * (0.05 + 1e-6), 0.0], **options)
        assert caught.value.solution.certificate @ caught.value.solution.wrench > 0.0


@pytest.mark.parametrize("most", [0, 1, 3, 10, 30, 100])
@pytest.mark.parametrize("name", METHODS)
def test_the_largest_number_of_steps_holds_at_the_boundary(name, most):
    """For the search from a carried start, its replacement, and the optimum just inside together."""
    supports = np.array(
        [[0.05, 0.0, 0.0], [-0.05, 0.05, 0.0], [-0.05, -0.05, 0.0], [-0.06, 0.01, 0.01]]
    )
    tray = Grasp.from_contacts(supports, [[0.0, 0.0, 1.0]] * 4, 0.5)
    for start in (None, "previous") if name == "newton" else (None,):
        optimizer = ForceOptimizer(tray, max_iterations=most, initial=start, **METHODS[name])
        for beyond in (-1e-3, -1e-9, -1e-12, 0.0, 1e-12):
            status, found = verdict(
                partial(
                    optimizer.solve, np.array([0.0, 0.0, -5.0, 0.0, -5.0 * (0.05 + beyond), 0.0])
                )
            )
            assert status in ("force", "NotConvergedError")
            assert found is None or found.iterations <= most
