"""Placing of a hand around an object: palm pose, rest posture and the fingers that touch."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grasp_env import core
from grasp_env.errors import InvalidInputError
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import Array, number, whole
from grasp_env.sim.grasping.approach import Approach, as_approach, palm_direction
from grasp_env.sim.grasping.pads import PATCH_RADIUS, SOFT_PAIR, torsion_of, with_protruding_tips
from grasp_env.sim.grasping.points import FRICTION_MARGIN, GraspPlan, GraspSearch, plan_grasp
from grasp_env.sim.grasping.sites import Site, find_sites, one_motor
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.frames import roll_pitch_yaw
from grasp_env.sim.hand.kinematics import HandKinematics, motor_force_basis
from grasp_env.sim.hand.limbs import hand_limbs, touching_pairs
from grasp_env.sim.objects.description import ObjectDescription, sides_text

# attempts to find a good grasp; attempts to find any, or one that is not weak
_ATTEMPTS, _MAX_ATTEMPTS = 3, 6
_SITES, _TURNS = 60, 6  # sites per attempt, and rotations of the object at each
_RAYS = 60  # rays per finger
_ENOUGH = 24  # candidates to choose from
_GOOD = 30.0  # force of the best grasp above which easier margins are tried [N]
_WEAK = 60.0  # force at which the motors provide half of what a grasp requires [N]
_ROOM = 0.003  # clearance that is not penalised [m]
_NEWTON_STEPS, _TOUCHING = 20, 1e-9  # most steps; gap at which a tip touches [m]
_IDLE = 1.3  # factor of the force for each finger that does not touch
_LISTED = 6  # joints or pairs of fingers listed in a message
_WIDE = 2.5  # range from which joints are listed in a message [rad]
_MIN_SHARE = 0.1  # lower bound of the motors' share of a normal force
_SHARE_POWER = 4.0  # exponent of the penalty on a low share
# ratio of a tip's smallest to largest singular value: not penalised; counted as zero
_EVEN, _PLANAR = 0.25, 1e-3


def place_hand(
    hand: HandDescription,
    item: ObjectDescription,
    *,
    seed: int = 0,
    least: int | None = None,
    approach: ArrayLike | str | None = None,
    friction_margin: float = FRICTION_MARGIN,
) -> HandDescription:
    """Choose the palm pose, rest posture and fingertips with which a hand holds the object well.

    The object is at the origin of the world, and gravity points along -y. Fingers that find no
    contact are left out if at least three others (two with soft contacts) hold the object. The
    tips of a two-finger gripper are moved towards each other until they protrude 1.5 mm from its
    jaws.

    Args:
        hand: The hand; its pose and rest posture do not matter.
        item: The object.
        seed: Seed of the search, >= 0.
        least: Smallest number of fingers that touch; None for three, or two with soft contacts.
        approach: Direction from the palm to the object, world frame, within 30 degrees: "down",
            "up", "side", or a vector (3,). None for any.
        friction_margin: Share of the friction that forces may use, 0.01 to 1.

    Returns:
        A hand for which `plan_grasp` finds a grasp. The result is deterministic and cached.

    Raises:
        InvalidInputError: No palm pose was found; the message counts the reasons. Or the hand has
            two fingers and the object no `torsional_friction`.

    Example:
        >>> ball = ObjectDescription("sphere", (0.06,), mass=0.15, friction=0.7)
        >>> placed = place_hand(HandDescription.three_finger(), ball)
        >>> plan_grasp(ball, HandKinematics(placed)).points.shape
        (3, 3)
    """
    if least is None:
        least = 2 if item.torsional_friction > 0.0 else 3
    else:
        least = whole(least, "least", 1, hand.finger_count)
    direction = None if approach is None else Approach(as_approach(approach, "approach"))
    if hand.finger_count == SOFT_PAIR and item.torsional_friction == 0.0:
        raise InvalidInputError(
            f"no palm pose was found in which the hand {hand.name!r} grasps the {item.shape}: two fingers hold with soft contacts only. "
            f"Give the object torsional_friction [m], {torsion_of(item.friction):.2g} with soft pads that touch within {1e3 * PATCH_RADIUS:g} mm"
        )
    margin = number(friction_margin, "friction_margin", ranges.FRICTION_MARGIN)
    return _placed(hand, item, whole(seed, "seed", 0), least, direction, margin)


class _Candidate(NamedTuple):
    """A candidate grasp."""

    fingers: tuple[int, ...]  # that touch
    home: Array  # rest posture [rad], (M,)
    turn: Array  # rotation of the hand, (3, 3)
    shift: Array  # translation of the hand [m], (3,)


@lru_cache(maxsize=64)
def _placed(
    hand: HandDescription,
    item: ObjectDescription,
    seed: int,
    least: int,
    approach: Approach | None,
    margin: float,
) -> HandDescription:
    rng = np.random.default_rng(seed)
    trials = _Trials(hand, item, margin)
    hand = trials.hand
    places = misdirected = 0
    faced = np.zeros((hand.finger_count,) * 2, dtype=bool)
    best: tuple[float, float, HandDescription] | None = None
    for attempt in range(_MAX_ATTEMPTS):
        pushed = (attempt % 2 == 0) == (item.shape != "cuboid")
        sites, facing = find_sites(hand, item, rng, least, _SITES, pushed)
        places += len(sites)
        faced |= facing
        palms = [None if approach is None else trials.palm(site) for site in sites]
        candidates: list[_Candidate] = []
        for tries in (0, 1):  # with the largest margins, then with easier ones
            enough = len(candidates) + _ENOUGH
            for site, palm in zip(sites, palms, strict=True):
                for _ in range(_TURNS):
                    turn = site.turned(rng, item, palm, approach)
                    if turn is None:
                        misdirected += 1
                        break
                    candidate = trials.grasp(site, turn, least, tries, rng)
                    if candidate is not None:
                        candidates.append(candidate)
                if len(candidates) >= enough:
                    break
            ratings = [trials.rating(candidate) for candidate in candidates]
            if tries == 0 and min(ratings, default=np.inf) > _GOOD:
                continue
            for index in np.argsort(ratings, kind="stable"):
                if best is not None and ratings[index] >= best[0]:
                    break
                placed = trials.placed(candidates[index])
                try:
                    plan = plan_grasp(item, HandKinematics(placed), None, margin)
                except InvalidInputError:
                    continue
                best = ratings[index], plan.force, placed
                break
            if best is not None:
                break
        last = attempt + 1 >= _ATTEMPTS
        if (best is None and last) or (best is not None and best[1] <= (_WEAK if last else _GOOD)):
            break
    if best is not None:
        return best[2]
    counts = ", ".join(f"{count} {what}" for what, count in trials.faults.most_common() if count)
    note = f", at {min(misdirected, places)} of which no side of the object comes from approach={approach}"
    raise InvalidInputError(
        f"no palm pose was found in which the hand {hand.name!r} grasps the {item.shape} of "
        f"{sides_text(item.extent)}: its fingers can surround it at {places} places{note if misdirected else ''}; of the "
        f"candidates tried there {counts or 'none is left'}. {'' if places else _never_facing(hand, faced)}{_wide_joints(hand)}Use an object of another size or "
        "more friction, another seed, or place the hand by `HandDescription.moved` and `home`"
    )


def _never_facing(hand: HandDescription, faced: NDArray[np.bool_]) -> str:
    """Return a sentence about fingers that never face each other, or ""."""
    names = hand.finger_names
    pairs = [
        f"{names[i]} and {names[j]}"
        for i, j in combinations(range(len(names)), 2)
        if not faced[i, j]
    ]
    if not pairs:
        return ""
    if not faced.any():
        return f"No two of its fingers ({', '.join(names)}) face each other with room for the object between them. "
    return f"Within their ranges these fingers never face each other: {_listed(pairs, '; ', ' pairs')}. "


def _wide_joints(hand: HandDescription) -> str:
    """Return a sentence about joints that turn further than those of fingers, or ""."""
    wide = [
        link.joint
        for link in hand.links
        if not link.sliding and not link.upper - link.lower < _WIDE
    ]
    if not wide:
        return ""
    return (
        f"Joints that turn by more than {_WIDE:g} rad are seldom those of a finger: {_listed(wide)}; give the true ranges as "
        "joint_limits={joint: (lower, upper)} to from_urdf. "
    )


def _listed(names: list[str], between: str = ", ", kind: str = "") -> str:
    more = f" and {len(names) - _LISTED} more{kind}" if len(names) > _LISTED else ""
    return between.join(names[:_LISTED]) + more


class _Trials:
    """Trial grasps of one object by one hand; counts rejected candidates in `faults`, by reason."""

    def __init__(self, hand: HandDescription, item: ObjectDescription, margin: float) -> None:
        self.hand = with_protruding_tips(hand)
        self.item = item
        self.margin = margin
        self.faults = Counter[str]()
        self._pairs = touching_pairs(hand, at_home=False)
        self._subhands: dict[tuple[int, ...], tuple[HandKinematics, core.HandLimbs]] = {}

    def grasp(
        self, site: Site, turn: Array, least: int, tries: int, rng: np.random.Generator
    ) -> _Candidate | None:
        """Try a grasp with those fingers of a site that find contacts."""
        fingers = site.fingers
        shift = -turn @ site.center
        while len(fingers) >= least:
            candidate = self._closed(_Candidate(fingers, site.posture, turn, shift))
            search = self._search(candidate)
            plan = search.run(rng, tries, _RAYS)
            self.faults.update(search.faults)
            if plan is not None:
                return candidate._replace(home=plan.start)
            if not max(search.short):
                return None
            fingers = tuple(
                finger for finger, short in zip(fingers, search.short, strict=True) if not short
            )
        return None

    def _closed(self, candidate: _Candidate) -> _Candidate:
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

    def rating(self, candidate: _Candidate) -> float:
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
        return force * uneven**2 * share**-_SHARE_POWER * (_ROOM / plan.clearance) ** 0.5

    def placed(self, candidate: _Candidate) -> HandDescription:
        """Return the hand in the pose of a candidate."""
        x, y, z = candidate.shift.tolist()
        hand = self._subhand(candidate.fingers)[0].hand
        hand = replace(hand, home=tuple(candidate.home.tolist()))
        return hand.moved((x, y, z), roll_pitch_yaw(candidate.turn))

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

    def _search(self, candidate: _Candidate) -> GraspSearch:
        kinematics, limbs = self._subhand(candidate.fingers)
        moved = limbs.moved(
            candidate.turn.ravel().tolist(), candidate.shift.tolist(), candidate.home
        )
        return GraspSearch(self.item, moved, kinematics.hand, self.margin)
