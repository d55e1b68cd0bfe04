"""The kinematics of a hand: its arrays, the compiled kernels over them, and the inverse kinematics."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from grasp_env._check import as_array
from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand import HandDescription
from grasp_env.sim.hand_frames import rotation_matrix
from grasp_env.sim.kinematics_kernels import (
    Tree,
    add_force_torques,
    hand_tips,
    trace_hand,
    write_gravity_torques,
    write_jacobian,
    write_tip_centers,
)
from grasp_env.sim.kinematics_solve import REACHED, solve_hand

__all__ = [
    "HandKinematics",
    "Tree",
    "add_force_torques",
    "trace_hand",
    "write_gravity_torques",
    "write_jacobian",
    "write_tip_centers",
]

_OTHER_STARTS = 11


class HandKinematics:
    """The geometry and masses of a hand as arrays, with what follows from them.

    Attributes:
        hand: The description.
        tree: Its arrays for the kernels, to be read only; M joints, N fingertips.
        home: Rest posture [rad], (M,).
        carries: Whether a joint moves a fingertip, (N, M) bool.
        reach: Most that a tip can be away from the origin of its finger's first joint [m], (N,).

    Example:
        >>> kinematics = HandKinematics(HandDescription.four_finger())
        >>> tips = kinematics.tips(kinematics.home)
        >>> bool(np.abs(kinematics.solve(tips) - kinematics.home).max() < 1e-12)
        True
    """

    def __init__(self, hand: HandDescription) -> None:
        self.hand = hand
        numbers = {link.name: index for index, link in enumerate(hand.links)}
        self.tree = Tree(
            parents=np.array([numbers.get(link.parent, -1) for link in hand.links], dtype=np.int64),
            offsets=np.array([link.origin for link in hand.links]),
            rotations=np.array([rotation_matrix(link.rotation) for link in hand.links]),
            axes=np.array([link.axis for link in hand.links]),
            masses=np.array([link.mass for link in hand.links]),
            centers=np.array([link.center for link in hand.links]),
            tip_links=np.array([numbers[tip.link] for tip in hand.fingertips], dtype=np.int64),
            tip_centers=np.array([tip.center for tip in hand.fingertips]),
            tip_radii=np.array([tip.radius for tip in hand.fingertips]),
            lower=np.array([link.lower for link in hand.links]),
            upper=np.array([link.upper for link in hand.links]),
            torque_limits=hand.torque_limits,
        )
        self.home = np.array(hand.home)
        self.carries = np.zeros((hand.finger_count, hand.joint_count), dtype=bool)
        self.reach, self._roots = np.zeros(hand.finger_count), np.zeros((hand.finger_count, 3))
        for finger in range(hand.finger_count):
            self._follow(finger)
        self._groups = _groups(self.carries)
        self._starts = _other_starts(self.tree)

    def tips(self, angles: ArrayLike) -> np.ndarray:
        """Centres of the fingertips [m], (N, 3), world frame, for joint angles (M,) [rad]."""
        return hand_tips(self.tree, as_array(angles, (self.hand.joint_count,), "angles"))

    def solve(self, tips: ArrayLike, start: ArrayLike | None = None) -> np.ndarray:
        """Joint angles within the limits that bring the tips to the given centres.

        The search starts at `start`, else at the rest posture, and tries a few fixed other postures for fingers that
        do not arrive. Fingers with more joints than they need stay near the start.

        Args:
            tips: Centres of the tips [m], (N, 3), world frame.
            start: Angles to start from [rad], (M,).

        Returns:
            Angles [rad], (M,), that miss no tip by more than 1e-9 m. Joints that move no fingertip stay.

        Raises:
            InvalidInputError: A finger cannot reach its tip; the message says by how much, or which limit is hit.
        """
        targets = as_array(tips, (self.hand.finger_count, 3), "tips")
        first = self.home if start is None else as_array(start, self.home.shape, "start")
        angles, missed = self._search(self.tree, targets, first)
        if not (missed <= REACHED).all():
            raise InvalidInputError(self._explain(targets, first, angles))
        return angles

    def reachable(self, tips: ArrayLike, start: ArrayLike | None = None) -> bool:
        """Whether `solve` would find angles."""
        targets = as_array(tips, (self.hand.finger_count, 3), "tips")
        if (np.square(targets - self._roots).sum(axis=1) > self.reach**2).any():
            return False
        first = self.home if start is None else as_array(start, self.home.shape, "start")
        return bool((self._search(self.tree, targets, first)[1] <= REACHED).all())

    def _follow(self, finger: int) -> None:
        """Note which joints carry a finger, where the first one is and how far the tip can be from it."""
        tree = self.tree
        link = int(tree.tip_links[finger])
        self.reach[finger] = np.linalg.norm(tree.tip_centers[finger])
        while True:
            self.carries[finger, link] = True
            if tree.parents[link] < 0:
                self._roots[finger] = tree.offsets[link]
                return
            self.reach[finger] += np.linalg.norm(tree.offsets[link])
            link = int(tree.parents[link])

    def _group(self, finger: int) -> tuple[np.ndarray, np.ndarray]:
        """The fingers that share joints with one, directly or through others, and all their joints, (M,) bool."""
        finger_order, finger_ends, joint_order, joint_ends = self._groups
        group = int(np.searchsorted(finger_ends, np.flatnonzero(finger_order == finger)[0], side="right"))
        joints = np.zeros(len(self.home), dtype=bool)
        joints[np.split(joint_order, joint_ends)[group]] = True
        return np.split(finger_order, finger_ends)[group], joints

    def _search(self, tree: Tree, targets: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angles (M,), and what the worst tip of each group misses [m]."""
        starts = np.vstack([np.clip(first, tree.lower, tree.upper), self._starts])
        angles, missed = np.empty(len(first)), np.empty(len(self._groups[1]))
        solve_hand(tree, targets, *self._groups, starts, angles, missed)
        return angles, missed

    def _explain(self, targets: np.ndarray, first: np.ndarray, angles: np.ndarray) -> str:
        """What keeps the fingers from their targets."""
        away = np.linalg.norm(self.tips(angles) - targets, axis=1)
        finger = int(np.argmax(away))
        name, target = self.hand.finger_names[finger], np.round(targets[finger], 4).tolist()
        distance = float(np.linalg.norm(targets[finger] - self._roots[finger]))
        if distance > self.reach[finger]:
            return (
                f"finger {name!r} cannot reach tip={target}: it is {distance:.4f} m from its first joint, allowed are "
                f"up to {self.reach[finger]:.4f} m; move the contact or the finger's base"
            )
        endless = np.full(len(angles), math.inf)
        free, _ = self._search(self.tree._replace(lower=-endless, upper=endless), targets, first)
        members, joints = self._group(finger)
        together = " together with the fingers that share its joints" if len(members) > 1 else ""
        if np.linalg.norm(self.tips(free) - targets, axis=1)[members].max() <= REACHED:
            turned = free + np.round((angles - free) / (2 * math.pi)) * 2 * math.pi
            beyond = [
                f"{link.joint} = {turned[joint]:.3f} rad, allowed are {link.lower:.3f} to {link.upper:.3f}"
                for joint, link in enumerate(self.hand.links)
                if joints[joint] and not link.lower <= turned[joint] <= link.upper
            ]
            if not beyond:
                return (
                    f"the search came within {away[finger]:.1e} m of tip={target} of finger {name!r} and no nearer, "
                    "though it can be reached: pass a start nearer to the posture, or move the contact a little"
                )
            return (
                f"finger {name!r} reaches tip={target}{together} only beyond its joint limits: {'; '.join(beyond)}; "
                f"within them it misses by {away[finger]:.4f} m. Move the contact, the finger's base or the limits"
            )
        return (
            f"finger {name!r} cannot reach tip={target}{together}: the nearest its tip comes is {away[finger]:.4f} m "
            f"away, at {distance:.4f} m from its first joint; move the contact or the finger's base"
        )


def _groups(carries: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Fingers that share joints: finger order, ends of groups in it, joint order, ends of groups in it."""
    finger_order: list[int] = []
    joint_order: list[int] = []
    finger_ends, joint_ends = [], []
    rest = list(range(len(carries)))
    while rest:
        joints, size = carries[rest[0]], 0
        while joints.sum() > size:
            size = joints.sum()
            joints = carries[(carries & joints).any(axis=1)].any(axis=0)
        members = [finger for finger in rest if (carries[finger] & joints).any()]
        rest = [finger for finger in rest if finger not in members]
        finger_order += members
        joint_order += np.flatnonzero(joints).tolist()
        finger_ends.append(len(finger_order))
        joint_ends.append(len(joint_order))
    order, ends, joints, stops = (
        np.array(row, dtype=np.int64) for row in (finger_order, finger_ends, joint_order, joint_ends)
    )
    return order, ends, joints, stops


def _other_starts(tree: Tree) -> np.ndarray:
    """The middle of the joints' ranges, then points spread over them, (S, M)."""
    lower, upper = np.maximum(tree.lower, -math.pi), np.minimum(tree.upper, math.pi)
    starts: list[np.ndarray] = [0.5 * (lower + upper)]
    for index in range(1, _OTHER_STARTS):
        # golden-ratio steps: spread for any number of joints, and the same in every process
        fractions = (index * (np.arange(len(lower)) + 1) * 0.6180339887498949) % 1.0
        starts.append(lower + fractions * (upper - lower))
    return np.array(starts)
