"""The controller of a torque-controlled hand: the one of the simulation, for your own hand.

Numbers are float64 arrays of a hand with M joints and N fingertips, in the frame of its base.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import ArrayLike

from grasp_env import core
from grasp_env.errors import InvalidInputError
from grasp_env.force.margin import Margin
from grasp_env.inputs.arguments import Array, as_array, number
from grasp_env.inputs.ranges import (
    FRICTION,
    FRICTION_MARGIN,
    LEAST_NORMAL_FORCE,
    Range,
)
from grasp_env.settings import NOT_NEGATIVE, POSITIVE, Settings, integer, real, setting
from grasp_env.sim.grasping.record import HandGrasp
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.kinematics import HandKinematics

HandState = core.HandState
"""What a hand and its sensors know at an update: `HandController.new_state` makes one.

Attributes:
    angles, rates: (M,) [rad], [rad/s].
    touching: (N,) 1 for a fingertip that touches the object, 0 for others.
    positions, normals: (N, 3) contact points [m] and unit normals into the object, object frame; not
        read where a fingertip does not touch.
    wrench: (6,) wrench to balance, object frame [N, N m]: the object's weight and feedback on its
        pose.
    gravity: (3,) [m/s^2], base frame: the hand may be on an arm.
    object, target: (13,) the object frame in the base frame, and where it should be: position [m],
        quaternion (x, y, z, w), velocity [m/s], angular velocity [rad/s]. Where the pose is not
        known, leave both as they are: then the object frame is that of the base.
    ages: (3,) of the joints, of the contacts and of the wrench [s].
    numbers: all of these in one row, for messages.
"""


@dataclass(frozen=True)
class HandControllerSettings(Settings):
    """Settings of `HandController`, to tune for a hand and a task.

    Example:
        >>> HandControllerSettings(friction=0.6, rate=500.0).preload
        0.5
    """

    friction: float = setting(0.8, real(FRICTION), "Friction coefficient.")
    torsional_friction: float = setting(
        0.0, real(NOT_NEGATIVE), "Torsional friction of soft fingertips; 0: hard ones.", unit="m"
    )
    friction_margin: float = setting(
        0.75, real(FRICTION_MARGIN), "Share of the friction that forces may use: `Margin.friction`."
    )
    preload: float = setting(
        0.5,
        real(LEAST_NORMAL_FORCE),
        "Normal force of each touching finger that does not count for friction: `Margin.preload`.",
        unit="N",
    )
    rate: float = setting(1000.0, real(POSITIVE), "Rate of `update`.", unit="Hz")
    budget: float = setting(1e-4, real(NOT_NEGATIVE), "Longer updates are counted.", unit="s")
    tolerance: float = setting(
        1e-4, real(Range(1e-12, 1.0)), "Relative certified gap at which a solve ends."
    )
    max_iterations: int = setting(
        40, integer(1), "Largest number of steps of a solve; an update makes one to eight."
    )
    joint_delay: float = setting(
        0.0, real(NOT_NEGATIVE), "Delay of the measured joints; it softens the springs.", unit="s"
    )
    grip_stiffness: float = setting(
        1500.0,
        real(NOT_NEGATIVE),
        "Stiffness of the spring from a touching fingertip to its place on the target pose; softer where `rate` and `joint_delay` "
        "demand.",
        unit="N/m",
    )
    grip_damping: float = setting(
        16.0, real(NOT_NEGATIVE), "Damping of these springs, likewise.", unit="N s/m"
    )
    grip_force: float = setting(
        10.0, real(NOT_NEGATIVE), "Largest force of each of these springs.", unit="N"
    )
    reach_stiffness: float = setting(
        60.0, real(POSITIVE), "Stiffness of a finger that reaches for its place.", unit="N/m"
    )
    reach_force: float = setting(
        0.3, real(NOT_NEGATIVE), "Its force on the object when it arrives.", unit="N"
    )
    reach_limit: float = setting(2.0, real(NOT_NEGATIVE), "Its largest force on the way.", unit="N")
    posture_stiffness: float = setting(
        0.01,
        real(NOT_NEGATIVE),
        "Stiffness of joints that the fingertips leave free, towards their home posture. A joint that moves several fingertips, such as a wrist, "
        "is a hundred times as stiff.",
        unit="N m/rad",
    )
    posture_damping: float = setting(
        0.001,
        real(NOT_NEGATIVE),
        "Least damping of these joints; their springs are damped critically.",
        unit="N m s/rad",
    )
    damping: float = setting(0.0, real(NOT_NEGATIVE), "Damping of every joint.", unit="N m s/rad")
    force_rate: float = setting(
        1000.0,
        real(POSITIVE),
        "Fastest change of a force beyond what balance requires.",
        unit="N/s",
    )
    torque_rate: float = setting(
        50.0, real(POSITIVE), "Fastest change of a torque relative to its limit.", unit="1/s"
    )
    release: int = setting(2, integer(0), "Updates without contact until a finger counts as free.")
    stale: float = setting(
        0.02, real(NOT_NEGATIVE), "Largest age of joints and contacts that are used.", unit="s"
    )
    stale_wrench: float | None = setting(
        None, real(NOT_NEGATIVE), "The same of the wrench.", unit="s", none="any age"
    )
    grace: float = setting(
        0.1, real(NOT_NEGATIVE), "Time to keep the last forces without knowledge.", unit="s"
    )
    fade: float = setting(0.2, real(POSITIVE), "Time in which they then fade.", unit="s")

    @property
    def margin(self) -> Margin:
        """The margin of the solver."""
        return Margin(self.friction_margin, self.preload)

    def to_core(self) -> core.HandControllerSettings:
        """Return the settings of the core."""
        out = core.HandControllerSettings()
        out.grip = core.Spring(self.grip_stiffness, self.grip_damping, self.grip_force)
        out.set_follow(self.tolerance, self.max_iterations)
        out.stale_wrench = np.inf if self.stale_wrench is None else self.stale_wrench
        for item in fields(self):
            if item.name not in _CONVERTED:
                setattr(out, item.name, getattr(self, item.name))
        return out


_CONVERTED = (
    "grip_stiffness",
    "grip_damping",
    "grip_force",
    "tolerance",
    "max_iterations",
    "stale_wrench",
)
"""Settings that the core keeps in another form."""


@dataclass(frozen=True)
class Calibration:
    """Tables from joint torques to the units of a hand's motors, and what the joints lose.

    Args:
        torques: (M, K) for each joint [N m], ascending through zero.
        units: (M, K) the device units of these torques. Between the points the table is linear; it
            is clipped at its ends, which limit the solver, too.
        friction: (M,) Coulomb friction of the joints [N m]: added in the direction of the wanted
            motion, in which the springs draw.
        dead_band: (M,) device units that do not move the motor: added in the direction of the
            torque.
        fade: torque of the springs, and torque, from which friction and dead band count in full
            [N m]; below they fade, so that a joint at rest does not chatter.
        resolution: commands are multiples of it [device units]; 0: any number.

    Raises:
        InvalidInputError: tables that do not ascend through zero, negative losses.

    Example:
        >>> table = Calibration([[-1.0, 0.0, 0.5]], [[-200.0, 10.0, 240.0]])
        >>> table.to_units([0.25]).tolist()
        [125.0]
    """

    torques: ArrayLike
    units: ArrayLike
    friction: ArrayLike = ()
    dead_band: ArrayLike = ()
    fade: float = 0.01
    resolution: float = 1.0
    core: core.Calibration = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        made = core.Calibration()
        for name in ("torques", "units"):
            rows = as_array(getattr(self, name), (None, None), f"{name} of a calibration")
            setattr(made, name, rows.tolist())
        for name in ("friction", "dead_band"):
            numbers = as_array(getattr(self, name), (None,), f"{name} of a calibration")
            setattr(made, name, numbers.tolist())
        made.fade = number(self.fade, "fade of a calibration", NOT_NEGATIVE)
        made.resolution = number(self.resolution, "resolution of a calibration", NOT_NEGATIVE)
        try:
            made.check(len(made.torques))
        except ValueError as error:
            raise InvalidInputError(str(error)) from None
        object.__setattr__(self, "core", made)

    @classmethod
    def newton_metres(
        cls, hand: HandDescription, friction: ArrayLike = (), dead_band: ArrayLike = ()
    ) -> Calibration:
        """Return the calibration of a hand whose motors take N m, of any size.

        Args:
            hand: The hand.
            friction, dead_band: as of the class.
        """
        made = core.Calibration.newton_metres(HandKinematics(hand).tree)
        return cls(made.torques, made.units, friction, dead_band, resolution=made.resolution)

    @classmethod
    def currents(
        cls,
        torque_constant: ArrayLike,
        largest: ArrayLike,
        units_per_ampere: ArrayLike,
        friction: ArrayLike = (),
        dead_band: ArrayLike = (),
    ) -> Calibration:
        """Return the calibration of a hand whose motors take currents.

        Args:
            torque_constant: (M,) [N m/A].
            largest: (M,) largest current [A].
            units_per_ampere: (M,) device units per ampere.
            friction, dead_band: as of the class.

        Example:
            >>> Calibration.currents([0.5], [0.6], [1000.0]).to_units([0.25]).tolist()
            [500.0]
        """
        parts = [
            as_array(part, (None,), name).tolist()
            for part, name in (
                (torque_constant, "torque_constant"),
                (largest, "largest"),
                (units_per_ampere, "units_per_ampere"),
            )
        ]
        try:
            made = core.Calibration.currents(*parts)
        except ValueError as error:
            raise InvalidInputError(str(error)) from None
        return cls(made.torques, made.units, friction, dead_band)

    @property
    def limits(self) -> Array:
        """(M,) torques that are reached in both directions [N m]."""
        return np.array([self.core.limit(joint) for joint in range(len(self.core.torques))])

    def to_units(self, torques: ArrayLike, wanted: ArrayLike | None = None) -> Array:
        """Return device units (M,) for torques (M,) [N m].

        wanted: (M,) torques of the springs, whose signs are those of the wanted motion; None: none.
        """
        numbers = as_array(torques, (len(self.core.torques),), "torques")
        motion = np.zeros(len(numbers)) if wanted is None else np.asarray(wanted, dtype=float)
        pairs = zip(numbers.tolist(), motion.tolist(), strict=True)
        return np.array([self.core(joint, *pair) for joint, pair in enumerate(pairs)])


class HandController(core.HandController):
    """Controller of a torque-controlled hand: from joints, contacts and a wrench to commands.

    `configure` and `activate` may raise, `update` never does.

    `status` tells what the commands do:

    - "inactive": zero torque.
    - "holding": forces within the margin balance the wrench.
    - "marginal": forces inside the friction cones do, with less than the margin; or forces within
      the margin do, but for 0.3 N and a fifth of the wrench at most.
    - "overloaded": such forces exceed the motors' limits; those that exceed them least.
    - "pivoting": they balance all but a moment that no contact resists, as that about the line
      through two hard fingertips.
    - "slipping": no forces inside the cones balance it, or only ones that are too large for it;
      those with the smallest imbalance.
    - "coasting": the last forces, since joints, contacts or wrench are too old. They fade.
    - "released": the hand carries itself.
    - "given": forces or places that `hold` asks for instead of optimal forces, unchecked.

    Attributes:
        status: see above.
        duration: time of the last update [s].
        late, over_budget: number of updates after a missed deadline, and of those longer than the
            budget.

    Example:
        >>> hand = HandDescription.allegro()
        >>> controller = HandController()
        >>> controller.configure(hand, HandControllerSettings(friction=0.6))
        >>> state = controller.new_state()
        >>> state.angles = np.array(hand.home)
        >>> state.gravity[:] = 0.0, 0.0, -9.81
        >>> controller.activate(state)
        >>> controller.update(state, 1e-3).shape, controller.status
        ((16,), 'released')
    """

    def configure(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
        hand: HandDescription | HandGrasp,
        settings: HandControllerSettings | None = None,
        calibration: Calibration | None = None,
        home: Sequence[float] | None = None,
    ) -> None:
        """Make all objects of an update.

        Args:
            hand: The hand, or its grasp of an object.
            settings: None: the defaults.
            calibration: None: the motors take N m.
            home: (M,) posture in which gains are computed and to which joints return that the
                fingertips leave free [rad]; None: that of the grasp's contacts, or of the hand.

        Raises:
            InvalidInputError: a calibration or a posture of another number of joints.
        """
        if isinstance(hand, HandGrasp):
            home = hand.angles.tolist() if home is None else home
            hand = hand.hand
        chosen = settings or HandControllerSettings()
        kinematics = HandKinematics(hand)
        table = calibration or Calibration.newton_metres(hand)
        rest = hand.home if home is None else as_array(home, (hand.joint_count,), "home").tolist()
        try:
            super().configure(kinematics.tree, chosen.to_core(), table.core, rest)
        except ValueError as error:
            raise InvalidInputError(str(error)) from None
        self.settings = chosen
        self.hand = hand
        arrays = self.arrays()
        self.torques: Array = arrays["torques"]
        self.force: Array = arrays["force"]
        self.limits: Array = np.array(self.torque_limits)

    def new_state(self) -> HandState:
        """Return a state of this hand: zeros, and an object frame at the base."""
        return HandState(self.hand.joint_count, self.hand.finger_count)

    def activate(self, state: HandState) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Start at the current state; torques rise from zero.

        Raises:
            InvalidInputError: before `configure`; a state of another hand, or with numbers that are
                not finite, or normals or quaternions of another length than 1.
        """
        if not hasattr(self, "hand"):
            raise InvalidInputError("call configure(hand) before activate")
        if not super().activate(state):
            raise InvalidInputError(
                f"a state of this hand, of {self.hand.joint_count} joints and {self.hand.finger_count} fingertips, is needed to begin "
                "with, with finite numbers, quaternions of length 1, and normals of length 1 where fingertips touch, got "
                f"{state.numbers.tolist()}"
            )
