"""Order of a hand's joints, and joints that hold still or are turned round."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from grasp_env.sim.hand.files.elements import FileJoint, names_of
from grasp_env.sim.hand.files.part import Part
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.tree import Mimic


def arrange(part: Part, joints: Sequence[FileJoint]) -> tuple[list[FileJoint], list[str]]:
    """Return the joints of a hand, parents before children, and sentences on what was changed.

    Chains of coupled joints are resolved to the joint with the motor. Joints that mimic a joint
    outside the part are fixed, and so are joints with equal limits.
    """
    joints = [_reversed(joint) if joint.name in part.reversed_joints else joint for joint in joints]
    by_name = {joint.name: joint for joint in joints}
    arranged = list[FileJoint]()
    alone = list[str]()
    stuck = list[str]()
    for joint in joints:
        mimic = joint.mimic
        while mimic and mimic.joint in by_name and (before := by_name[mimic.joint].mimic):
            mimic = Mimic(before.joint, mimic.ratio * before.ratio, mimic.angle(before.offset))
        if mimic is not None and mimic.joint not in by_name:
            alone.append(joint.name)
            arranged.append(_frozen(joint, mimic.offset))
        elif not joint.fixed and joint.lower == joint.upper:
            stuck.append(joint.name)
            arranged.append(_frozen(joint, joint.lower))
        elif mimic is not None and (driver := by_name[mimic.joint]).lower == driver.upper:
            stuck.append(joint.name)
            arranged.append(_frozen(joint, mimic.angle(driver.lower)))
        else:
            arranged.append(replace(joint, mimic=mimic))
    notes = list[str]()
    if alone:
        notes.append(f"joints that mimic others that are left out hold still: {names_of(alone)}")
    if stuck:
        notes.append(
            f"joints with equal limits, lower = upper, or a mimic multiplier of 0 hold still: {names_of(stuck)}; give the true ranges as joint_limits="
        )
    return _ordered(part.root, arranged), notes


def _ordered(root: str, joints: list[FileJoint]) -> list[FileJoint]:
    """Sort the joints of a tree: parents before children, otherwise in file order."""
    ordered = list[FileJoint]()
    known = {root}
    rest = list(joints)
    while rest:
        joint = next(joint for joint in rest if joint.parent in known)
        rest.remove(joint)
        ordered.append(joint)
        known.add(joint.child)
    return ordered


def _reversed(joint: FileJoint) -> FileJoint:
    """Return a fixed joint with parent and child exchanged."""
    origin, rotation = Frame.of(joint.origin, joint.rotation).inverse().numbers()
    return replace(joint, parent=joint.child, child=joint.parent, origin=origin, rotation=rotation)


def _frozen(joint: FileJoint, angle: float) -> FileJoint:
    """Return a joint fixed at an angle [rad], a sliding one at a length [m]."""
    moved = Frame.of_joint(np.array(joint.axis), angle, joint.sliding)
    origin, rotation = (Frame.of(joint.origin, joint.rotation) @ moved).numbers()
    return FileJoint(joint.name, joint.parent, joint.child, True, origin, rotation)
