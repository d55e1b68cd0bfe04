"""The start of an episode: the object, its grasp, and the state in which the hand holds it at rest."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from grasp_env.config import EnvConfig
from grasp_env.control.closing import close_hand, take_over
from grasp_env.control.loop import ForceLoop
from grasp_env.control.structure import MAX_CARRIED, Posture, finger_structure
from grasp_env.errors import GraspError, InvalidInputError, SimulationError
from grasp_env.force.margin import Margin
from grasp_env.inputs.arguments import warn
from grasp_env.sim import HandKinematics, ObjectDescription, Scene
from grasp_env.sim.config import START_CLEARANCE, SceneConfig
from grasp_env.sim.engine import engine_of
from grasp_env.sim.grasping import FRICTION_MARGIN, check_motion, place_hand, plan_grasp
from grasp_env.sim.grasping.points import GraspPlan, check_points, narrowness
from grasp_env.sim.grasping.record import HandGrasp
from grasp_env.sim.hand.description import HandDescription
from grasp_env.task import Move

PLACINGS = 3
"""Number of poses that are tried for each object, for a hand that is not `placed`."""
BETTER = 0.75
"""Share of the `_cost` at its own place below which a built-in hand is placed elsewhere."""
ENOUGH = 60.0
"""The `_cost` of a place [N] above which others are tried, too."""
PUSH = 0.5
"""Force along each axis [N] with which places of the hand are compared, besides the weight."""
POSES = 33
"""Number of poses of a motion that a hand must reach, for a hand that is not `placed`."""
REDRAWS = 20
"""Largest number of random objects that are tried at a reset until the hand can hold one."""


def _cost(grasp: HandGrasp) -> float:
    """Return the force of a grasp [N], which counts more where links are near to the object."""
    return grasp.force * narrowness(grasp.clearance)


class Stage:
    """One scene, and the object that the hand holds in it.

    While shape and size stay the same, the fingers close only once. The state "closed", in which
    they just touch, is kept, and every mass and friction settles from there. An episode starts from
    the same bits, whatever came before. A `GraspError` means that the hand cannot reach or hold the
    object.

    Attributes:
        grasp: how the hand holds the object.
        episode: the settings of the episode, including drawn ones.
        redrawn: number of random objects of the last draw that the hand could not hold.
    """

    def __init__(self, config: EnvConfig, loop: ForceLoop, gui: bool, visuals: bool) -> None:
        self.config, self._loop = config, loop
        self._given = config.hand_description
        self._margin = min(FRICTION_MARGIN, config.controller.friction_margin)
        self._visible = gui, visuals
        self._nominal: HandGrasp | None = None
        self._scene: Scene | None = None
        self.redrawn = 0
        self.episode = config
        try:
            self._hold(config.object)
        except GraspError:
            if self._scene is not None:
                self._scene.close()
            raise
        self._nominal = self.grasp

    @property
    def kinematics(self) -> HandKinematics:
        """The hand at its place."""
        return self.scene.kinematics

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
        if isinstance(self.config.task, Move) and not self.config.pose_is_given:
            try:
                return self._hold_from(places, item, follows=True)
            except GraspError as error:
                warn(
                    f"the hand is placed where it holds the object at rest, since no pose was found from which it follows the motion "
                    f"{self.config.task.motion!r}: {error}"
                )
        return self._hold_from(places, item, follows=False)

    def _hold_from(
        self, places: list[Callable[[], HandGrasp]], item: ObjectDescription, follows: bool
    ) -> None:
        first = self._nominal is None
        failure: GraspError | None = None
        for place in places:
            try:
                self.grasp = place()
                config = self._scene_config(item)
                if follows:
                    self._follow(config)
                if self._scene is None:
                    self._scene = Scene(config, *self._visible)
                else:
                    self._scene.load(config)
                close_hand(self.scene, self._loop)
                if first:
                    self.scene.keep("closed")
                self._settle()
                if first:
                    self.scene.keep("settled")
                return
            except GraspError as error:
                # that there are no other places tells less than why the hand did not hold
                if not isinstance(error, InvalidInputError) or isinstance(
                    failure, InvalidInputError | None
                ):
                    failure = error
        assert failure is not None
        raise failure

    def _places(self, item: ObjectDescription) -> Iterator[Callable[[], HandGrasp]]:
        """Yield functions that find the grasps of an object to try."""
        config, hand, least, nominal = self.config, self._given, None, self._nominal
        if nominal is not None:
            yield lambda: self._planned(nominal.hand, item)
            touching = set(nominal.hand.finger_names)  # observations keep their shape
            tips = tuple(tip for tip in hand.fingertips if tip.name in touching)
            hand = replace(hand, fingertips=tips)
            least = len(touching)
        elif (grasp := config.grasp) is not None:
            yield lambda: grasp
        elif config.contact_points or (hand.placed and config.approach is None):
            yield lambda: self._own_place(item)
        for number in range(0 if config.pose_is_given else PLACINGS):
            yield lambda number=number: self._placed(hand, item, least, number)

    def _placed(
        self, hand: HandDescription, item: ObjectDescription, least: int | None, number: int
    ) -> HandGrasp:
        """Return the grasp with this number of those that are tried.

        First are those whose motors make most of the forces, by their `_cost`; then the others, by
        the share that motors make. A first one of little cost is enough.
        """
        if self._nominal is not None:
            return self._place(hand, item, least, number)
        found = list[tuple[float, float, HandGrasp]]()
        failure: InvalidInputError | None = None
        for seed in range(PLACINGS):
            try:
                grasp = self._place(hand, item, least, seed)
            except InvalidInputError as error:
                failure = error
                continue
            carried = max(self._carried(grasp, item), MAX_CARRIED)
            found.append((carried, _cost(grasp), grasp))
            if len(found) == 1 and carried <= MAX_CARRIED and _cost(grasp) <= ENOUGH:
                break
        if failure is not None and number >= len(found):
            raise failure
        found.sort(key=lambda row: row[:2])
        return found[number][2] if number < len(found) else self._place(hand, item, least, number)

    def _place(
        self, hand: HandDescription, item: ObjectDescription, least: int | None, seed: int
    ) -> HandGrasp:
        return place_hand(
            hand,
            item,
            seed=seed,
            least=least,
            approach=self.config.approach,
            friction_margin=self._margin,
            keep=self._nominal is None,  # random objects do not come again
        )

    def _carried(self, grasp: HandGrasp, item: ObjectDescription) -> float:
        """Return the largest share of a finger's force that no motor makes, with some loads."""
        weight = [*np.multiply(item.mass, self.config.gravity), 0.0, 0.0, 0.0]
        pushes = np.diag([PUSH] * 3 + [0.0] * 3)
        loads = weight + np.concatenate([np.zeros((1, 6)), pushes, -pushes])
        posture = Posture(grasp.angles, grasp.points, np.eye(3))
        contacts = Margin(self._margin, 0.0).narrowed(grasp.contacts())
        structure = finger_structure(posture, HandKinematics(grasp.hand), contacts, loads)
        return float(structure.share.max())

    def _own_place(self, item: ObjectDescription) -> HandGrasp:
        """Return the grasp of the hand at its own place, or at a better one if it may move."""
        grasp = self._planned(self._given, item)
        if self.config.pose_is_given or np.isinf(grasp.force):
            return grasp
        with suppress(GraspError):
            placed = self._place(self._given, item, None, 0)
            same = placed.hand.finger_count == grasp.hand.finger_count
            if same and _cost(placed) < BETTER * _cost(grasp):
                return placed
        return grasp

    def _planned(self, hand: HandDescription, item: ObjectDescription) -> HandGrasp:
        """Return the grasp of a hand where it is."""
        kinematics = HandKinematics(hand)
        if not self.config.contact_points:
            plan = plan_grasp(item, kinematics, None, self._margin)
            return HandGrasp.of_plan(hand, item, plan)
        points, normals = check_points(item, self.config.contact_points)
        radii = np.array([tip.radius for tip in hand.fingertips])[:, None]
        angles, start = (
            kinematics.solve(points - (radii + gap) * normals) for gap in (0.0, START_CLEARANCE)
        )
        return HandGrasp.of_plan(hand, item, GraspPlan(points, normals, angles, start))

    def _scene_config(self, item: ObjectDescription) -> SceneConfig:
        config, grasp = self.config, self.grasp
        engine = engine_of(config.engine)
        return SceneConfig(
            hand=grasp.hand,
            object=item,
            contact_points=tuple((x, y, z) for x, y, z in grasp.points.tolist()),
            start_angles=tuple(grasp.start.tolist()),
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
        check_motion(grasp, HandKinematics(grasp.hand), poses)

    def _settle(self) -> None:
        self._loop.begin(self.scene)
        take_over(self.scene, self._loop)
        if self.episode.controller.friction_error or self._loop.learned:
            self._loop.begin(self.scene, held=True)
        self._loop.settling = False
