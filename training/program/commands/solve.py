"""`grasp solve`: one grasp, one wrench."""

from __future__ import annotations

import math
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from grasp_env.errors import GraspError, GraspWarning, InvalidInputError
from grasp_env.force import ForceLimits, ForceSolution, Margin, optimize_force
from grasp_env.force.options import CRITERIA, METHODS
from grasp_env.force.rules import RULES
from grasp_env.grasp import Grasp, advise, load_grasp, save_grasp
from grasp_env.grasp.presets import PRESETS, preset
from grasp_env.grasp.wrench import PAPER_CONSTANT
from training.program.commands.answers import write_json
from training.program.commands.options import SIX, left_out, one_of
from training.program.commands.rules import rule
from training.program.commands.solution import numbers, print_solution


@dataclass(frozen=True)
class Solve:
    """Optimise one grasp force and print it.

    To use your own contacts, write a file to start from:
    `grasp solve --save-grasp my.json`

    Change positions [m], normals (INTO the object) and friction in it. Then:
    `grasp solve --grasp my.json --wrench 0 0 -5 0 0 0`

    Advice about contacts that look wrong goes to stderr.

    Attributes:
        wrench: external wrench on the object: force fx fy fz [N], moment mx my mz [N m] about the
            object frame's origin.
        preset: a named grasp.
        grasp: JSON file of a grasp instead of a preset.
        save_grasp: also write the grasp as such a file.
        friction: replaces the friction coefficient of the preset or the file.
        initial: start of the methods on Phi: internal_force, linear_combination (the paper's),
            single_value, lagrange, phase_one, "learned" for the shipped network, or the path of a
            fitted one.
        method: newton, reduced_flow and full_flow (the paper's) minimise Phi, conic the normal
            forces.
        criterion: objective of conic: the sum or the maximum of the normal forces.
        barrier_weight: lambda of Phi [N^2]: a larger one keeps further from slipping, and squeezes
            more; not for conic.
        tolerance: relative gap to the certified bound.
        margin: share of the friction that forces may use, 0.01 to 1: 0.9, 0.75 or 0.5 where the
            friction is known to 10, 25 or 50 %.
        preload: normal force of every contact that does not count for friction [N].
        min_normal: least normal force of every contact [N].
        max_normal: largest normal force of every contact [N].
        json: print one JSON object, errors too.
    """

    wrench: Annotated[
        tuple[float, ...] | None,
        SIX,
        left_out(f"of a preset {' '.join(f'{value:g}' for value in PAPER_CONSTANT)}"),
    ] = None
    preset: Annotated[str, one_of(PRESETS)] = "paper_cuboid"
    grasp: Annotated[Path | None, left_out("the preset", "FILE")] = None
    save_grasp: Annotated[Path | None, left_out("nothing is written", "FILE")] = None
    friction: Annotated[float | None, left_out("its own", "MU")] = None
    initial: Annotated[
        str | None, left_out("internal_force, of the flows linear_combination", "RULE|FILE")
    ] = None
    method: Annotated[str, one_of(METHODS)] = "newton"
    criterion: Annotated[str, one_of(CRITERIA)] = "sum"
    barrier_weight: Annotated[float | None, left_out("0.01", "FLOAT")] = None
    tolerance: Annotated[float | None, left_out("1e-4, of conic 1e-6", "GAP")] = None
    margin: float = 1.0
    preload: float = 0.0
    min_normal: float = 0.0
    max_normal: Annotated[float, left_out("no limit", "FLOAT")] = math.inf
    json: bool = False

    def execute(self) -> None:
        """Run the command."""
        grasp, title = self._grasp()
        wrench = self._wrench()
        title = f"{title}, wrench {' '.join(f'{value:g}' for value in wrench)}"
        if self.save_grasp is not None:
            sys.stderr.write(f"grasp: {save_grasp(grasp, self.save_grasp)} has the contacts\n")
        if self.initial == "previous":
            raise InvalidInputError(
                "a single solve has no previous solution: leave --initial out, or choose one of "
                f"'internal_force', {', '.join(map(repr, RULES))}, 'learned'; from solve to solve ForceOptimizer(grasp, initial='previous') remembers"
            )
        advice = advise(grasp)
        sys.stderr.writelines(f"grasp: look again: {text}\n" for text in advice)
        try:
            solution = self._solution(grasp, wrench)
            if not self.json:
                print_solution(solution, grasp, title)
            solution.raise_for_status()
        except GraspError as error:
            failed = getattr(error, "solution", None)
            facts = {"advice": advice} if failed is None else numbers(failed, grasp, advice)
            vars(error)["numbers"] = facts
            raise
        if self.json:
            write_json(numbers(solution, grasp, advice))

    def _grasp(self) -> tuple[Grasp, str]:
        if self.grasp is None:
            return preset(self.preset, self.friction), self.preset
        grasp = load_grasp(self.grasp)
        if self.friction is not None:
            grasp = grasp.with_friction(self.friction)
        return grasp, self.grasp.name

    def _wrench(self) -> tuple[float, ...]:
        """Return the external wrench; only presets have the paper's as default."""
        if self.wrench is None and self.grasp is not None:
            raise InvalidInputError(
                "--grasp needs --wrench FX FY FZ MX MY MZ, the external wrench on the object [N, N m]: for example its weight in the "
                "object frame, --wrench 0 0 -5 0 0 0"
            )
        return PAPER_CONSTANT if self.wrench is None else self.wrench

    def _solution(self, grasp: Grasp, wrench: tuple[float, ...]) -> ForceSolution:
        limits = None
        if (self.min_normal, self.max_normal) != (0.0, math.inf):
            limits = ForceLimits(min_normal=self.min_normal, max_normal=self.max_normal)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GraspWarning)  # `advise` has printed it
            return optimize_force(
                grasp,
                np.array(wrench),
                initial=None if self.initial is None else rule(self.initial),
                method=self.method,
                criterion=self.criterion,
                limits=limits,
                margin=Margin(self.margin, self.preload),
                barrier_weight=self.barrier_weight,
                tolerance=self.tolerance,
            )
