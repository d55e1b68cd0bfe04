"""Parts of a hand: links with joints, geometries, fingertips, the palm; and their checks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs.arguments import choice, instance
from grasp_env.sim.hand.check import (
    Vector3,
    hull_corners,
    limits,
    numbers,
    parts,
    positive,
    unit,
    word,
)
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.inertia import Inertia, inertia_of

SIZES = {
    "sphere": ("radius",),
    "capsule": ("radius", "length"),
    "cylinder": ("radius", "length"),
    "box": ("x", "y", "z"),
    "hull": (),
    "mesh": ("x", "y", "z"),
}
"""Kinds of geometry and their sizes [m].

The length of a capsule is that of its cylinder; its axis is z. A mesh has scale factors.
"""

UNITS = {False: ("rad", "N m"), True: ("m", "N")}
"""Units of a joint's position and load; the key is True for a sliding joint."""

_NOWHERE: Vector3 = (0.0, 0.0, 0.0)


def _fix(part: Any, **values: Any) -> None:
    """Set fields of a frozen dataclass."""
    for name, value in values.items():
        object.__setattr__(part, name, value)


@dataclass(frozen=True)
class Geometry:
    """A shape fixed to a link.

    Attributes:
        kind: "sphere", "capsule", "cylinder" or "box"; the axis of capsule and cylinder is z.
            "hull": the convex hull of `corners`. "mesh": a file that is drawn and touches nothing.
        size: Radius; radius and length (of a capsule without its ends); or three sides [m]. () for
            a hull; scale factors for a mesh.
        origin: Position of the centre, or of the frame of a hull or mesh [m], (3,), link frame.
        rotation: Roll, pitch and yaw of its axes [rad], (3,), link frame.
        color: Red, green and blue in [0, 1]; None: the link's color.
        corners: Corners of a hull [m], (K, 3), in its own frame: at least 4 that are not in a
            plane.
        file: Path of a mesh.
    """

    kind: str
    size: tuple[float, ...]
    origin: Vector3 = _NOWHERE
    rotation: Vector3 = _NOWHERE
    color: Vector3 | None = None
    corners: tuple[Vector3, ...] = ()
    file: str = ""

    def __post_init__(self) -> None:
        choice(self.kind, "kind of geometry", SIZES)
        name = f"geometry {self.kind!r}"
        size = numbers(
            self.size, len(SIZES[self.kind]), f"{name}: size ({', '.join(SIZES[self.kind])})"
        )
        if min(size, default=1.0) <= 0.0:
            raise InvalidInputError(f"{name}: size={size} m must be above 0")
        none = isinstance(self.corners, list | tuple) and not self.corners
        if none == (self.kind == "hull") or bool(self.file) != (self.kind == "mesh"):
            raise InvalidInputError(
                f"{name}: corners belong to a hull, a file to a mesh; got corners={shown(self.corners)}, file={self.file!r}"
            )
        _fix(
            self,
            size=size,
            origin=numbers(self.origin, 3, f"{name}: origin"),
            rotation=numbers(self.rotation, 3, f"{name}: rotation"),
            color=None if self.color is None else numbers(self.color, 3, f"{name}: color"),
            corners=hull_corners(self.corners, name) if self.kind == "hull" else (),
        )

    def carried(self, frame: Frame) -> Geometry:
        """Return the shape in the outer frame of `frame`."""
        origin, angles = frame.carry(self.origin, self.rotation)
        return replace(self, origin=origin, rotation=angles)


@dataclass(frozen=True)
class Mimic:
    """The coupling of a joint to another one: its angle is ratio * driver's angle + offset.

    Attributes:
        joint: Name of the driver, which is not coupled itself.
        ratio: Ratio of the angles, not 0; [m/rad] if a sliding joint follows a turning one, and so
            on.
        offset: Angle of the joint when the driver is at 0 [rad], for a sliding joint [m].
    """

    joint: str
    ratio: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        name = f"mimic that follows joint {self.joint!r}"
        (ratio,) = numbers((self.ratio,), 1, f"{name}: ratio")
        (offset,) = numbers((self.offset,), 1, f"{name}: offset")
        if ratio == 0.0:
            raise InvalidInputError(
                f"mimic: ratio=0.0 does not move the joint that follows {self.joint!r}; make that joint fixed"
            )
        _fix(self, joint=word(self.joint, "mimic: joint"), ratio=ratio, offset=offset)

    def angle(self, driver: float) -> float:
        """Return the coupled joint's angle for the driver's [rad], for sliding joints [m]."""
        return self.ratio * driver + self.offset


@dataclass(frozen=True)
class Link:
    """A moving link and its joint.

    At angle 0 the link frame lies at `origin`, turned by `rotation`, in the frame of its parent.
    The joint turns it about `axis` through its own origin; a sliding joint moves it along `axis`.

    Attributes:
        name: Name of the link.
        parent: Name of the parent link or of the palm.
        origin: Position of the joint [m], (3,), parent's frame.
        rotation: Roll, pitch and yaw at angle 0 [rad], (3,), parent's frame.
        axis: Unit axis of the joint, (3,), link frame.
        lower: Lower joint limit [rad], of a sliding joint [m]. A joint without limits has
            lower=-inf and upper=inf.
        upper: Upper joint limit [rad], of a sliding joint [m].
        torque_limit: Largest torque in both directions [N m], for a sliding joint the largest force
            [N]. It is not used for a coupled joint, because the driver carries the load.
        mass: Mass of the link [kg].
        center: Centre of mass [m], (3,), link frame.
        inertia: ixx, ixy, ixz, iyy, iyz, izz about the centre of mass [kg m^2], link axes.
        collision: Shapes that touch the object and other fingers.
        visual: Shapes that are drawn.
        color: Red, green and blue in [0, 1] of shapes without a color.
        joint: Name of the joint; "" becomes the link's name with "_joint".
        sliding: True for a prismatic joint; its "angle" is a length [m], its "torque" a force [N].
        mimic: Coupling to the driver; None: the joint has a motor of its own.
    """

    name: str
    parent: str
    origin: Vector3
    rotation: Vector3
    axis: Vector3
    lower: float
    upper: float
    torque_limit: float
    mass: float
    center: Vector3
    inertia: Inertia
    collision: tuple[Geometry, ...] = ()
    visual: tuple[Geometry, ...] = ()
    color: Vector3 = (0.5, 0.5, 0.5)
    joint: str = ""
    sliding: bool = False
    mimic: Mimic | None = None

    def __post_init__(self) -> None:
        _fix(self, name=word(self.name, "link name"))
        name = f"link {self.name!r}"
        _fix(self, parent=word(self.parent, f"{name}: parent"))
        length, force = UNITS[bool(self.sliding)]
        lower, upper = limits(self.lower, self.upper, f"{name}: joint limits [{length}]")
        _fix(
            self,
            origin=numbers(self.origin, 3, f"{name}: origin"),
            rotation=numbers(self.rotation, 3, f"{name}: rotation"),
            axis=unit(self.axis, f"{name}: axis"),
            lower=lower,
            upper=upper,
            torque_limit=positive(self.torque_limit, f"{name}: torque_limit [{force}]"),
            mass=positive(self.mass, f"{name}: mass [kg]"),
            center=numbers(self.center, 3, f"{name}: center"),
            inertia=inertia_of(self.inertia, name),
            collision=parts(self.collision, Geometry, f"{name}: collision"),
            visual=parts(self.visual, Geometry, f"{name}: visual"),
            color=numbers(self.color, 3, f"{name}: color"),
            sliding=bool(self.sliding),
            mimic=instance(self.mimic, Mimic, f"{name}: mimic", or_none=True),
            joint=f"{self.name}_joint" if self.joint == "" else word(self.joint, f"{name}: joint"),
        )

    @property
    def units(self) -> tuple[str, str]:
        """Units of the joint's position and load."""
        return UNITS[self.sliding]


@dataclass(frozen=True)
class Fingertip:
    """A sphere on a link with which a finger touches the object.

    Attributes:
        name: Name of the finger.
        link: Name of the link.
        center: Centre of the sphere [m], (3,), link frame.
        radius: Radius of the sphere [m].
    """

    name: str
    link: str
    center: Vector3
    radius: float

    def __post_init__(self) -> None:
        _fix(self, name=word(self.name, "name of a fingertip"))
        name = f"fingertip {self.name!r}"
        _fix(self, link=word(self.link, f"{name}: link"))
        center = numbers(self.center, 3, f"{name}: center")
        _fix(self, center=center, radius=positive(self.radius, f"{name}: radius [m]"))


@dataclass(frozen=True)
class Palm:
    """The fixed base of the fingers; its frame is the world frame.

    Attributes:
        name: Name of its link.
        collision: Shapes that touch the object and the fingers.
        visual: Shapes that are drawn.
        color: Red, green and blue in [0, 1] of shapes without a color.
    """

    name: str = "palm"
    collision: tuple[Geometry, ...] = ()
    visual: tuple[Geometry, ...] = ()
    color: Vector3 = (0.17, 0.19, 0.23)

    def __post_init__(self) -> None:
        _fix(self, name=word(self.name, "palm: name"))
        _fix(
            self,
            collision=parts(self.collision, Geometry, f"palm {self.name!r}: collision"),
            visual=parts(self.visual, Geometry, f"palm {self.name!r}: visual"),
            color=numbers(self.color, 3, f"palm {self.name!r}: color"),
        )


def check_tree(name: str, palm: Palm, links: tuple[Link, ...]) -> None:
    """Check that names differ and that every link stands after its parent."""
    if not links:
        raise InvalidInputError(f"{name}: links=() is empty; describe at least one moving link")
    names = [palm.name, *(link.name for link in links)]
    _check_different(name, "links", names)
    _check_different(name, "joints", [link.joint for link in links])
    for index, link in enumerate(links):
        known = names[: index + 1]
        if link.parent not in known:
            late = (
                "stands after it in `links`, or is the link itself; order parents before children"
            )
            hint = late if link.parent in names else f"is not a link; known are {', '.join(known)}"
            raise InvalidInputError(
                f"{name}: the parent {link.parent!r} of link {link.name!r} {hint}"
            )


def _check_different(name: str, kind: str, names: list[str]) -> None:
    if len(set(names)) < len(names):
        twice = max(names, key=names.count)
        raise InvalidInputError(f"{name}: two {kind} are called {twice!r}; give each its own name")


def check_mimics(name: str, links: tuple[Link, ...]) -> None:
    """Check that coupled joints follow joints that exist and are not coupled themselves."""
    free = [link.joint for link in links if link.mimic is None]
    for link in links:
        if link.mimic is not None and link.mimic.joint not in free:
            raise InvalidInputError(
                f"{name}: joint {link.joint!r} is coupled to {link.mimic.joint!r}, which is not a joint with a motor of its "
                f"own; these are {', '.join(free) or 'none'}"
            )


def check_fingertips(name: str, links: tuple[Link, ...], tips: tuple[Fingertip, ...]) -> None:
    """Check that there are fingertips, their names differ, and each is on a moving link."""
    if not tips:
        raise InvalidInputError(
            f"{name}: fingertips=() is empty; name at least one, as a hand only touches with them"
        )
    _check_different(name, "fingertips", [tip.name for tip in tips])
    known = [link.name for link in links]
    for tip in tips:
        if tip.link not in known:
            raise InvalidInputError(
                f"{name}: fingertip {tip.name!r} is on link {tip.link!r}, which does not move or does not exist; "
                f"moving links are {', '.join(known)}"
            )
