"""Contacts of a hand without tactile sensors, from what its joints measure."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from grasp_env import core
from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import Array, as_array, instance
from grasp_env.settings import NOT_NEGATIVE, POSITIVE, Settings, real, setting
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.objects.description import ObjectDescription


@dataclass(frozen=True)
class ContactEstimatorSettings(Settings):
    """Settings of `ContactEstimator`.

    A free finger arrives with the `reach_force` of the controller, 0.3 N. `touch` must be lower, or
    the controller never learns that it has arrived. It must also exceed the errors of the forces,
    or free fingers seem to touch. Where joint friction alone is larger than 0.2 N at a fingertip,
    raise `touch`, and `reach_force` above it.

    Raises:
        InvalidInputError: `touch` is not above `release`, or a setting is out of range.

    Example:
        >>> ContactEstimatorSettings(touch=0.4, release=0.2).time_constant
        0.01
    """

    touch: float = setting(
        0.2, real(POSITIVE), "Force along the normal from which on a finger touches.", unit="N"
    )
    release: float = setting(
        0.1, real(NOT_NEGATIVE), "Force below which it touches no longer.", unit="N"
    )
    time_constant: float = setting(
        0.01, real(NOT_NEGATIVE), "Time constant of the observer.", unit="s"
    )
    largest_gap: float = setting(
        0.005,
        real(NOT_NEGATIVE),
        "A fingertip farther from the surface of the object does not touch it, whatever its force. It must exceed the error of the "
        "object's pose.",
        unit="m",
    )

    def agree(self) -> None:
        """See the base class."""
        if self.touch <= self.release:
            raise InvalidInputError(
                f"touch must be above release, got touch={self.touch:g} N and release={self.release:g} N"
            )


class ContactEstimator(core.ContactEstimator):
    """Contacts of fingertips from joint angles, rates and motor torques, without tactile sensors.

    An observer of the generalised momentum finds the torques of the contacts on the joints, without
    accelerations (De Luca and Mattone 2003; Haddadin, De Luca and Albu-Schaeffer 2017). Least
    squares turn them into the force of each fingertip. The contact points follow from the joint
    angles and from the surface of the object, or from a guess of the normals.

    The observer takes every torque that the motors and the weight of the links do not explain for a
    contact of a fingertip. So it does not tell a contact from a pull at the finger or from joint
    friction: a friction of F N m hides F / L newtons at a lever of L m, and the joints of a finger
    add up. It neglects Coriolis
    torques and the inertia of rotors. A finger of two joints does not feel forces across its plane,
    and they count as zero.

    Args:
        hand: The hand.
        item: The object, whose pose is `object` of the state.
        normals: (N, 3) unit normals into the object, object frame, without `item`; see
            `set_normals`.
        settings: None: the defaults.

    Attributes:
        forces: (N, 3) forces of the fingertips on the object [N], base frame. A view, as the next
            two: the next update overwrites it.
        gaps: (N,) distances between tips and surface [m]; nan without `item`.
        residual: (M,) torques of the contacts on the joints [N m].

    Raises:
        InvalidInputError: both or neither of `item` and `normals`, or normals of another shape or
            length than 1.

    Example:
        >>> import numpy as np
        >>> hand = HandDescription.allegro()
        >>> kinematics = HandKinematics(hand)
        >>> estimator = ContactEstimator(hand, normals=np.tile([1.0, 0.0, 0.0], (4, 1)))
        >>> state = core.HandState(hand.joint_count, hand.finger_count)
        >>> state.angles = np.array(hand.home)
        >>> points, _, _ = kinematics.contacts(hand.home, normals=np.tile([1.0, 0.0, 0.0], (4, 1)))
        >>> force = np.array([0.5, 0.0, 0.0])  # of the thumb on the object, without gravity
        >>> torques = kinematics.jacobian(hand.home, 3, points[3]).T @ force
        >>> estimator.update(state, torques, 0.001), state.touching.tolist()
        (True, [0.0, 0.0, 0.0, 1.0])
        >>> bool(np.abs(estimator.forces[3] - force).max() < 0.02)
        True
    """

    def __init__(
        self,
        hand: HandDescription,
        item: ObjectDescription | None = None,
        normals: ArrayLike | None = None,
        settings: ContactEstimatorSettings | None = None,
    ) -> None:
        if (item is None) == (normals is None):
            raise InvalidInputError("give an item or normals, and not both")
        chosen = ContactEstimatorSettings()
        if settings is not None:
            chosen = instance(settings, ContactEstimatorSettings, "settings")
        super().__init__(
            HandKinematics(instance(hand, HandDescription, "hand")).tree,
            chosen.touch,
            chosen.release,
            chosen.time_constant,
            chosen.largest_gap,
        )
        self.hand = hand
        self.settings = chosen
        if normals is not None:
            self.set_normals(normals)
        else:
            self.set_surface(instance(item, ObjectDescription, "item").surface)

    def set_normals(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, normals: ArrayLike
    ) -> None:
        """Guess the normals, in place of an object.

        A guess that is wrong by an angle moves the contact point by the angle times the radius of
        the tip, and the force along the normal by its cosine.

        Args:
            normals: (N, 3) unit normals into the object, object frame.

        Raises:
            InvalidInputError: a wrong shape, or a length that is not 1, to 1 %.
        """
        rows = as_array(normals, (self.hand.finger_count, 3), "normals")
        try:
            super().set_normals(rows)
        except ValueError as error:
            raise InvalidInputError(str(error)) from None

    def update(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, state: core.HandState, torques: ArrayLike, period: float
    ) -> bool:
        """Write `touching`, `positions` and `normals` of a state.

        It reads `angles`, `rates`, `gravity` and `object` of the state. The first update, and the
        first after `reset`, takes the hand to be at rest. The contacts are as old as the joints: set
        `ages` accordingly.

        Args:
            state: a state of this hand, which the caller fills from the sensors.
            torques: (M,) mean joint torques that the motors delivered since the last update [N m]:
                their currents times the torque constant. Those of coupled joints count for nothing.
            period: time since the last update [s].

        Returns:
            False if a number is not finite, a quaternion has another length than 1 or the period is
            negative. Then the state gets the last estimate.

        Raises:
            InvalidInputError: a state of another hand, torques of another number of joints.
        """
        counts = len(state.angles), len(state.touching)
        if counts != (self.hand.joint_count, self.hand.finger_count):
            raise InvalidInputError(
                f"a state of this hand has {self.hand.joint_count} joints and {self.hand.finger_count} fingertips, got {counts[0]} and "
                f"{counts[1]}: make one with HandController.new_state"
            )
        given: Array = as_array(
            torques, (self.hand.joint_count,), "torques", finite=False, copy=False
        )
        return super().update(state, given, period)
