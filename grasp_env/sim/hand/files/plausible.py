"""Judges masses, inertias, efforts and ranges in a file of a hand. Implausible values are replaced, and a sentence names both.

The bounds are set by some 200 public files of hands and robots: what makers measured or took from CAD lies within them.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from grasp_env._check import Array
from grasp_env.sim.hand.check import Vector3
from grasp_env.sim.hand.files.elements import FileJoint, names_of
from grasp_env.sim.hand.files.options import Inertial
from grasp_env.sim.hand.inertia import Inertia, inertia_matrix, nearest_inertia
from grasp_env.sim.hand.solids import hull_of, outline
from grasp_env.sim.hand.tree import Geometry

TIP_FORCE = 15.0
"""[N] that an unknown motor is assumed to make at the tip of a straight finger. Makers' files give 4 N (Allegro), 6 N (LEAP), 9 N
(Inspire), 20 N (Shadow, Dex3), 59 N (a prosthesis)."""
JAW_FORCE = 20.0
"""[N] of a sliding joint whose force is unknown."""
LARGEST_TIP_FORCE = 100.0
"""[N] above which an effort is no motor's. The strongest finger of a maker's file has 59 N, a human index 50 N."""
LARGEST_ROUND_TIP_FORCE = 30.0
"""[N] above which 10, 100, ... N m for all joints of all fingers is no motor's. Makers who give all joints one effort: 2 N to 9 N."""
LARGEST_JAW_FORCE = 1000.0
"""[N] from which on the effort of a sliding joint is no motor's; grippers on arms have 20 N to 235 N."""
SHORTEST_FINGER = 0.03
"""[m] from a joint to its fingertip, at least. A smaller distance means that shapes are missing."""

LARGEST_TURN = 3.3
"""[rad] of a joint's range: a hinge between two links folds by half a turn."""
HALF_TURN = 3.1
"""[rad] of a range to one side, such as 0 to pi. It is a placeholder if three joints or more share it."""
DEGREES = 4.0 * math.pi
"""[rad] of the median range, above which all ranges are degrees."""
LARGEST_STROKE = 0.5
"""[m] of a sliding joint's range."""

LARGEST_LINK = 1.0
"""[m] of a moving link, above which sizes are not metres."""
LARGEST_DENSITY, LEAST_HEAVY = 50.0, 0.1
"""[g/cm^3] of the box around a link and its mass [kg], above which the mass is wrong. Shapes may be smaller than their link."""
LARGEST_MEAN_DENSITY, LEAST_HEAVY_HAND = 12.0, 1.0
"""[g/cm^3] of all moving links and their mass [kg], above which all masses are wrong; lead has 11.3, the heaviest maker's file 9."""
LEAST_DENSITY = 0.02
"""[g/cm^3] of a link's shapes, below which its mass is wrong; foam has 0.03, the lightest link of a maker's file 0.15."""
LARGEST_HAND = 10.0
"""[kg] of all moving links."""
LARGEST_GYRATION, LEAST_MOMENT = 1.0, 2e-4
"""Radius of gyration in sizes of the link, and moment of inertia [kg m^2], above which the latter is wrong. A body inside its shapes
has 0.5 at the most; files of makers have 0.1 to 0.9. A smaller moment may hold a rotor, see `HandDescription.with_rotors`."""
LEAST_GYRATION = 0.02
"""Radius of gyration in sizes of the link, below which its inertia is wrong; files of makers have 0.08 and more."""

ASSUMED_DENSITY, LEAST_MASS, LEAST_SIDE = 1000.0, 1e-3, 0.01
"""[kg/m^3] of links without a mass that can be, their least mass [kg], and the least side of the box that gives an inertia [m]."""
_MOST_LISTED = 20

_NO_MASS = "moving links without mass get that of their shapes at 1 g/cm^3"
_WRONG_MASS = "masses that links of this size cannot have are replaced by those of their shapes at 1 g/cm^3"
_ASTRAY = (
    "centres of mass that lie outside their links by more than these measure are put into the middle of their shapes"
)
_WRONG_INERTIA = "inertias that links of this size cannot have are replaced by those of boxes around them"
_NO_INERTIA = "inertias that no body has are replaced by the nearest possible"


@dataclass(frozen=True)
class Body:
    """A link that a joint moves, with all that is fixed to it, as the file says.

    Attributes:
        joint: That moves it.
        mass: [kg]; 0: unknown.
        center: Of mass [m], (3,), link frame.
        inertia: About it [kg m^2].
        shapes: That touch, link frame.
        points: Whose hull holds these, or what is drawn where nothing touches [m], (K, 3), link frame.
        carrier: Name of the moving link that carries it; None: the palm.
        place: Of its joint [m], (3,), the carrier's frame.
    """

    joint: FileJoint
    mass: float
    center: Vector3
    inertia: Inertia
    shapes: tuple[Geometry, ...]
    points: Array
    carrier: str | None
    place: Vector3

    @cached_property
    def volume(self) -> float:
        """Of its shapes [m^3]."""
        return sum(float(hull_of(outline(shape)).volume) for shape in self.shapes)


class Judge:
    """Judges the moving links of a hand, parents before children.

    Args:
        bodies: Of the file.

    Attributes:
        said: A sentence for each kind of value that cannot be.
    """

    def __init__(self, bodies: Sequence[Body]) -> None:
        self._bodies = list(bodies)
        self.said: list[str] = []
        at = {body.joint.child: number for number, body in enumerate(bodies)}
        self._carrier = [-1 if body.carrier is None else at[body.carrier] for body in bodies]
        own = [np.vstack([np.zeros((1, 3)), body.points]) for body in bodies]
        for body, carrier in zip(bodies, self._carrier, strict=True):
            if carrier >= 0:
                own[carrier] = np.vstack([own[carrier], body.place])
        self._extents = own
        self._sizes = [float(np.linalg.norm(np.ptp(points, axis=0))) for points in own]
        self._reaches = [float(np.linalg.norm(points, axis=1).max()) for points in own]
        self._ends = [0] * len(bodies)
        for number in range(len(bodies) - 1, -1, -1):
            self._ends[number] = max(1, self._ends[number])
            carrier = self._carrier[number]
            if carrier >= 0:
                away = float(np.linalg.norm(bodies[number].place)) + self._reaches[number]
                self._reaches[carrier] = max(self._reaches[carrier], away)
                self._ends[carrier] += self._ends[number]
        self._length = max(self._reaches)  # [m], of what nothing is known of
        self._levers = self._motor_levers()
        large = [body.joint.child for body, size in zip(bodies, self._sizes, strict=True) if size > LARGEST_LINK]
        self._scaled = not large
        if large:
            self.said.append(
                f"{names_of(large)} are larger than {LARGEST_LINK:g} m: a file has metres, not millimetres (sizes, scale of meshes); look again"
            )

    def _motor_levers(self) -> list[float]:
        """The torque of each joint's motor [N m] that makes 1 N at each fingertip that it moves, the fingers straight.

        Each motor of a finger counts as the one at the palm: most makers give those near the tip as much. A motor also carries what
        the joints that are coupled to it do.
        """
        levers = list[float]()
        drivers = {body.joint.name: number for number, body in enumerate(self._bodies)}
        own = [ends * max(SHORTEST_FINGER, reach) for ends, reach in zip(self._ends, self._reaches, strict=True)]
        for number, carrier in enumerate(self._carrier):
            levers.append(levers[carrier] if carrier >= 0 and self._ends[carrier] == 1 else own[number])
        for number, body in enumerate(self._bodies):
            if body.joint.mimic is not None:
                lever = self._ends[number] if body.joint.sliding else own[number]
                levers[drivers[body.joint.mimic.joint]] += abs(body.joint.mimic.ratio) * lever
        return levers

    def inertials(self, given: Mapping[str, float | Inertial]) -> list[Inertial]:
        """Mass, centre and inertia of each body: as given, else as the file says where that can be."""
        told = [given.get(body.joint.child) for body in self._bodies]
        weighed = [body for body in self._bodies if body.mass > 0.0 and body.volume > 0.0]
        heavy, volume = sum(body.mass for body in weighed), sum(body.volume for body in weighed)
        lead = self._scaled and heavy > max(LEAST_HEAVY_HAND, 1e3 * LARGEST_MEAN_DENSITY * volume)
        changed: dict[str, list[str]] = {}
        found = list[Inertial]()
        for number, (body, value) in enumerate(zip(self._bodies, told, strict=True)):
            own = Inertial(body.mass, body.center, body.inertia)
            if isinstance(value, Inertial):
                own = value
            elif body.mass <= 0.0:
                own = self._box(number, value)
                if value is None:
                    changed.setdefault(_NO_MASS, []).append(f"{body.joint.child!r} ({1e3 * own.mass:.2g} g)")
            elif value is None and ((lead and body.volume > 0.0) or self._weighs_wrong(number)):
                own = self._box(number)
                changed.setdefault(_WRONG_MASS, []).append(
                    f"{body.joint.child!r} ({body.mass:.3g} kg, assumed {own.mass:.2g} kg)"
                )
            else:
                own = self._possible(number, own if value is None else _scaled(own, value / body.mass), changed)
            found.append(own)
        for what, rows in changed.items():
            self.said.append(f"{what}: {_listed(rows)}; give the true ones as inertials=")
        if (total := sum(body.mass for body in found)) > LARGEST_HAND:
            self.said.append(
                f"the moving links weigh {total:.3g} kg together: a file has kilograms, not grams (inertials=), and of a whole robot "
                "palm= names the hand; look again"
            )
        return found

    def _possible(self, number: int, own: Inertial, changed: dict[str, list[str]]) -> Inertial:
        """A link's mass with a centre and an inertia that can be; what is changed is noted by its kind."""
        body = self._bodies[number]
        if away := _astray(own.center, body.points):
            changed.setdefault(_ASTRAY, []).append(f"{body.joint.child!r} ({away:.2g} m)")
            own = self._box(number, own.mass)
        wrong = self._turns_wrong(number, own)
        inertia = self._box(number, own.mass).inertia if wrong else nearest_inertia(own.inertia, own.mass)
        if inertia is None:
            return own
        changed.setdefault(_WRONG_INERTIA if wrong else _NO_INERTIA, []).append(
            f"{body.joint.child!r} ({_largest(own.inertia):.2g} kg m^2, assumed {_largest(inertia):.2g} kg m^2)"
        )
        return own._replace(inertia=inertia)

    def torques(self, given: Mapping[str, float]) -> list[float]:
        """The largest torque of each joint [N m], of sliding joints [N]: as given, else as the file says where that can be."""
        doubted = self._doubted(given)
        limits = list[float]()
        assumed: dict[tuple[float | None, bool], dict[str, float]] = {}
        for number, body in enumerate(self._bodies):
            joint, effort = body.joint, body.joint.effort
            if joint.name in given:
                limits.append(given[joint.name])
                continue
            fits = effort is not None and (effort < LARGEST_JAW_FORCE if joint.sliding else effort not in doubted)
            if effort is None or effort <= 0.0 or not fits:
                known = JAW_FORCE if joint.sliding else TIP_FORCE * self._levers[number]
                limit = float(f"{known:.2g}")
                if joint.mimic is None:
                    assumed.setdefault((effort, joint.sliding), {})[joint.name] = limit
                effort = limit
            limits.append(effort)
        self._add_jaws(limits, given, {name for joints in assumed.values() for name in joints})
        for (effort, sliding), joints in assumed.items():
            least, most, names = min(joints.values()), max(joints.values()), names_of(list(joints))
            force = f" ({doubted[effort]:.0f} N at a fingertip)" if effort in doubted and not sliding else ""
            cause = f"no effort is given for {names}"
            if effort is not None:
                cause = f"effort {effort:g} of {names} is no motor's limit{force}"
            span = f"{least:g}" if least == most else f"{least:g} to {most:g}"
            unit = "N" if sliding else f"N m, {TIP_FORCE:g} N at the tip of a straight finger"
            self.said.append(f"{cause}: assumed is {span} {unit}; give the true one as torque_limit=")
        return limits

    def _add_jaws(self, limits: list[float], given: Mapping[str, float], assumed: set[str]) -> None:
        """A motor that moves several jaws gets the force of all: files say what each jaw pushes with."""
        numbers = {body.joint.name: number for number, body in enumerate(self._bodies)}
        shared = dict[str, float]()
        for number, body in enumerate(self._bodies):
            mimic, effort = body.joint.mimic, body.joint.effort
            if mimic is None or not body.joint.sliding or effort is None or not 0.0 < effort < LARGEST_JAW_FORCE:
                continue
            driver = numbers.get(mimic.joint, -1)
            if driver < 0 or not self._bodies[driver].joint.sliding or mimic.joint in given or mimic.joint in assumed:
                continue
            limits[driver] += abs(mimic.ratio) * limits[number]
            shared[mimic.joint] = limits[driver]
        if shared:
            forces = ", ".join(f"{joint!r} ({force:g} N)" for joint, force in shared.items())
            self.said.append(
                f"motors that move several jaws push with what the file says of each jaw together: {forces}; give the true ones as "
                "torque_limit="
            )

    def _doubted(self, given: Mapping[str, float]) -> dict[float, float]:
        """Efforts of turning joints [N m] that no motor of this hand has, with the largest force [N] that each makes at a fingertip."""
        forces: dict[float, list[float]] = {}
        fingers = list[float]()
        for number, body in enumerate(self._bodies):
            joint, effort = body.joint, body.joint.effort
            if joint.sliding or joint.mimic is not None or effort is None or effort <= 0.0 or joint.name in given:
                continue
            forces.setdefault(effort, []).append(effort / self._levers[number])
            if self._ends[number] == 1:
                fingers.append(effort)
        alike = len(fingers) >= 3 and len(set(fingers)) == 1 and math.log10(fingers[0]).is_integer()
        most = dict.fromkeys(forces, LARGEST_TIP_FORCE)
        if alike:
            most[fingers[0]] = LARGEST_ROUND_TIP_FORCE
        return {effort: max(each) for effort, each in forces.items() if max(each) > most[effort]}

    def _weighs_wrong(self, number: int) -> bool:
        """True if no link of this size has this mass."""
        body = self._bodies[number]
        if not self._scaled or body.volume <= 0.0:
            return False
        box = float(np.maximum(np.ptp(self._extents[number], axis=0), LEAST_SIDE).prod())
        light = body.mass < 1e3 * LEAST_DENSITY * body.volume
        return light or body.mass > max(LEAST_HEAVY, 1e3 * LARGEST_DENSITY * box)

    def _turns_wrong(self, number: int, own: Inertial) -> bool:
        """True if no link of this size and mass has this inertia."""
        size = self._sizes[number] if len(self._bodies[number].points) else self._length
        if not self._scaled or size <= 0.0:
            return False
        moment = _largest(own.inertia)
        gyration = math.sqrt(max(moment, 0.0) / own.mass) / size
        return (gyration < LEAST_GYRATION and len(self._bodies[number].points) > 0) or (
            gyration > LARGEST_GYRATION and moment > LEAST_MOMENT
        )

    def _box(self, number: int, mass: float | None = None) -> Inertial:
        """Of a box around a link; its mass is that of its shapes, where it is not known."""
        body = self._bodies[number]
        points = body.points if len(body.points) else self._extents[number]
        mass = mass or max(LEAST_MASS, ASSUMED_DENSITY * body.volume)
        x, y, z = (0.5 * (points.min(axis=0) + points.max(axis=0))).tolist()
        a, b, c = (np.maximum(np.ptp(points, axis=0), LEAST_SIDE) ** 2 * mass / 12.0).tolist()
        return Inertial(mass, (x, y, z), (b + c, 0.0, 0.0, a + c, 0.0, a + b))


def judge_ranges(
    joints: Sequence[FileJoint], given: Mapping[str, tuple[float, float]]
) -> tuple[list[FileJoint], list[str]]:
    """The joints with ranges in radians, and sentences about ranges that no finger's joint has.

    Args:
        joints: All of a hand, fixed ones among them.
        given: Ranges that a caller gave; they are not judged.
    """
    judged = [joint for joint in joints if not joint.fixed and joint.name not in given]
    spans = [joint.upper - joint.lower for joint in judged if not joint.sliding and math.isfinite(joint.lower)]
    said, true = list[str](), "; give the true ones as joint_limits="
    if spans and statistics.median(spans) > DEGREES:
        turned = {joint.name: _in_radians(joint) for joint in judged if not joint.sliding}
        joints = [turned.get(joint.name, joint) for joint in joints]
        shown = _listed([_range(joint) for joint in turned.values()])
        said.append(f"ranges of more than two turns are taken as degrees: {shown}{true}")
        judged = [turned.get(joint.name, joint) for joint in judged]
    driven = [joint for joint in judged if joint.mimic is None]
    wide = [_range(joint) for joint in driven if _is_wide(joint, driven)]
    if wide:
        said.append(f"ranges that no finger's joint has are taken as they are: {_listed(wide)}{true}")
    return list(joints), said


def _is_wide(joint: FileJoint, others: Sequence[FileJoint]) -> bool:
    """True if a range is wider than a hinge allows, or if several joints share one of half a turn to one side."""
    span = joint.upper - joint.lower
    if joint.sliding:
        return span > LARGEST_STROKE
    alike = sum((other.lower, other.upper) == (joint.lower, joint.upper) for other in others)
    one_side = max(-joint.lower, joint.upper) > 0.75 * span
    return span > LARGEST_TURN or (span > HALF_TURN and one_side and alike >= 3)


def _range(joint: FileJoint) -> str:
    if not math.isfinite(joint.lower):
        return f"{joint.name!r} (without end)"
    return f"{joint.name!r} ({joint.lower:.3g} to {joint.upper:.3g} {'m' if joint.sliding else 'rad'})"


def _in_radians(joint: FileJoint) -> FileJoint:
    return replace(joint, lower=math.radians(joint.lower), upper=math.radians(joint.upper))


def _scaled(own: Inertial, factor: float) -> Inertial:
    """A body of the same shape with another mass."""
    xx, xy, xz, yy, yz, zz = (factor * value for value in own.inertia)
    return Inertial(factor * own.mass, own.center, (xx, xy, xz, yy, yz, zz))


def _listed(rows: Sequence[str]) -> str:
    return ", ".join(rows[:_MOST_LISTED]) + (
        f" and {len(rows) - _MOST_LISTED} more" if len(rows) > _MOST_LISTED else ""
    )


def _largest(inertia: Inertia) -> float:
    """The largest principal moment [kg m^2]."""
    return float(np.linalg.eigvalsh(inertia_matrix(inertia))[2])


def _astray(center: Vector3, points: Array) -> float:
    """How far a point lies outside the box around others (K, 3) [m], where that is more than the box measures; else 0."""
    if len(points) == 0:
        return 0.0
    low, high = points.min(axis=0), points.max(axis=0)
    away = float(np.linalg.norm(np.maximum(np.maximum(low - center, center - high), 0.0)))
    return away if away > float((high - low).max()) else 0.0
