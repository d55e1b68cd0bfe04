"""Annotations of an environment's pictures."""

from __future__ import annotations

import math

import numpy as np

from grasp_env.config import EnvConfig
from grasp_env.control.loop import ForceLoop
from grasp_env.core import Outcome
from grasp_env.env.plan import Plan
from grasp_env.errors import GraspError
from grasp_env.force import optimize_force
from grasp_env.grasp.grasp import Grasp
from grasp_env.inputs.arguments import Array
from grasp_env.sim import Scene
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.picture.annotation import LONGEST, LONGEST_TURN, WRENCH_STRETCH, Annotation
from grasp_env.task.disturbance import name_of
from grasp_env.task.motion import ANGULAR_ACCELERATION, LINEAR_ACCELERATION

FAILURES = {
    "dropped": "the object left its place",
    "closure_lost": "no force closure",
    "force_optimisation": "no force was found",
    "simulation_diverged": "the simulation diverged",
}
"""`info["failure"]` in words."""

DISTURBANCES = {
    "none": "",
    "constant": "constant wrench",
    "paper_path": "the paper's wrench",
    "random": "random wrench",
}
"""Words for disturbances with unclear names."""

PALETTE = np.array(
    [
        (0.85, 0.33, 0.24),
        (0.20, 0.50, 0.80),
        (0.95, 0.69, 0.20),
        (0.27, 0.65, 0.42),
        (0.55, 0.40, 0.75),
        (0.35, 0.70, 0.75),
        (0.80, 0.45, 0.60),
        (0.50, 0.55, 0.30),
    ]
)
"""Colours of the fingers of a hand of one colour, repeated."""

LEAST_FORCE, LEAST_MOMENT = 0.1, 0.02
"""Smallest force [N] and moment [N m] that set the scale, so that rounding errors stay small."""

_ALIKE = 0.1  # largest difference between colours that count as equal


class Annotator:
    """Makes the annotations of one environment's pictures, with its `resolved` settings.

    The scales follow from the largest force and moment in the plans of all episodes so far, or from
    `pictures.force` and `pictures.moment`. They stay constant within an episode and never grow.
    """

    def __init__(self, config: EnvConfig, hand: HandDescription) -> None:
        self._config, self._hand, self._title = config, hand.name.replace("_", " "), title(config)
        links = {link.name: link.color for link in hand.links}
        self._colors = np.array([links[tip.link] for tip in hand.fingertips])
        if np.ptp(self._colors, axis=0).max() < _ALIKE:
            self._colors = np.resize(PALETTE, self._colors.shape)
        self._scale = self._turn = np.inf

    def expect(self, plan: Plan, scene: Scene, friction: float) -> None:
        """Adapt the scales to the largest arrows of an episode, at the assumed friction."""
        config = self._config
        wrenches = _wrenches(plan, scene)
        pull, moment = (
            float(np.linalg.norm(vectors, axis=1).max())
            for vectors in (wrenches[:, :3], wrenches[:, 3:])
        )
        force = config.pictures.force or max(
            _largest(config, scene, wrenches, friction), WRENCH_STRETCH * pull
        )
        self._scale = min(self._scale, LONGEST / max(force, LEAST_FORCE))
        self._turn = min(
            self._turn, LONGEST_TURN / max(config.pictures.moment or moment, LEAST_MOMENT)
        )

    def __call__(
        self, loop: ForceLoop, scene: Scene, time: float, outcome: Outcome, failure: str
    ) -> Annotation:
        """Return the annotation of the current picture, `time` [s] after the reset."""
        snapshot = scene.look()
        solution = loop.solution
        to_world = snapshot.rotation
        count = len(loop.force)
        return Annotation(
            points=snapshot.touch,
            normals=snapshot.normals @ to_world.T,
            forces=np.einsum("nij,nj->ni", to_world @ loop.frames, loop.force),
            measured=snapshot.forces @ to_world.T,
            friction=np.full(count, loop.friction),
            active=np.isin(np.arange(count), loop.fingers),
            colors=self._colors,
            wrench=(loop.wrench.reshape(2, 3) @ to_world.T).ravel(),
            center=snapshot.position,
            scale=self._scale,
            turn=self._turn,
            title=self._title,
            hand=self._hand,
            alarm=f"lost: {FAILURES[failure]}" if failure else "",
            lines=(
                ("lost after" if failure else "held", f"{time:.2f} s"),
                ("drift", f"{1e3 * outcome.drift:.2f} mm"),
                ("tilt", f"{math.degrees(outcome.tilt):.2f} deg"),
                ("iterations", str(solution.iterations) if solution else "-"),
                ("margin", f"{solution.cone_margin:.2f} N" if solution else "-"),
            ),
        )


def title(config: EnvConfig) -> str:
    """Return task and disturbance of `resolved` settings in words.

    Example:
        >>> title(EnvConfig(disturbance="tilting_gravity").resolved())
        'hold: tilting gravity'
    """
    name, task = name_of(config.disturbance), config.task
    disturbance = DISTURBANCES.get(name, name).strip("_").replace("_", " ")
    details = ", ".join(filter(None, (task.caption.format_map(vars(task)), disturbance)))
    return task.name.replace("_", " ") + (details and f": {details}")


def _wrenches(plan: Plan, scene: Scene) -> Array:
    """Return the wrenches (T, 6) to balance while the object follows its target, upright."""
    item = scene.config.object
    mass = (item.mass * plan.mass_factor)[:, None]
    force = (
        plan.wrench[:, :3] + plan.push + mass * (plan.gravity - plan.target[:, LINEAR_ACCELERATION])
    )
    moment = plan.wrench[:, 3:] - plan.target[:, ANGULAR_ACCELERATION] @ item.inertia_matrix.T
    return np.hstack([force, moment])


def _largest(config: EnvConfig, scene: Scene, wrenches: Array, friction: float) -> float:
    """Return the largest force of a finger [N] at the largest wrench of the episode."""
    points = np.array(scene.config.contact_points)
    if config.agent.sets_forces:
        return 2.0 * config.agent.action_scale
    if config.controller.kind != "optimized":
        return config.controller.squeeze / len(points)
    arm = float(np.linalg.norm(points, axis=1).mean())
    loads = np.linalg.norm(wrenches[:, :3], axis=1) + np.linalg.norm(wrenches[:, 3:], axis=1) / arm
    worst = int(loads.argmax())
    try:
        grasp = Grasp.from_contacts(points, scene.config.contact_normals, friction)
        solver = config.solver
        solution = optimize_force(
            grasp,
            wrenches[worst],
            force_weight=solver.force_weight,
            barrier_weight=solver.barrier_weight,
        )
        return float(np.linalg.norm(solution.force, axis=1).max())
    except GraspError:  # two fingers, which need torsion: each holds half of the wrench by friction
        return 0.5 * loads[worst] / friction
