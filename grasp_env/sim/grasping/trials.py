"""Trial grasps of one object by one hand, for the search of a place of the palm."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from grasp_env import core
from grasp_env.inputs.arguments import Array
from grasp_env.sim.grasping.approach import palm_direction
from grasp_env.sim.grasping.pads import SOFT_PAIR, with_protruding_tips
from grasp_env.sim.grasping.points import MISSES, GraspPlan, GraspSearch, narrowness
from grasp_env.sim.grasping.sites import Site, one_motor
from grasp_env.sim.hand.check import Vector3
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.frames import roll_pitch_yaw
from grasp_env.sim.hand.kinematics import HandKinematics, motor_force_basis
from grasp_env.sim.hand.limbs import hand_limbs, touching_pairs
from grasp_env.sim.objects.description import ObjectDescription

_RAYS = 60  # rays per finger
_NEWTON_STEPS, _TOUCHING = 20, 1e-9  # most steps; gap at which a tip touches [m]
_IDLE = 1.3  # factor of the force for each finger that does not touch
_MIN_SHARE = 0.1  # lower bound of the motors' share of a normal force
_SHARE_POWER = 4.0  # exponent of the penalty on a low share
# ratio of a tip's smallest to largest singular value: not penalised; counted as zero
_EVEN, _PLANAR = 0.25, 1e-3


class Candidate(NamedTuple):
    """A candidate grasp."""

    fingers: tuple[int, ...]  # that touch
    home: Array  # rest posture [rad], (M,)
    turn: Array  # rotation of the hand, (3, 3)
    shift: Array  # translation of the hand [m], (3,)

    @property
    def place(self) -> tuple[Vector3, Vector3]:
        """Position [m], and roll, pitch and yaw [rad], of the hand."""
        x, y, z = self.shift.tolist()
        return (x, y, z), roll_pitch_yaw(self.turn)


class Miss(NamedTuple):
    """A candidate without a grasp."""

    candidate: Candidate
    reached: tuple[int, ...]  # fingers that find contacts
    fault: str  # why most of its choices fail


def at_place(
    hand: HandDescription,
    fingers: Sequence[int],
    home: Array,
    position: Vector3,
    rotation: Vector3,
) -> HandDescription:
    """Return a hand at a place, with some of its fingertips and a rest posture (M,) [rad]."""
    tips = tuple(hand.fingertips[finger] for finger in fingers)
    posed = replace(hand, fingertips=tips, home=tuple(home.tolist()))
    return posed.moved(position, rotation)


class Trials:
    """Trial grasps of one object by one hand; counts rejected candidates in `faults`, by reason."""

    def __init__(self, hand: HandDescription, item: ObjectDescription, margin: float) -> None:
        self.hand = with_protruding_tips(hand)
        self.item = item
        self.margin = margin
        self.faults = Counter[str]()
        self._pairs = touching_pairs(hand, at_home=False)
        self.nearest: Miss | None = None
        self._subhands: dict[tuple[int, ...], tuple[HandKinematics, core.HandLimbs]] = {}

    def grasp(
        self, site: Site, turn: Array, least: int, tries: int, rng: np.random.Generator
    ) -> Candidate | None:
        """Try a grasp with those fingers of a site that find contacts."""
        fingers = site.fingers
        shift = -turn @ site.center
        while len(fingers) >= least:
            candidate = self._closed(Candidate(fingers, site.posture, turn, shift))
            search = self._search(candidate)
            plan = search.run(rng, tries, _RAYS)
            self.faults.update(search.faults)
            if plan is not None:
                return candidate._replace(home=plan.start)
            if search.in_palm:
                return None
            self._remember(candidate, search)
            if not max(search.short):
                return None
            fingers = tuple(
                finger for finger, short in zip(fingers, search.short, strict=True) if not short
            )
        return None

    def _remember(self, candidate: Candidate, search: GraspSearch) -> None:
        """Keep a candidate without a grasp if more fingers find contacts than before."""
        reached = tuple(
            finger for finger, found in zip(candidate.fingers, search.reached, strict=True) if found
        )
        if len(reached) <= (0 if self.nearest is None else len(self.nearest.reached)):
            return
        faults = [
            (count, what)
            for what, count in search.faults.items()
            if (what in MISSES) == (reached != candidate.fingers)
        ]
        self.nearest = Miss(candidate, reached, max(faults)[1])

    def nearest_text(self) -> str:
        """Return a sentence on the candidate that came nearest to a grasp, or ""."""
        if self.nearest is None:
            return ""
        candidate, reached, fault = self.nearest
        names = self.hand.finger_names
        found = ", ".join(names[finger] for finger in reached)
        missing = ", ".join(names[finger] for finger in candidate.fingers if finger not in reached)
        (x, y, z), (roll, pitch, yaw) = candidate.place
        what = (
            f"{missing} finds none, most candidates are {fault}"
            if missing
            else f"their choices are {fault}"
        )
        return (
            f"The nearest miss, with the palm at ({1e3 * x:.0f}, {1e3 * y:.0f}, {1e3 * z:.0f}) mm turned by ({roll:.2f}, {pitch:.2f}, {yaw:.2f}) rad: "
            f"{found} find contacts, {what}; `nearest.draw(path)` of this error draws it. "
        )

    def _closed(self, candidate: Candidate) -> Candidate:
        """Move a hand whose fingers share their motors until all tips touch."""
        kinematics = self._subhand(candidate.fingers)[0]
        if not one_motor(kinematics):
            return candidate
        angles = candidate.home.copy()
        shift = candidate.shift.copy()
        for _ in range(_NEWTON_STEPS):
            tips = kinematics.tips(angles) @ candidate.turn.T + shift
            _, normals, distances = zip(*map(self.item.surface.nearest, tips), strict=True)
            inward = np.array(normals)
            gaps = np.array(distances) - kinematics.tip_radii
            if np.abs(gaps).max() < _TOUCHING:
                break
            turned = inward @ candidate.turn
            moves = [turned[i] @ kinematics.jacobian(angles, i) for i in range(len(tips))]
            step = np.linalg.pinv(np.hstack([inward, np.array(moves)])) @ gaps
            shift = shift + step[:3]
            angles = kinematics.coupled(
                np.clip(angles + step[3:], kinematics.lower, kinematics.upper)
            )
        return candidate._replace(home=angles, shift=shift)

    def palm(self, site: Site) -> Array:
        """Return the unit direction (3,) from the palm to the object at a site, hand frame."""
        return palm_direction(*self._subhand(site.fingers), site.center)

    def rating(self, candidate: Candidate) -> float:
        """Return the force of a candidate's grasp [N] times penalties; inf if it has no grasp.

        With more than two fingers, normal forces of the structure instead of motors are penalised.
        So are little clearance, and tips that hardly move in some direction, as they are slow to
        close. Each finger that does not touch is penalised, too: with more fingers, a grasp loses
        less when one slips.
        """
        plan: GraspPlan | None = self._search(candidate).run(np.random.default_rng(0))
        if plan is None:
            return np.inf
        kinematics = self._subhand(candidate.fingers)[0]
        moves = [
            kinematics.jacobian(plan.angles, finger) for finger in range(len(candidate.fingers))
        ]
        shares = [
            float(np.linalg.norm(motor_force_basis(move[:, joints]).T @ candidate.turn.T @ normal))
            for move, joints, normal in zip(moves, kinematics.carries, plan.normals, strict=True)
        ]
        share = 1.0 if len(moves) == SOFT_PAIR else max(min(shares), _MIN_SHARE)
        values = [np.linalg.svd(move, compute_uv=False) for move in moves]
        ratios = [sizes[-1] / sizes[0] for sizes in values if sizes[-1] > _PLANAR * sizes[0]]
        uneven = max(1.0, _EVEN / min(ratios, default=1.0))
        force = plan.force * _IDLE ** (self.hand.finger_count - len(moves))
        return force * uneven**2 * share**-_SHARE_POWER * narrowness(plan.clearance)

    def placed(self, candidate: Candidate) -> HandDescription:
        """Return the hand in the pose of a candidate."""
        return at_place(self.hand, candidate.fingers, candidate.home, *candidate.place)

    def _subhand(self, fingers: tuple[int, ...]) -> tuple[HandKinematics, core.HandLimbs]:
        """Return kinematics and limbs of the hand with only these fingertips."""
        if fingers not in self._subhands:
            tips = tuple(self.hand.fingertips[finger] for finger in fingers)
            kinematics = HandKinematics(replace(self.hand, fingertips=tips))
            limbs = core.HandLimbs.make(
                kinematics.tree, hand_limbs(kinematics.hand), kinematics.home, self._pairs
            )
            self._subhands[fingers] = kinematics, limbs
        return self._subhands[fingers]

    def _search(self, candidate: Candidate) -> GraspSearch:
        kinematics, limbs = self._subhand(candidate.fingers)
        moved = limbs.moved(
            candidate.turn.ravel().tolist(), candidate.shift.tolist(), candidate.home
        )
        return GraspSearch(self.item, moved, kinematics.hand, self.margin)
