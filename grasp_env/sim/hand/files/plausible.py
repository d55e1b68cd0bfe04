"""Judge masses, inertias and efforts in a hand's file.

Implausible values are replaced, and a sentence gives both values.

The bounds come from some 200 public files of hands and robots: values that makers measured or took
from CAD lie within them.
"""

from __future__ import annotations

import math
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
JAW_FORCE = 20.0  # assumed of a sliding joint
LARGEST_TIP_FORCE = 100.0  # largest plausible one; a human index finger has 50
# the same if all finger joints have one effort of 10, 100, ... N m; makers' have 2 to 9
LARGEST_ROUND_TIP_FORCE = 30.0
# effort from which on that of a sliding joint is implausible [N]; grippers have 20 to 235
LARGEST_JAW_FORCE = 1000.0
# smallest distance assumed from a joint to its tip [m]; below it shapes are missing
SHORTEST_FINGER = 0.03

# largest plausible size of a moving link [m]; larger sizes are probably millimetres
LARGEST_LINK = 1.0
LARGEST_DENSITY, LEAST_HEAVY = 50.0, 0.1
"""Density of the box around a link [g/cm^3] and mass [kg] above which the mass is wrong.

Shapes may be smaller than their link.
"""
LARGEST_MEAN_DENSITY, LEAST_HEAVY_HAND = 12.0, 1.0
"""Mean density [g/cm^3] and mass [kg] of all moving links above which all masses are wrong; the
heaviest maker's file has 9 g/cm^3."""
LEAST_DENSITY = 0.02
"""Density of a link's shapes [g/cm^3] below which its mass is wrong; foam has 0.03, the lightest
link of a maker's file 0.15."""
LARGEST_HAND = 10.0  # largest plausible mass of all moving links [kg]
LARGEST_GYRATION, LEAST_MOMENT = 1.0, 2e-4
"""Radius of gyration over the size of the link, and moment of inertia [kg m^2], above which the
inertia is wrong. A body inside its
shapes has at most 0.5; makers' files have 0.1 to 0.9. A smaller moment may include a rotor, see
`HandDescription.with_rotors`.
"""
# the same ratio below which the inertia is wrong; makers' files have 0.08 and more
LEAST_GYRATION = 0.02
ASSUMED_DENSITY, LEAST_MASS, LEAST_SIDE = 1000.0, 1e-3, 0.01
"""Density of links without a plausible mass [kg/m^3], their smallest mass [kg], and the smallest
side of the box for an inertia [m]."""

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
_NO_INERTIA = "physically impossible inertias are replaced by the nearest possible ones"


@dataclass(frozen=True)
class Body:
    """A moving link including everything fixed to it, with the values of the file; origin and
    rotation are those of its joint.
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
    """A judge of the moving links of a hand, parents before children; `notes` has a sentence for
    each kind of implausible value.
    """

    def __init__(self, bodies: Sequence[Body]) -> None:
        self._bodies = list(bodies)
        self.notes: list[str] = []
        self._numbers = {body.joint.name: number for number, body in enumerate(bodies)}
        at = {body.joint.child: number for number, body in enumerate(bodies)}
        self._carrier = [-1 if body.carrier is None else at[body.carrier] for body in bodies]
        own = [np.vstack([np.zeros((1, 3)), body.points]) for body in bodies]
        for body, carrier in zip(bodies, self._carrier, strict=True):
            if carrier >= 0:
                own[carrier] = np.vstack([own[carrier], body.origin])
        self._extents = own
        self._sizes = [float(np.linalg.norm(np.ptp(points, axis=0))) for points in own]
        self._reaches = [float(np.linalg.norm(points, axis=1).max()) for points in own]
        self._ends = [0] * len(bodies)
        for number, carrier in reversed(list(enumerate(self._carrier))):
            self._ends[number] = max(1, self._ends[number])
            if carrier >= 0:
                away = float(np.linalg.norm(bodies[number].origin)) + self._reaches[number]
                self._reaches[carrier] = max(self._reaches[carrier], away)
                self._ends[carrier] += self._ends[number]
        self._length = max(self._reaches)  # [m], size assumed for a link without shapes
        self._levers = self._motor_levers()
        large = [
            body.joint.child
            for body, size in zip(bodies, self._sizes, strict=True)
            if size > LARGEST_LINK
        ]
        self._scaled = not large
        if large:
            self.notes.append(
                f"{names_of(large)} are larger than {LARGEST_LINK:g} m: a file is in metres, not millimetres (sizes, scale of meshes); check it"
            )

    def _motor_levers(self) -> list[float]:
        """Return the torque of each motor [N m] for 1 N at each fingertip that it moves, with
        straight fingers.

        Each motor of a finger gets the lever of the one at the palm, since most makers use equal
        motors along a finger. A motor also carries the load of the joints that are coupled to it.
        """
        levers = list[float]()
        own = [
            ends * max(SHORTEST_FINGER, reach)
            for ends, reach in zip(self._ends, self._reaches, strict=True)
        ]
        for number, carrier in enumerate(self._carrier):
            levers.append(
                levers[carrier] if carrier >= 0 and self._ends[carrier] == 1 else own[number]
            )
        for number, body in enumerate(self._bodies):
            if body.joint.mimic is not None:
                lever = self._ends[number] if body.joint.sliding else own[number]
                levers[self._numbers[body.joint.mimic.joint]] += abs(body.joint.mimic.ratio) * lever
        return levers

    def inertials(self, given: Mapping[str, float | Inertial]) -> list[Inertial]:
        """Return mass, centre and inertia of each body: as given, else as in the file if plausible."""
        weighed = [body for body in self._bodies if body.mass > 0.0 and body.volume > 0.0]
        heavy = sum(body.mass for body in weighed)
        volume = sum(body.volume for body in weighed)
        heavier_than_lead = self._scaled and heavy > max(
            LEAST_HEAVY_HAND, 1e3 * LARGEST_MEAN_DENSITY * volume
        )
        changed: dict[str, list[str]] = {}
        found = list[Inertial]()
        for number, body in enumerate(self._bodies):
            value = given.get(body.joint.child)
            own = Inertial(body.mass, body.center, body.inertia)
            if isinstance(value, Inertial):
                own = value
            elif body.mass <= 0.0:
                own = self._box(number, value)
                if value is None:
                    changed.setdefault(_NO_MASS, []).append(
                        f"{body.joint.child!r} ({1e3 * own.mass:.2g} g)"
                    )
            elif value is None and (
                (heavier_than_lead and body.volume > 0.0) or self._mass_is_wrong(number)
            ):
                own = self._box(number)
                changed.setdefault(_WRONG_MASS, []).append(
                    f"{body.joint.child!r} ({body.mass:.3g} kg, assumed {own.mass:.2g} kg)"
                )
            else:
                own = self._possible(
                    number, own if value is None else _scaled(own, value / body.mass), changed
                )
            found.append(own)
        for what, rows in changed.items():
            self.notes.append(f"{what}: {listed(rows)}; give the true ones as inertials=")
        if (total := sum(body.mass for body in found)) > LARGEST_HAND:
            self.notes.append(
                f"the moving links weigh {total:.3g} kg together: a file is in kilograms, not grams (inertials=), and for a whole robot "
                "palm= names the hand; check it"
            )
        return found

    def _possible(self, number: int, own: Inertial, changed: dict[str, list[str]]) -> Inertial:
        """Return a link's mass with a plausible centre and inertia; changes are added to `changed`
        by their kind.
        """
        body = self._bodies[number]
        if away := _distance_outside(own.center, body.points):
            changed.setdefault(_CENTER_OUTSIDE, []).append(f"{body.joint.child!r} ({away:.2g} m)")
            own = self._box(number, own.mass)
        wrong = self._inertia_is_wrong(number, own)
        inertia = (
            self._box(number, own.mass).inertia if wrong else nearest_inertia(own.inertia, own.mass)
        )
        if inertia is None:
            return own
        changed.setdefault(_WRONG_INERTIA if wrong else _NO_INERTIA, []).append(
            f"{body.joint.child!r} ({_largest(own.inertia):.2g} kg m^2, assumed {_largest(inertia):.2g} kg m^2)"
        )
        return own._replace(inertia=inertia)

    def torques(self, given: Mapping[str, float]) -> list[float]:
        """Return the torque limit of each joint [N m], of sliding joints [N]: as given, else as in
        the file if plausible.
        """
        doubted = self._doubted(given)
        limits = list[float]()
        assumed: dict[tuple[float | None, bool], dict[str, float]] = {}
        for number, body in enumerate(self._bodies):
            joint, effort = body.joint, body.joint.effort
            if joint.name in given:
                limits.append(given[joint.name])
                continue
            fits = effort is not None and (
                effort < LARGEST_JAW_FORCE if joint.sliding else effort not in doubted
            )
            if effort is None or effort <= 0.0 or not fits:
                known = JAW_FORCE if joint.sliding else TIP_FORCE * self._levers[number]
                limit = float(f"{known:.2g}")
                if joint.mimic is None:
                    assumed.setdefault((effort, joint.sliding), {})[joint.name] = limit
                effort = limit
            limits.append(effort)
        self._add_jaws(limits, given, {name for joints in assumed.values() for name in joints})
        for (effort, sliding), joints in assumed.items():
            least = min(joints.values())
            most = max(joints.values())
            names = names_of(list(joints))
            force = (
                f" ({doubted[effort]:.0f} N at a fingertip)"
                if effort in doubted and not sliding
                else ""
            )
            known = (
                f"effort {effort:g} of {names} is no motor's limit{force}"
                if effort is not None
                else ""
            )
            cause = known or f"no effort is given for {names}"
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
            if (
                mimic is None
                or not body.joint.sliding
                or effort is None
                or not 0.0 < effort < LARGEST_JAW_FORCE
            ):
                continue
            driver = self._numbers[mimic.joint]
            if (
                self._bodies[driver].joint.sliding
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

    def _doubted(self, given: Mapping[str, float]) -> dict[float, float]:
        """Return implausible efforts of turning joints [N m], each with its largest force at a
        fingertip [N].
        """
        forces: dict[float, list[float]] = {}
        fingers = list[float]()
        for number, body in enumerate(self._bodies):
            joint, effort = body.joint, body.joint.effort
            if (
                joint.sliding
                or joint.mimic is not None
                or effort is None
                or effort <= 0.0
                or joint.name in given
            ):
                continue
            forces.setdefault(effort, []).append(effort / self._levers[number])
            if self._ends[number] == 1:
                fingers.append(effort)
        most = dict.fromkeys(forces, LARGEST_TIP_FORCE)
        if len(fingers) >= 3 and len(set(fingers)) == 1 and math.log10(fingers[0]).is_integer():
            most[fingers[0]] = LARGEST_ROUND_TIP_FORCE
        return {effort: max(each) for effort, each in forces.items() if max(each) > most[effort]}

    def _mass_is_wrong(self, number: int) -> bool:
        """Return True if the mass does not fit the size of the link."""
        body = self._bodies[number]
        if not self._scaled or body.volume <= 0.0:
            return False
        box = float(np.maximum(np.ptp(self._extents[number], axis=0), LEAST_SIDE).prod())
        light = body.mass < 1e3 * LEAST_DENSITY * body.volume
        return light or body.mass > max(LEAST_HEAVY, 1e3 * LARGEST_DENSITY * box)

    def _inertia_is_wrong(self, number: int, own: Inertial) -> bool:
        """Return True if the inertia does not fit the size and mass of the link."""
        shaped = len(self._bodies[number].points) > 0
        size = self._sizes[number] if shaped else self._length
        if not self._scaled or size <= 0.0:
            return False
        moment = _largest(own.inertia)
        gyration = math.sqrt(max(moment, 0.0) / own.mass) / size
        return (gyration < LEAST_GYRATION and shaped) or (
            gyration > LARGEST_GYRATION and moment > LEAST_MOMENT
        )

    def _box(self, number: int, mass: float | None = None) -> Inertial:
        """Return mass, centre and inertia of a box around a link; mass None: that of its shapes."""
        body = self._bodies[number]
        points = body.points if len(body.points) else self._extents[number]
        mass = mass or max(LEAST_MASS, ASSUMED_DENSITY * body.volume)
        x, y, z = (0.5 * (points.min(axis=0) + points.max(axis=0))).tolist()
        a, b, c = (np.maximum(np.ptp(points, axis=0), LEAST_SIDE) ** 2 * mass / 12.0).tolist()
        return Inertial(mass, (x, y, z), (b + c, 0.0, 0.0, a + c, 0.0, a + b))


def _scaled(own: Inertial, factor: float) -> Inertial:
    return Inertial(
        factor * own.mass, own.center, inertia_numbers(factor * inertia_matrix(own.inertia))
    )


def _largest(inertia: Inertia) -> float:
    """Return the largest principal moment [kg m^2]."""
    return float(np.linalg.eigvalsh(inertia_matrix(inertia))[2])


def _distance_outside(center: Vector3, points: Array) -> float:
    """Return the distance of a point from the box around others (K, 3) [m] if it exceeds the size
    of the box; else 0.
    """
    if len(points) == 0:
        return 0.0
    low = points.min(axis=0)
    high = points.max(axis=0)
    away = float(np.linalg.norm(np.maximum(np.maximum(low - center, center - high), 0.0)))
    return away if away > float((high - low).max()) else 0.0
