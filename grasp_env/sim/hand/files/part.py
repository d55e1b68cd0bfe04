"""Find the hand in a file: the tree of its joints, the palm, and the arm or robot that carries it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from grasp_env._check import AllFaults
from grasp_env.errors import InvalidInputError, shown
from grasp_env.sim.hand.files.elements import FileJoint, names_of
from grasp_env.sim.hand.frames import Frame, axis_rotation
from grasp_env.sim.hand.tree import Mimic

Ends: TypeAlias = Sequence[tuple[str, str, str]]
"""Name, parent and child of each joint."""

LONGEST_FINGER = 6
"""Largest number of motors of an unbranched chain; fingers of public hands have up to 5, arms without a hand 6 and more."""
LONGEST_WRIST = 3
"""Largest number of motors of a chain that ends at a branching; forearms and wrists have up to 3, arms with a hand 4 and more."""


@dataclass(frozen=True)
class Part:
    """The part of a file that is the hand.

    Attributes:
        root: Name of the palm's link.
        links: Names of the palm, of links fixed to it, and of all their descendants.
        reversed_joints: Names of the fixed joints that carry the palm; they are read from child to parent.
        notes: Sentences on what is left out.
    """

    root: str
    links: tuple[str, ...]
    reversed_joints: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()


def find_part(root: str, ends: Ends, fixed: Collection[str], mimics: Mapping[str, str], palm: str | None) -> Part:
    """Find the part of a file that is the hand.

    Args:
        root: Name of the root link, see `find_root`.
        ends: Name, parent and child of each joint.
        fixed: Names of the fixed joints.
        mimics: The driver that each coupled joint names.
        palm: Name of the palm's link; None: `root`.

    Raises:
        InvalidInputError: There is no such palm, or it carries no moving joint; or no palm is named and the file is an arm or a
            whole robot.
    """
    robot = _Robot(root, ends, fixed, mimics)
    if palm is not None:
        return robot.part(palm)
    robot.refuse_arms()
    return Part(root, robot.links)


class _Robot:
    """The links of a file in rigid groups, each named by its topmost link."""

    def __init__(self, root: str, ends: Ends, fixed: Collection[str], mimics: Mapping[str, str]) -> None:
        self._root, self._ends, self._fixed = root, ends, fixed
        self._above = {child: (joint, parent) for joint, parent, child in ends}
        self._below: dict[str, list[tuple[str, str]]] = {}
        for joint, parent, child in ends:
            self._below.setdefault(parent, []).append((joint, child))
        self.links = tuple(self._down(root))
        self._group = {root: root}
        self._joints: dict[str, list[tuple[str, str]]] = {
            root: []
        }  # moving joints of each group, with their child links
        for link in self.links[1:]:
            joint, parent = self._above[link]
            self._group[link] = self._group[parent] if joint in fixed else link
            if joint not in fixed:
                self._joints[self._group[parent]].append((joint, link))
                self._joints[link] = []
        self._arms = self._chains(mimics)

    def _down(self, top: str) -> list[str]:
        """Return a link and all its descendants, parents first."""
        found = [top]
        for link in found:
            found += [child for _, child in self._below.get(link, [])]
        return found

    def _chains(self, mimics: Mapping[str, str]) -> dict[str, list[str]]:
        """Return the motors of each chain that is too long for a finger or a wrist, by the group at its end."""
        chains: dict[str, list[str]] = {self._root: []}
        arms: dict[str, list[str]] = {}
        for group, joints in self._joints.items():
            chain = chains[group]
            for joint, child in joints:
                start = chain if len(joints) == 1 else []
                chains[child] = [*start, joint] if joint not in mimics else start
            if len(joints) != 1 and len(chain) > (LONGEST_WRIST if joints else LONGEST_FINGER):
                arms[group] = chain
        return arms

    def _palms(self) -> list[str]:
        """Return candidates for the palm: links at which several chains branch, none of them an arm; if there are arms, links at their ends."""
        carriers = set[str]()  # groups that carry arms
        for group in self._arms:
            while group != self._root:
                group = self._group[self._above[group][1]]
                carriers.add(group)
        inside, palms = set[str](), dict[str, str]()
        for group, joints in self._joints.items():
            above = self._above.get(group)
            if above and self._group[above[1]] in inside:
                inside.add(group)
            elif len(joints) > 1 and group not in carriers:
                inside.add(group)
                parents = [self._above[child][1] for _, child in joints]
                palms[group] = max(parents, key=parents.count)
        return [palm for group, palm in palms.items() if group in self._arms] or list(palms.values())

    def refuse_arms(self) -> None:
        """Raise InvalidInputError if a chain of joints is too long for a finger or a wrist."""
        if not self._arms:
            return
        group, chain = max(self._arms.items(), key=lambda item: len(item[1]))
        where = " and leads to a branching" if self._joints[group] else ""
        palms = " or ".join(f"palm={name!r}" for name in self._palms())
        raise InvalidInputError(
            f"this is an arm or a whole robot: the chain of {names_of(chain)} has {len(chain)} motors{where}. "
            + (f"Name the hand's palm, {palms}" if palms else "No link carries several chains that may be fingers")
            + f"; palm={self._root!r} reads all of it as one hand"
        )

    def part(self, palm: str) -> Part:
        """Return the part of a named palm."""
        if palm not in self._group:
            raise InvalidInputError(
                f"palm: no link is called {shown(palm)}; joints branch at {names_of(self._palms())}; links are {names_of(self.links)}"
            )
        top, reversed_joints = palm, list[str]()
        while top in self._above and self._above[top][0] in self._fixed:
            joint, top = self._above[top]
            reversed_joints.append(joint)
        links = self._down(top)
        kept = set(links)
        moving = [joint for joint, _, child in self._ends if joint not in self._fixed]
        inside = {joint for joint, parent, _ in self._ends if parent in kept}
        if not inside.intersection(moving):
            carriers = dict.fromkeys(parent for joint, parent, _ in self._ends if joint not in self._fixed)
            raise InvalidInputError(
                f"the palm {palm!r} carries no joint that moves; links that do are {names_of(list(carriers))}"
            )
        arm, link = list[str](), top
        while link in self._above:
            joint, link = self._above[link]
            arm += [joint] if joint not in self._fixed else []
        limbs = [joint for joint in moving if joint not in inside and joint not in arm]
        notes = list[str]()
        if arm:
            notes.append(
                f"the joints that carry the palm {palm!r} hold still, their links are left out: {names_of(arm[::-1])}"
            )
        if limbs:
            notes.append(f"limbs that the palm {palm!r} does not carry are left out, with the joints {names_of(limbs)}")
        return Part(palm, tuple(links), frozenset(reversed_joints), tuple(notes))


def find_root(links: Sequence[str], ends: Ends) -> str:
    """Return the root link, which is the child of no joint.

    Raises:
        InvalidInputError: The links are not a tree; the message lists every fault.
    """
    children: dict[str, str] = {}
    faults = list[str]()
    for joint, *pair in ends:
        faults += [
            f"joint {joint!r} names the link {link!r}, which is not in the file; links are {names_of(links)}"
            for link in pair
            if link and link not in links
        ]
        child = pair[1]
        if child and child in children:
            faults.append(
                f"link {child!r} is the child of two joints, {children[child]!r} and {joint!r}; a hand must be a tree, cut the loop"
            )
        children[child] = joint
    roots = [link for link in dict.fromkeys(links) if link not in children]
    if not roots:
        faults.append("every link is carried by a joint, so the joints form a cycle; cut it")
    elif len(roots) > 1 and not faults:
        faults.append(
            f"{len(roots)} links are carried by no joint, {names_of(roots)}; one of them is the palm, "
            "fix the others to it with joints of type fixed"
        )
    known, grew = {*roots}, True
    while grew and not faults:
        reached = {child for _, parent, child in ends if parent in known} - known
        known, grew = known | reached, bool(reached)
    if not faults and (rest := [joint for joint, parent, _ in ends if parent not in known]):
        faults.append(f"the joints {names_of(rest)} form a cycle apart from {roots[0]!r}; cut it")
    with AllFaults() as check:
        check.add(*faults)
    return roots[0]


def check_mimics(ends: Ends, fixed: Collection[str], mimics: Mapping[str, str]) -> None:
    """Check that the driver of every coupled joint moves and that couplings form no loop.

    Raises:
        InvalidInputError: A coupling is impossible; the message lists all of these.
    """
    faults, known = list[str](), [name for name, _, _ in ends]
    for joint, other in mimics.items():
        if other not in known:
            faults.append(
                f"joint {joint!r} mimics {other!r}, which is not a joint of the file; joints are {names_of(known)}"
            )
        elif other in fixed:
            faults.append(
                f"joint {joint!r} mimics {other!r}, which does not move; make both of them fixed, or move {other!r}"
            )
        seen = [joint]
        while seen[-1] in mimics and mimics[seen[-1]] not in seen:
            seen.append(mimics[seen[-1]])
        if mimics.get(seen[-1]) == joint:
            faults.append(f"the joints {names_of(sorted(seen))} mimic each other in a loop; one of them needs a motor")
    with AllFaults() as check:
        check.add(*faults)


def arrange(part: Part, joints: Sequence[FileJoint]) -> tuple[list[FileJoint], list[str]]:
    """Return the joints of a hand, parents before children and otherwise in file order, and sentences on what was changed.

    Chains of coupled joints are resolved to the joint with the motor. Joints that mimic a joint outside the part are fixed, and so
    are joints with equal limits.
    """
    joints = [_reversed(joint) if joint.name in part.reversed_joints else joint for joint in joints]
    by_name = {joint.name: joint for joint in joints}
    driven, alone, stuck = list[FileJoint](), list[str](), list[str]()
    for joint in joints:
        mimic = joint.mimic
        while mimic is not None and mimic.joint in by_name and (before := by_name[mimic.joint].mimic) is not None:
            mimic = Mimic(before.joint, mimic.ratio * before.ratio, mimic.angle(before.offset))
        if mimic is not None and mimic.joint not in by_name:
            alone.append(joint.name)
            driven.append(_frozen(joint, mimic.offset))
        elif not joint.fixed and joint.lower == joint.upper:
            stuck.append(joint.name)
            driven.append(_frozen(joint, joint.lower))
        elif mimic is not None and (other := by_name[mimic.joint]).lower == other.upper:
            stuck.append(joint.name)
            driven.append(_frozen(joint, mimic.angle(other.lower)))
        else:
            driven.append(replace(joint, mimic=mimic))
    notes = list[str]()
    if alone:
        notes.append(f"joints that mimic others that are left out hold still: {names_of(alone)}")
    if stuck:
        notes.append(
            f"joints with equal limits, lower = upper, hold still: {names_of(stuck)}; give the true ranges as joint_limits="
        )
    return _ordered(part.root, driven), notes


def _ordered(root: str, joints: list[FileJoint]) -> list[FileJoint]:
    """Sort the joints of a tree: parents before children, otherwise in file order."""
    ordered, known, rest = list[FileJoint](), {root}, list(joints)
    while rest:
        ready = next(joint for joint in rest if joint.parent in known)
        rest.remove(ready)
        ordered.append(ready)
        known.add(ready.child)
    return ordered


def _reversed(joint: FileJoint) -> FileJoint:
    """Return a fixed joint with parent and child exchanged."""
    frame = Frame.of(joint.origin, joint.rotation)
    origin, rotation = Frame(frame.rotation.T, -frame.rotation.T @ frame.origin).numbers()
    return replace(joint, parent=joint.child, child=joint.parent, origin=origin, rotation=rotation)


def _frozen(joint: FileJoint, angle: float) -> FileJoint:
    """Return a joint fixed at an angle [rad], a sliding one at a length [m]."""
    axis = np.array(joint.axis)
    moved = Frame(np.eye(3), angle * axis) if joint.sliding else Frame(axis_rotation(axis, angle), np.zeros(3))
    origin, rotation = (Frame.of(joint.origin, joint.rotation) @ moved).numbers()
    return FileJoint(joint.name, joint.parent, joint.child, True, origin, rotation)
