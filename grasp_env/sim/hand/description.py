"""Describe a hand as data: a tree of links on a palm, with the fingertips that touch the object.

The engines' files and `HandKinematics` are derived from this one record. Longer than most modules:
`from_file` documents each argument.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import flag, instance
from grasp_env.sim.hand import presets
from grasp_env.sim.hand.check import Vector3, numbers, parts, positive, word
from grasp_env.sim.hand.fingers import FingerDescription
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.inertia import inertia_matrix, with_rotor
from grasp_env.sim.hand.tree import (
    Fingertip,
    Geometry,
    Link,
    Mimic,
    Palm,
    check_fingertips,
    check_mimics,
    check_tree,
)

__all__ = [
    "HANDS",
    "FingerDescription",
    "Fingertip",
    "Geometry",
    "HandDescription",
    "Link",
    "Mimic",
    "Palm",
    "Vector3",
]


ROTOR_INERTIA = 1e-4  # default rotor inertia at a joint [kg m^2]; see `HandDescription.with_rotors`
_LIGHT_INERTIA = 1e-5
"""End links with less inertia about their joint than this [kg m^2] get `ROTOR_INERTIA` added: a
torque error of 50 mN m would change their speed by 50 rad/s in one control tick."""


@dataclass(frozen=True)
class HandDescription:
    """A hand: a fixed palm, moving links with torque-controlled joints, and fingertips.

    Joints turn or slide, and may be coupled to other joints. Joint i moves link i, and finger i
    ends in fingertip i; i is the index in `links` or `fingertips`. The palm's frame is the world
    frame.

    Attributes:
        name: Name of the hand.
        palm: The fixed base.
        links: The moving links, parents before children.
        fingertips: One per finger, in the order of the contacts.
        home: Rest posture [rad], (M,), within the limits. () stands for the middle of each range,
            and 0 for joints without limits. Coupled joints follow their drivers.
        tip_friction: Friction coefficient of all links, tips included. The coefficient of a contact
            is this times the object's, in both engines. With 1 it is the object's.
        placed: True if the palm's pose and `home` suit an object at the origin. If False, as for a
            hand just read from a file, an environment chooses both.

    Raises:
        InvalidInputError: The hand is not valid; the message gives the reason.

    Example:
        >>> hand = HandDescription.four_finger()
        >>> hand.finger_count, hand.joint_count
        (4, 12)
        >>> hand.joint_names[:3]
        ('thumb_knuckle_joint', 'thumb_proximal_joint', 'thumb_distal_joint')
    """

    name: str
    palm: Palm
    links: tuple[Link, ...]
    fingertips: tuple[Fingertip, ...]
    home: tuple[float, ...] = ()
    tip_friction: float = 1.0
    placed: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", word(self.name, "name of a hand"))
        name = f"hand {self.name!r}"
        object.__setattr__(self, "links", parts(self.links, Link, f"{name}: links"))
        object.__setattr__(
            self, "fingertips", parts(self.fingertips, Fingertip, f"{name}: fingertips")
        )
        instance(self.palm, Palm, f"{name}: palm")
        positive(self.tip_friction, f"{name}: tip_friction")
        object.__setattr__(self, "placed", flag(self.placed, f"{name}: placed"))
        check_tree(name, self.palm, self.links)
        check_mimics(name, self.links)
        check_fingertips(name, self.links, self.fingertips)
        home = self.home
        if isinstance(home, list | tuple) and not home:
            home = [_middle(link) for link in self.links]
        home = numbers(home, len(self.links), f"{name}: home [rad, m]")
        object.__setattr__(self, "home", self._coupled(home))
        for link, angle in zip(self.links, self.home, strict=True):
            if link.mimic is None and not link.lower <= angle <= link.upper:
                length = link.units[0]
                raise InvalidInputError(
                    f"{name}: home={angle} {length} of joint {link.joint!r} must be within its limits, "
                    f"{link.lower} to {link.upper} {length}"
                )

    @property
    def drivers(self) -> tuple[int, ...]:
        """The index of each joint's driver, (M,); a joint that is not coupled drives itself."""
        joints = {link.joint: index for index, link in enumerate(self.links)}
        return tuple(joints[link.mimic.joint if link.mimic else link.joint] for link in self.links)

    def _coupled(self, angles: tuple[float, ...]) -> tuple[float, ...]:
        """Return the angles (M,) with each coupled joint set by its driver."""
        return tuple(
            angle if link.mimic is None else link.mimic.angle(angles[driver])
            for link, angle, driver in zip(self.links, angles, self.drivers, strict=True)
        )

    @property
    def joint_count(self) -> int:
        """Number M of joints, one per link, coupled joints included."""
        return len(self.links)

    @property
    def finger_count(self) -> int:
        """Number N of fingertips."""
        return len(self.fingertips)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of all joints, (M,)."""
        return tuple(link.joint for link in self.links)

    @property
    def finger_names(self) -> tuple[str, ...]:
        """Names of all fingers, (N,)."""
        return tuple(tip.name for tip in self.fingertips)

    @property
    def torque_limits(self) -> np.ndarray:
        """Largest torque of each joint [N m], (M,)."""
        return np.array([link.torque_limit for link in self.links])

    def moved(self, position: Vector3, rotation: Vector3 = (0.0, 0.0, 0.0)) -> HandDescription:
        """Return the hand with its palm frame at `position`, turned by `rotation`.

        It is then `placed`.

        Args:
            position: Origin of the palm frame [m], (3,), world frame.
            rotation: Roll, pitch and yaw [rad], (3,).
        """
        x, y, z = numbers(position, 3, "position [m]")
        roll, pitch, yaw = numbers(rotation, 3, "rotation (roll, pitch, yaw)")
        place = Frame.of((x, y, z), (roll, pitch, yaw))

        links = list(self.links)
        for index, link in enumerate(links):
            if link.parent == self.palm.name:
                origin, angles = place.carry(link.origin, link.rotation)
                links[index] = replace(link, origin=origin, rotation=angles)
        palm = replace(
            self.palm,
            collision=tuple(shape.carried(place) for shape in self.palm.collision),
            visual=tuple(shape.carried(place) for shape in self.palm.visual),
        )
        return replace(self, palm=palm, links=tuple(links), placed=True)

    def without_visuals(self) -> HandDescription:
        """Return the hand without visual shapes."""
        links = tuple(replace(link, visual=()) for link in self.links)
        return replace(self, palm=replace(self.palm, visual=()), links=links)

    def with_rotors(
        self, inertia: float = ROTOR_INERTIA, links: Sequence[str] | None = None
    ) -> HandDescription:
        """Return the hand with the inertia of its motors' rotors, which most files leave out.

        The inertia at the joint is that of the rotor times the gear ratio squared: a rotor of 5e-8
        kg m^2 behind 1:288 adds 4e-3 kg m^2. This inertia is added to a link about all axes.

        Args:
            inertia: Inertia that is added to the link of each turning joint [kg m^2]. The default
                is far below that of geared servos.
            links: Names of the links to which it is added; None: every link whose joint has a
                motor.
        """
        (added,) = numbers((inertia,), 1, "inertia [kg m^2]")
        if added < 0.0:
            raise InvalidInputError(f"inertia={added} kg m^2 must be 0 or above")
        heavier = list(self.links)
        for index, link in enumerate(heavier):
            if not link.sliding and (link.mimic is None if links is None else link.name in links):
                heavier[index] = replace(link, inertia=with_rotor(link.inertia, added))
        return replace(self, links=tuple(heavier))

    def _light_ends(self) -> list[str]:
        """Return the end links lighter than `_LIGHT_INERTIA`; of a coupled one, its driver's link."""
        carriers = {link.parent for link in self.links}
        light: dict[str, None] = {}
        for link, driver in zip(self.links, self.drivers, strict=True):
            center = np.array(link.center)
            axis = np.array(link.axis)
            inertia = axis @ inertia_matrix(link.inertia) @ axis
            inertia += link.mass * (center @ center - (axis @ center) ** 2)  # about the joint
            if not link.sliding and link.name not in carriers and inertia < _LIGHT_INERTIA:
                light[self.links[driver].name] = None
        return list(light)

    @staticmethod
    def of_fingers(
        fingers: Sequence[FingerDescription],
        name: str = "hand",
        palm: Palm | None = None,
        tip_friction: float = 1.0,
    ) -> HandDescription:
        """Make a hand of hanging fingers, each with three or four joints.

        Args:
            fingers: One finger or more, with different names.
            name: Name of the hand.
            palm: The palm; None: the box of the four-finger hand.
            tip_friction: See the class.

        Example:
            >>> thumb = FingerDescription("thumb", base=(0, 0.135, -0.09), press=(0, 0, 1))
            >>> HandDescription.of_fingers([thumb]).joint_count
            3
        """
        carrier: Palm = instance(_box_palm() if palm is None else palm, Palm, "palm")
        fingers = parts(fingers, FingerDescription, "fingers")
        return HandDescription(
            name=name,
            palm=carrier,
            links=tuple(link for finger in fingers for link in finger.links(carrier.name)),
            fingertips=tuple(finger.fingertip() for finger in fingers),
            home=tuple(angle for finger in fingers for angle in finger.home),
            tip_friction=tip_friction,
        )

    @staticmethod
    def from_file(
        path: str | os.PathLike[str],
        fingertips: Sequence[str] | dict[str, tuple[Sequence[float], float]] | None = None,
        *,
        palm: str | None = None,
        tip_radius: float | None = None,
        torque_limit: float | Sequence[float] | dict[str, float] | None = None,
        joint_limits: dict[str, tuple[float, float]] | None = None,
        inertials: dict[str, float | tuple[float, Sequence[float], Sequence[float]]] | None = None,
        home: Sequence[float] = (),
        position: Vector3 | None = None,
        rotation: Vector3 | None = None,
        tip_friction: float = 1.0,
        rotor_inertia: float | None = None,
        xacro: bool | None = None,
        xacro_args: Mapping[str, str | float | bool] | None = None,
    ) -> HandDescription:
        """Read a hand from a URDF, a xacro file or a MuJoCo model (MJCF).

        `from_urdf` and `from_mjcf` are aliases.

        Joints may turn, slide, be fixed or mimic others. Links behind a fixed joint are merged into
        their parent. Collision meshes become convex hulls, or several convex pieces if one hull
        would fill hollows; visual meshes are drawn.

        Missing and implausible values are replaced. Each kind has an argument that overrides it:

        - `inertials`: masses, centres of mass and inertias that do not fit the size of the link.
        - `torque_limit`: efforts that no motor of such a finger has. The assumed torques give 15 N
          at the tip of a straight finger; the assumed force of a sliding joint is 20 N.
        - `joint_limits`: ranges in degrees. Other wide ranges are kept.

        One warning lists the replaced values, the assumed ones, the wide ranges, and the arguments
        that override them.

        To read the hand of an arm or of a whole robot, name its `palm`. The palm is then fixed, the
        joints that carry it are frozen, and all other limbs are left out.

        Each fingertip is a sphere. It is the only sphere among the collision shapes of the named
        link if that is at the link's end; else one of `tip_radius` at the link's origin, if given;
        else the largest sphere that fits in the link's end. The link's other collision shapes are
        cut back behind the sphere, so that the sphere touches first.

        Args:
            path: Path of the file. Meshes are looked for under their names, beside the file, and in
                the folders above it.
            fingertips: Names of links in the order of the contacts, for a MuJoCo model also of
                sites and geometries. The fingers get these names. Or a dict from the name of a link
                to the centre (3,) [m], link frame, and radius [m] of its sphere. None: the moving
                links at the ends of branches, with the tip frames that are fixed to them, without
                gears and rods. If one jaw moves, the palm's own jaw is the second one.
            palm: Name of the link that becomes the palm, together with everything fixed to it; the
                hand is what it carries. None: the root link.
            tip_radius: Radius of the sphere [m] at the origin of each named link that has no sphere
                at its end.
            torque_limit: Torque limit [N m] of all joints, or one for each in the order of
                `joint_names`, or a dict by joint name. It overrides the file.
            joint_limits: Dict from the name of a joint to its limits (lower, upper) [rad], for
                sliding joints [m]. It overrides the file. A joint without limits has (-math.inf,
                math.inf).
            inertials: Dict from the name of a moving link to its mass [kg], with which the file's
                inertia is scaled. Or to its mass [kg], its centre of mass (3,) [m] and its inertia
                (ixx, ixy, ixz, iyy, iyz, izz) about that centre [kg m^2], in the link's frame. The
                values include all links that are fixed to the link.
            home: Rest posture [rad], (M,), in the order of `joint_names`; () as in the class.
            position: Position of the palm's link [m], (3,), world frame. If none of `position`,
                `rotation` and `home` is given, the hand is not `placed`.
            rotation: Roll, pitch and yaw of the palm's link [rad], (3,).
            tip_friction: See the class.
            rotor_inertia: Rotor inertia at every motor [kg m^2]. None: the armature of a MuJoCo
                model, and the default of `with_rotors` for end links with less than 1e-5 kg m^2
                about their joint.
            xacro: True if xacro expands the file; None: if its name ends in .xacro.
            xacro_args: Dict from the names of arguments of a xacro file to their values. The others
                have their defaults.

        Raises:
            InvalidInputError: The file is not such a hand; the message lists everything that must
                be changed.

        Warns:
            UserWarning: A value was replaced or assumed, or a part of the file was left out.
        """
        from grasp_env.sim.hand.files.importing import read_hand
        from grasp_env.sim.hand.files.options import HandOptions  # these need the parts above

        options = HandOptions(
            fingertips,
            tip_radius,
            torque_limit,
            joint_limits,
            inertials,
            palm,
            rotor_inertia,
            xacro,
            xacro_args,
        )
        read = read_hand(path, options)
        angles = numbers(home, None, "home [rad]")
        hand = HandDescription(*read[:4], angles, tip_friction, placed=bool(angles))
        repairs = read.repairs
        if rotor_inertia is not None:
            hand = hand.with_rotors(rotor_inertia)
        elif light := hand._light_ends():
            hand = hand.with_rotors(links=light)
            repairs.append(
                f"end links have less inertia than any geared motor: {', '.join(light)} get a rotor of {ROTOR_INERTIA:g} kg m^2 "
                "(rotor_inertia=0 adds none)"
            )
        if position is not None or rotation is not None:
            zero = (0.0, 0.0, 0.0)
            hand = hand.moved(
                zero if position is None else position, zero if rotation is None else rotation
            )
        if repairs:
            warnings.warn(f"{path}: {'; '.join(repairs)}", stacklevel=2)
        return hand

    from_urdf = from_mjcf = from_file

    @staticmethod
    def four_finger() -> HandDescription:
        """Return the hand of the reference grasp: a thumb at z < 0 and three fingers at z > 0."""
        return HandDescription.of_fingers(_four_fingers(), "four_finger")

    @staticmethod
    def three_finger() -> HandDescription:
        """Return a hand with a thumb at z < 0 and two fingers at z > 0."""
        fingers = [_thumb(), _front("left", -0.03, 2), _front("right", 0.03, 3)]
        return HandDescription.of_fingers(fingers, "three_finger")

    @staticmethod
    def five_finger() -> HandDescription:
        """Return a hand with a thumb at z < 0 and four fingers at z > 0."""
        fingers = [
            _front("index", -0.0175, 1),
            _front("middle", 0.0175, 4),
            _front("left", -0.05, 2),
            _front("right", 0.05, 3),
        ]
        return HandDescription.of_fingers([_thumb(), *fingers], "five_finger")

    @staticmethod
    def four_finger_4dof() -> HandDescription:
        """Return the four-finger hand with one more flexion in each finger: 16 joints."""
        fingers = [replace(finger, **_FOUR_JOINTS) for finger in _four_fingers()]
        return HandDescription.of_fingers(fingers, "four_finger_4dof")

    @staticmethod
    def allegro() -> HandDescription:
        """Return the right Allegro Hand V4 with its largest torques of 0.7 N m; see `presets`.

        It is not placed.
        """
        return HandDescription(**presets.allegro()).with_rotors()

    @staticmethod
    def leap() -> HandDescription:
        """Return the right LEAP Hand with torques up to 0.95 N m; see `presets`.

        It is not placed.
        """
        return HandDescription(**presets.leap()).with_rotors()


HANDS: dict[str, Callable[[], HandDescription]] = {
    name: getattr(HandDescription, name)
    for name in (
        "four_finger",
        "three_finger",
        "five_finger",
        "four_finger_4dof",
        "allegro",
        "leap",
    )
}
"""The built-in hands by name."""

_COLORS = (
    (0.85, 0.33, 0.24),
    (0.20, 0.50, 0.80),
    (0.95, 0.69, 0.20),
    (0.27, 0.65, 0.42),
    (0.55, 0.40, 0.70),
)
_FOUR_JOINTS = {
    "link_lengths": (0.035, 0.065, 0.05, 0.04),
    "link_masses": (0.02, 0.025, 0.015, 0.01),
    "joint_lower": (-1.0, -1.8, 0.05, 0.05),
    "joint_upper": (1.0, 1.2, 2.0, 1.8),
    "home": (0.0, -0.7, 0.8, 0.6),
}


def _thumb() -> FingerDescription:
    return FingerDescription("thumb", (0.0, 0.135, -0.09), (0.0, 0.0, 1.0), color=_COLORS[0])


def _four_fingers() -> list[FingerDescription]:
    return [
        _thumb(),
        _front("middle", 0.0, 1),
        _front("left", -0.045, 2),
        _front("right", 0.045, 3),
    ]


def _front(name: str, x: float, color: int) -> FingerDescription:
    """Return a finger opposite the thumb.

    Fingers near the middle touch high contacts and start farther away.
    """
    depth = 0.105 if abs(x) < 0.02 else 0.09
    return FingerDescription(name, (x, 0.135, depth), (0.0, 0.0, -1.0), color=_COLORS[color])


def _box_palm() -> Palm:
    box = Geometry("box", (0.124, 0.016, 0.236), (0.0, 0.145, 0.0))
    return Palm(collision=(box,), visual=(box,))


def _middle(link: Link) -> float:
    return 0.5 * (link.lower + link.upper) if np.isfinite(link.lower) else 0.0
