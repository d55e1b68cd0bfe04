"""`grasp solve`: one grasp, one wrench."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from grasp_env.errors import InfeasibleWrenchError
from grasp_env.force import ForceLimits, optimize_force
from grasp_env.grasp import load_grasp, presets
from grasp_env.grasp.advice import advise
from training.commands.rules import rule
from training.commands.solution import print_solution


@dataclass(frozen=True)
class Solve:
    """Optimise one grasp force and print it.

    Attributes:
        wrench: external wrench on the object: fx fy fz [N] mx my mz [N m].
        preset: the named grasp.
        grasp: a grasp's JSON file (positions, normals, friction, ...) instead of a preset.
        friction: replaces the preset's or the file's coefficient.
        initial: start rule, "learned" for the shipped network, or the path of a fitted one; of the methods on Phi.
        method: reduced_flow, full_flow, newton, conic or linear.
        criterion: what conic makes least, sum or max of the normal forces.
        barrier_weight: lambda [N^2].
        tolerance: relative gap; 0: the method's own (1e-4, conic 1e-6).
        min_normal, max_normal: limits of every normal force [N].
        json: print JSON for machines.
    """

    wrench: tuple[float, float, float, float, float, float] = (1.0, 0.5, -0.6, -0.1, 0.2, 0.0)
    preset: str = "paper_cuboid"
    grasp: Path | None = None
    friction: float | None = None
    initial: str | None = None
    method: str = "reduced_flow"
    criterion: str = "sum"
    barrier_weight: float = 0.01
    tolerance: float = 0.0
    min_normal: float = 0.0
    max_normal: float = math.inf
    json: bool = False

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        if self.grasp is None:
            grasp = presets.preset(self.preset, self.friction)
        else:
            grasp = load_grasp(self.grasp)
            grasp = grasp if self.friction is None else grasp.with_friction(self.friction)
        limited = (self.min_normal, self.max_normal) != (0.0, math.inf)
        try:
            solution = optimize_force(
                grasp,
                np.array(self.wrench),
                initial=None if self.initial is None else rule(self.initial),
                method=self.method,
                criterion=self.criterion,
                limits=ForceLimits(min_normal=self.min_normal, max_normal=self.max_normal) if limited else None,
                barrier_weight=self.barrier_weight,
                tolerance=self.tolerance or None,
            )
        except InfeasibleWrenchError:
            for advice in advise(grasp):
                sys.stderr.write(f"grasp: {advice}\n")
            raise
        title = self.preset if self.grasp is None else self.grasp.name
        print_solution(solution, grasp, title, self.json)
        solution.raise_for_status()
