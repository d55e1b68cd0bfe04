"""
A controller for a torque-controlled hand
=========================================

The inputs are joint state, contacts and a wrench; the outputs are commands in the units of the
motors. To learn: the life cycle of a controller, calibration, a watchdog, lost contacts, gravity
compensation and a time budget, with one solve in each update. In C++: ``hand_controller.hpp``.
"""

from dataclasses import dataclass
from time import perf_counter

import numpy as np

from grasp_env.force import ForceLimits, ForceOptimizer, Margin, Status
from grasp_env.grasp import Grasp
from grasp_env.sim import HandDescription, HandKinematics

STATUSES = ("inactive", "holding", "overloaded", "coasting", "released", "pivoting")


@dataclass
class HandState:
    """Message of a hand with M joints and N fingertips: float64 arrays in the frame of the hand's
    base.
    """

    angles: np.ndarray  # (M,) [rad]
    rates: np.ndarray  # (M,) [rad/s]
    touching: np.ndarray  # (N,) bool, True for a fingertip that touches
    positions: np.ndarray  # (N, 3) contact points [m]; anything for a fingertip that does not touch
    normals: np.ndarray  # (N, 3) unit vectors into the object, likewise
    # (6,) external wrench: the object's weight and feedback on its pose [N, N m]
    wrench: np.ndarray
    gravity: np.ndarray  # (3,) [m/s^2]: the hand may be on an arm
    age: float = 0.0  # time since the contacts were measured [s]


@dataclass(frozen=True)
class HandControllerSettings:
    """Parameters to tune for a hand and a task."""

    friction: float = 0.8
    # share of the friction that forces may use, and normal force that does not count for it [N]:
    # they cover errors of friction and wrench
    friction_margin: float = 0.75
    preload: float = 0.5
    rate: float = 1000.0  # rate of `update` [Hz]
    iterations: int = 40  # largest number of solver steps in an update
    budget: float = 1e-4  # time of an update, longer ones are counted [s]
    damping: float = 0.01  # damping of every joint [N m s/rad]
    # towards the posture at `activate`, for joints that contacts leave free [N m/rad]
    stiffness: float = 0.1
    push: float = 0.1  # force of a finger without contact, along its last normal [N]
    slew: float = 50.0  # largest rate of a torque, relative to its limit [1/s]
    stale: float = 0.005  # largest age of usable contacts [s]
    grace: float = 0.1  # time for which the last forces are kept without a solution [s]
    fade: float = 0.2  # time in which they then fade [s]


class Calibration:
    """Table from torques (M, K) [N m], ascending through zero, to units (M, K): linear, clipped at
    the ends.
    """

    def __init__(self, torques, units):
        torques = np.array(torques, dtype=float)
        units = np.array(units, dtype=float)
        if torques.ndim != 2 or torques.shape != units.shape or not (np.diff(torques) > 0.0).all():
            raise ValueError(
                "a calibration needs for each joint torques that ascend, and as many units"
            )
        self.knots, self.widths, self.first = torques[:, :-1], np.diff(torques), units[:, 0]
        self.slopes = np.diff(units) / self.widths
        # (M,) reached in both directions [N m]
        self.limits = np.minimum(-torques[:, 0], torques[:, -1])

    def __call__(self, torques):
        """Return device units (M,) for torques (M,), as whole numbers."""
        covered = np.clip(torques[:, None] - self.knots, 0.0, self.widths)  # of each piece
        return np.rint(self.first + (self.slopes * covered).sum(axis=1))


class HandController:
    """`configure` and `activate` may raise, `update` never does; it commands `torques` [N m],
    explained by `status`.

    "holding": forces that balance the wrench; "overloaded": those that exceed the motors' limits
    least; "pivoting": those that balance all but a moment which no contact resists, as that about
    the line through two; "coasting": the last forces, as contacts are stale, numbers broken or no
    force balances; "released": the hand carries itself.
    """

    def configure(
        self, hand: HandDescription, settings: HandControllerSettings, calibration: Calibration
    ):
        """Make all objects of an update."""
        self.kinematics = HandKinematics(hand)
        self.settings = settings
        self.calibration = calibration
        self.limits = np.minimum(self.kinematics.torque_limits, calibration.limits)
        turn = 2 * np.pi * np.arange(hand.finger_count) / hand.finger_count
        # any contacts: every call passes its own
        ring = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
        limits = ForceLimits(
            jacobian=np.zeros((len(turn), 3, hand.joint_count)), torque_limit=self.limits
        )
        options = {"initial": "previous", "elastic": True, "max_iterations": settings.iterations}
        grasp = Grasp.from_contacts(0.03 * ring, -ring, settings.friction)
        margin = Margin(settings.friction_margin, settings.preload)
        self.optimizer = ForceOptimizer(grasp, limits=limits, margin=margin, **options)
        self.size = 2 * hand.joint_count + 7 * hand.finger_count + 10  # size of a state
        self.duration, self.late, self.over_budget = 0.0, 0, 0
        self.deactivate()

    def activate(self, state: HandState):
        """Start at the current state; torques rise from zero."""
        if not self._good(state):
            raise ValueError(
                f"a state of {self.size} finite numbers is needed to begin with, got {state}"
            )
        self.state, self.age, self.home = state, state.age, state.angles.copy()
        touching = np.asarray(state.touching, dtype=bool)[:, None]
        self.positions, self.normals = (
            np.where(touching, state.positions, 0.0),
            np.where(touching, state.normals, 0.0),
        )
        self.forces = np.zeros_like(state.positions)  # (N, 3) of the last solution [N]
        self.blind = np.inf
        self.late = 0
        self.over_budget = 0
        self.status = "released"
        self.optimizer.forget()

    def deactivate(self):
        """Command zero torque from now on."""
        self.status, self.torques = "inactive", np.zeros(len(self.limits))

    def update(self, state: HandState, period: float):
        """Return commands (M,) in device units.

        state: the newest one; period: time since the last update [s].
        """
        begin = perf_counter()
        if self.status != "inactive":
            self.late += period > 1.9 / self.settings.rate
            self._watch(state, max(0.0, period))
        commands = self.calibration(self.torques)
        self.duration = perf_counter() - begin
        self.over_budget += self.duration > self.settings.budget
        return commands

    def _good(self, state):
        numbers = np.concatenate([np.ravel(part) for part in vars(state).values()])
        if numbers.size != self.size or np.shape(state.normals) != np.shape(state.positions):
            return False
        fingers = len(self.optimizer.grasp.positions)
        joints = len(self.limits)
        places = numbers[2 * joints + fingers :][: 6 * fingers].reshape(2, fingers, 3)
        places[:, numbers[2 * joints :][:fingers] == 0.0] = 0.0  # of fingertips that do not touch
        return np.isfinite(numbers).all()

    def _watch(self, state, period):
        s = self.settings
        good = self._good(state)  # otherwise the last good message is used
        self.state, self.age = (state, state.age) if good else (self.state, self.age + period)
        now = self.state
        touching = np.asarray(self.state.touching, dtype=bool)[:, None]
        # a finger without contact keeps its last values
        np.copyto(self.positions, now.positions, where=touching)
        np.copyto(self.normals, now.normals, where=touching)
        jacobian, weight = self.kinematics.statics(now.angles, self.positions, now.gravity)
        # forces at the fingertips @ levers are joint torques
        levers = jacobian.reshape(-1, len(weight))
        carry = weight - s.damping * now.rates
        spring = s.stiffness * (self.home - now.angles)
        pushes = ~touching * s.push * self.normals
        solution, status = None, "holding"
        if self.age <= s.stale:
            limits = {"jacobian": jacobian, "torque_bias": carry + spring + pushes.ravel() @ levers}
            solution = self._solve(now.wrench, **limits)
            if solution is None and (rest := self._within_reach(now)) is not None:
                solution = self._solve(rest, **limits)
                status = "pivoting"
        if solution is not None:
            self.blind = 0.0
            self.forces = solution.object_force + pushes
            wanted = solution.torques
            self.status = "overloaded" if solution.status is Status.LIMITS_EXCEEDED else status
        else:
            # The same forces hold the object until contacts have moved or the load has changed.
            # Later the forces fade, because a hand must not squeeze an object that it no longer
            # senses.
            self.blind += period
            share = min(max(1.0 - (self.blind - s.grace) / s.fade, 0.0), 1.0)
            wanted = carry + share * (spring + self.forces.ravel() @ levers)
            self.status = "coasting" if share > 0.0 else "released"
        # torques do not jump after a missed deadline
        most = s.slew * min(period, 2.0 / s.rate) * self.limits
        self.torques = np.clip(
            np.clip(wanted, self.torques - most, self.torques + most), -self.limits, self.limits
        )

    def _solve(self, wrench, **limits):
        now = {
            "positions": self.positions,
            "normals": self.normals,
            "contacts": self.state.touching,
        }
        try:
            return self.optimizer.solve(wrench, **now, **limits)
        except (
            ValueError
        ):  # base of the solver's errors: no force balances the wrench, or wrong numbers
            return None

    def _within_reach(self, now):
        """Return the part of the wrench that several touching contacts can make; None: all of it,
        or too few touch.
        """
        touching = np.asarray(now.touching, dtype=bool)
        if touching.sum() < 2:  # a single fingertip does not stop an object from turning
            return None
        try:
            held = Grasp.from_contacts(
                self.positions[touching], self.normals[touching], self.settings.friction
            )
        except ValueError:
            return None
        return held.within_reach(now.wrench) if held.rank < 6 else None
