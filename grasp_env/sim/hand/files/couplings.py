"""Find the joints that each motor of a MuJoCo model moves.

Hands couple joints by equalities, tendons, springs and closed loops of links. A simulation of each
motor, without gravity and contacts, covers all of them.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from grasp_env.inputs.arguments import Array
from grasp_env.sim.mujoco_api import mujoco

_STATIONS = 7  # positions of a motor at which the joints are measured
# time from one position to the next, and waiting time before the joints are measured [s]
_TRAVEL, _REST = 0.2, 0.8
# steps for one motor, and time step [s]; that of the file is adjusted to these
_MAX_STEPS, _LONGEST_STEP = 4000, 0.005
_FROZEN = 1e6  # armature that freezes a joint against constraints [kg m^2]
# armature of hinges [kg m^2] and slides [kg], so that joints on one tendon move alike
_ROTOR, _SLIDER = 1e-3, 1.0
_SETTLING = 0.05  # time in which a joint without springs comes to rest [s]
_DIGITS = 4  # significant digits of a coupling, as many as the measurement has
_STILL = 1e-6  # largest travel of a joint that counts as still [rad] or [m]
_MOVED = 0.02  # smallest travel of a coupled joint, as a share of its range, or [rad] without one
# share of the largest relative travel on a tendon; the first joint that moves as far is the driver
_NEARLY = 0.9
STRAIGHT = 0.05  # largest `Motor.bend` of a coupling that a line fits well
# travel in both directions of a hinge [rad] and a slide [m] without limits
_FREE_TURN, _FREE_WAY = np.pi, 0.1


@dataclass(frozen=True)
class Motor:
    """A motor, the joint that it moves farthest, and the joints that follow that one."""

    actuator: int  # -1 for a joint that counts as a motor because the file has no actuators
    joint: int
    followers: dict[int, tuple[float, float]]  # ratio, offset: angle = ratio * driver's + offset
    arm: float  # torque of `joint` [N m], followers' shares included, per motor force [N or N m]
    bend: float  # largest distance of a follower from its line, as a share of its travel


def find_motors(model: Any) -> list[Motor]:
    """Return the motors of a compiled model, each with its followers.

    Free and ball joints are frozen. A joint belongs to the motor that moves it farthest.
    """
    candidates = _actuators(model)
    if model.nu == 0:
        followers = {
            int(model.eq_obj1id[row]) for row in range(model.neq) if _is_joint_pair(model, row)
        }
        candidates = [(-1, joint) for joint in _movable(model) if joint not in followers]
    bench = _Bench(model, [joint for _, joint in candidates if joint >= 0])
    tied = _tied(model)
    driven = {joint for _, joint in candidates}
    measured = list[tuple[Motor, dict[int, float]]]()
    for actuator, joint in candidates:
        arm = abs(float(model.actuator_gear[actuator, 0])) if actuator >= 0 else 1.0
        if joint >= 0 and joint not in tied:
            measured.append((Motor(actuator, joint, {}, arm, 0.0), {}))
        elif (motor := bench.moved_by(actuator, joint, arm)) is not None:
            measured.append(motor)
    motors = list[Motor]()
    taken = set[int]()
    for index, (motor, travels) in enumerate(measured):
        if motor.joint in taken:
            continue
        others = [travel for number, (_, travel) in enumerate(measured) if number != index]
        followers = {
            joint: line
            for joint, line in motor.followers.items()
            if joint not in taken | driven
            and all(other.get(joint, 0.0) <= travels[joint] for other in others)
        }
        taken |= {motor.joint, *followers}
        motors.append(replace(motor, followers=followers))
    return motors


def _movable(model: Any) -> list[int]:
    kinds = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    return [joint for joint in range(model.njnt) if int(model.jnt_type[joint]) in kinds]


def _is_joint_pair(model: Any, row: int) -> bool:
    return int(model.eq_type[row]) == int(mujoco.mjtEq.mjEQ_JOINT)


def _tied(model: Any) -> set[int]:
    """Return the joints that an equality or a tendon connects to others."""
    joints = {int(model.dof_jntid[dof]) for dof in np.ravel(model.ten_J_colind).tolist()}
    for row in range(model.neq):
        kind = int(model.eq_objtype[row])
        on_site = kind == int(mujoco.mjtObj.mjOBJ_SITE)
        ends = (int(model.eq_obj1id[row]), int(model.eq_obj2id[row]))
        if _is_joint_pair(model, row):
            joints |= {end for end in ends if end >= 0}
        elif on_site or kind == int(mujoco.mjtObj.mjOBJ_BODY):
            for end in ends:
                body = int(model.site_bodyid[end]) if on_site else end
                while body > 0:
                    joints |= {*joints_of(model, body)}
                    body = int(model.body_parentid[body])
    return joints


def joints_of(model: Any, body: int) -> range:
    """Return the numbers of a body's joints."""
    first = int(model.body_jntadr[body])
    return range(first, first + int(model.body_jntnum[body]))


def _actuators(model: Any) -> list[tuple[int, int]]:
    """Return pairs of actuator and hinge or slide, then pairs of actuator and -1 for tendons."""
    kind = mujoco.mjtTrn
    on_joint = (int(kind.mjTRN_JOINT), int(kind.mjTRN_JOINTINPARENT))
    movable = set(_movable(model))
    joints = list[tuple[int, int]]()
    tendons = list[tuple[int, int]]()
    for actuator in range(model.nu):
        target = int(model.actuator_trnid[actuator, 0])
        transmission = int(model.actuator_trntype[actuator])
        if transmission in on_joint and target in movable:
            joints.append((actuator, target))
        elif transmission == int(kind.mjTRN_TENDON):
            tendons.append((actuator, -1))
    return [*joints, *tendons]


class _Bench:
    """A test bench that moves the motors of a model one at a time, without gravity and contacts.

    The joints of other motors are `frozen`.
    """

    def __init__(self, model: Any, frozen: list[int]) -> None:
        self.model, self.frozen = model, frozen
        self.movable = _movable(model)
        self.addresses = model.jnt_qposadr[self.movable]
        limited = model.jnt_limited[self.movable].astype(bool)
        hinge = model.jnt_type[self.movable] == int(mujoco.mjtJoint.mjJNT_HINGE)
        free = np.where(hinge, _FREE_TURN, _FREE_WAY)
        self.low = np.where(limited, model.jnt_range[self.movable, 0], -free)
        self.high = np.where(limited, model.jnt_range[self.movable, 1], free)
        self.paired = set[int]()  # joints of equalities
        self.lines = dict[tuple[int, int], list[float]]()  # offset and ratio of linear equalities
        for row in range(model.neq):
            pair = int(model.eq_obj1id[row]), int(model.eq_obj2id[row])
            if _is_joint_pair(model, row) and pair[1] >= 0:
                self.paired |= {*pair}
                if not model.eq_data[row, 2:5].any():
                    self.lines[pair] = model.eq_data[row, :2].tolist()

    def moved_by(
        self, actuator: int, joint: int, arm: float
    ) -> tuple[Motor, dict[int, float]] | None:
        """Return a motor with all joints that it moves, and the share of its range that each moves.

        The actuator is -1 for none, the joint -1 for a tendon. The result is None if no joint moves
        or the simulation fails.
        """
        path = self._path(actuator, joint)
        if path is None:
            return None
        angles, lengths = path
        spans = np.ptp(angles, axis=0) / (self.high - self.low)
        if joint >= 0:
            column = self.movable.index(joint)
        else:
            column = int((spans >= _NEARLY * spans.max()).argmax())
        driver = angles[:, column]
        if np.ptp(driver) < _STILL:
            return None
        first = self.movable[column]
        followers = dict[int, tuple[float, float]]()
        travels = {first: float(spans[column])}
        bend = 0.0
        for other, number in enumerate(self.movable):
            travel = float(np.ptp(angles[:, other]))
            moves = travel > _STILL if number in self.paired else spans[other] >= _MOVED
            if other == column or not moves or number in self.frozen:
                continue
            ratio, offset = np.polyfit(driver, angles[:, other], 1)
            error = float(np.abs(ratio * driver + offset - angles[:, other]).max())
            # rounded to the precision of the measurement
            decimals = max(0, 3 - math.floor(math.log10(travel)))
            line = float(f"{ratio:.{_DIGITS}g}"), round(float(offset), decimals)
            followers[number] = self._equality(number, first) or line
            travels[number] = float(spans[other])
            bend = max(bend, error / travel)
        if joint < 0:
            arm = abs(float(np.polyfit(driver, lengths, 1)[0]))
        return Motor(actuator, first, followers, arm, bend), travels

    def _equality(self, joint: int, driver: int) -> tuple[float, float] | None:
        """Return ratio and offset of a linear equality between a joint and a driver, if any."""
        rest, driver_rest = self.model.qpos0[self.model.jnt_qposadr[[joint, driver]]].tolist()
        if (joint, driver) in self.lines:
            offset, ratio = self.lines[joint, driver]
            return ratio, rest + offset - ratio * driver_rest
        offset, ratio = self.lines.get((driver, joint), (0.0, 0.0))
        return (1.0 / ratio, rest - (driver_rest + offset) / ratio) if ratio != 0.0 else None

    def _path(self, actuator: int, joint: int) -> tuple[Array, Array] | None:
        """Return the joints' angles (K, J) and the actuator's lengths (K,) at K stations."""
        model = copy(self.model)
        model.opt.gravity[:] = 0.0
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        shortest = _STATIONS * (_TRAVEL + _REST) / _MAX_STEPS
        model.opt.timestep = min(max(float(model.opt.timestep), shortest), _LONGEST_STEP)
        model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
        model.dof_frictionloss[:] = model.tendon_frictionloss[:] = model.tendon_damping[:] = 0.0
        hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
        for other in self.movable:
            dof = int(model.jnt_dofadr[other])
            heavier = _ROTOR if int(model.jnt_type[other]) == hinge else _SLIDER
            model.dof_armature[dof], model.dof_damping[dof] = heavier, heavier / _SETTLING
        free = np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)).tolist()
        frozen = [*self.frozen, *([joint] if joint >= 0 else []), *free]
        for other in frozen:
            first = int(model.jnt_dofadr[other])
            model.dof_armature[first : first + (6 if other in free else 1)] = _FROZEN
        data = mujoco.MjData(model)
        mujoco.mj_setConst(model, data)
        mujoco.mj_forward(model, data)
        data.ctrl[:] = _idle(model, data)
        travel, rest = (round(seconds / model.opt.timestep) for seconds in (_TRAVEL, _REST))
        if joint >= 0:
            column = self.movable.index(joint)
            low, high = self.low[column], self.high[column]
            address = int(model.jnt_qposadr[joint])
            dof = int(model.jnt_dofadr[joint])
        else:
            limited = model.actuator_ctrllimited[actuator]
            low, high = model.actuator_ctrlrange[actuator] if limited else (-1.0, 1.0)
            address = dof = -1
        model.jnt_limited[frozen] = False
        # limits of coupled joints narrow the motor's range, but do not change the line
        if joint >= 0:
            model.jnt_limited[list(self.paired)] = False
        stations = np.linspace(low, high, _STATIONS).tolist()
        for _ in range(travel + rest):  # the initial posture may violate constraints
            mujoco.mj_step(model, data)
        before = float(data.qpos[address] if joint >= 0 else data.ctrl[actuator])
        angles = np.empty((_STATIONS, len(self.movable)))
        lengths = np.empty(_STATIONS)
        for row, target in enumerate(stations):
            for step in range(travel + rest):
                position = before + min(1.0, (step + 1) / travel) * (target - before)
                if joint >= 0:
                    data.qpos[address] = position
                    data.qvel[dof] = 0.0 if step >= travel else (target - before) / _TRAVEL
                else:
                    data.ctrl[actuator] = position
                mujoco.mj_step(model, data)
            if joint >= 0:
                data.qpos[address] = target
            before = target
            mujoco.mj_forward(model, data)
            angles[row] = data.qpos[self.addresses]
            lengths[row] = data.actuator_length[actuator] if actuator >= 0 else 0.0
        return (angles, lengths) if np.isfinite(angles).all() else None


def _idle(model: Any, data: Any) -> Array:
    """Return controls at which the actuators make no force: position servos keep their position."""
    gain = model.actuator_gainprm[:, 0]
    bias = model.actuator_biasprm
    force = bias[:, 0] + bias[:, 1] * data.actuator_length
    return np.where(gain != 0.0, -force / np.where(gain != 0.0, gain, 1.0), 0.0)
