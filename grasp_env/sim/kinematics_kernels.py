"""Positions, Jacobians and gravity torques of a tree of links, compiled.

PyBullet offers the same, one link and one call at a time (about 17 us each); these kernels take about a microsecond
for a hand. The tests compare the two.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from grasp_env._compile import compiled


class Tree(NamedTuple):
    """A hand as arrays for the kernels: M links with the joints that move them, N fingertips.

    Attributes:
        parents: Number of the link that carries each link, -1 for the palm, (M,) int64; always a smaller number.
        offsets: Joint origins in their parents' frames [m], (M, 3).
        rotations: Link frame at angle 0 to parent's frame, (M, 3, 3).
        axes: Of the joints, unit, link frames, (M, 3).
        masses: [kg], (M,).
        centers: Centres of mass in link frames [m], (M, 3).
        tip_links: The link of each fingertip, (N,) int64.
        tip_centers: [m], link frames, (N, 3).
        tip_radii: [m], (N,).
        lower: Joint limits [rad], (M,); -inf where there is none.
        upper: [rad], (M,); inf where there is none.
        torque_limits: [N m], (M,).
    """

    parents: np.ndarray
    offsets: np.ndarray
    rotations: np.ndarray
    axes: np.ndarray
    masses: np.ndarray
    centers: np.ndarray
    tip_links: np.ndarray
    tip_centers: np.ndarray
    tip_radii: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    torque_limits: np.ndarray


@compiled
def trace_hand(tree, angles, frames, origins, axes):
    """Write where every link is, in the world frame.

    Args:
        tree: The hand, a `Tree`.
        angles: Of the joints [rad], (M,).
        frames: Output, link frame to world frame, (M, 3, 3).
        origins: Output, of the link frames, which lie on their joints' axes [m], (M, 3).
        axes: Output, of the joints, unit, (M, 3).
    """
    for j in range(len(angles)):
        parent = tree.parents[j]
        frame, rotation, axis = frames[j], tree.rotations[j], tree.axes[j]
        x, y, z = axis[0], axis[1], axis[2]
        sine, cosine = math.sin(angles[j]), math.cos(angles[j])
        rest = 1.0 - cosine
        for k in range(3):
            a, b, c = rotation[k, 0], rotation[k, 1], rotation[k, 2]
            position = tree.offsets[j, k]
            if parent >= 0:
                carrier = frames[parent]
                p, q, r = carrier[k, 0], carrier[k, 1], carrier[k, 2]
                a = p * rotation[0, 0] + q * rotation[1, 0] + r * rotation[2, 0]
                b = p * rotation[0, 1] + q * rotation[1, 1] + r * rotation[2, 1]
                c = p * rotation[0, 2] + q * rotation[1, 2] + r * rotation[2, 2]
                offset = tree.offsets[j]
                position = origins[parent, k] + p * offset[0] + q * offset[1] + r * offset[2]
            along = a * x + b * y + c * z
            # Rodrigues' formula for a row of the rest frame
            frame[k, 0] = a * cosine + (b * z - c * y) * sine + rest * along * x
            frame[k, 1] = b * cosine + (c * x - a * z) * sine + rest * along * y
            frame[k, 2] = c * cosine + (a * y - b * x) * sine + rest * along * z
            axes[j, k], origins[j, k] = along, position


@compiled
def write_tip_centers(tree, frames, origins, tips):
    """Write the centres of the fingertips [m], (N, 3), world frame."""
    for i in range(len(tips)):
        link, center = tree.tip_links[i], tree.tip_centers[i]
        for k in range(3):
            tips[i, k] = origins[link, k]
            for m in range(3):
                tips[i, k] += frames[link, k, m] * center[m]


@compiled
def write_jacobian(tree, link, origins, axes, point, jacobian):
    """Write the velocity of a point of a link per joint speed, (3, M), world frame.

    Args:
        tree: The hand.
        link: Number of the link that carries the point.
        origins: Of the joints [m], (M, 3), as `trace_hand` writes them.
        axes: Of the joints, (M, 3), likewise.
        point: [m], (3,), world frame.
        jacobian: Output; columns of joints that do not carry the link are 0.
    """
    jacobian[:] = 0.0
    while link >= 0:
        axis, origin = axes[link], origins[link]
        x, y, z = point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]
        jacobian[0, link] = axis[1] * z - axis[2] * y
        jacobian[1, link] = axis[2] * x - axis[0] * z
        jacobian[2, link] = axis[0] * y - axis[1] * x
        link = tree.parents[link]


@compiled
def add_force_torques(tree, link, origins, axes, point, force, torques):
    """Add the joint torques (M,) with which a link pushes at `point` with `force`: J^T f.

    Args:
        tree: The hand.
        link: Number of the link that pushes.
        origins: Of the joints [m], (M, 3), as `trace_hand` writes them.
        axes: Of the joints, (M, 3), likewise.
        point: [m], (3,), world frame.
        force: [N], (3,), world frame.
        torques: Changed [N m], (M,).
    """
    while link >= 0:
        axis, origin = axes[link], origins[link]
        x, y, z = point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]
        torques[link] += (
            force[0] * (axis[1] * z - axis[2] * y)
            + force[1] * (axis[2] * x - axis[0] * z)
            + force[2] * (axis[0] * y - axis[1] * x)
        )
        link = tree.parents[link]


@compiled
def write_gravity_torques(tree, frames, origins, axes, gravity, torques):
    """Write the torques that carry the weight of all links [N m], (M,); gravity (3,) [m/s^2], world frame."""
    point, lift = np.empty(3), np.empty(3)
    torques[:] = 0.0
    for j in range(len(torques)):
        for k in range(3):
            point[k] = origins[j, k]
            lift[k] = -tree.masses[j] * gravity[k]
            for m in range(3):
                point[k] += frames[j, k, m] * tree.centers[j, m]
        add_force_torques(tree, j, origins, axes, point, lift, torques)


@compiled
def hand_tips(tree, angles):
    """Centres of the fingertips [m], (N, 3), world frame."""
    count = len(angles)
    frames, origins, axes = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 3))
    tips = np.empty((len(tree.tip_links), 3))
    trace_hand(tree, angles, frames, origins, axes)
    write_tip_centers(tree, frames, origins, tips)
    return tips
