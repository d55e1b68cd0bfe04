"""Kinematics and statics of a hand: poses, Jacobians, gravity torques, inverse kinematics."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from grasp_env import core
from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import Array, Indices, as_array, instance, whole
from grasp_env.inputs.files import as_path, file_fault, replacing
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.frames import quaternion_rotation, rotation_matrix
from grasp_env.sim.hand.tree import Mimic
from grasp_env.sim.objects.description import ObjectDescription

_OTHER_STARTS = 11
_LIMIT = 1e-6  # [rad], largest excess of an angle over a limit
# singular values of a Jacobian up to this, relative to the largest, count as 0
_SMALLEST_LEVER = 0.01
_UNIT_TOLERANCE = 0.01  # that of the core for normals and quaternions


class HandKinematics:
    """The kinematics of a hand with M joints and N fingertips, computed by the core.

    Attributes:
        hand: The description.
        tree: Its links and fingertips in the core.
        home: Rest posture [rad], (M,).
        lower, upper: Joint limits [rad], (M,), -inf and inf without limits, so narrow that coupled
            joints stay within theirs.
        torque_limits: Torque limits [N m], (M,).
        drivers: The index of each joint's driver, (M,); a joint that is not coupled drives itself.
        motors: Indices of the joints with a motor, ascending.
        tip_links: The index of each fingertip's link, (N,).
        tip_radii: Radii of the fingertips [m], (N,).
        carries: True where a joint's motor moves a fingertip, (N, M).
        reach: Largest distance of a tip from the first joint of its finger [m], (N,).
        roots: Origins of the first joints of the fingers [m], (N, 3), world frame.

    Example:
        >>> kinematics = HandKinematics(HandDescription.four_finger())
        >>> tips = kinematics.tips(kinematics.home)
        >>> bool(np.abs(kinematics.solve(tips) - kinematics.home).max() < 1e-12)
        True
    """

    def __init__(self, hand: HandDescription) -> None:
        self.hand = hand
        numbers = {link.name: index for index, link in enumerate(hand.links)}
        parents = [numbers.get(link.parent, -1) for link in hand.links]
        self.drivers: Indices = np.array(hand.drivers, dtype=np.int64)
        self.motors: Indices = np.flatnonzero(self.drivers == np.arange(hand.joint_count))
        self.lower, self.upper = _ranges(hand)
        links = list[core.Link]()
        for index, link in enumerate(hand.links):
            driver, mimic = -1, Mimic("none")
            if link.mimic is not None:
                driver, mimic = hand.drivers[index], link.mimic
            links.append(
                core.Link(
                    parent=parents[index],
                    offset=link.origin,
                    rotation=rotation_matrix(link.rotation).ravel().tolist(),
                    axis=link.axis,
                    mass=link.mass,
                    center=link.center,
                    lower=self.lower[index],
                    upper=self.upper[index],
                    torque_limit=link.torque_limit,
                    sliding=link.sliding,
                    driver=driver,
                    ratio=mimic.ratio,
                    shift=mimic.offset,
                    inertia=link.inertia,
                )
            )
        tips = [
            core.Tip(link=numbers[tip.link], center=tip.center, radius=tip.radius)
            for tip in hand.fingertips
        ]
        self.tree = core.Tree.make(links, tips)
        self.home = np.array(hand.home)
        self.torque_limits = hand.torque_limits
        tip_links = [numbers[tip.link] for tip in hand.fingertips]
        self.tip_links: Indices = np.array(tip_links, dtype=np.int64)
        self.tip_radii = np.array([tip.radius for tip in hand.fingertips])
        self.carries = np.zeros((hand.finger_count, hand.joint_count), dtype=bool)
        self.reach, self.roots = np.zeros(hand.finger_count), np.zeros((hand.finger_count, 3))
        for finger, tip in enumerate(hand.fingertips):
            chain = [numbers[tip.link]]
            while parents[chain[-1]] >= 0:
                chain.append(parents[chain[-1]])
            self.carries[finger, self.drivers[chain]] = True
            arms = [tip.center, *(hand.links[link].origin for link in chain[:-1])]
            slides = [
                max(-self.lower[link], self.upper[link])
                for link in chain
                if hand.links[link].sliding
            ]
            self.reach[finger] = sum([*(float(np.linalg.norm(arm)) for arm in arms), *slides])
            self.roots[finger] = hand.links[chain[-1]].origin
        self._within = core.Reach.make(self.tree)
        self._beyond = core.Reach.make(self.tree, limited=False)
        self._starts = _other_starts(self.lower, self.upper)

    def __repr__(self) -> str:
        return f"HandKinematics({self.hand.name}, {self.hand.joint_count} joints, {self.hand.finger_count} fingertips)"

    def links(self, angles: ArrayLike) -> tuple[Array, Array]:
        """Return the rotations (M, 3, 3) and origins (M, 3) [m] of the links, world frame.

        The origin of a link lies on the axis of its joint; `angles` are (M,) [rad].
        """
        count = self.hand.joint_count
        rotations = np.empty((count, 3, 3))
        origins = np.empty((count, 3))
        self.tree.trace(self._angles(angles), rotations, origins)
        return rotations, origins

    def tips(self, angles: ArrayLike) -> Array:
        """Return the centres of the fingertips (N, 3) [m], world frame, at `angles` (M,) [rad]."""
        centers = np.empty((self.hand.finger_count, 3))
        self.tree.tips(self._angles(angles), centers)
        return centers

    def contacts(
        self,
        angles: ArrayLike,
        item: ObjectDescription | None = None,
        pose: ArrayLike | None = None,
        *,
        normals: ArrayLike | None = None,
    ) -> tuple[Array, Array, Array]:
        """Return where the fingertips touch an object, from joint angles alone.

        Give the object, or a guess of the normals. A contact is the point of the spherical tip that
        lies farthest along its normal: the tip's centre + its radius * the normal. With an object
        the normal is that of the surface point nearest to the tip. All arrays are in the world
        frame, which is that of the hand's base.

        Args:
            angles: Joint angles [rad], (M,).
            item: The object.
            pose: Its position [m] and quaternion (x, y, z, w), (7,); None: at the origin.
            normals: Unit normals into the object, (N, 3), to 1 %; without `item`.

        Returns:
            The contact points (N, 3) [m], the unit normals into the object (N, 3), and the gaps
            (N,) [m] between the tips and the surface, negative if they overlap. Gaps are nan
            without an object.

        Raises:
            InvalidInputError: Both or neither of `item` and `normals`, a pose without an object, an
                array of a wrong shape, or a normal or a quaternion of another length than 1.

        Example:
            >>> kinematics = HandKinematics(HandDescription.allegro())
            >>> tips = kinematics.tips(kinematics.home)
            >>> ball = ObjectDescription("sphere", (0.06,))
            >>> pose = [*0.5 * (tips[1] + tips[3]), 0.0, 0.0, 0.0, 1.0]
            >>> points, normals, gaps = kinematics.contacts(kinematics.home, ball, pose)
            >>> guessed, _, _ = kinematics.contacts(kinematics.home, normals=normals)
            >>> bool(np.abs(guessed - points).max() < 1e-12), gaps.shape
            (True, (4,))
        """
        if (item is None) == (normals is None):
            raise InvalidInputError("give an item or normals, and not both")
        centers = self.tips(angles)
        if normals is not None:
            if pose is not None:
                raise InvalidInputError("a pose belongs to an item; normals are in the world frame")
            inwards = _unit_rows(as_array(normals, centers.shape, "normals"), "normals")
            gaps = np.full(len(centers), np.nan)
        else:
            surface = instance(item, ObjectDescription, "item").surface
            inwards, gaps = self._nearest(surface, pose, centers)
        return centers + self.tip_radii[:, None] * inwards, inwards, gaps

    def _nearest(
        self, surface: core.Surface, pose: ArrayLike | None, centers: Array
    ) -> tuple[Array, Array]:
        """Return the inward normals (N, 3) nearest to tips, and their gaps (N,) [m]."""
        position, rotation = np.zeros(3), np.eye(3)
        if pose is not None:
            row = as_array(pose, (7,), "pose")
            position = row[:3]
            rotation = quaternion_rotation(_unit_rows(row[None, 3:], "the quaternion of a pose")[0])
        found = [surface.nearest(center) for center in (centers - position) @ rotation]
        inwards = np.array([normal for _, normal, _ in found]) @ rotation.T
        return inwards, np.array([distance for _, _, distance in found]) - self.tip_radii

    def jacobian(self, angles: ArrayLike, finger: int, point: ArrayLike | None = None) -> Array:
        """Return the Jacobian J of a point on a finger's last link, (3, M) [m/rad], world frame.

        The joint torques J^T f exert the force f at the point.

        Args:
            angles: Joint angles [rad], (M,).
            finger: Index of the finger.
            point: The point [m], (3,), world frame; None: the centre of the fingertip.

        Raises:
            InvalidInputError: There is no such finger, or an array has a wrong shape.

        Example:
            >>> kinematics = HandKinematics(HandDescription.four_finger())
            >>> kinematics.jacobian(kinematics.home, finger=0).shape
            (3, 12)
        """
        whole(finger, "finger", 0, self.hand.finger_count - 1)
        place = self.tips(angles)[finger] if point is None else as_array(point, (3,), "point")
        return self.link_jacobian(angles, int(self.tip_links[finger]), place)

    def link_jacobian(self, angles: ArrayLike, link: int, point: ArrayLike) -> Array:
        """Return the Jacobian (3, M) of a `point` (3,) [m] on the link of index `link`.

        Both are in the world frame; joint `angles` are (M,) [rad].
        """
        whole(link, "link", 0, self.hand.joint_count - 1)
        out = np.empty((3, self.hand.joint_count))
        self.tree.jacobian(self._angles(angles), link, as_array(point, (3,), "point"), out)
        return out

    def gravity_torques(self, angles: ArrayLike, gravity: ArrayLike = (0.0, -9.81, 0.0)) -> Array:
        """Return the joint torques (M,) [N m] that carry the hand's weight.

        `angles` are (M,) [rad], and `gravity` is (3,) [m/s^2], world frame.
        """
        out = np.empty(self.hand.joint_count)
        self.tree.gravity_torques(self._angles(angles), as_array(gravity, (3,), "gravity"), out)
        return out

    def statics(
        self, angles: ArrayLike, positions: ArrayLike, gravity: ArrayLike = (0.0, -9.81, 0.0)
    ) -> tuple[Array, Array]:
        """Return the contact points' Jacobians and the torques that carry the hand's weight.

        Args:
            angles: Joint angles [rad], (M,).
            positions: The contact point of each fingertip [m], (N, 3), world frame.
            gravity: Gravity [m/s^2], (3,), world frame.

        Returns:
            The Jacobians (N, 3, M) [m/rad] of these points, as `ForceLimits` takes them, and the
            torques (M,) [N m] of `gravity_torques`.

        Example:
            >>> kinematics = HandKinematics(HandDescription.four_finger())
            >>> jacobian, weight = kinematics.statics(kinematics.home, kinematics.tips(kinematics.home))
            >>> jacobian.shape, weight.shape
            ((4, 3, 12), (12,))
        """
        count = self.hand.joint_count
        points = as_array(positions, (self.hand.finger_count, 3), "positions")
        jacobian = np.empty((len(points), 3, count))
        torques = np.empty(count)
        self.tree.statics(
            self._angles(angles), points, as_array(gravity, (3,), "gravity"), jacobian, torques
        )
        return jacobian, torques

    def export(self, path: str | Path) -> Path:
        """Write the hand without shapes to a file for `grasp::TreeFile::load` in C++.

        Args:
            path: Path of the file, which is written completely or not at all.

        Raises:
            InvalidInputError: The file cannot be written; the message gives the reason.

        Example:
            >>> import tempfile
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     HandKinematics(HandDescription.allegro()).export(f"{folder}/allegro.hand").stat().st_size
            4416
        """
        file = as_path(path, InvalidInputError, "a hand's file")
        try:
            with replacing(file) as temporary:
                temporary.write_bytes(self.tree.save())
        except OSError as error:
            raise InvalidInputError(f"cannot write hand file {file}: {file_fault(error)}") from None
        return file

    def mass_matrix(self, angles: ArrayLike) -> Array:
        """Return the mass matrix (M, M) [kg m^2] at `angles` (M,) [rad].

        Rows and columns of coupled joints are 0.
        """
        out = np.empty((self.hand.joint_count, self.hand.joint_count))
        self.tree.mass_matrix(self._angles(angles), out)
        return out

    def mobility(self, angles: ArrayLike) -> tuple[Array, Array]:
        """Return the mobility of tips and joints at `angles` (M,) [rad], for gains of springs.

        Returns:
            The largest acceleration of each tip per force on it, (N,) [1/kg]. An upper bound on the
            acceleration of each joint per torque, when all joints have springs, (M,)
            [1/(kg m^2)]; 0 for coupled joints.
        """
        tips, joints = self.tree.mobility(self._angles(angles))
        return np.array(tips), np.array(joints)

    def solve(self, tips: ArrayLike, start: ArrayLike | None = None) -> Array:
        """Find joint angles within the limits that bring the tips to the given centres.

        The search begins at `start`. Fingers that do not arrive are tried from a few other fixed
        postures. Redundant fingers stay near the start.

        Args:
            tips: Centres of the tips [m], (N, 3), world frame.
            start: Initial angles [rad], (M,); None: the rest posture.

        Returns:
            Angles [rad], (M,), at which every tip is within 1e-9 m of its target. Joints that move
            no fingertip keep their angle.

        Raises:
            InvalidInputError: A finger cannot reach its tip; the message gives the distance or the
                limit that is hit.
        """
        targets = as_array(tips, (self.hand.finger_count, 3), "tips")
        first = self.home if start is None else as_array(start, self.home.shape, "start")
        angles, missed = self._search(self._within, targets, first)
        if not (missed <= core.REACHED).all():
            raise InvalidInputError(self._explain(targets, first, angles))
        return angles

    def reachable(self, tips: ArrayLike, start: ArrayLike | None = None) -> bool:
        """Return True if `solve` finds angles for the same `tips` and `start`."""
        targets = as_array(tips, (self.hand.finger_count, 3), "tips")
        if (np.square(targets - self.roots).sum(axis=1) > self.reach**2).any():
            return False
        first = self.home if start is None else as_array(start, self.home.shape, "start")
        return bool((self._search(self._within, targets, first)[1] <= core.REACHED).all())

    def coupled(self, angles: ArrayLike) -> Array:
        """Return the angles (M,) with each coupled joint set by its driver."""
        out = self._angles(angles).copy()
        self.tree.couple(out)
        return out

    def _angles(self, angles: ArrayLike) -> Array:
        return as_array(angles, (self.hand.joint_count,), "angles")

    def _search(self, reach: core.Reach, targets: Array, first: Array) -> tuple[Array, Array]:
        """Return angles (M,) and the largest error of a tip [m] in each group of coupled fingers."""
        starts = np.vstack([np.clip(first, self.lower, self.upper), self._starts])
        angles = np.empty(len(first))
        missed = np.empty(len(reach.groups))
        reach.solve(np.ascontiguousarray(targets), starts, angles, missed)
        return angles, missed

    def _explain(self, targets: Array, first: Array, angles: Array) -> str:
        """Return the message that explains why the fingers miss their targets."""
        away = np.linalg.norm(self.tips(angles) - targets, axis=1)
        finger = int(np.argmax(away))
        name = self.hand.finger_names[finger]
        target = np.round(targets[finger], 4).tolist()
        distance = float(np.linalg.norm(targets[finger] - self.roots[finger]))
        if distance > self.reach[finger]:
            return (
                f"finger {name!r} cannot reach tip={target}: it is {distance:.4f} m from its first joint, allowed are "
                f"up to {self.reach[finger]:.4f} m; move the contact or the finger's base"
            )
        free, _ = self._search(self._beyond, targets, first)
        members, joints = next(group for group in self._within.groups if finger in group[0])
        together = " together with the fingers that share its joints" if len(members) > 1 else ""
        if np.linalg.norm(self.tips(free) - targets, axis=1)[members].max() <= core.REACHED:
            turned = free + np.round((angles - free) / (2 * math.pi)) * 2 * math.pi
            beyond = [
                f"{link.joint} = {turned[joint]:.3f} {link.units[0]}, allowed are {link.lower:.3f} to {link.upper:.3f}"
                for joint, link in enumerate(self.hand.links)
                if joint in joints
                and not link.lower - _LIMIT <= turned[joint] <= link.upper + _LIMIT
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


def _unit_rows(rows: Array, name: str) -> Array:
    """Return rows with length 1, or raise an error if a length is off by more than 1 %."""
    lengths = np.linalg.norm(rows, axis=1)
    if (np.abs(lengths - 1.0) > _UNIT_TOLERANCE).any():
        raise InvalidInputError(
            f"{name} must have length 1, to 1 %, got lengths {lengths.round(4).tolist()}"
        )
    return rows / lengths[:, None]


def motor_force_basis(jacobian: Array) -> Array:
    """Return an orthonormal basis (K, R) of the forces of motors with the Jacobian (K, J)."""
    directions, levers, _ = np.linalg.svd(jacobian, full_matrices=False)
    return directions[:, levers > _SMALLEST_LEVER * levers[0]]


def _ranges(hand: HandDescription) -> tuple[Array, Array]:
    """Return lower and upper joint limits (M,), narrowed so that coupled joints stay within theirs."""
    lower, upper = (
        np.array([getattr(link, side) for link in hand.links]) for side in ("lower", "upper")
    )
    for link, driver in zip(hand.links, hand.drivers, strict=True):
        if link.mimic is not None:
            low, high = sorted(
                (end - link.mimic.offset) / link.mimic.ratio for end in (link.lower, link.upper)
            )
            lower[driver], upper[driver] = max(lower[driver], low), min(upper[driver], high)
    for index, (link, driver) in enumerate(zip(hand.links, hand.drivers, strict=True)):
        if lower[driver] >= upper[driver]:
            raise InvalidInputError(
                f"hand {hand.name!r}: the limits of joint {hand.links[driver].joint!r} and of those coupled to it leave it no range"
            )
        if link.mimic is not None:
            ends = link.mimic.angle(lower[driver]), link.mimic.angle(upper[driver])
            lower[index], upper[index] = min(ends), max(ends)
    return lower, upper


def _other_starts(lower: Array, upper: Array) -> Array:
    """Return postures (S, M): the middle of the joint ranges, then points spread over them."""
    lower = np.maximum(lower, -math.pi)
    upper = np.minimum(upper, math.pi)
    starts: list[Array] = [0.5 * (lower + upper)]
    for index in range(1, _OTHER_STARTS):
        # golden-ratio steps: spread for any number of joints, and the same in every process
        fractions = (index * (np.arange(len(lower)) + 1) * 0.6180339887498949) % 1.0
        starts.append(lower + fractions * (upper - lower))
    return np.array(starts)
