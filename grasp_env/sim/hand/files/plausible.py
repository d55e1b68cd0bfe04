"""Judge masses, inertias and efforts in a hand's file; `joints.judge_ranges` judges joint ranges.

Implausible values are replaced, and a sentence gives both values. The bounds come from some 200
public files of hands and robots: values that makers measured or took from CAD lie within them.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from grasp_env.inputs.arguments import Array
from grasp_env.sim.hand.check import Vector3
from grasp_env.sim.hand.files.elements import FileJoint, listed, names_of
from grasp_env.sim.hand.files.options import Inertial
from grasp_env.sim.hand.inertia import Inertia, inertia_matrix, inertia_numbers, nearest_inertia
from grasp_env.sim.hand.solids import hull_of, outline
from grasp_env.sim.hand.tree import Geometry

# forces at a fingertip [N]; makers' files give 4 (Allegro), 6 (LEAP), 9 (Inspire), 20 (Shadow,
# Dex3) and 59 (a prosthesis)
TIP_FORCE = 15.0  # assumed of an unknown motor, at the tip of a straight finger
LARGEST_TIP_FORCE = 100.0  # largest plausible one; a human index finger has 50
# the same if all finger joints have one effort of 10, 100, ... N m; makers' have 2 to 9
LARGEST_ROUND_TIP_FORCE = 30.0
JAW_FORCE = 20.0  # assumed of a sliding joint [N]
LARGEST_JAW_FORCE = 1000.0  # smallest implausible one of a sliding joint [N]; grippers: 20 to 235
# smallest distance assumed from a joint to its tip [m]; below it shapes are missing
SHORTEST_FINGER = 0.03

LARGEST_LINK = 1.0  # largest plausible size of a moving link [m]; larger ones are millimetres
# density of the box around a link [g/cm^3] and mass [kg] above which the mass is wrong; shapes may
# be smaller than their link
LARGEST_DENSITY, LEAST_HEAVY = 50.0, 0.1
# mean density [g/cm^3] and mass [kg] of all moving links above which all masses are wrong; the
# heaviest maker's file has 9 g/cm^3
LARGEST_MEAN_DENSITY, LEAST_HEAVY_HAND = 12.0, 1.0
# density of a link's shapes [g/cm^3] below which its mass is wrong; foam has 0.03, the lightest
# link of a maker's file 0.15
LEAST_DENSITY = 0.02
LARGEST_HAND = 10.0  # largest plausible mass of all moving links [kg]
# radius of gyration over the size of the link, and moment of inertia [kg m^2], above which the
# inertia is wrong; a body inside its shapes has at most 0.5, makers' files have 0.08 to 0.9; a
# smaller moment may include a rotor
LARGEST_GYRATION, LEAST_MOMENT = 1.0, 2e-4
_ROUNDING = 0.01  # relative change of moments that counts as rounding of the file's digits
LEAST_GYRATION = 0.02  # the same ratio below which the inertia is wrong
# of links without a plausible mass: density [kg/m^3], smallest mass [kg], smallest side [m] of the
# box for an inertia
ASSUMED_DENSITY, LEAST_MASS, LEAST_SIDE = 1000.0, 1e-3, 0.01

_NO_MASS = "moving links without mass get that of their shapes at 1 g/cm^3"
_WRONG_MASS = (
    "masses that links of this size cannot have are replaced by those of their shapes at 1 g/cm^3"
)
_CENTER_OUTSIDE = (
    "centres of mass farther outside their link than its size are moved to the middle of its shapes"
)
_WRONG_INERTIA = (
    "inertias that links of this size cannot have are replaced by those of boxes around them"
)
_NO_INERTIA = "principal moments that no body can have are replaced by the nearest possible ones"


@dataclass(frozen=True)
class Body:
    """A moving link including everything fixed to it, with the values of the file.

    `origin` and `rotation` are those of its joint.
    """

    joint: FileJoint
    mass: float  # 0 if the file has none
    center: Vector3
    inertia: Inertia
    shapes: tuple[Geometry, ...]
    looks: tuple[Geometry, ...]
    points: Array  # of its collision shapes, or of its visual ones if it has no others [m], (K, 3)
    carrier: str | None  # the moving link that carries it; None for the palm
    origin: Vector3
    rotation: Vector3

    @cached_property
    def volume(self) -> float:
        """Volume of its collision shapes [m^3]."""
        return sum(float(hull_of(outline(shape)).volume) for shape in self.shapes)


class Judge:
    """Judges the moving links of a hand, parents before children.

    `notes` has a sentence for each kind of implausible value.
    """

    def __init__(self, bodies: Sequence[Body]) -> None:
        self._bodies = bodies
        self.notes: list[str] = []
        self._numbers = {body.joint.name: number for number, body in enumerate(bodies)}
        numbers = {body.joint.child: number for number, body in enumerate(bodies)}
        self._carriers = [-1 if body.carrier is None else numbers[body.carrier] for body in bodies]
        self._extents = [np.vstack([np.zeros((1, 3)), body.points]) for body in bodies]
        for body, carrier in zip(bodies, self._carriers, strict=True):
            if carrier >= 0:
                self._extents[carrier] = np.vstack([self._extents[carrier], body.origin])
        self._sizes = [float(np.linalg.norm(np.ptp(points, axis=0))) for points in self._extents]
        self._reaches = [float(np.linalg.norm(points, axis=1).max()) for points in self._extents]
        self._ends = [0] * len(bodies)  # number of finger ends that each body carries
        for number, carrier in reversed(list(enumerate(self._carriers))):
            self._ends[number] = max(1, self._ends[number])
            if carrier >= 0:
                reach = float(np.linalg.norm(bodies[number].origin)) + self._reaches[number]
                self._reaches[carrier] = max(self._reaches[carrier], reach)
                self._ends[carrier] += self._ends[number]
        self._length = max(self._reaches)  # [m], size assumed for a link without shapes
        self._levers = self._motor_levers()
        sizes = zip(bodies, self._sizes, strict=True)
        large = [body.joint.child for body, size in sizes if size > LARGEST_LINK]
        self._scaled = not large
        if large:
            self.notes.append(
                f"{names_of(large)} are larger than {LARGEST_LINK:g} m: a file is in metres, not millimetres (sizes, scale of meshes); check it"
            )

    def _motor_levers(self) -> list[float]:
        """Return each motor's torque [N m] for 1 N at each tip that it moves, fingers straight.

        Each motor of a finger gets the lever of the one at the palm, since most makers use equal
        motors along a finger. A motor also carries the load of the joints that are coupled to it.
        """
        reaches = zip(self._ends, self._reaches, strict=True)
        alone = [ends * max(SHORTEST_FINGER, reach) for ends, reach in reaches]
        levers = list[float]()
        for lever, carrier in zip(alone, self._carriers, strict=True):
            in_finger = carrier >= 0 and self._ends[carrier] == 1
            levers.append(levers[carrier] if in_finger else lever)
        for number, body in enumerate(self._bodies):
            if (mimic := body.joint.mimic) is not None:
                lever = self._ends[number] if body.joint.sliding else alone[number]
                levers[self._numbers[mimic.joint]] += abs(mimic.ratio) * lever
        return levers

    def inertials(self, given: Mapping[str, float | Inertial]) -> list[Inertial]:
        """Return each body's inertial: as given, else that of the file if plausible."""
        weighed = [body for body in self._bodies if body.mass > 0.0 and body.volume > 0.0]
        mass = sum(body.mass for body in weighed)
        volume = sum(body.volume for body in weighed)
        too_heavy = self._scaled and mass > max(
            LEAST_HEAVY_HAND, 1e3 * LARGEST_MEAN_DENSITY * volume
        )
        changed = defaultdict[str, list[str]](list)
        inertials = list[Inertial]()
        for number, body in enumerate(self._bodies):
            link = body.joint.child
            value = given.get(link)
            inertial = Inertial(body.mass, body.center, body.inertia)
            if isinstance(value, Inertial):
                inertial = value
            elif body.mass <= 0.0:
                inertial = self._box(number, value)
                if value is None:
                    changed[_NO_MASS].append(f"{link!r} ({1e3 * inertial.mass:.2g} g)")
            elif value is None and (
                (too_heavy and body.volume > 0.0) or self._mass_is_wrong(number)
            ):
                inertial = self._box(number)
                changed[_WRONG_MASS].append(
                    f"{link!r} ({body.mass:.3g} kg, assumed {inertial.mass:.2g} kg)"
                )
            else:
                if value is not None:
                    inertial = _scaled(inertial, value / body.mass)
                inertial = self._possible(number, inertial, changed)
            inertials.append(inertial)
        for what, rows in changed.items():
            self.notes.append(f"{what}: {listed(rows)}; give the true ones as inertials=")
        if (total := sum(inertial.mass for inertial in inertials)) > LARGEST_HAND:
            self.notes.append(
                f"the moving links weigh {total:.3g} kg together: a file is in kilograms, not grams (inertials=), and for a whole robot "
                "palm= names the hand; check it"
            )
        return inertials

    def _possible(self, number: int, inertial: Inertial, changed: dict[str, list[str]]) -> Inertial:
        """Return the mass with a plausible centre and inertia; changes go to `changed`."""
        body = self._bodies[number]
        link = body.joint.child
        if distance := _distance_outside(inertial.center, body.points):
            changed[_CENTER_OUTSIDE].append(f"{link!r} ({distance:.2g} m)")
            inertial = self._box(number, inertial.mass)
        wrong = self._inertia_is_wrong(number, inertial)
        inertia = (
            self._box(number, inertial.mass).inertia
            if wrong
            else nearest_inertia(inertial.inertia, inertial.mass)
        )
        if inertia is None:
            return inertial
        before = _moments(inertial.inertia)
        after = _moments(inertia)
        if max(abs(b - a) for b, a in zip(before, after, strict=True)) > _ROUNDING * max(after):
            changed[_WRONG_INERTIA if wrong else _NO_INERTIA].append(
                f"{link!r} ({_listed_moments(before)}, assumed {_listed_moments(after)})"
            )
        return inertial._replace(inertia=inertia)

    def torques(self, given: Mapping[str, float]) -> list[float]:
        """Return each joint's limit [N m] or [N]: as given, else the file's if plausible."""
        tip_forces = self._implausible_efforts(given)
        limits = list[float]()
        assumed = defaultdict[tuple[float | None, bool], dict[str, float]](dict)
        for body, lever in zip(self._bodies, self._levers, strict=True):
            joint, effort = body.joint, body.joint.effort
            if joint.name in given:
                limits.append(given[joint.name])
                continue
            if (
                effort is None
                or effort <= 0.0
                or (effort >= LARGEST_JAW_FORCE if joint.sliding else effort in tip_forces)
            ):
                limit = float(f"{JAW_FORCE if joint.sliding else TIP_FORCE * lever:.2g}")
                if joint.mimic is None:
                    assumed[effort, joint.sliding][joint.name] = limit
                effort = limit
            limits.append(effort)
        self._add_jaws(limits, given, {name for joints in assumed.values() for name in joints})
        for (effort, sliding), joints in assumed.items():
            names = names_of(list(joints))
            if effort is None:
                cause = f"no effort is given for {names}"
            else:
                cause = f"effort {effort:g} of {names} is no motor's limit"
                if effort in tip_forces and not sliding:
                    cause += f" ({tip_forces[effort]:.0f} N at a fingertip)"
            least = min(joints.values())
            most = max(joints.values())
            span = f"{least:g}" if least == most else f"{least:g} to {most:g}"
            unit = "N" if sliding else f"N m, {TIP_FORCE:g} N at the tip of a straight finger"
            self.notes.append(
                f"{cause}: assumed is {span} {unit}; give the true one as torque_limit="
            )
        return limits

    def _add_jaws(self, limits: list[float], given: Mapping[str, float], assumed: set[str]) -> None:
        """Add up the forces of jaws that share a motor: files give the force of each jaw."""
        shared = dict[str, float]()
        for number, body in enumerate(self._bodies):
            mimic, effort = body.joint.mimic, body.joint.effort
            if mimic is None or effort is None or not body.joint.sliding:
                continue
            driver = self._numbers[mimic.joint]
            if (
                0.0 < effort < LARGEST_JAW_FORCE
                and self._bodies[driver].joint.sliding
                and mimic.joint not in given
                and mimic.joint not in assumed
            ):
                limits[driver] += abs(mimic.ratio) * limits[number]
                shared[mimic.joint] = limits[driver]
        if shared:
            forces = ", ".join(f"{joint!r} ({force:g} N)" for joint, force in shared.items())
            self.notes.append(
                f"motors that move several jaws get the sum of the jaws' forces in the file: {forces}; give the true ones as "
                "torque_limit="
            )

    def _implausible_efforts(self, given: Mapping[str, float]) -> dict[float, float]:
        """Return the largest tip force [N] of each implausible effort of turning joints [N m]."""
        forces = defaultdict[float, list[float]](list)
        fingers = list[float]()
        for number, body in enumerate(self._bodies):
            joint, effort = body.joint, body.joint.effort
            if joint.sliding or joint.mimic is not None or joint.name in given:
                continue
            if effort is None or effort <= 0.0:
                continue
            forces[effort].append(effort / self._levers[number])
            if self._ends[number] == 1:
                fingers.append(effort)
        allowed = dict.fromkeys(forces, LARGEST_TIP_FORCE)
        if len(fingers) >= 3 and len(set(fingers)) == 1 and math.log10(fingers[0]).is_integer():
            allowed[fingers[0]] = LARGEST_ROUND_TIP_FORCE
        largest = {effort: max(values) for effort, values in forces.items()}
        return {effort: force for effort, force in largest.items() if force > allowed[effort]}

    def _mass_is_wrong(self, number: int) -> bool:
        """Return True if the mass does not fit the size of the link."""
        body = self._bodies[number]
        if not self._scaled or body.volume <= 0.0:
            return False
        box = float(np.maximum(np.ptp(self._extents[number], axis=0), LEAST_SIDE).prod())
        light = body.mass < 1e3 * LEAST_DENSITY * body.volume
        return light or body.mass > max(LEAST_HEAVY, 1e3 * LARGEST_DENSITY * box)

    def _inertia_is_wrong(self, number: int, inertial: Inertial) -> bool:
        """Return True if the inertia does not fit the size and mass of the link."""
        shaped = len(self._bodies[number].points) > 0
        size = self._sizes[number] if shaped else self._length
        if not self._scaled or size <= 0.0:
            return False
        moment = _largest_moment(inertial.inertia)
        gyration = math.sqrt(max(moment, 0.0) / inertial.mass) / size
        return (gyration < LEAST_GYRATION and shaped) or (
            gyration > LARGEST_GYRATION and moment > LEAST_MOMENT
        )

    def _box(self, number: int, mass: float | None = None) -> Inertial:
        """Return the inertial of a box around a link; mass None: that of its shapes."""
        body = self._bodies[number]
        points = body.points if len(body.points) else self._extents[number]
        mass = mass or max(LEAST_MASS, ASSUMED_DENSITY * body.volume)
        x, y, z = (0.5 * (points.min(axis=0) + points.max(axis=0))).tolist()
        a, b, c = (np.maximum(np.ptp(points, axis=0), LEAST_SIDE) ** 2 * mass / 12.0).tolist()
        return Inertial(mass, (x, y, z), (b + c, 0.0, 0.0, a + c, 0.0, a + b))


def _scaled(inertial: Inertial, factor: float) -> Inertial:
    inertia = inertia_numbers(factor * inertia_matrix(inertial.inertia))
    return Inertial(factor * inertial.mass, inertial.center, inertia)


def _largest_moment(inertia: Inertia) -> float:
    return _moments(inertia)[2]


def _moments(inertia: Inertia) -> list[float]:
    """Return the principal moments [kg m^2], ascending."""
    return np.linalg.eigvalsh(inertia_matrix(inertia)).tolist()


def _listed_moments(moments: Sequence[float]) -> str:
    return f"{', '.join(f'{moment:.2g}' for moment in moments)} kg m^2"


def _distance_outside(center: Vector3, points: Array) -> float:
    """Return the distance [m] from the box around points (K, 3); 0 up to the size of the box."""
    if len(points) == 0:
        return 0.0
    low = points.min(axis=0)
    high = points.max(axis=0)
    distance = float(np.linalg.norm(np.maximum(np.maximum(low - center, center - high), 0.0)))
    return distance if distance > float((high - low).max()) else 0.0
