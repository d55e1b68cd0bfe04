"""Find the hand in a file: the tree of its joints, the palm, and the arm or robot that carries it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs.arguments import AllFaults
from grasp_env.sim.hand.files.elements import Ends, FileJoint, FileLink, HandFile, names_of
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.tree import Mimic

LONGEST_FINGER = 6
"""Largest number of motors of an unbranched chain; fingers of public hands have up to 5, arms
without a hand 6 and more."""
LONGEST_WRIST = 3
"""Largest number of motors of a chain that ends at a branching; forearms and wrists have up to 3,
arms with a hand 4 and more."""


@dataclass(frozen=True)
class Part:
    """The part of a file that is the hand: the palm's link, and all links fixed to it or carried by
    it.
    """

    root: str
    links: tuple[str, ...]
    # fixed joints that carry the palm, read from child to parent
    reversed_joints: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()  # sentences on what is left out


def read_part(
    file: HandFile, palm: str | None, tips: Collection[str]
) -> tuple[Part, dict[str, FileLink], list[FileJoint]]:
    """Return the part of a file that is the hand, with a palm that is named or None, its links by
    name and its joints.

    An error lists all faults, those of the links named as `tips` included.
    """
    root, fault = "", None
    try:
        root = find_root(file.names, file.ends)
    except InvalidInputError as error:
        fault = error
    part = Part(root, tuple(file.names))
    if fault is None:
        robot = _Robot(root, file)
        part = robot.whole() if palm is None else robot.part(palm)
    kept = set(part.links)
    inside = {joint for joint, parent, child in file.ends if parent in kept and child in kept}
    mimics = {joint: other for joint, other in file.mimics.items() if joint in inside}
    with AllFaults() as check:
        elements = check(file.elements, kept)
        if fault is not None:
            check.add(fault)
        check(_known, tips, file.names, part)
        check(check_mimics, file.ends, file.fixed, mimics)
    return part, *elements


def _known(tips: Collection[str], links: Sequence[str], part: Part) -> None:
    """Check that every fingertip is a link of the hand."""
    if missing := [tip for tip in tips if tip not in links]:
        raise InvalidInputError(
            f"no link is called {', '.join(map(repr, missing))}; links are {names_of(links)}"
        )
    if left := [tip for tip in tips if tip not in part.links]:
        raise InvalidInputError(
            f"the palm {part.root!r} does not carry the fingertips {names_of(left)}; its links are {names_of(part.links)}"
        )


class _Robot:
    """The links of a file in rigid groups, each named by its topmost link."""

    def __init__(self, root: str, file: HandFile) -> None:
        self._root = root
        self._ends = file.ends
        self._fixed = file.fixed
        self._above = {child: (joint, parent) for joint, parent, child in file.ends}
        self.links = tuple(self._down(root))
        self._group = {root: root}
        # moving joints of each group, with their child links
        self._joints = {root: list[tuple[str, str]]()}
        for link in self.links[1:]:
            joint, parent = self._above[link]
            self._group[link] = self._group[parent] if joint in file.fixed else link
            if joint not in file.fixed:
                self._joints[self._group[parent]].append((joint, link))
                self._joints[link] = []
        self._arms = self._chains(file.mimics)

    def _down(self, top: str) -> list[str]:
        """Return a link and all its descendants, parents first."""
        found = [top]
        for link in found:
            found += [child for _, parent, child in self._ends if parent == link]
        return found

    def _chains(self, mimics: Mapping[str, str]) -> dict[str, list[str]]:
        """Return the motors of each chain that is too long for a finger or a wrist, by the group at
        its end.
        """
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
        """Return candidates for the palm: links at which several chains branch, none of them an
        arm; if there are arms, links at their ends.
        """
        carriers = set[str]()  # groups that carry arms
        for group in self._arms:
            while group != self._root:
                group = self._group[self._above[group][1]]
                carriers.add(group)
        inside = set[str]()
        palms = dict[str, str]()
        for group, joints in self._joints.items():
            above = self._above.get(group)
            if above and self._group[above[1]] in inside:
                inside.add(group)
            elif len(joints) > 1 and group not in carriers:
                inside.add(group)
                parents = [self._above[child][1] for _, child in joints]
                palms[group] = max(parents, key=parents.count)
        return [palm for group, palm in palms.items() if group in self._arms] or list(
            palms.values()
        )

    def whole(self) -> Part:
        """Return the whole file as the part, unless a chain of joints is too long for a finger or a
        wrist.
        """
        if not self._arms:
            return Part(self._root, self.links)
        group, chain = max(self._arms.items(), key=lambda item: len(item[1]))
        where = " and leads to a branching" if self._joints[group] else ""
        palms = " or ".join(f"palm={name!r}" for name in self._palms())
        raise InvalidInputError(
            f"this is an arm or a whole robot: the chain of {names_of(chain)} has {len(chain)} motors{where}. "
            + (
                f"Name the hand's palm, {palms}"
                if palms
                else "No link carries several chains that may be fingers"
            )
            + f"; palm={self._root!r} reads all of it as one hand"
        )

    def part(self, palm: str) -> Part:
        """Return the part of a named palm."""
        if palm not in self._group:
            raise InvalidInputError(
                f"palm: no link is called {shown(palm)}; joints branch at {names_of(self._palms())}; links are {names_of(self.links)}"
            )
        top = palm
        reversed_joints = list[str]()
        while top in self._above and self._above[top][0] in self._fixed:
            joint, top = self._above[top]
            reversed_joints.append(joint)
        links = self._down(top)
        kept = set(links)
        moving = [joint for joint, _, child in self._ends if joint not in self._fixed]
        inside = {joint for joint, parent, _ in self._ends if parent in kept}
        if not inside.intersection(moving):
            carriers = dict.fromkeys(
                parent for joint, parent, _ in self._ends if joint not in self._fixed
            )
            raise InvalidInputError(
                f"the palm {palm!r} carries no joint that moves; links that do are {names_of(list(carriers))}"
            )
        arm = list[str]()
        link = top
        while link in self._above:
            joint, link = self._above[link]
            arm += [joint] if joint not in self._fixed else []
        limbs = [joint for joint in moving if joint not in inside and joint not in arm]
        notes = list[str]()
        if arm:
            still = f"the joints that carry the palm {palm!r} hold still, their links are left out"
            notes.append(f"{still}: {names_of(arm[::-1])}")
        if limbs:
            notes.append(
                f"limbs that the palm {palm!r} does not carry are left out, with the joints {names_of(limbs)}"
            )
        return Part(palm, tuple(links), frozenset(reversed_joints), tuple(notes))


def find_root(links: Sequence[str], ends: Ends) -> str:
    """Return the root link, which is the child of no joint; an error lists all faults if the links
    are not a tree.
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
    known = {*roots}
    grew = True
    while grew and not faults:
        reached = {child for _, parent, child in ends if parent in known} - known
        known = known | reached
        grew = bool(reached)
    if not faults and (rest := [joint for joint, parent, _ in ends if parent not in known]):
        faults.append(f"the joints {names_of(rest)} form a cycle apart from {roots[0]!r}; cut it")
    with AllFaults() as check:
        check.add(*faults)
    return roots[0]


def check_mimics(ends: Ends, fixed: Collection[str], mimics: Mapping[str, str]) -> None:
    """Check that the driver of every coupled joint moves and that couplings form no loop; an error
    lists all that do not.
    """
    faults = list[str]()
    known = [name for name, _, _ in ends]
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
            faults.append(
                f"the joints {names_of(sorted(seen))} mimic each other in a loop; one of them needs a motor"
            )
    with AllFaults() as check:
        check.add(*faults)


def arrange(part: Part, joints: Sequence[FileJoint]) -> tuple[list[FileJoint], list[str]]:
    """Return the joints of a hand, parents before children and otherwise in file order, and
    sentences on what was changed.

    Chains of coupled joints are resolved to the joint with the motor. Joints that mimic a joint
    outside the part are fixed, and so are joints with equal limits.
    """
    joints = [_reversed(joint) if joint.name in part.reversed_joints else joint for joint in joints]
    by_name = {joint.name: joint for joint in joints}
    driven = list[FileJoint]()
    alone = list[str]()
    stuck = list[str]()
    for joint in joints:
        mimic = joint.mimic
        while (
            mimic is not None
            and mimic.joint in by_name
            and (before := by_name[mimic.joint].mimic) is not None
        ):
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
    equal = "joints with equal limits, lower = upper, hold still"
    notes = (
        [f"joints that mimic others that are left out hold still: {names_of(alone)}"]
        if alone
        else []
    )
    notes += [f"{equal}: {names_of(stuck)}; give the true ranges as joint_limits="] if stuck else []
    return _ordered(part.root, driven), notes


def _ordered(root: str, joints: list[FileJoint]) -> list[FileJoint]:
    """Sort the joints of a tree: parents before children, otherwise in file order."""
    ordered = list[FileJoint]()
    known = {root}
    rest = list(joints)
    while rest:
        ordered.append(rest.pop(next(at for at, joint in enumerate(rest) if joint.parent in known)))
        known.add(ordered[-1].child)
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
