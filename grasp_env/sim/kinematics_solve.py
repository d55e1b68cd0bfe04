"""Inverse kinematics, compiled: damped least squares within the joint limits.

Fingers that share a joint form a group and are solved together; for most hands every finger is a group. With J the
Jacobian of a group's tips, e what they still miss and f the joints that may move, a step is

    J_f^T (J_f J_f^T + d I)^-1 e,

of all steps that do as much the shortest, so fingers with more joints than they need stay near where they start. The
damping d shrinks with |e|^2, so the last steps are Newton's. A joint that would pass its limit stops there and the
rest make up for it.
"""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled
from grasp_env.sim.kinematics_kernels import trace_hand, write_jacobian, write_tip_centers

REACHED = 1e-9
"""[m] that a tip may miss its target by."""

_EXACT = 1e-14  # [m]; rounding of positions of 0.1 m
_MOST_STEPS = 80
_LARGEST_STEP = 0.6  # [rad] that a joint turns in one step, so that it does not leap past the near solution
_SLOW = 0.98  # a step that leaves more of |e|^2 than this is slow
_MOST_SLOW = 3  # in a row: a dead end
_MOST_REFUSED = 8  # steps in a row that do not come nearer: a dead end


@compiled
def _solve_symmetric(matrix, vector, size):
    """Solve in place by Cholesky; the matrix is positive definite and is overwritten."""
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = math.sqrt(max(total, 1e-30)) if i == j else total / matrix[j, j]
    for i in range(size):
        for k in range(i):
            vector[i] -= matrix[i, k] * vector[k]
        vector[i] /= matrix[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            vector[i] -= matrix[k, i] * vector[k]
        vector[i] /= matrix[i, i]


@compiled
def _write_step(jacobian, error, angles, lower, upper, damping, free, matrix, rest, vector, step):
    """Write the damped step (m,) of the free joints, and return its largest turn; joints stop at their limits."""
    rows, joints = jacobian.shape
    for i in range(rows):
        rest[i] = error[i]
    for j in range(joints):
        step[j], pull = 0.0, 0.0
        for i in range(rows):
            pull += jacobian[i, j] * error[i]
        free[j] = not ((angles[j] <= lower[j] and pull < 0.0) or (angles[j] >= upper[j] and pull > 0.0))
    for _ in range(joints + 1):
        trace = 0.0
        for i in range(rows):
            vector[i] = rest[i]
            for k in range(i + 1):
                matrix[i, k] = 0.0
                for j in range(joints):
                    if free[j]:
                        matrix[i, k] += jacobian[i, j] * jacobian[k, j]
            trace += matrix[i, i]
        for i in range(rows):
            matrix[i, i] += damping + 1e-12 * trace + 1e-18
        _solve_symmetric(matrix, vector, rows)
        stopped = False
        for j in range(joints):
            if free[j]:
                step[j] = 0.0
                for i in range(rows):
                    step[j] += jacobian[i, j] * vector[i]
                low, high = lower[j] - angles[j], upper[j] - angles[j]
                if step[j] < low or step[j] > high:
                    step[j] = min(max(step[j], low), high)
                    free[j], stopped = False, True
                    for i in range(rows):
                        rest[i] -= jacobian[i, j] * step[j]
        if not stopped:
            break
    largest = 0.0
    for j in range(joints):
        largest = max(largest, abs(step[j]))
    return largest


@compiled
def _reach(tree, targets, fingers, joints, angles):
    """Move the joints of a group until its tips are at their targets; returns what the worst misses [m]."""
    count, rows = len(angles), 3 * len(fingers)
    frames, origins, axes = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 3))
    tips, full, trial = np.empty((len(targets), 3)), np.empty((3, count)), np.empty(count)
    jacobian, matrix = np.empty((rows, len(joints))), np.empty((rows, rows))
    error, rest, vector = np.empty(rows), np.empty(rows), np.empty(rows)
    own, lower, upper = np.empty(len(joints)), np.empty(len(joints)), np.empty(len(joints))
    step, free = np.empty(len(joints)), np.empty(len(joints), np.bool_)
    for j in range(count):
        trial[j] = angles[j]
    for j in range(len(joints)):
        lower[j], upper[j] = tree.lower[joints[j]], tree.upper[joints[j]]
    missed, best, factor, slow, refused = math.inf, math.inf, 0.5, 0, 0
    for _ in range(_MOST_STEPS):
        trace_hand(tree, trial, frames, origins, axes)
        write_tip_centers(tree, frames, origins, tips)
        total, worst = 0.0, 0.0
        for i in range(len(fingers)):
            squared = 0.0
            for k in range(3):
                rest[3 * i + k] = targets[fingers[i], k] - tips[fingers[i], k]
                squared += rest[3 * i + k] ** 2
            total, worst = total + squared, max(worst, squared)
        if total < best:
            slow = slow + 1 if total > _SLOW * best else 0
            missed, best, factor, refused = math.sqrt(worst), total, 0.2 * factor, 0
            for j in range(len(joints)):
                angles[joints[j]] = own[j] = trial[joints[j]]
            if missed <= _EXACT or slow == _MOST_SLOW:
                break
            for i in range(len(fingers)):
                write_jacobian(tree, tree.tip_links[fingers[i]], origins, axes, tips[fingers[i]], full)
                for k in range(3):
                    error[3 * i + k] = rest[3 * i + k]
                    for j in range(len(joints)):
                        jacobian[3 * i + k, j] = full[k, joints[j]]
        else:
            factor, refused = 8.0 * max(factor, 1e-3), refused + 1
            if refused == _MOST_REFUSED or missed <= REACHED:
                break
        largest = _write_step(jacobian, error, own, lower, upper, factor * best, free, matrix, rest, vector, step)
        scale = _LARGEST_STEP / largest if largest > _LARGEST_STEP else 1.0
        for j in range(len(joints)):
            trial[joints[j]] = min(max(own[j] + scale * step[j], lower[j]), upper[j])
    return missed


@compiled
def solve_hand(tree, targets, finger_order, finger_ends, joint_order, joint_ends, starts, angles, missed):
    """Write the angles (M,) of all groups and what each group's worst tip misses [m].

    Args:
        tree: The hand.
        targets: Centres of the tips [m], (N, 3), world frame.
        finger_order: Fingers group by group, (N,) int64.
        finger_ends: Where each group ends in it, (G,) int64.
        joint_order: Joints that move fingers, group by group, int64.
        joint_ends: Where each group ends in it, (G,) int64.
        starts: Angles to start from, tried in this order [rad], (S, M).
        angles: Output [rad], (M,); joints that move no finger as in the first start.
        missed: Output [m], (G,).
    """
    count = len(angles)
    trial = np.empty(count)
    for j in range(count):
        angles[j] = starts[0, j]
    finger, joint = 0, 0
    for group in range(len(missed)):
        fingers = finger_order[finger : finger_ends[group]]
        joints = joint_order[joint : joint_ends[group]]
        finger, joint = finger_ends[group], joint_ends[group]
        missed[group] = math.inf
        for start in range(len(starts)):
            for j in range(count):
                trial[j] = starts[start, j]
            distance = _reach(tree, targets, fingers, joints, trial)
            if distance < missed[group]:
                missed[group] = distance
                for j in range(len(joints)):
                    angles[joints[j]] = trial[joints[j]]
            if distance <= REACHED:
                break
