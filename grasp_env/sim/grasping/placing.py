"""Placing of a hand around an object: palm pose, rest posture and the fingers that touch."""

from __future__ import annotations

import json
import os
import time
from functools import lru_cache
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grasp_env.errors import InvalidInputError, NoGraspError
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import flag, number, whole
from grasp_env.inputs.files import digest
from grasp_env.sim.grasping.approach import Approach, as_approach
from grasp_env.sim.grasping.miss import NearestMiss
from grasp_env.sim.grasping.pads import PATCH_RADIUS, SOFT_PAIR, torsion_of, with_protruding_tips
from grasp_env.sim.grasping.points import FRICTION_MARGIN, GraspPlan, plan_grasp
from grasp_env.sim.grasping.record import HandGrasp, fingerprint
from grasp_env.sim.grasping.sites import find_sites
from grasp_env.sim.grasping.trials import Candidate, Trials, at_place
from grasp_env.sim.hand.check import Vector3
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.objects.cache import cached
from grasp_env.sim.objects.description import ObjectDescription, sides_text

LONGEST = 20.0
"""Most processor time of a search [s]."""
_VERSION = 5  # part of the cache's key: increase it when a search may find another grasp

# attempts to find a good grasp; attempts to find any, or one that is not weak
_ATTEMPTS, _MAX_ATTEMPTS = 3, 6
_SITES, _TURNS = 60, 6  # sites per attempt, and rotations of the object at each
_ENOUGH = 24  # candidates to choose from
_GOOD = 30.0  # force of the best grasp above which easier margins are tried [N]
_WEAK = 60.0  # force at which the motors provide half of what a grasp requires [N]
_LISTED = 6  # joints or pairs of fingers listed in a message
_WIDE = 2.5  # range from which joints are listed in a message [rad]


def place_hand(
    hand: HandDescription,
    item: ObjectDescription,
    *,
    seed: int = 0,
    least: int | None = None,
    approach: ArrayLike | str | None = None,
    friction_margin: float = FRICTION_MARGIN,
    keep: bool = True,
) -> HandGrasp:
    """Choose the palm pose, posture, fingertips and contacts with which a hand holds an object well.

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
        keep: Keep the result in the user's cache folder.

    Returns:
        The grasp, with the hand at its place. The result is deterministic. The user's cache folder
        keeps it by the content of hand and object, and failures, too.

    Raises:
        NoGraspError: No palm pose was found, or none in `LONGEST` seconds; the message counts the
            reasons and describes the nearest miss, which the error's `nearest` draws.
        InvalidInputError: The hand has two fingers and the object no `torsional_friction`, or an
            argument is not allowed.

    Example:
        >>> ball = ObjectDescription("sphere", (0.06,), mass=0.15, friction=0.7)
        >>> grasp = place_hand(HandDescription.three_finger(), ball)
        >>> grasp.hand.placed, grasp.points.shape
        (True, (3, 3))
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
    request = _Request(hand, item, whole(seed, "seed", 0), least, direction, margin)
    return _placed(request, flag(keep, "keep"))


class _Request(NamedTuple):
    """The checked arguments of `place_hand`."""

    hand: HandDescription
    item: ObjectDescription
    seed: int
    least: int
    approach: Approach | None
    margin: float

    @property
    def key(self) -> str:
        """A digest that differs if the grasp may differ."""
        wanted = None if self.approach is None else self.approach.wanted
        options = json.dumps([_VERSION, self.seed, self.least, wanted, self.margin]).encode()
        return digest(options, fingerprint(self.hand, self.item))


@lru_cache(maxsize=64)
def _placed(request: _Request, keep: bool) -> HandGrasp:
    """Return a grasp from the cache folder, or search for it."""
    hand, item = request.hand, request.item
    kept = cached(
        request.key,
        f"{hand.name} holds {os.path.basename(item.mesh) if item.mesh else item.shape}",
        lambda: _searched(request),
        use="grasp",
        # a faster machine may find a grasp where this one's time was over
        keep=lambda made: keep and ("fault" not in made or bool(made["in_time"])),
    )
    posed = _posed(hand, kept) if "home" in kept else hand
    if "fault" in kept:
        reached = tuple(hand.finger_names[finger] for finger in kept.get("reached", ()))
        nearest = NearestMiss(posed, item, reached) if reached else None
        raise NoGraspError(str(kept["fault"]), nearest)
    plan = GraspPlan(
        *(kept[name] for name in ("points", "normals", "angles", "start")),
        force=float(kept["force"]),
        clearance=float(kept["clearance"]),
    )
    return HandGrasp.of_plan(posed, item, plan, *_place_of(kept))


def _kept(candidate: Candidate) -> dict[str, Any]:
    """Return the arrays that the cache keeps of a candidate."""
    position, rotation = candidate.place
    return {
        "fingers": np.array(candidate.fingers),
        "position": np.array(position),
        "rotation": np.array(rotation),
        "home": candidate.home,
    }


def _place_of(kept: dict[str, Any]) -> tuple[Vector3, Vector3]:
    """Return position [m], and roll, pitch and yaw [rad], of a candidate in the cache."""
    x, y, z = kept["position"].tolist()
    roll, pitch, yaw = kept["rotation"].tolist()
    return (x, y, z), (roll, pitch, yaw)


def _posed(hand: HandDescription, kept: dict[str, Any]) -> HandDescription:
    """Return the hand in the pose of a candidate in the cache."""
    fingers = kept["fingers"].tolist()
    return at_place(with_protruding_tips(hand), fingers, kept["home"], *_place_of(kept))


def _searched(request: _Request) -> dict[str, Any]:
    """Search for a grasp; return the arrays that the cache keeps, or "fault" with a message."""
    hand, item, seed, least, approach, margin = request
    rng = np.random.default_rng(seed)
    trials = Trials(hand, item, margin)
    end = time.process_time() + LONGEST
    hand = trials.hand
    places = misdirected = 0
    faced = np.zeros((hand.finger_count,) * 2, dtype=bool)
    best: tuple[float, GraspPlan, Candidate] | None = None
    for attempt in range(_MAX_ATTEMPTS):
        pushed = (attempt % 2 == 0) == (item.shape != "cuboid")
        sites, facing = find_sites(hand, item, rng, least, _SITES, pushed, end)
        places += len(sites)
        faced |= facing
        palms = [None if approach is None else trials.palm(site) for site in sites]
        candidates: list[Candidate] = []
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
                if len(candidates) >= enough or time.process_time() > end:
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
                best = ratings[index], plan, candidates[index]
                break
            if best is not None:
                break
        last = attempt + 1 >= _ATTEMPTS
        enough_force = _WEAK if last else _GOOD
        if (best is None and last) or (best is not None and best[1].force <= enough_force):
            break
        if time.process_time() > end:
            break
    in_time = np.array(time.process_time() <= end)
    if best is None:
        fault = _fault(trials, places, misdirected, faced, approach, bool(in_time))
        miss = trials.nearest
        pose = {} if miss is None else {**_kept(miss.candidate), "reached": np.array(miss.reached)}
        return {"fault": np.array(fault), "in_time": in_time, **pose}
    _, plan, candidate = best
    return {
        **_kept(candidate),
        **{name: np.asarray(value) for name, value in vars(plan).items()},
        "in_time": in_time,
    }


def _fault(
    trials: Trials,
    places: int,
    misdirected: int,
    faced: NDArray[np.bool_],
    approach: Approach | None,
    in_time: bool,
) -> str:
    """Return why no grasp was found, and what to change."""
    hand, item = trials.hand, trials.item
    counts = ", ".join(f"{count} {what}" for what, count in trials.faults.most_common() if count)
    note = f", at {min(misdirected, places)} of which no side of the object comes from approach={approach}"
    limit = "" if in_time else f" in {LONGEST:.0f} s"
    return (
        f"no palm pose was found{limit} in which the hand {hand.name!r} grasps the {item.shape} of "
        f"{sides_text(item.extent)}: its fingers can surround it at {places} places{note if misdirected else ''}; of the "
        f"candidates tried there {counts or 'none is left'}. {trials.nearest_text()}{'' if places else _never_facing(hand, faced)}"
        f"{_wide_joints(hand)}Use an object of another size or more friction, another seed, or place the hand by `HandDescription.moved` "
        "and `home`"
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
