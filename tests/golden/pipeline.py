"""The control loop's compiled solves over contacts that move: smooth and in jumps, with adjustments, carried between solves."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from golden.record import Case, Outcome, Problem, named, of_solution

from grasp_env.control.solver import ContactSolver
from grasp_env.force import Objective
from grasp_env.grasp import Grasp, presets, wrench

PAPER = np.array(wrench.PAPER_CONSTANT)
BASIS = 5e-5
"""Part of the largest component to which starts are compared that are made of the 12-basis: the recorded one is certified to 1e-10 of
Phi, so its forces are known to a few times 1e-5."""


def wrenches(seed: int, count: int, size: float) -> np.ndarray:
    """(count, 6) random wrenches [N, N m]: one newton, and its moment at the size of a hand."""
    return size * np.repeat([1.0, 0.03], 3) * np.random.default_rng(seed).standard_normal((count, 6))


def _uneven(preset: Grasp, seed: int) -> Grasp:
    """Millimetres and degrees off the preset, friction unequal: no symmetry that would hide an error."""
    rng = np.random.default_rng(seed)
    normals = preset.normals + 0.03 * rng.standard_normal((preset.n_contacts, 3))
    return Grasp.from_contacts(
        preset.positions + 2e-3 * rng.standard_normal((preset.n_contacts, 3)),
        normals / np.linalg.norm(normals, axis=1)[:, None],
        preset.friction * rng.uniform(0.9, 1.3, preset.n_contacts),
    )


GRASPS = {
    "tripod": presets.tripod(),
    "cuboid": presets.paper_cuboid(),
    "5 uneven": _uneven(presets.five_finger_cuboid(), 5),
}


def problem_of(grasp: Grasp, load: np.ndarray, options: dict[str, Any]) -> Problem:
    """The problem that these options describe."""
    phi = Objective(options.get("force_weight", 1.0), options.get("barrier_weight", 0.01))
    return Problem(grasp, load, options.get("method", "reduced_flow"), options.get("tolerance", 1e-4), phi)


def pipeline_of(grasp: Grasp, **options: Any) -> ContactSolver:
    """With the defaults of the environment: the paper's start and flow."""
    given = {"initial": "linear_combination", "method": "reduced_flow", "force_weight": 1.0, "barrier_weight": 0.01}
    return ContactSolver(grasp, {**given, "tolerance": 1e-4, "max_iterations": 20_000, **options})


def path(grasp: Grasp, steps: int, size: tuple[float, float], smooth: bool) -> list[tuple[np.ndarray, np.ndarray]]:
    """Contact points [m] and normals of each step, off the nominal ones by about `size` [m], [1]."""
    rng, shape = np.random.default_rng(21), grasp.positions.shape
    if smooth:
        turns = np.linspace(0.0, 2.0 * np.pi, steps, endpoint=False)
        first, second = rng.standard_normal((2, 2, *shape))
        moves = [np.sin(a) * first + (1.0 - np.cos(a)) * second for a in turns]
    else:
        moves = list(rng.standard_normal((steps, 2, *shape)))
    out = []
    for off, turn in moves:
        normals = grasp.normals + size[1] * turn
        out.append((grasp.positions + size[0] * off, normals / np.linalg.norm(normals, axis=1)[:, None]))
    return out


def walk(name: str, size: tuple[float, float], smooth: bool, adjust: float = 0.0, **options: Any) -> list[Outcome]:
    """Twelve solves along a path, the last six after `reset`."""
    grasp = GRASPS[name]
    pipeline, rows = pipeline_of(grasp, **options), []
    cone_matrix = pipeline.core.arrays()["cone_matrix"]
    rng = np.random.default_rng(22)
    loads = PAPER + wrenches(23, 12, 0.3 if smooth else 1.0)
    for k, (points, normals) in enumerate(path(grasp, 12, size, smooth)):
        if k == 6:
            pipeline.reset()
        shift = adjust * rng.standard_normal(grasp.null_dimension) if adjust and k % 3 else None
        now = Grasp.from_contacts(points, normals, grasp.friction)
        problem = problem_of(now, loads[k], options)
        found = pipeline.solve(points, normals, loads[k], adjust=shift)
        rows.append(of_solution(found, problem))
        rows.append(Outcome("array", "frames", extra=pipeline.frames.reshape(-1).copy()))
        rows.append(Outcome("array", "cone_matrix", extra=cone_matrix.reshape(-1).copy()))
    return rows


def carried(name: str, jump: float) -> list[Outcome]:
    """`carry` after tight solves: contacts and wrench a little on, the wrench by `jump` of the paper's."""
    grasp, rows = GRASPS[name], []
    pipeline = pipeline_of(grasp, method="newton", tolerance=1e-12)
    for points, normals in path(grasp, 6, (1e-3, 0.02), True):
        pipeline.solve(points, normals, PAPER)
        force = np.empty((grasp.n_contacts, 3))
        code = pipeline.core.carry(points + 1e-5, normals, PAPER * (1.0 + jump), force)
        rows.append(Outcome("force", f"carry {code}", force=np.column_stack([force, np.zeros(len(force))])))
    return rows


SMALL, LARGE = (1e-3, 0.02), (4e-3, 0.1)


def cases() -> dict[str, Case]:
    """All of them."""
    out: list[Case] = []
    names = ("tripod", "cuboid", "5 uneven")
    for name, method, initial in product(names, ("reduced_flow", "newton"), ("linear_combination", "previous")):
        for label, size, smooth in (("smooth", SMALL, True), ("jumps", LARGE, False)):
            text, options = f"{method} from {initial}, {name}, {label}", {"method": method, "initial": initial}
            # the start is a function of the previous optimum, here known to 1e-4 of Phi, in the tight case to 1e-12
            start = np.inf if initial == "previous" else BASIS
            out.append(Case(text, lambda n=name, z=size, s=smooth, o=options: walk(n, z, s, **o), start=start))
            tight = {**options, "tolerance": 1e-12}
            out.append(
                Case(f"{text}, tight", lambda n=name, z=size, s=smooth, o=tight: walk(n, z, s, **o), True, BASIS)
            )
        text, options = f"{method} from {initial}, {name}, adjusted", {"method": method, "initial": initial, "tolerance": 1e-12}  # fmt: skip
        out.append(Case(text, lambda n=name, o=options: walk(n, SMALL, True, 2.0, **o), tight=True, start=BASIS))
    weights = {"force_weight": (1.0, 2.0, 0.5, 3.0), "barrier_weight": 0.1, "tolerance": 1e-12}
    out.append(Case("newton, unequal weights", lambda: walk("cuboid", SMALL, True, method="newton", **weights), True, BASIS))  # fmt: skip
    for name, jump in product(names, (0.0, 0.01, 20.0)):
        out.append(Case(f"carry, {name}, {jump:g}", lambda n=name, j=jump: carried(n, j)))
    return named(out)
