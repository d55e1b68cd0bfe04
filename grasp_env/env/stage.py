"""The start of an episode: the object, its grasp, and the state in which the hand holds it at rest."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from grasp_env.config import EnvConfig
from grasp_env.control.closing import close_hand, take_over
from grasp_env.control.loop import ForceLoop
from grasp_env.errors import GraspError, SimulationError
from grasp_env.inputs.arguments import warn
from grasp_env.sim import HandKinematics, ObjectDescription, Scene
from grasp_env.sim.config import START_CLEARANCE, SceneConfig
from grasp_env.sim.engine import engine_of
from grasp_env.sim.grasping import FRICTION_MARGIN, check_motion, place_hand, plan_grasp
from grasp_env.task import Move

PLACINGS = 3
"""Number of poses that are tried for each object, for a hand that is not `placed`."""
POSES = 33
"""Number of poses of a motion that a hand must reach, for a hand that is not `placed`."""
REDRAWS = 20
"""Largest number of random objects that are tried at a reset until the hand can hold one."""


class Stage:
    """One scene, and the object that the hand holds in it.

    While shape and size stay the same, the fingers close only once. The state "closed", in which
    they just touch, is kept, and every mass and friction settles from there. An episode starts from
    the same bits, whatever came before. A `GraspError` means that the hand cannot reach or hold the
    object.

    Attributes:
        episode: the settings of the episode, including drawn ones.
        redrawn: number of random objects of the last draw that the hand could not hold.
    """

    def __init__(self, config: EnvConfig, loop: ForceLoop, gui: bool, visuals: bool) -> None:
        self.config, self._loop = config, loop
        self._given = config.hand_description
        self._fixed = self._given.placed or bool(config.contact_points)
        self._margin = min(FRICTION_MARGIN, config.controller.friction_margin)
        self._visible = gui, visuals
        self._nominal: HandKinematics | None = None
        self._scene: Scene | None = None
        self.redrawn = 0
        self.episode = config
        try:
            self._hold(config.object)
        except GraspError:
            if self._scene is not None:
                self._scene.close()
            raise
        self._nominal = self.kinematics

    @property
    def scene(self) -> Scene:
        """The simulation."""
        assert self._scene is not None
        return self._scene

    def set(self, rng: np.random.Generator) -> None:
        """Let the hand hold the object of the next episode, with randomised settings from `rng`."""
        scene = self.scene
        if not self.config.randomize:
            scene.set_gravity(np.array(self.config.gravity))
            mass = self.config.object.mass
            if scene.config.object.mass != mass:  # a payload, which `Scene.reset` does not remove
                scene.change_object(mass)
            scene.reset("settled")
            return
        rebuilds = dict(self.config.randomize).keys() & {"object.shape", "object.size"}
        failed: GraspError | None = None
        for self.redrawn in range(REDRAWS):
            self.episode = self._loop.config = self.config.drawn(rng)
            drawn = self.episode.object
            scene.set_gravity(np.array(self.episode.gravity))
            try:
                if rebuilds:
                    self._hold(drawn)
                else:
                    scene.reset("closed")
                    scene.change_object(drawn.mass, drawn.friction)
                    self._settle()
                return
            except GraspError as error:
                failed = error
        raise SimulationError(f"none of {REDRAWS} random objects could be held; the last: {failed}")

    def _hold(self, item: ObjectDescription) -> None:
        """Let the hand hold an object, from the first pose where it can, also along a motion."""
        places = list(self._places(item))
        if isinstance(self.config.task, Move) and not self._fixed:
            try:
                return self._hold_from(places, item, follows=True)
            except GraspError as error:
                warn(
                    f"the hand is placed where it holds the object at rest, since no pose was found from which it follows the motion "
                    f"{self.config.task.motion!r}: {error}"
                )
        return self._hold_from(places, item, follows=False)

    def _hold_from(
        self, places: list[Callable[[], HandKinematics]], item: ObjectDescription, follows: bool
    ) -> None:
        first = self._nominal is None
        failure: GraspError | None = None
        for place in places:
            try:
                self.kinematics = place()
                grasp = self._scene_config(item)
                if follows:
                    self._follow(grasp)
                if self._scene is None:
                    self._scene = Scene(grasp, *self._visible)
                else:
                    self._scene.load(grasp)
                close_hand(self.scene, self._loop)
                if first:
                    self.scene.keep("closed")
                self._settle()
                if first:
                    self.scene.keep("settled")
                return
            except GraspError as error:
                failure = error
        assert failure is not None
        raise failure

    def _places(self, item: ObjectDescription) -> Iterator[Callable[[], HandKinematics]]:
        """Yield functions that find the poses of the hand to try for an object."""
        hand, least, nominal = self._given, None, self._nominal
        if nominal is not None:
            yield lambda: nominal
            touching = set(nominal.hand.finger_names)  # observations keep their shape
            tips = tuple(tip for tip in hand.fingertips if tip.name in touching)
            hand = replace(hand, fingertips=tips)
            least = len(touching)
        elif self._fixed:
            yield lambda: HandKinematics(hand)
        side = self.config.approach
        for seed in range(0 if self._fixed else PLACINGS):
            yield lambda seed=seed: HandKinematics(
                place_hand(
                    hand,
                    item,
                    seed=seed,
                    least=least,
                    approach=side,
                    friction_margin=self._margin,
                )
            )

    def _scene_config(self, item: ObjectDescription) -> SceneConfig:
        config = self.config
        engine = engine_of(config.engine)
        points, start = config.contact_points, ()
        if not points:
            plan = plan_grasp(item, self.kinematics, None, self._margin)
            points = tuple((x, y, z) for x, y, z in plan.points.tolist())
            start = tuple(plan.start.tolist())
        return SceneConfig(
            hand=self.kinematics.hand,
            object=item,
            contact_points=points,
            start_angles=start,
            gravity=self.episode.gravity,
            engine=engine,
            substeps=engine.rate // config.controller.rate,
            clearance=START_CLEARANCE,
        )

    def _follow(self, grasp: SceneConfig) -> None:
        """Raise a `GraspError` unless the fingers hold the object along the task's motion."""
        duration = self.config.limits.duration
        assert duration is not None
        times = np.linspace(0.0, duration, POSES)
        poses = self.config.task.target(times, 1.0 / self.config.controller.rate)[:, :7]
        check_motion(grasp, self.kinematics, poses)

    def _settle(self) -> None:
        self._loop.begin(self.scene)
        take_over(self.scene, self._loop)
        if self.episode.controller.friction_error or self._loop.learned:
            self._loop.begin(self.scene, held=True)
        self._loop.settling = False
