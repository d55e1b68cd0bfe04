"""Where a hand must be to take hold of an object: palm pose, rest posture and the fingers that touch.

Every finger's tips at some hundred postures are a map of where it can touch. Where a ball as large as the object meets tips of several
fingers that push against one another, the object's centre may be; turned many ways it is then grasped there as anywhere else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from grasp_env import core
from grasp_env._check import Array, Indices, whole
from grasp_env.errors import InvalidInputError
from grasp_env.sim.grasping.points import GraspPlan, GraspSearch, plan_grasp
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.frames import roll_pitch_yaw
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.hand.limbs import hand_limbs, touching_pairs
from grasp_env.sim.objects.description import ObjectDescription

_ROUNDS, _POSTURES = (
    12,
    200,
)  # at most, each with one posture of the joints that move several fingers; of the other joints
_PAIRS, _ACROSS = 30_000, 0.7  # of tips in a round; the least they are apart, of the most that touch the same ball
_CENTERS, _DRAWS = 1000, 6  # places of the object in a round; postures drawn of each further finger there
_NEAR = 0.008  # [m] between a tip and the object's ball
_CLEAR = 0.001  # [m] of the rest of a finger from the ball
_OPPOSED = 0.45  # of the shortest sum of normals whose weights add to 1
_APART = 0.004  # [m] between centres that are tried with the same fingers
_TRIED, _TURNS = 60, 6  # centres, and turns of the object at each
_ENOUGH = 12  # grasps to choose from
_INSIDE = 0.05  # of a joint's range that postures keep from its ends


@dataclass(frozen=True)
class _Site:
    """A place for the object's centre in the hand [m], (3,); the posture (M,), the fingers, and the axis along which they push."""

    center: Array
    posture: Array
    fingers: tuple[int, ...]
    axis: Array


def place_hand(
    hand: HandDescription, item: ObjectDescription, *, seed: int = 0, least: int | None = None
) -> HandDescription:
    """The hand where it holds the object well: palm, rest posture and fingertips are chosen.

    The object is at the origin of the world, gravity along -y, and the hand may come from any side. Fingers that find no place are
    left out where at least three others, with soft contacts two, hold without them.

    Args:
        hand: Its own place and rest posture do not matter.
        item: The object.
        seed: Of the search, >= 0.
        least: Fingers that touch at least; None: three, with soft contacts two.

    Returns:
        A hand with which `plan_grasp` finds a grasp; the same for the same arguments. Found once for each of them in a process.

    Raises:
        InvalidInputError: No palm pose was found; the message says on how many candidates what failed.
    """
    fingers = (
        (2 if item.torsional_friction > 0.0 else 3) if least is None else whole(least, "least", 1, hand.finger_count)
    )
    return _placed(hand, item, whole(seed, "seed", 0), fingers)


@lru_cache(maxsize=64)
def _placed(hand: HandDescription, item: ObjectDescription, seed: int, least: int) -> HandDescription:
    rng = np.random.default_rng(seed)
    faults: dict[str, int] = {}
    found: list[tuple[float, HandDescription]] = []
    hands: dict[tuple[int, ...], tuple[HandDescription, core.HandLimbs]] = {}
    sites = _sites(hand, item, rng, least)
    for site in sites:
        for _ in range(_TURNS):
            turn = _turn(rng, item, site.axis)
            plan, fingers = _try(site, turn, item, hand, hands, least, faults, rng)
            if plan is not None:
                x, y, z = (-turn @ site.center).tolist()
                placed = replace(hands[fingers][0], home=tuple(plan.start.tolist())).moved(
                    (x, y, z), roll_pitch_yaw(turn)
                )
                found.append((plan.force, placed))
        if len(found) >= _ENOUGH:
            break
    for _, placed in sorted(found, key=lambda pair: pair[0]):
        try:
            plan_grasp(item, HandKinematics(placed))
        except InvalidInputError:
            continue
        return placed
    counts = ", ".join(f"{count} {what}" for what, count in sorted(faults.items(), key=lambda pair: -pair[1]) if count)
    raise InvalidInputError(
        f"no palm pose was found in which the hand {hand.name!r} grasps the {item.shape} of "
        f"{' x '.join(f'{side:.3g}' for side in item.extent)} m: its fingers can surround it at {len(sites)} places; of what was "
        f"tried there {counts or 'nothing is left'}. Use an object of another size or more friction, another seed, or place the hand "
        "by `HandDescription.moved` and `home`"
    )


def _try(
    site: _Site,
    turn: Array,
    item: ObjectDescription,
    hand: HandDescription,
    hands: dict[tuple[int, ...], tuple[HandDescription, core.HandLimbs]],
    least: int,
    faults: dict[str, int],
    rng: np.random.Generator,
) -> tuple[GraspPlan | None, tuple[int, ...]]:
    """A grasp there with the fingers of a site, or with those of them that find places."""
    fingers = site.fingers
    while len(fingers) >= least:
        if fingers not in hands:
            part = replace(hand, fingertips=tuple(hand.fingertips[finger] for finger in fingers))
            kinematics = HandKinematics(part)
            pairs = touching_pairs(hand, at_home=False)
            hands[fingers] = part, core.HandLimbs.make(kinematics.tree, hand_limbs(part), kinematics.home, pairs)
        part, limbs = hands[fingers]
        moved = limbs.moved(turn.ravel().tolist(), (-turn @ site.center).tolist(), site.posture)
        search = GraspSearch(item, moved, part)
        plan = search.run(rng, tries=0)
        for what, count in search.faults.items():
            faults[what] = faults.get(what, 0) + count
        if plan is not None or not max(search.short):
            return plan, fingers
        fingers = tuple(finger for finger, short in zip(fingers, search.short, strict=True) if not short)
    return None, fingers


def _sites(hand: HandDescription, item: ObjectDescription, rng: np.random.Generator, least: int) -> list[_Site]:
    """Places for the object, those first where most fingers push against one another."""
    kinematics = HandKinematics(hand)
    limbs = core.HandLimbs.make(kinematics.tree, hand_limbs(hand), kinematics.home)
    low, high = np.maximum(kinematics.lower, -np.pi), np.minimum(kinematics.upper, np.pi)
    low, high = low + _INSIDE * (high - low), high - _INSIDE * (high - low)
    shared = kinematics.carries.sum(axis=0) > 1
    found: list[tuple[float, _Site]] = []
    sites: list[_Site] = []
    for turn in range(_ROUNDS):
        postures = low + rng.random((_POSTURES, hand.joint_count)) * (high - low)
        postures[:, shared] = kinematics.home[shared] if turn % 2 == 0 else postures[0, shared]
        for posture in postures:
            kinematics.tree.couple(posture)
        found += _meetings(kinematics, limbs, postures, item, rng, least)
        found.sort(key=lambda pair: pair[0])
        sites = []
        for _, site in found:
            if len(sites) == _TRIED:
                return sites
            if all(
                np.linalg.norm(site.center - other.center) > _APART or site.fingers != other.fingers for other in sites
            ):
                sites.append(site)
    return sites


def _meetings(
    kinematics: HandKinematics,
    limbs: core.HandLimbs,
    postures: Array,
    item: ObjectDescription,
    rng: np.random.Generator,
    least: int,
) -> list[tuple[float, _Site]]:
    """Centres of a ball that tips of several fingers touch, with how little they oppose one another."""
    tips = np.array([kinematics.tips(posture) for posture in postures])  # (K, N, 3)
    radius = 0.5 * float(np.median(item.extent))
    count, fingers = tips.shape[:2]

    def clear(finger: int, at: Indices, middles: Array) -> NDArray[np.bool_]:
        gaps = np.empty(len(at))
        limbs.beside(finger, np.ascontiguousarray(postures[at]), np.ascontiguousarray(middles), 2.0 * _CLEAR, gaps)
        return gaps > _CLEAR

    centers, pairs, samples = _between(tips, radius + kinematics.tip_radii, rng)
    for side in (0, 1):
        good = np.zeros(len(centers), dtype=bool)
        for finger in range(fingers):
            rows = np.flatnonzero(pairs[:, side] == finger)
            good[rows] = clear(finger, samples[rows, side], centers[rows])
        centers, pairs, samples = centers[good], pairs[good], samples[good]
    centers, pairs, samples = centers[:_CENTERS], pairs[:_CENTERS], samples[:_CENTERS]
    away = np.linalg.norm(tips[None] - centers[:, None, None], axis=3) - radius - kinematics.tip_radii  # (C, K, N)
    near, rows = np.abs(away) < _NEAR, np.arange(len(centers))
    members, chosen = np.zeros((len(centers), fingers), dtype=bool), np.zeros((len(centers), fingers), dtype=np.int64)
    for side in (0, 1):
        members[rows, pairs[:, side]], chosen[rows, pairs[:, side]] = True, samples[:, side]
    for finger in range(fingers):
        for _ in range(_DRAWS):
            left = np.flatnonzero(~members[:, finger] & near[:, :, finger].any(axis=1))
            at: Indices = (near[left, :, finger] * rng.random((len(left), count))).argmax(axis=1)
            chosen[left, finger] = at
            members[left, finger] = clear(finger, at, centers[left])
    rows = np.flatnonzero(members.sum(axis=1) >= least)
    centers, members, chosen, away = centers[rows], members[rows], chosen[rows], away[rows]
    arms = centers[:, None] - tips[chosen, np.arange(fingers)]
    normals = arms / np.linalg.norm(arms, axis=2, keepdims=True)
    opposed = _shortest(normals, members)
    out: list[tuple[float, _Site]] = []
    for row in np.flatnonzero(opposed < _OPPOSED):
        posture = kinematics.home.copy()
        for finger in range(fingers):
            # fingers that do not touch keep away from the object
            own = chosen[row, finger] if members[row, finger] else int(np.argmax(away[row, :, finger]))
            joints = kinematics.carries[finger]
            posture[joints] = postures[own, joints]
        pushing = normals[row, members[row]]
        axis = np.linalg.eigh(pushing.T @ pushing)[1][:, -1]
        askew = 1.0 - float(np.abs(pushing @ axis).mean()) if item.shape == "cuboid" else 0.0
        score = float(opposed[row]) + 0.1 * (fingers - len(pushing)) + askew
        touching = tuple(np.flatnonzero(members[row]).tolist())
        out.append((score, _Site(centers[row], kinematics.coupled(posture), touching, axis)))
    return out


def _between(tips: Array, sizes: Array, rng: np.random.Generator) -> tuple[Array, Indices, Indices]:
    """Centres (C, 3) that are `sizes` (N,) [m] from tips (K, N, 3) of two fingers on nearly opposite sides; these, (C, 2), and their K."""
    count, fingers = tips.shape[:2]
    samples = rng.integers(count, size=(_PAIRS, 2))
    one = rng.integers(fingers, size=_PAIRS)
    other = (one + rng.integers(1, max(fingers, 2), size=_PAIRS)) % fingers
    start, way = tips[samples[:, 0], one], tips[samples[:, 1], other] - tips[samples[:, 0], one]
    apart, most = np.linalg.norm(way, axis=1), sizes[one] + sizes[other]
    kept = np.flatnonzero((one != other) & (apart < most) & (apart > _ACROSS * most))
    way, apart, one, other = way[kept] / apart[kept, None], apart[kept], one[kept], other[kept]
    along = (apart**2 + sizes[one] ** 2 - sizes[other] ** 2) / (2.0 * apart)
    aside = np.cross(way, _directions(rng, len(kept)))
    aside *= (np.sqrt(np.maximum(sizes[one] ** 2 - along**2, 0.0)) / np.linalg.norm(aside, axis=1))[:, None]
    return start[kept] + along[:, None] * way + aside, np.column_stack([one, other]), samples[kept]


def _shortest(normals: Array, members: Array) -> Array:
    """The least length of weighted sums of unit normals (C, N, 3), weights adding to 1 over the members (C, N): Frank and Wolfe."""
    weight = members / members.sum(axis=1, keepdims=True)
    total = np.einsum("cn,cnk->ck", weight, normals)
    for _ in range(12):
        slopes = np.where(members, np.einsum("cnk,ck->cn", normals, total), np.inf)
        best = normals[np.arange(len(normals)), slopes.argmin(axis=1)]
        change = best - total
        size = np.maximum((change**2).sum(axis=1), 1e-12)
        total = total + np.clip(-(total * change).sum(axis=1) / size, 0.0, 1.0)[:, None] * change
    return np.linalg.norm(total, axis=1)


def _turn(rng: np.random.Generator, item: ObjectDescription, axis: Array) -> Array:
    """A rotation of the hand (3, 3): the axis along which the fingers push becomes one of those of the object, any for round ones."""
    if item.shape in ("sphere", "mesh"):
        to = _directions(rng, 1)[0]
    else:
        to = np.zeros(3)
        to[rng.integers(3)] = 1.0 if rng.random() < 0.5 else -1.0
    return _frame(to, _directions(rng, 1)[0]) @ _frame(axis, _directions(rng, 1)[0]).T


def _frame(first: Array, second: Array) -> Array:
    """A rotation whose first column is `first`, the second as near to `second` as it can."""
    second = second - (second @ first) * first
    second /= np.linalg.norm(second)
    return np.column_stack([first, second, np.cross(first, second)])


def _directions(rng: np.random.Generator, count: int) -> Array:
    drawn = rng.standard_normal((count, 3))
    return drawn / np.linalg.norm(drawn, axis=1)[:, None]
