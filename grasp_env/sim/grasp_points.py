"""Where the hand takes hold of an object: force-closure grasps that it reaches, and checks of points a user gives."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grasp_env._check import Array, as_array
from grasp_env.errors import InvalidInputError
from grasp_env.grasp.presets import paper_cuboid
from grasp_env.sim.clearance import Limbs, hand_clearance, hand_limbs
from grasp_env.sim.grasp_places import fill_pool
from grasp_env.sim.grasp_search import choose
from grasp_env.sim.hand import HandDescription
from grasp_env.sim.hand_frames import rotation_matrix
from grasp_env.sim.kinematics import HandKinematics
from grasp_env.sim.kinematics_kernels import Tree
from grasp_env.sim.objects import ObjectDescription
from grasp_env.sim.shapes import nearest

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
)  # what `fill_pool` keeps; easier each time
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
        distance = nearest(item.surface, point, on[index], inward[index])
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
        there, seen = np.empty(3), np.empty(3)
        for index, unit in enumerate(wanted / lengths[:, None]):
            # on an edge every direction between those of its faces is normal: the way back from outside leads there
            nearest(item.surface, on[index] - _ASIDE * unit, there, seen)
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
        self.limbs, self.carried, self.chains = _parts(kinematics)
        self.fingers = len(self.chains)
        self.length = 0.5 * float(np.mean(item.extent))
        size, limbs = (self.fingers, _PLACES), len(self.limbs.links)
        self.counts = np.zeros(self.fingers, dtype=np.int64)
        self.points, self.normals = np.empty((*size, 3)), np.empty((*size, 3))
        self.starts, self.ends = np.empty((*size, limbs, 3)), np.empty((*size, limbs, 3))
        self.outcome = np.zeros((self.fingers, 3), dtype=np.int64)

    def result(self) -> tuple[Array, Array]:
        self._check_palm()
        reason = ""
        for margins in _MARGINS:
            self._fill(np.array(margins))
            if not self.counts.all():
                reason = self._unreached()
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

    def _fill(self, margins: Array) -> None:
        extent = np.array(self.item.extent)
        for finger, tip in enumerate(self.kinematics.tips(self.kinematics.home)):
            rays = self.rng.random((_RAYS, 6)) - 0.5
            rays *= np.concatenate([extent, np.full(3, 2.0 * _SPREAD)])
            joints = self.chains[finger].joints
            self.counts[finger] = fill_pool(
                self.chains[finger].tree, self.limbs, self.item.surface, joints, self.carried[finger],
                self.kinematics.home[None, joints], tip / max(float(np.linalg.norm(tip)), 1e-9), rays, margins,
                self.points[finger], self.normals[finger], self.starts[finger], self.ends[finger], self.outcome[finger],
            )  # fmt: skip

    def _best(self, clearance: float) -> tuple[Array, Array] | None:
        """The best choice for which the whole hand has angles, without contact but at the tips."""
        loads = self._loads()
        directions = np.zeros((_DIRECTIONS + _ROUNDS * len(loads), 6))
        directions[:_DIRECTIONS] = _spread_directions()
        choices, forces = np.zeros((_ROUNDS, self.fingers), dtype=np.int64), np.full(_ROUNDS, np.inf)
        picks = self.rng.integers(0, 1 << 30, (_STARTS, self.fingers))
        choose(
            self.limbs, self.carried, self.counts, self.points, self.normals, self.starts, self.ends,
            FRICTION_MARGIN * self.item.friction, self.length, loads, _SPACE, directions, _DIRECTIONS, picks,
            choices, forces,
        )  # fmt: skip
        row = np.arange(self.fingers)
        for turn in np.argsort(forces, kind="stable"):
            if forces[turn] > LARGEST_FORCE:
                return None
            points, normals = self.points[row, choices[turn]], self.normals[row, choices[turn]]
            try:
                angles = self.kinematics.solve(points - self.kinematics.tip_radii[:, None] * normals)
            except InvalidInputError:  # fingers that share joints reach their places one by one only
                continue
            away, apart = hand_clearance(_tree(self.kinematics), self.limbs, self.item.surface, angles)
            if away >= 0.9 * clearance and apart > 0.0:
                return points, normals
        return None

    def _loads(self) -> Array:
        """Wrenches that the contacts must make, moments over `length` [N], (14, 6); 0 is inside their convex hull."""
        weight = np.array([0.0, self.item.mass * _GRAVITY, 0.0, 0.0, 0.0, 0.0])
        steps = np.concatenate([np.full(3, _PUSH), np.full(3, _TURN / self.length)])
        return np.concatenate([weight + np.diag(steps), weight - np.diag(steps), [weight, -0.5 * weight]])

    def _check_palm(self) -> None:
        limbs = self.limbs
        palm = limbs.links < 0
        gap = np.inf
        if palm.any():
            still = Limbs(*(np.ascontiguousarray(part[palm]) for part in limbs))
            gap, _ = hand_clearance(_tree(self.kinematics), still, self.item.surface, self.kinematics.home)
        if gap < _MARGINS[-1][2]:
            raise InvalidInputError(
                f"{self._name} reaches {-1e3 * gap:.1f} mm into the palm of the hand {self.kinematics.hand.name!r}; "
                "use a smaller object or a palm further away"
            )

    def _unreached(self) -> str:
        finger = int(self.counts.argmin())
        edges, far, touching = self.outcome[finger].tolist()
        name = self.kinematics.hand.finger_names[finger]
        why = (
            f"of the places tried {far} are out of reach, at {touching} its links touch the object, and {edges} are "
            "too near to an edge"
        )
        return f"finger {name!r} finds no place on it: {why}. Use an object of another size, or move the finger's base"


@lru_cache(maxsize=1)
def _four_finger() -> HandDescription:
    return HandDescription.four_finger()


class _Chain(NamedTuple):
    """The joints that move one finger, and the tree of these alone."""

    joints: NDArray[np.int64]
    tree: Tree


@lru_cache(maxsize=8)
def _parts(kinematics: HandKinematics) -> tuple[Limbs, NDArray[np.bool_], list[_Chain]]:
    """The hand's limbs, whether a finger moves a limb, (N, C) bool, and the chain of each finger."""
    limbs = hand_limbs(kinematics.hand)
    carried = (limbs.links >= 0) & kinematics.carries[:, limbs.links]
    return limbs, carried, [_chain(kinematics, finger) for finger in range(len(carried))]


def _chain(kinematics: HandKinematics, finger: int) -> _Chain:
    tree, joints = _tree(kinematics), np.flatnonzero(kinematics.carries[finger])
    own = slice(finger, finger + 1)
    chain = Tree(
        parents=np.arange(len(joints)) - 1,
        offsets=tree.offsets[joints],
        rotations=tree.rotations[joints],
        axes=tree.axes[joints],
        masses=tree.masses[joints],
        centers=tree.centers[joints],
        tip_links=np.array([len(joints) - 1]),
        tip_centers=tree.tip_centers[own].copy(),
        tip_radii=tree.tip_radii[own].copy(),
        lower=tree.lower[joints],
        upper=tree.upper[joints],
        torque_limits=tree.torque_limits[joints],
    )
    return _Chain(joints.astype(np.int64), chain)


@lru_cache(maxsize=8)
def _tree(kinematics: HandKinematics) -> Tree:
    """The arrays of the search's kernels."""
    hand = kinematics.hand
    numbers = {link.name: index for index, link in enumerate(hand.links)}
    return Tree(
        parents=np.array([numbers.get(link.parent, -1) for link in hand.links], dtype=np.int64),
        offsets=np.array([link.origin for link in hand.links]),
        rotations=np.array([rotation_matrix(link.rotation) for link in hand.links]),
        axes=np.array([link.axis for link in hand.links]),
        masses=np.array([link.mass for link in hand.links]),
        centers=np.array([link.center for link in hand.links]),
        tip_links=kinematics.tip_links,
        tip_centers=np.array([tip.center for tip in hand.fingertips]),
        tip_radii=kinematics.tip_radii,
        lower=kinematics.lower,
        upper=kinematics.upper,
        torque_limits=kinematics.torque_limits,
    )


@lru_cache(maxsize=1)
def _spread_directions() -> Array:
    """Unit directions in wrench space: the axes, then points spread over the sphere, (D, 6)."""
    drawn = np.random.default_rng(6).standard_normal((_DIRECTIONS - 12, 6))
    drawn /= np.linalg.norm(drawn, axis=1)[:, None]
    return np.concatenate([np.eye(6), -np.eye(6), drawn])
