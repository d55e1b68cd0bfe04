"""Contacts on an object: force-closure grasps that a hand reaches, and checks of contacts."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from grasp_env import core
from grasp_env.errors import InvalidInputError
from grasp_env.grasp.presets import paper_cuboid
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import Array, as_array, number, unit_vectors
from grasp_env.sim.config import ON_SURFACE, START_CLEARANCE, SceneConfig
from grasp_env.sim.engine import engine_of
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.hand.limbs import APART, hand_limbs, touching_pairs
from grasp_env.sim.objects.description import ObjectDescription, sides_text

FRICTION_MARGIN = 0.85  # default share of the friction that a grasp may use
LARGEST_FORCE = 500.0  # largest total normal force of a grasp in the worst case [N]
_GRAVITY, _PUSH, _TURN = 9.81, 2.0, 0.06  # loads that rate a grasp [m/s^2], [N], [N m]
_ASIDE = 1e-3  # distance from the contact at which a normal is tested [m]
_CONTACTS = 20  # candidates per finger
_RAYS = 140
_STARTS = 20
_ROUNDS = 8
_SPREAD = 0.7  # spread of the rays' directions
# flat surface [m], distance from joint limits [rad], clearance [m], distance to a mesh's pieces
# [m]; easier row by row
_MARGINS = (
    (0.005, 0.1, 0.003, 0.0003),
    (0.003, 0.02, 0.0015, 0.0006),
    (0.001, 0.0, 0.0005, 0.0015),
)
_ROOM = _MARGINS[0][2]
_DIRECTIONS = 120
_TRIES = 3  # runs with the easier margins
MISSES = (
    "too near to an edge",
    "out of reach",
    "too near to a joint limit",
    "with a link at the object",
    "without room to start",
    "without push along the normal",
)  # of candidates, in the core's order
_FAULTS = (
    "with a link of the whole hand at the object",
    "with links that touch",
    "without a start",
    "with a link at the object at the start",
    "with links that touch at the start",
    "with fingers of one motor that do not touch together",
)  # of postures of the hand, in the core's order


@dataclass(frozen=True)
class GraspPlan:
    """A grasp and the postures that lead to it; N fingers, M joints.

    Attributes:
        points: Contacts [m], (N, 3), object frame, in the order of the fingers.
        normals: Inward unit normals at the contacts, (N, 3).
        angles: Joint angles at the contacts [rad], (M,).
        start: Joint angles before the fingers close [rad], (M,), with every tip `START_CLEARANCE`
            from the object.
        force: Total normal force in the worst case [N], or the load of the most loaded joint if
            that is more: 30 N is its torque limit. inf: not rated, as for given contacts.
        clearance: Clearance of the links from the object [m]; margins from edges and joint limits
            decrease with it.
    """

    points: Array
    normals: Array
    angles: Array
    start: Array
    force: float = np.inf
    clearance: float = 0.0


def grasp_points(
    item: ObjectDescription,
    kinematics: HandKinematics,
    rng: np.random.Generator | None = None,
    friction_margin: float = FRICTION_MARGIN,
) -> tuple[Array, Array]:
    """Return the points [m] and inward unit normals, (N, 3) each, of `plan_grasp`.

    Example:
        >>> hand = HandKinematics(HandDescription.four_finger())
        >>> points, normals = grasp_points(ObjectDescription("sphere"), hand)
        >>> bool(np.allclose(points, -0.05 * normals))
        True
    """
    plan = plan_grasp(item, kinematics, rng, friction_margin)
    return plan.points, plan.normals


def plan_grasp(
    item: ObjectDescription,
    kinematics: HandKinematics,
    rng: np.random.Generator | None = None,
    friction_margin: float = FRICTION_MARGIN,
) -> GraspPlan:
    """Find the best of some thousand choices of contacts for the hand in its pose.

    The fingers reach the contacts from the rest posture, away from edges, with margins to joint
    limits and between links. With this share of the friction the contacts balance the weight,
    +-2 N and +-0.06 N m. The best plan has the smallest `GraspPlan.force`. The default cuboid in
    the four-finger hand keeps the reference grasp.

    Args:
        item: The object; its body frame is the world frame.
        kinematics: The hand.
        rng: Random generator of the candidate contacts; None for a fixed seed.
        friction_margin: Share of the friction that forces may use, 0.01 to 1.

    Raises:
        InvalidInputError: The object is out of reach, too large for the hand, or cannot be held;
            the message counts the reasons.
    """
    margin = number(friction_margin, "friction_margin", ranges.FRICTION_MARGIN)
    if (
        rng is None
        and item.shape == "cuboid"
        and item.size == (0.1, 0.1, 0.1)
        and kinematics.hand == _four_finger()
    ):
        return _reference_plan(item, kinematics)
    search = GraspSearch(item, limbs_of(kinematics), kinematics.hand, margin)
    plan = search.run(np.random.default_rng(0) if rng is None else rng)
    if plan is None:
        raise InvalidInputError(search.reason())
    return plan


def _reference_plan(item: ObjectDescription, kinematics: HandKinematics) -> GraspPlan:
    grasp = paper_cuboid()
    points = np.array(grasp.positions)
    engine = engine_of(quiet=True)  # nothing is simulated
    config = SceneConfig(kinematics.hand, item, tuple(map(tuple, points.tolist())), engine=engine)
    angles = kinematics.solve(config.nominal_tips())
    start = kinematics.solve(replace(config, clearance=START_CLEARANCE).nominal_tips())
    return GraspPlan(points, np.array(grasp.normals), angles, start)


def check_points(
    item: ObjectDescription, points: ArrayLike, normals: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Project contacts onto the surface, and check or find their normals.

    Args:
        item: The object.
        points: Contacts [m], (N, 3), object frame, at most 0.1 mm off the surface.
        normals: Inward normals, (N, 3), of any length; on an edge any direction between the normals
            of its faces. None for those of the surface.

    Returns:
        Points [m] and unit normals, (N, 3) each.

    Raises:
        InvalidInputError: A point is off the surface, or a normal is not the surface's.

    Example:
        >>> check_points(ObjectDescription("sphere"), [[0.0, 0.0, -0.05]])[1]
        array([[0., 0., 1.]])
    """
    contacts = as_array(points, (None, 3), "points")
    on = np.empty_like(contacts)
    inward = np.empty_like(contacts)
    for index, point in enumerate(contacts):
        on[index], inward[index], distance = item.surface.nearest(point)
        if abs(distance) > ON_SURFACE:
            raise InvalidInputError(
                f"points[{index}]={point.tolist()} must lie on the surface of the {item.shape} of size {item.size}, it "
                f"is {1e3 * distance:.2f} mm {'outside' if distance > 0.0 else 'inside'}: the nearest point on it is "
                f"{np.round(on[index], 5).tolist()}"
            )
    if normals is not None:
        vectors = as_array(normals, contacts.shape, "normals")
        lengths = np.linalg.norm(vectors, axis=1)
        if not (lengths > 0.0).all():
            raise InvalidInputError(
                f"normals={vectors.tolist()} must not be zero; leave them out to use the surface's"
            )
        for index, unit in enumerate(vectors / lengths[:, None]):
            # for every normal of a face or edge, a point outside along it is nearest to the contact
            nearest, normal, _ = item.surface.nearest(on[index] - _ASIDE * unit)
            if np.abs(nearest - on[index]).max() > 0.01 * _ASIDE or normal @ unit < 0.0:
                raise InvalidInputError(
                    f"normals[{index}]={vectors[index].tolist()} must be the surface's inward normal "
                    f"{np.round(inward[index], 6).tolist()} at {on[index].tolist()}; leave normals out to use it"
                )
            inward[index] = unit
    return on, inward


def narrowness(clearance: float) -> float:
    """Return the factor by which a force counts more where links are this near to an object [m]."""
    return (_ROOM / clearance) ** 0.5


class GraspSearch:
    """Search for a grasp of one object by a hand, whose limbs are in its pose.

    It draws candidate contacts for each finger, chooses among them, and finds postures of the
    whole hand. `faults` counts rejected candidates by reason, and `short` how often each finger
    had no candidate. `reached` tells which fingers had one with those margins with which most had.
    """

    def __init__(
        self,
        item: ObjectDescription,
        limbs: core.HandLimbs,
        hand: HandDescription,
        friction_margin: float,
    ) -> None:
        self.item, self.limbs, self.hand = item, limbs, hand
        self.margin = friction_margin
        self.faults = Counter[str]()
        self.short = [0] * hand.finger_count
        self.reached = [False] * hand.finger_count
        self._gap = limbs.palm_gap(item.surface)
        length = 0.5 * float(np.mean(item.extent))
        self._spread = [*item.extent, *[2.0 * _SPREAD] * 3]
        self.core = core.GraspSearch.make(
            limbs,
            item.surface,
            friction=self.margin * item.friction * hand.tip_friction,
            torsion=self.margin * item.torsional_friction * hand.tip_friction,
            length=length,
            space=APART,
            start=START_CLEARANCE,
            gravity=(0.0, -_GRAVITY, 0.0),
            loads=_loads(item.mass, length),
            directions=_spread_directions(),
        )

    @property
    def in_palm(self) -> bool:
        """True if the palm is where the object is; no contact is tried then."""
        return self._gap < _MARGINS[-1][2]

    def run(
        self, rng: np.random.Generator, tries: int = _TRIES, rays: int = _RAYS
    ) -> GraspPlan | None:
        """Search along `rays` per finger; after a failure, `tries` times with each easier margin.

        None if no grasp is found.
        """
        if self.in_palm:
            self.faults["with the object in the palm"] += 1
            return None
        for margins in _MARGINS[:1] + _MARGINS[1:] * tries:
            counts = [
                self.core.fill(finger, rng.random((rays, 6)), self._spread, margins, _CONTACTS)
                for finger in range(self.hand.finger_count)
            ]
            for finger, count in enumerate(counts):
                self.short[finger] += count == 0
                self.faults.update(dict(zip(MISSES, self.core.misses(finger), strict=True)))
            reached = [count > 0 for count in counts]
            self.reached = max(reached, self.reached, key=sum)
            if min(counts) > 0 and (plan := self._best(rng, margins[2])) is not None:
                return plan
        return None

    def reason(self) -> str:
        """Explain why `run` found no grasp."""
        name = f"the {self.item.shape} of {sides_text(self.item.extent)}"
        if self.in_palm:
            return (
                f"{name} reaches {-1e3 * self._gap:.1f} mm into the palm of the hand {self.hand.name!r}; "
                "use a smaller object or a palm further away"
            )
        counts = ", ".join(f"{count} {what}" for what, count in self.faults.items() if count)
        start = f"{name} cannot be grasped by the hand {self.hand.name!r}: "
        if max(self.short) > 0:
            finger = self.hand.finger_names[int(np.argmax(self.short))]
            return (
                f"{start}finger {finger!r} finds no contact on it; of all contacts tried {counts}. Use an object of another size, "
                "move the finger's base, or let `place_hand` look for a palm pose"
            )
        return (
            f"{start}the fingers reach it, but no choice of contacts balances its weight, +-2 N and +-0.06 N m with "
            f"{self.margin:g} of its friction {self.item.friction}; of contacts and choices tried {counts}; raise the friction, "
            "or use a hand with more fingers or another palm pose"
        )

    def _best(self, rng: np.random.Generator, clearance: float) -> GraspPlan | None:
        """Return the best choice of contacts that the whole hand touches with its tips only."""
        fingers = self.hand.finger_count
        joints = self.hand.joint_count
        picks = rng.integers(0, 1 << 30, (_STARTS, fingers))
        forces = np.full(_ROUNDS, np.inf)
        points = np.empty((_ROUNDS, fingers, 3))
        normals = np.empty_like(points)
        choices = np.empty((_ROUNDS, fingers))
        self.core.choose(picks.tolist(), forces, points, normals, choices)
        for best in np.argsort(forces, kind="stable"):
            if forces[best] > LARGEST_FORCE:
                self.faults["without force closure"] += 1
                return None
            angles = np.empty(joints)
            start = np.empty(joints)
            chosen = [int(contact) for contact in choices[best]]
            fault = self.core.assemble(chosen, clearance, angles, start)
            if fault == 0:
                force = float(forces[best])
                return GraspPlan(points[best], normals[best], angles, start, force, clearance)
            self.faults[_FAULTS[fault - 1]] += 1
        return None


def _loads(mass: float, length: float) -> Array:
    """Return the wrenches that the contacts must balance, moments over `length` [N], (14, 6).

    Their convex hull contains 0.
    """
    weight = np.array([0.0, mass * _GRAVITY, 0.0, 0.0, 0.0, 0.0])
    steps = np.diag([_PUSH] * 3 + [_TURN / length] * 3)
    return np.concatenate([weight + steps, weight - steps, [weight, -0.5 * weight]])


@lru_cache(maxsize=1)
def _four_finger() -> HandDescription:
    return HandDescription.four_finger()


@lru_cache(maxsize=8)
def limbs_of(kinematics: HandKinematics) -> core.HandLimbs:
    """Return the limbs of a hand in its pose."""
    hand = kinematics.hand
    return core.HandLimbs.make(
        kinematics.tree, hand_limbs(hand), kinematics.home, touching_pairs(hand)
    )


@lru_cache(maxsize=1)
def _spread_directions() -> Array:
    """Return unit directions in wrench space, (D, 6): the axes and random ones."""
    random = unit_vectors(np.random.default_rng(6).standard_normal((_DIRECTIONS - 12, 6)))
    return np.concatenate([np.eye(6), -np.eye(6), random])
