"""Places in a hand where its fingertips can surround an object.

Every finger's tips at some hundred postures are a map of where it can touch. Where a ball as large as the object meets tips of several
fingers that push against one another, the object's centre may be; of a cuboid, where two of them meet one side and a third the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grasp_env import core
from grasp_env._check import Array, Indices
from grasp_env.sim.grasping.approach import Approach
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.kinematics import HandKinematics, motor_span
from grasp_env.sim.hand.limbs import hand_limbs
from grasp_env.sim.objects.description import ObjectDescription

_ROUNDS, _POSTURES = 40, 200  # at most; postures in each, with one of the joints that move several fingers
_LOCKED_ROUNDS = 4  # of hands with one motor, whose postures form one line
_PAIRS, _ACROSS = 30_000, 0.7  # of tips in a round; the least they are apart, of the most that touch the same ball
_CENTERS, _DRAWS = 1000, 6  # places of the object in a round; postures drawn of each further finger there
_NEAR = 0.008  # [m] between a tip and the object's ball
_CLEAR = 0.001  # [m] of the rest of a finger from the object
_FLATTER = 1.6  # of a cuboid's ball, against which fingers are kept clear: its sides are flat
_ALIGNED = 1.0, 3.0  # how much it counts that fingers push along one axis of a cuboid: where all tips go anywhere, else
_OPPOSED = 0.45  # of the shortest sum of normals whose weights add to 1
_PUSHED = 0.3  # how much it counts that motors make none of the force along a normal
_APART = 0.004  # [m] between centres that are tried with the same fingers
_LOOKS = 40  # rotations that are drawn until the palm has a wanted direction
_PLAIN, _FEW = 2, 20  # rounds in which joints are anywhere in their ranges; sites with which these are too few
_SPAN = 0.8  # [rad] of the ranges at most, in later rounds
_PARTS = 3  # then in turn: at the lower ends of the ranges, in their middles, at the upper ends
_BESIDE = 0.1  # [rad] that half of the later postures lie beside those of sites, once there are some
_END = 0.001  # [rad] of later postures from the ends of the ranges, at least
_INSIDE = 0.05  # of a joint's range that postures keep from its ends


@dataclass(frozen=True)
class Site:
    """A place for the object in the hand.

    Attributes:
        center: Of the object [m], (3,), hand frame.
        posture: Of the hand there, (M,) [rad].
        fingers: That touch.
        axis: Along which they push, unit, (3,), hand frame.
        score: The smaller the better.
    """

    center: Array
    posture: Array
    fingers: tuple[int, ...]
    axis: Array
    score: float

    def turned(
        self,
        rng: np.random.Generator,
        item: ObjectDescription,
        palm: Array | None = None,
        approach: Approach | None = None,
    ) -> Array | None:
        """A rotation from the hand's frame to the object's (3, 3): the axis becomes one of the object's, of round ones any.

        Args:
            rng: Draws.
            item: The object.
            palm: Direction from the palm to the object, unit, (3,), hand frame.
            approach: What that must become; None: anything.

        Returns:
            None where no rotation that was drawn does.
        """
        if approach is None or palm is None:
            return self._drawn(rng, item)
        if item.shape in ("sphere", "mesh"):
            return _frame(approach.draw(rng), _directions(rng, 1)[0]) @ _frame(palm, _directions(rng, 1)[0]).T
        for _ in range(_LOOKS):
            turn = self._drawn(rng, item)
            if approach.allows(turn @ palm):
                return turn
        return None

    def _drawn(self, rng: np.random.Generator, item: ObjectDescription) -> Array:
        to = np.zeros(3)
        to[rng.integers(3)] = 1.0 if rng.random() < 0.5 else -1.0
        if item.shape in ("sphere", "mesh"):
            to = _directions(rng, 1)[0]
        return _frame(to, _directions(rng, 1)[0]) @ _frame(self.axis, _directions(rng, 1)[0]).T


def find_sites(
    hand: HandDescription, item: ObjectDescription, rng: np.random.Generator, least: int, most: int, pushed: bool = True
) -> tuple[list[Site], NDArray[np.bool_]]:
    """Find places at which the hand's fingers can surround an object.

    Args:
        hand: Where it was described.
        item: The object.
        rng: Draws.
        least: Fingers that touch at least.
        most: Sites.
        pushed: Prefer sites at which motors push along the normals; they are rare for some cuboids.

    Returns:
        Up to `most` sites at which at least `least` fingers touch, those first at which the most fingers push against one another; and
        which two fingers face each other with room for the object between them, in any posture that was drawn, (N, N).
    """
    kinematics = HandKinematics(hand)
    low, high = np.maximum(kinematics.lower, -np.pi), np.minimum(kinematics.upper, np.pi)
    end = np.minimum(_END, _INSIDE * (high - low))
    wide = low + end, high - end
    low, high = low + _INSIDE * (high - low), high - _INSIDE * (high - low)
    shared = kinematics.carries.sum(axis=0) > 1
    locked = one_motor(kinematics)
    found: list[Site] = []
    sites: list[Site] = []
    faced = np.zeros((hand.finger_count,) * 2, dtype=bool)
    for turn in range(_LOCKED_ROUNDS if locked else _ROUNDS):
        narrow = turn >= _PLAIN and len(sites) < _FEW and not locked
        postures = rng.random((_POSTURES, hand.joint_count))
        if narrow:
            span = np.minimum(wide[1] - wide[0], _SPAN)
            postures = wide[0] + turn % _PARTS * (wide[1] - wide[0] - span) / (_PARTS - 1) + postures * span
        else:
            postures = low + postures * (high - low)
        if narrow and sites:
            around = np.array([site.posture for site in sites])[rng.integers(len(sites), size=_POSTURES // 2)]
            near = around + _BESIDE * rng.standard_normal(around.shape)
            postures[: len(near)] = np.clip(near, *wide)
        if not locked:
            postures[:, shared] = kinematics.home[shared] if turn % 2 == 0 else postures[0, shared]
        for posture in postures:
            kinematics.tree.couple(posture)
        reach = _Reach(kinematics, item, postures, rng, pushed)
        found += reach.around(least, faced)
        found.sort(key=lambda site: site.score)
        sites = []
        for site in found:
            if len(sites) == most:
                return sites, faced
            if all(
                np.linalg.norm(site.center - other.center) > _APART or site.fingers != other.fingers for other in sites
            ):
                sites.append(site)
    return sites, faced


def one_motor(kinematics: HandKinematics) -> bool:
    """True if no finger has a motor of its own, as in a gripper whose jaws close together."""
    return bool((kinematics.carries.sum(axis=0) > 1)[kinematics.carries.any(axis=0)].all())


class _Reach:
    """Where the tips (K, N, 3) are at postures (K, M)."""

    def __init__(
        self,
        kinematics: HandKinematics,
        item: ObjectDescription,
        postures: Array,
        rng: np.random.Generator,
        pushed: bool,
    ) -> None:
        self.kinematics, self.item, self.postures, self.rng = kinematics, item, postures, rng
        self.limbs = core.HandLimbs.make(kinematics.tree, hand_limbs(kinematics.hand), kinematics.home)
        self.tips = np.array([kinematics.tips(posture) for posture in postures])
        self.radii, self.fingers = kinematics.tip_radii, kinematics.hand.finger_count
        self.aligned = _ALIGNED[0] if all(self.limbs.free) else _ALIGNED[1]
        self.locked = one_motor(kinematics)
        self.pushes = self._pushes() if pushed else None
        # two fingers hold what is narrow between them, more surround it
        self.radius = 0.5 * float(np.min(item.extent) if kinematics.hand.finger_count == 2 else np.median(item.extent))
        self.flatter = _FLATTER if item.shape == "cuboid" else 1.0

    def around(self, least: int, faced: NDArray[np.bool_]) -> list[Site]:
        """Centres of a ball that tips of several fingers touch. Two that face each other there are noted in `faced`."""
        tips, fingers, rng, item = self.tips, self.fingers, self.rng, self.item
        radius = self.radius
        centers, pairs, samples = self._between(radius + self.radii)
        for side in (0, 1):
            good = self._clear(pairs[:, side], samples[:, side], centers)
            centers, pairs, samples = centers[good], pairs[good], samples[good]
        faced[pairs[:, 0], pairs[:, 1]] = faced[pairs[:, 1], pairs[:, 0]] = True
        centers, pairs, samples = centers[:_CENTERS], pairs[:_CENTERS], samples[:_CENTERS]
        away = np.linalg.norm(tips[None] - centers[:, None, None], axis=3) - radius - self.radii  # (C, K, N)
        near, rows = np.abs(away) < _NEAR, np.arange(len(centers))
        if self.locked:  # all fingers are in the same sample
            near &= (np.arange(len(tips)) == samples[:, :1])[:, :, None]
        members, chosen = np.zeros((len(centers), fingers), dtype=bool), np.zeros((len(centers), fingers), np.int64)
        for side in (0, 1):
            members[rows, pairs[:, side]], chosen[rows, pairs[:, side]] = True, samples[:, side]
        for finger in range(fingers):
            for _ in range(_DRAWS):
                left = np.flatnonzero(~members[:, finger] & near[:, :, finger].any(axis=1))
                at: Indices = (near[left, :, finger] * rng.random((len(left), len(tips)))).argmax(axis=1)
                chosen[left, finger] = at
                members[left, finger] = self._clear(np.full(len(left), finger), at, centers[left])
        rows = np.flatnonzero(members.sum(axis=1) >= least)
        centers, members, chosen = centers[rows], members[rows], chosen[rows]
        arms = centers[:, None] - tips[chosen, np.arange(fingers)]
        normals = arms / np.linalg.norm(arms, axis=2, keepdims=True)
        opposed = _shortest(normals, members)
        out: list[Site] = []
        for row in np.flatnonzero(opposed < _OPPOSED):
            touching = np.flatnonzero(members[row])
            pushing = normals[row, touching]
            axis = np.linalg.eigh(pushing.T @ pushing)[1][:, -1]
            askew = 1.0 - float(np.abs(pushing @ axis).mean()) if item.shape == "cuboid" else 0.0
            score = float(opposed[row]) + 0.1 * (fingers - len(pushing)) + self.aligned * askew
            if self.pushes is not None:
                made = np.einsum("nij,nj->ni", self.pushes[chosen[row, touching], touching], pushing)
                score += _PUSHED * (1.0 - float(np.linalg.norm(made, axis=1).min()))
            posture = self._posture(centers[row], touching, chosen[row, touching])
            out.append(Site(centers[row], posture, tuple(touching.tolist()), axis, score))
        return out

    def _pushes(self) -> Array | None:
        """Projectors (K, N, 3, 3) on the forces that motors make at the tips; None where each finger has three motors or more."""
        kinematics = self.kinematics
        if self.locked or kinematics.carries.sum(axis=1).min() > 2:
            return None
        out = np.empty((len(self.postures), self.fingers, 3, 3))
        for row, posture in enumerate(self.postures):
            for finger in range(self.fingers):
                span = motor_span(kinematics.jacobian(posture, finger)[:, kinematics.carries[finger]])
                out[row, finger] = span @ span.T
        return out

    def _posture(self, center: Array, fingers: Indices, samples: Indices) -> Array:
        """Of the hand (M,), with these fingers as in these samples; the others keep away from the object."""
        if self.locked:
            return self.postures[samples[0]]
        posture = self.kinematics.home.copy()
        away = np.linalg.norm(self.tips - center, axis=2).argmax(axis=0)
        away[fingers] = samples
        for finger, at in enumerate(away):
            joints = self.kinematics.carries[finger]
            posture[joints] = self.postures[at, joints]
        return self.kinematics.coupled(posture)

    def _clear(self, fingers: Indices, samples: Indices, middles: Array) -> NDArray[np.bool_]:
        """Whether fingers (C,) in samples (C,) touch balls about `middles` (C, 3), of cuboids larger ones, with their tips alone."""
        gaps = np.empty(len(fingers))
        tips = self.tips[samples, fingers]
        middles = tips + self.flatter * (middles - tips)
        for finger in range(self.fingers):
            rows = np.flatnonzero(fingers == finger)
            found = np.empty(len(rows))
            self.limbs.beside(
                finger, self.postures[samples[rows]], np.ascontiguousarray(middles[rows]), 2.0 * _CLEAR, found
            )
            gaps[rows] = found
        return gaps > _CLEAR

    def _between(self, sizes: Array) -> tuple[Array, Indices, Indices]:
        """Centres (C, 3) that are `sizes` (N,) [m] from tips of two fingers on nearly opposite sides; these, and samples, (C, 2)."""
        rng, tips, fingers = self.rng, self.tips, self.fingers
        samples = rng.integers(len(tips), size=(_PAIRS, 2))
        if self.locked:
            samples[:, 1] = samples[:, 0]
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


def _shortest(normals: Array, members: NDArray[np.bool_]) -> Array:
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


def _frame(first: Array, second: Array) -> Array:
    """A rotation whose first column is `first`, the second as near to `second` as it can."""
    second = second - (second @ first) * first
    second /= np.linalg.norm(second)
    return np.column_stack([first, second, np.cross(first, second)])


def _directions(rng: np.random.Generator, count: int) -> Array:
    drawn = rng.standard_normal((count, 3))
    return drawn / np.linalg.norm(drawn, axis=1)[:, None]
