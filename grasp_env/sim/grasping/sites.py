"""Sites in a hand where its fingertips can surround an object.

Some hundred random postures show where each fingertip can be. A site is the centre of a ball as
large as the object that touches the tips of several opposing fingers. At a cuboid two of them touch
one side and a third the opposite one.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grasp_env import core
from grasp_env.inputs.arguments import Array, Indices, unit_vectors
from grasp_env.sim.grasping.approach import Approach
from grasp_env.sim.grasping.pads import has_fixed_jaw
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.kinematics import HandKinematics, motor_force_basis
from grasp_env.sim.hand.limbs import hand_limbs
from grasp_env.sim.objects.description import ObjectDescription

_ROUNDS = 40
_POSTURES = 200  # in each round, with the same angles of joints that move several fingers
_LOCKED_ROUNDS = 4  # rounds for hands with one motor, whose postures form a line
_PAIRS = 30_000  # pairs of tips in a round
_ACROSS = 0.7  # least distance of a pair over the largest at which both touch the ball
_CENTERS, _DRAWS = 1000, 6  # centres in a round; postures drawn for each further finger at each
_NEAR = 0.008  # largest gap between a tip and the ball [m]
_CLEAR = 0.001  # least distance between the rest of a finger and the object [m]
_FLATTER = 1.6  # factor on the ball that fingers must clear for a cuboid, whose sides are flat
# weight of fingers pushing along one axis of a cuboid: if all tips can move freely, otherwise
_ALIGNED = 1.0, 3.0
_OPPOSED = 0.45  # largest norm of the shortest convex combination of normals
_PUSHED = 0.3  # weight of normal forces that motors do not make
_APART = 0.004  # least distance between sites of the same fingers [m]
_ROTATIONS = 40  # drawn to find one with the wanted direction of the palm
_WIDE_ROUNDS = 2  # rounds that use whole ranges of joints
_FEW = 20  # number of sites below which later rounds are narrow: they use sections of the ranges
_SPAN = 0.8  # largest section [rad]
_SECTIONS = 3  # in turn: lower end, middle, upper end
_BESIDE = 0.1  # standard deviation of half of the narrow postures around those of sites [rad]
_END = 0.001  # least distance of narrow postures from the ends of the ranges [rad]
_INSIDE = 0.05  # margin of wide postures at the ends of a joint's range, relative to it


@dataclass(frozen=True)
class Site:
    """A site for the object in the hand, hand frame."""

    center: Array  # of the object [m]
    posture: Array  # joint angles of the hand [rad], (M,)
    fingers: tuple[int, ...]  # that touch
    axis: Array  # unit direction along which they push
    score: float  # smaller is better

    def turned(
        self,
        rng: np.random.Generator,
        item: ObjectDescription,
        palm: Array | None,
        approach: Approach | None,
    ) -> Array | None:
        """Draw a rotation (3, 3) from the hand's frame to the object's.

        It turns `axis` into one of the object's axes, or any direction if the object is round, and
        `palm`, the direction from the palm to the object, into `approach`. None if no such rotation
        was drawn.
        """
        any_side = item.shape in ("sphere", "mesh")
        if any_side and approach is not None and palm is not None:
            return _random_turn(rng, palm, approach.draw(rng))
        for _ in range(_ROTATIONS):
            to = np.zeros(3)
            to[rng.integers(3)] = 1.0 if rng.random() < 0.5 else -1.0
            if any_side:
                to = _directions(rng, 1)[0]
            turn = _random_turn(rng, self.axis, to)
            if approach is None or palm is None or approach.allows(turn @ palm):
                return turn
        return None


def find_sites(
    hand: HandDescription,
    item: ObjectDescription,
    rng: np.random.Generator,
    least: int,
    most: int,
    pushed: bool = True,
    until: float = math.inf,
) -> tuple[list[Site], NDArray[np.bool_]]:
    """Find up to `most` sites, best first, where `least` or more fingers can surround an object.

    Also return an array (N, N), True if two fingers faced each other with room for the object
    between them. If `pushed`, sites at which motors push along the normals are preferred; they are
    rare for some cuboids. The search stops when this process has taken `until` seconds.
    """
    kinematics = HandKinematics(hand)
    low = np.maximum(kinematics.lower, -np.pi)
    high = np.minimum(kinematics.upper, np.pi)
    end = np.minimum(_END, _INSIDE * (high - low))
    ends = low + end, high - end
    low, high = low + _INSIDE * (high - low), high - _INSIDE * (high - low)
    shared = kinematics.carries.sum(axis=0) > 1
    locked = one_motor(kinematics)
    candidates: list[Site] = []
    sites: list[Site] = []
    faced = np.zeros((hand.finger_count,) * 2, dtype=bool)
    for number in range(_LOCKED_ROUNDS if locked else _ROUNDS):
        if time.process_time() > until:
            break
        narrow = number >= _WIDE_ROUNDS and len(sites) < _FEW and not locked
        postures = rng.random((_POSTURES, hand.joint_count))
        if narrow:
            span = np.minimum(ends[1] - ends[0], _SPAN)
            step = number % _SECTIONS * (ends[1] - ends[0] - span) / (_SECTIONS - 1)
            postures = ends[0] + step + postures * span
        else:
            postures = low + postures * (high - low)
        if narrow and sites:
            around = np.array([site.posture for site in sites])[
                rng.integers(len(sites), size=_POSTURES // 2)
            ]
            near = around + _BESIDE * rng.standard_normal(around.shape)
            postures[: len(near)] = np.clip(near, *ends)
        if not locked:
            even = number % 2 == 0
            postures[:, shared] = kinematics.home[shared] if even else postures[0, shared]
        for posture in postures:
            kinematics.tree.couple(posture)
        candidates += _Reach(kinematics, item, postures, rng, pushed).sites(least, faced)
        candidates.sort(key=lambda site: site.score)
        sites = []
        for site in candidates:
            if len(sites) == most:
                return sites, faced
            alike = [other.center for other in sites if other.fingers == site.fingers]
            if all(np.linalg.norm(site.center - center) > _APART for center in alike):
                sites.append(site)
    return sites, faced


def one_motor(kinematics: HandKinematics) -> bool:
    """True if no finger has a motor of its own, as in a gripper whose jaws close together."""
    return bool((kinematics.carries.sum(axis=0) > 1)[kinematics.carries.any(axis=0)].all())


class _Reach:
    """Positions of the tips (K, N, 3) [m] at postures (K, M)."""

    def __init__(
        self,
        kinematics: HandKinematics,
        item: ObjectDescription,
        postures: Array,
        rng: np.random.Generator,
        pushed: bool,
    ) -> None:
        self.kinematics = kinematics
        self.item = item
        self.postures = postures
        self.rng = rng
        self.limbs = core.HandLimbs.make(
            kinematics.tree, hand_limbs(kinematics.hand), kinematics.home
        )
        self.tips = np.array([kinematics.tips(posture) for posture in postures])
        self.radii = kinematics.tip_radii
        self.fingers = kinematics.hand.finger_count
        self.aligned = _ALIGNED[0] if all(self.limbs.free) else _ALIGNED[1]
        self.locked = one_motor(kinematics)
        self.pushes = self._pushes() if pushed else None
        # two fingers hold the narrowest side between them, more fingers surround the object
        self.radius = 0.5 * float(
            np.min(item.extent) if kinematics.hand.finger_count == 2 else np.median(item.extent)
        )
        # a fixed jaw is part of the palm, which the larger ball of the other jaw would always reach
        flat = item.shape == "cuboid" and not has_fixed_jaw(kinematics.hand)
        self.flatter = _FLATTER if flat else 1.0

    def sites(self, least: int, faced: NDArray[np.bool_]) -> list[Site]:
        """Find sites of `least` fingers or more; mark pairs that face each other in `faced`."""
        tips = self.tips
        fingers = self.fingers
        centers, pairs, samples = self._between(self.radius + self.radii)
        rows = np.arange(len(centers))
        for side in (0, 1):
            rows = rows[self._clear(pairs[rows, side], samples[rows, side], centers[rows])]
        faced[pairs[rows, 0], pairs[rows, 1]] = faced[pairs[rows, 1], pairs[rows, 0]] = True
        rows = rows[:_CENTERS]
        centers = centers[rows]
        pairs = pairs[rows]
        samples = samples[rows]
        distances = np.linalg.norm(tips[None] - centers[:, None, None], axis=3)  # (C, K, N)
        near = np.abs(distances - self.radius - self.radii) < _NEAR
        rows = np.arange(len(centers))
        if self.locked:  # all fingers have the same posture
            near &= (np.arange(len(tips)) == samples[:, :1])[:, :, None]
        members = np.zeros((len(centers), fingers), dtype=bool)
        chosen = np.zeros((len(centers), fingers), np.int64)
        for side in (0, 1):
            members[rows, pairs[:, side]], chosen[rows, pairs[:, side]] = True, samples[:, side]
        for finger in range(fingers):
            for _ in range(_DRAWS):
                rows = np.flatnonzero(~members[:, finger] & near[:, :, finger].any(axis=1))
                weights = near[rows, :, finger] * self.rng.random((len(rows), len(tips)))
                drawn: Indices = weights.argmax(axis=1)
                chosen[rows, finger] = drawn
                clear = self._clear(np.full(len(rows), finger), drawn, centers[rows])
                members[rows, finger] = clear
        rows = np.flatnonzero(members.sum(axis=1) >= least)
        centers = centers[rows]
        members = members[rows]
        chosen = chosen[rows]
        normals = unit_vectors(centers[:, None] - tips[chosen, np.arange(fingers)])
        opposed = _shortest(normals, members)
        sites: list[Site] = []
        for row in np.flatnonzero(opposed < _OPPOSED):
            touching = np.flatnonzero(members[row])
            pushing = normals[row, touching]
            axis = np.linalg.eigh(pushing.T @ pushing)[1][:, -1]
            score = float(opposed[row]) + 0.1 * (fingers - len(pushing))
            if self.item.shape == "cuboid":
                score += self.aligned * (1.0 - float(np.abs(pushing @ axis).mean()))
            if self.pushes is not None:
                projectors = self.pushes[chosen[row, touching], touching]
                shares = np.linalg.norm(np.einsum("nij,nj->ni", projectors, pushing), axis=1)
                score += _PUSHED * (1.0 - float(shares.min()))
            posture = self._posture(centers[row], touching, chosen[row, touching])
            sites.append(Site(centers[row], posture, tuple(touching.tolist()), axis, score))
        return sites

    def _pushes(self) -> Array | None:
        """Return projectors (K, N, 3, 3) onto the forces that motors make at the tips.

        None if every finger has three motors or more.
        """
        kinematics = self.kinematics
        if self.locked or kinematics.carries.sum(axis=1).min() > 2:
            return None
        projectors = np.empty((len(self.postures), self.fingers, 3, 3))
        for row, posture in enumerate(self.postures):
            for finger in range(self.fingers):
                jacobian = kinematics.jacobian(posture, finger)
                basis = motor_force_basis(jacobian[:, kinematics.carries[finger]])
                projectors[row, finger] = basis @ basis.T
        return projectors

    def _posture(self, center: Array, fingers: Indices, samples: Indices) -> Array:
        """Return joint angles (M,): these fingers as in these samples, the others far away."""
        if self.locked:
            return self.postures[samples[0]]
        posture = self.kinematics.home.copy()
        chosen = np.linalg.norm(self.tips - center, axis=2).argmax(axis=0)
        chosen[fingers] = samples
        for finger, sample in enumerate(chosen):
            joints = self.kinematics.carries[finger]
            posture[joints] = self.postures[sample, joints]
        return self.kinematics.coupled(posture)

    def _clear(self, fingers: Indices, samples: Indices, centers: Array) -> NDArray[np.bool_]:
        """Return (C,) True if fingers (C,) in samples (C,) touch balls with their tips only.

        The balls around `centers` (C, 3) are larger for cuboids.
        """
        clear = np.empty(len(fingers), dtype=bool)
        tips = self.tips[samples, fingers]
        centers = tips + self.flatter * (centers - tips)
        for finger in range(self.fingers):
            rows = np.flatnonzero(fingers == finger)
            gaps = np.empty(len(rows))
            middles = np.ascontiguousarray(centers[rows])
            self.limbs.beside(finger, self.postures[samples[rows]], middles, 2.0 * _CLEAR, gaps)
            clear[rows] = gaps > _CLEAR
        return clear

    def _between(self, sizes: Array) -> tuple[Array, Indices, Indices]:
        """Find points (C, 3) at distances `sizes` (N,) [m] from tips of two nearly opposite fingers.

        Also return their fingers and samples, (C, 2) each.
        """
        rng, tips, fingers = self.rng, self.tips, self.fingers
        samples = rng.integers(len(tips), size=(_PAIRS, 2))
        if self.locked:
            samples[:, 1] = samples[:, 0]
        first = rng.integers(fingers, size=_PAIRS)
        second = (first + rng.integers(1, max(fingers, 2), size=_PAIRS)) % fingers
        start = tips[samples[:, 0], first]
        axis = tips[samples[:, 1], second] - start
        length = np.linalg.norm(axis, axis=1)
        most = sizes[first] + sizes[second]
        rows = np.flatnonzero((first != second) & (length < most) & (length > _ACROSS * most))
        axis = axis[rows] / length[rows, None]
        length = length[rows]
        first = first[rows]
        second = second[rows]
        along = (length**2 + sizes[first] ** 2 - sizes[second] ** 2) / (2.0 * length)
        aside = np.cross(axis, _directions(rng, len(rows)))
        height = np.sqrt(np.maximum(sizes[first] ** 2 - along**2, 0.0))
        aside *= (height / np.linalg.norm(aside, axis=1))[:, None]
        points = start[rows] + along[:, None] * axis + aside
        return points, np.column_stack([first, second]), samples[rows]


def _shortest(normals: Array, members: NDArray[np.bool_]) -> Array:
    """Return the norm (C,) of the shortest convex combination of the members' unit normals.

    By the method of Frank and Wolfe; the shapes are (C, N, 3) and (C, N).
    """
    weight = members / members.sum(axis=1, keepdims=True)
    total = np.einsum("cn,cnk->ck", weight, normals)
    for _ in range(12):
        slopes = np.where(members, np.einsum("cnk,ck->cn", normals, total), np.inf)
        best = normals[np.arange(len(normals)), slopes.argmin(axis=1)]
        change = best - total
        size = np.maximum((change**2).sum(axis=1), 1e-12)
        total = total + np.clip(-(total * change).sum(axis=1) / size, 0.0, 1.0)[:, None] * change
    return np.linalg.norm(total, axis=1)


def _random_turn(rng: np.random.Generator, axis: Array, to: Array) -> Array:
    """Return a random rotation (3, 3) that turns the unit vector `axis` into `to`."""
    return _frame(to, _directions(rng, 1)[0]) @ _frame(axis, _directions(rng, 1)[0]).T


def _frame(first: Array, second: Array) -> Array:
    """Return a rotation with first column `first` and second column as near to `second` as can be."""
    second = second - (second @ first) * first
    second /= np.linalg.norm(second)
    return np.column_stack([first, second, np.cross(first, second)])


def _directions(rng: np.random.Generator, count: int) -> Array:
    return unit_vectors(rng.standard_normal((count, 3)))
