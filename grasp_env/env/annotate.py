"""What the pictures of an environment say: forces, cones, the wrench that is balanced, where the episode stands; all to one scale."""

from __future__ import annotations

import math

import numpy as np

from grasp_env._check import Array
from grasp_env.config import EnvConfig
from grasp_env.control.loop import ForceLoop
from grasp_env.core import Outcome
from grasp_env.env.plan import Plan
from grasp_env.errors import GraspError
from grasp_env.force import optimize_force
from grasp_env.grasp.grasp import Grasp
from grasp_env.sim import Scene
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.picture.annotation import Annotation, arc_scale, arrow_scale
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
"""Disturbances that their names do not say."""

_ALIKE = 0.1
"""Fingers whose colours differ by less than this are told apart by the palette's."""


class Annotator:
    """Describes the pictures of one environment.

    Their scales are those of the largest force and moment that the plan of an episode asks for, known at reset: within an episode
    nothing changes them, and a later episode makes them smaller where it asks for more, never larger. `render_force` and
    `render_moment` fix them.

    Args:
        config: resolved.
        hand: that holds.
    """

    def __init__(self, config: EnvConfig, hand: HandDescription) -> None:
        self._config, self._hand, self._title = config, hand.name.replace("_", " "), title(config)
        links = {link.name: link for link in hand.links}
        colors = np.array([links[tip.link].color for tip in hand.fingertips])
        self._colors = colors if len(colors) and np.ptp(colors, axis=0).max() > _ALIKE else None
        self._scale = self._turn = np.inf

    def expect(self, plan: Plan, scene: Scene, friction: float) -> None:
        """Makes room for an episode.

        Args:
            plan: of the episode.
            scene: with its object in the hand.
            friction: that the controller believes in.
        """
        config, wrenches = self._config, _wrenches(plan, scene)
        force = np.array([[config.render_force or 0.0, 0.0, 0.0]])
        if config.render_force is None:
            force = _largest(config, scene, wrenches, friction)
        moment = config.render_moment or float(np.linalg.norm(wrenches[:, 3:], axis=1).max())
        none = np.zeros(6) if config.render_force is not None else wrenches
        self._scale, self._turn = min(self._scale, arrow_scale(force, none)), min(self._turn, arc_scale(moment))

    def __call__(self, loop: ForceLoop, scene: Scene, time: float, outcome: Outcome, failure: str) -> Annotation:
        """The overlay of now.

        Args:
            loop: its last command and solution.
            scene: as it is.
            time: since reset [s].
            outcome: how the object is held.
            failure: "" while it is held.
        """
        snapshot, solution = scene.look(), loop.solution
        active = np.zeros(len(loop.force))
        active[loop.fingers] = 1.0
        to_world = snapshot.rotation
        return Annotation(
            points=snapshot.touch,
            normals=snapshot.normals @ to_world.T,
            forces=np.einsum("nij,nj->ni", to_world @ loop.frames, loop.force),
            measured=snapshot.forces @ to_world.T,
            friction=np.full(len(active), loop.friction),
            active=active,
            wrench=np.concatenate([to_world @ loop.wrench[:3], to_world @ loop.wrench[3:]]),
            center=snapshot.position,
            colors=self._colors,
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
    """Task and disturbance in words.

    Args:
        config: resolved.

    Example:
        >>> title(EnvConfig(disturbance="tilting_gravity").resolved())
        'hold: tilting gravity'
        >>> title(EnvConfig(task="six_directions").resolved())
        'six directions: pushes of 10 N/kg'
    """
    words = {
        "move": config.motion,
        "payload": f"{config.payload_factor:g} times the mass at {config.payload_time:g} s",
        "six_directions": f"pushes of {config.push_per_mass:g} N/kg",
    }
    name = config.disturbance if isinstance(config.disturbance, str) else getattr(config.disturbance, "__name__", "")
    disturbance = DISTURBANCES.get(name or "", name or "")
    what = [each for each in (words.get(config.task, ""), disturbance.strip("_").replace("_", " ")) if each]
    return f"{config.task.replace('_', ' ')}{': ' if what else ''}{', '.join(what)}"


def _wrenches(plan: Plan, scene: Scene) -> Array:
    """(T, 6) that the forces will have to balance, with the object where it should be and upright: what a scale needs."""
    item = scene.config.object
    mass = (item.mass * plan.mass_factor)[:, None]
    force = plan.wrench[:, :3] + plan.push + mass * (plan.gravity - plan.target[:, LINEAR_ACCELERATION])
    moment = plan.wrench[:, 3:] - plan.target[:, ANGULAR_ACCELERATION] @ item.inertia_matrix.T
    return np.hstack([force, moment])


def _largest(config: EnvConfig, scene: Scene, wrenches: Array, friction: float) -> Array:
    """(N, 3) forces of the fingers where the episode asks most of them."""
    points = np.array(scene.config.contact_points)
    if config.action_mode == "contact_force":
        return np.tile([2.0 * config.action_scale, 0.0, 0.0], (len(points), 1))
    if config.controller != "optimised":
        return np.tile([config.squeeze / len(points), 0.0, 0.0], (len(points), 1))
    arm = float(np.linalg.norm(points, axis=1).mean())
    asked = np.linalg.norm(wrenches[:, :3], axis=1) + np.linalg.norm(wrenches[:, 3:], axis=1) / arm
    worst = int(asked.argmax())
    try:
        grasp = Grasp.from_contacts(points, scene.config.contact_normals, friction)
        return optimize_force(
            grasp, wrenches[worst], force_weight=config.force_weight, barrier_weight=config.barrier_weight
        ).force
    except GraspError:  # two fingers, torsion: half of the wrench by friction
        return np.array([[0.5 * asked[worst] / friction, 0.0, 0.0]])
