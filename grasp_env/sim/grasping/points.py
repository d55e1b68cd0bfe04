"""Where the hand takes hold of an object: force-closure grasps that it reaches, and checks of points a user gives."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from grasp_env import core
from grasp_env._check import Array, as_array
from grasp_env.errors import InvalidInputError
from grasp_env.grasp.presets import paper_cuboid
from grasp_env.sim.grasping.limbs import hand_limbs
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.objects.description import ObjectDescription

FRICTION_MARGIN = 0.85
"""Part of the friction with which a grasp must do."""
ON_SURFACE = 1e-4
"""[m] that a given point may be off the surface."""
LARGEST_FORCE = 500.0
"""[N] of total normal force in the worst case; a grasp that needs more is none."""

_GRAVITY, _PUSH, _TURN = 9.81, 2.0, 0.06  # [m/s^2], [N], [N m] that a grasp is rated by
_ASIDE = 1e-3  # [m] at which a given normal is tried
_SPACE = 0.003  # [m] between fingers
_PLACES, _RAYS, _STARTS, _ROUNDS = 20, 140, 20, 8
_SPREAD = 0.7  # of the directions in which places are sought
_MARGINS = (
    (0.005, 0.1, 0.003),
    (0.003, 0.02, 0.0015),
    (0.001, 0.0, 0.0005),
)  # [m] of flat surface, [rad] from joint limits, [m] of clearance that a place keeps; easier each time
_DIRECTIONS = 120


def grasp_points(
    item: ObjectDescription, kinematics: HandKinematics, rng: np.random.Generator | None = None
) -> tuple[Array, Array]:
    """Contacts with which the hand holds the object, the best of some thousand choices.

    The fingers reach them from the rest posture, joints and links with room to spare, away from edges. With 0.85 of the
    friction they balance weight, +-2 N and +-0.06 N m; among such choices the total normal force in the worst case is
    small. The default cuboid in the four-finger hand keeps the reference grasp.

    Args:
        item: The object, its body frame the world frame.
        kinematics: The hand.
        rng: Draws the places that are tried; None: always the same.

    Returns:
        Points [m] and inward unit normals, (N, 3) each, object frame, in the order of the fingers.

    Raises:
        InvalidInputError: The object is out of reach, too large for the hand, or cannot be held; the message says why.

    Example:
        >>> hand = HandKinematics(HandDescription.four_finger())
        >>> points, normals = grasp_points(ObjectDescription("sphere"), hand)
        >>> bool(np.allclose(points, -0.05 * normals))
        True
    """
    if rng is None and item.shape == "cuboid" and item.size == (0.1, 0.1, 0.1) and kinematics.hand == _four_finger():
        paper = paper_cuboid()
        return np.array(paper.positions), np.array(paper.normals)
    return _Search(item, kinematics, np.random.default_rng(0) if rng is None else rng).result()


def check_points(item: ObjectDescription, points: ArrayLike, normals: ArrayLike | None = None) -> tuple[Array, Array]:
    """A user's contacts, put exactly on the surface, with the normals there.

    Args:
        item: The object.
        points: [m], (N, 3), object frame, at most 0.1 mm off the surface.
        normals: Inward, (N, 3), of any length; on an edge any direction between those of its faces.

    Returns:
        Points [m] and unit normals, (N, 3) each.

    Raises:
        InvalidInputError: A point off the surface, or a normal that points out of the object or is not the surface's.

    Example:
        >>> check_points(ObjectDescription("sphere"), [[0.0, 0.0, -0.05]])[1]
        array([[0., 0., 1.]])
    """
    given = as_array(points, (None, 3), "points")
    on, inward = np.empty_like(given), np.empty_like(given)
    for index, point in enumerate(given):
        on[index], inward[index], distance = item.surface.nearest(point)
        if abs(distance) > ON_SURFACE:
            raise InvalidInputError(
                f"points[{index}]={point.tolist()} must lie on the surface of the {item.shape} of size {item.size}, it "
                f"is {1e3 * distance:.2f} mm {'outside' if distance > 0.0 else 'inside'}: the nearest point on it is "
                f"{np.round(on[index], 5).tolist()}"
            )
    if normals is not None:
        wanted = as_array(normals, given.shape, "normals")
        lengths = np.linalg.norm(wanted, axis=1)
        if not (lengths > 0.0).all():
            raise InvalidInputError(f"normals={wanted.tolist()} must not be zero; leave them out to use the surface's")
        for index, unit in enumerate(wanted / lengths[:, None]):
            # on an edge every direction between those of its faces is normal: the way back from outside leads there
            there, seen, _ = item.surface.nearest(on[index] - _ASIDE * unit)
            if np.abs(there - on[index]).max() > 0.01 * _ASIDE or seen @ unit < 0.0:
                raise InvalidInputError(
                    f"normals[{index}]={wanted[index].tolist()} must be the surface's inward normal "
                    f"{np.round(inward[index], 6).tolist()} at {on[index].tolist()}; leave normals out to use it"
                )
            inward[index] = unit
    return on, inward


class _Search:
    """One object in one hand: pools of places, choices among them, the first that the whole hand can take."""

    def __init__(self, item: ObjectDescription, kinematics: HandKinematics, rng: np.random.Generator) -> None:
        self.item, self.kinematics, self.rng = item, kinematics, rng
        self.limbs, self.fingers = _limbs(kinematics), kinematics.hand.finger_count
        length = 0.5 * float(np.mean(item.extent))
        self.core = core.GraspSearch.make(
            self.limbs,
            item.surface,
            friction=FRICTION_MARGIN * item.friction,
            length=length,
            space=_SPACE,
            loads=_loads(item.mass, length),
            directions=_spread_directions(),
        )

    def result(self) -> tuple[Array, Array]:
        self._check_palm()
        reason = ""
        for margins in _MARGINS:
            counts = self._fill(margins)
            if min(counts) == 0:
                reason = self._unreached(counts.index(0))
                continue
            found = self._best(margins[2])
            if found is not None:
                return found
            reason = (
                "the fingers reach it, but no choice of places balances its weight, +-2 N and +-0.06 N m with "
                f"{FRICTION_MARGIN} of its friction {self.item.friction}; raise the friction, or use a hand with more "
                "fingers"
            )
        raise InvalidInputError(f"{self._name} cannot be grasped by the hand {self.kinematics.hand.name!r}: {reason}")

    @property
    def _name(self) -> str:
        return f"the {self.item.shape} of {' x '.join(f'{side:.3g}' for side in self.item.extent)} m"

    def _fill(self, margins: tuple[float, float, float]) -> list[int]:
        """How many places each finger has."""
        sides = np.concatenate([self.item.extent, np.full(3, 2.0 * _SPREAD)])
        return [
            self.core.fill(finger, (self.rng.random((_RAYS, 6)) - 0.5) * sides, margins, _PLACES)
            for finger in range(self.fingers)
        ]

    def _best(self, clearance: float) -> tuple[Array, Array] | None:
        """The best choice for which the whole hand has angles, without contact but at the tips."""
        picks = self.rng.integers(0, 1 << 30, (_STARTS, self.fingers))
        forces, shape = np.full(_ROUNDS, np.inf), (_ROUNDS, self.fingers, 3)
        points, normals = np.empty(shape), np.empty(shape)
        self.core.choose(picks.tolist(), forces, points, normals)
        for turn in np.argsort(forces, kind="stable"):
            if forces[turn] > LARGEST_FORCE:
                return None
            try:
                angles = self.kinematics.solve(points[turn] - self.kinematics.tip_radii[:, None] * normals[turn])
            except InvalidInputError:  # fingers that share joints reach their places one by one only
                continue
            away, apart = self.limbs.clearance(self.item.surface, angles)
            if away >= 0.9 * clearance and apart > 0.0:
                return points[turn], normals[turn]
        return None

    def _check_palm(self) -> None:
        gap = self.limbs.palm_gap(self.item.surface)
        if gap < _MARGINS[-1][2]:
            raise InvalidInputError(
                f"{self._name} reaches {-1e3 * gap:.1f} mm into the palm of the hand {self.kinematics.hand.name!r}; "
                "use a smaller object or a palm further away"
            )

    def _unreached(self, finger: int) -> str:
        edges, far, touching = self.core.misses(finger)
        name = self.kinematics.hand.finger_names[finger]
        why = (
            f"of the places tried {far} are out of reach, at {touching} its links touch the object, and {edges} are "
            "too near to an edge"
        )
        return f"finger {name!r} finds no place on it: {why}. Use an object of another size, or move the finger's base"


def _loads(mass: float, length: float) -> Array:
    """Wrenches that the contacts must make, moments over `length` [N], (14, 6); 0 is inside their convex hull."""
    weight = np.array([0.0, mass * _GRAVITY, 0.0, 0.0, 0.0, 0.0])
    steps = np.concatenate([np.full(3, _PUSH), np.full(3, _TURN / length)])
    return np.concatenate([weight + np.diag(steps), weight - np.diag(steps), [weight, -0.5 * weight]])


@lru_cache(maxsize=1)
def _four_finger() -> HandDescription:
    return HandDescription.four_finger()


@lru_cache(maxsize=8)
def _limbs(kinematics: HandKinematics) -> core.HandLimbs:
    return core.HandLimbs.make(kinematics.tree, hand_limbs(kinematics.hand), kinematics.home)


@lru_cache(maxsize=1)
def _spread_directions() -> Array:
    """Unit directions in wrench space: the axes, then points spread over the sphere, (D, 6)."""
    drawn = np.random.default_rng(6).standard_normal((_DIRECTIONS - 12, 6))
    drawn /= np.linalg.norm(drawn, axis=1)[:, None]
    return np.concatenate([np.eye(6), -np.eye(6), drawn])
