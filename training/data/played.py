"""Force problems that an environment's controller solves, as its start rule sees them."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from grasp_env import core
from grasp_env.config import EnvConfig
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import InvalidInputError
from grasp_env.force import Objective
from grasp_env.force.initial import LinearCombination
from grasp_env.grasp import Grasp
from grasp_env.inputs.arguments import Array, ContactForces, Wrench
from policies.controllers import RandomPolicy
from training.data.environment import environment
from training.data.episodes import episode

EPISODES, STEPS = 40, 100
"""Number of episodes, and of agent steps of each, from which a model learns its problems."""
FEWEST = 200
"""Least number of problems."""
FIRST_SEED = 2**29
"""First seed of these episodes, which are not those that score."""
ONE_GRASP = 3e-3
"""Deviation from their mean that 95 % of the contacts of one grasp do not exceed [m]."""
LEAST_SIZE = 0.01
"""Least norm of a wrench [N]; below it the optimum is nearly that without a wrench."""
WIDER = 1.05
"""Factor by which the range of the friction is widened."""


@dataclass
class Recorder:
    """Start rule: the paper's; it keeps the problems of all fingers.

    Attributes:
        objective: Phi.
        fingers: number of fingers in the hand.
        problems: pairs of grasp and wrench, without the margin.
    """

    objective: Objective
    fingers: int = 0
    problems: list[tuple[Grasp, Wrench]] = field(default_factory=list)

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """See `InitialForceRule`."""
        if grasp.n_contacts == self.fingers:
            self.problems.append((grasp, wrench))
        return LinearCombination(self.objective)(grasp, wrench)


@dataclass(frozen=True)
class Played:
    """Problems of an environment whose contacts are those of one grasp.

    Attributes:
        grasp: the mean contacts with the mean friction, within the margin.
        wrenches: (B, 6) wrenches to balance [N, N m], without the margin's preload.
        frictions: range of the mean friction within the margin.
        magnitudes: range of the wrenches' norm in the grasp's unit frame [N].
        objective: the environment's Phi.
        surface: surface of the object.
    """

    grasp: Grasp
    wrenches: Array
    frictions: tuple[float, float]
    magnitudes: tuple[float, float]
    objective: Objective
    surface: core.Surface


@cache
def played(text: str) -> Played:
    """Play episodes of an environment and return its problems.

    The solver is the reduced flow from the paper's start, and the agent asks for nothing; in the
    mode "grip" it sets random margins. An episode ends when the object is not held.

    Args:
        text: see `training.data.environment.environment`.

    Raises:
        InvalidInputError: the contacts are soft, fewer than three, held too briefly, or not those
            of one grasp.
    """
    given = environment(text)
    solver = given.solver
    objective = Objective(solver.force_weight, solver.barrier_weight)
    recorder = Recorder(objective)
    problems: list[tuple[Grasp, Wrench]] = []
    with closing(FourFingerGrasp(config=solving(given, recorder))) as env:
        recorder.fingers = env.scene.config.hand.finger_count
        policy = RandomPolicy(2) if given.action_mode == "grip" else None
        for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
            steps = episode(env, seed, policy, STEPS)
            recorder.problems.clear()  # of the hand that takes hold of the object
            for step in steps:
                if not step.info["is_success"]:
                    break
                problems += recorder.problems
                recorder.problems.clear()
    if len(problems) < FEWEST:
        raise InvalidInputError(
            f"a model learns from {FEWEST} problems with three and more hard contacts, episodes of this environment have {len(problems)}: "
            "weaken what disturbs the object if the hand loses it, or use a start without a model"
        )
    grasps, wrenches = zip(*problems, strict=True)
    positions, normals = (
        np.array([getattr(grasp, name) for grasp in grasps]) for name in ("positions", "normals")
    )
    middle, inward = positions.mean(axis=0), normals.mean(axis=0)
    apart = float(np.percentile(np.linalg.norm(positions - middle, axis=2), 95))
    if apart > ONE_GRASP:
        raise InvalidInputError(
            f"a model knows one grasp, the contacts of this environment move by {1e3 * apart:.1f} mm: leave random shapes and sizes out of "
            "it, and motions or disturbances that let the fingers roll or slide so far"
        )
    friction = np.array([float(grasp.friction.mean()) for grasp in grasps])
    grasp = Grasp.from_contacts(middle, inward, float(friction.mean()))
    loads = np.array(wrenches)
    sizes = np.linalg.norm(loads @ grasp.unit_frame.T, axis=1)
    least = max(0.5 * float(sizes.min()), LEAST_SIZE)
    magnitudes = least, max(2.0 * float(sizes.max()), 10.0 * least)
    return Played(
        grasp,
        loads,
        (float(friction.min()) / WIDER, float(friction.max()) * WIDER),
        magnitudes,
        objective,
        given.object.surface,
    )


def solving(config: EnvConfig, rule: Any) -> EnvConfig:
    """Return settings in which the reduced flow solves every step from a start rule.

    Nothing breaks, and no fault that lasts ends an episode.
    """
    mode = "grip" if config.action_mode == "grip" else "initial_force"
    return config.override(
        method="reduced_flow",
        initial_force=rule,
        action_mode=mode,
        observation="vector",
        **{
            "agent.info": "all",
            "controller.kind": "optimized",
            "limits.end_at_fault": False,
            "limits.max_force": None,
        },
    )
