"""Find the hand in a file: its joints, its palm, and the arm or robot that carries it."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs.arguments import AllFaults
from grasp_env.sim.hand.check import Vector3
from grasp_env.sim.hand.files.elements import Ends, FileJoint, FileLink, HandFile, names_of

# largest number of motors of an unbranched chain; fingers of public hands have up to 5, arms
# without a hand 6 and more
LONGEST_FINGER = 6
# smallest length of such a chain that is an arm [m], from its first joint to its last; fingers with
# more motors, in files of tendon-driven hands, have 0.06
LEAST_ARM = 0.3
# the same of a chain that ends at a branching; forearms and wrists have up to 3, arms with a hand 4
# and more
LONGEST_WRIST = 3


@dataclass(frozen=True)
class Part:
    """The part of a file that is the hand: the palm and all that it carries."""

    root: str  # the palm's link
    links: tuple[str, ...]
    # fixed joints that carry the palm, read from child to parent
    reversed_joints: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()  # sentences on what is left out


def read_part(
    file: HandFile, palm: str | None, tips: Collection[str]
) -> tuple[Part, dict[str, FileLink], list[FileJoint]]:
    """Return the part of a file that is the hand, its links by name and its joints.

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
        check(_check_tips, tips, file.names, part)
        check(check_mimics, file.ends, file.fixed, mimics)
    return part, *elements


def _check_tips(tips: Collection[str], links: Sequence[str], part: Part) -> None:
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
        self.links = tuple(self._descendants(root))
        self._group = {root: root}
        # moving joints of each group, with their child links
        self._joints = {root: list[tuple[str, str]]()}
        for link in self.links[1:]:
            joint, parent = self._above[link]
            self._group[link] = self._group[parent] if joint in file.fixed else link
            if joint not in file.fixed:
                self._joints[self._group[parent]].append((joint, link))
                self._joints[link] = []
        self._arms = self._find_arms(file.mimics, file.origins)

    def _descendants(self, top: str) -> list[str]:
        """Return a link and all its descendants, parents first."""
        links = [top]
        for link in links:
            links += [child for _, parent, child in self._ends if parent == link]
        return links

    def _find_arms(
        self, mimics: Mapping[str, str], origins: Mapping[str, Vector3]
    ) -> dict[str, list[str]]:
        """Return the motors of chains too long for a finger or a wrist, by the group at the end."""
        chains: dict[str, list[str]] = {self._root: []}
        lengths = {self._root: 0.0}  # [m] from the first motor of the chain
        arms: dict[str, list[str]] = {}
        alone = all(len(joints) <= 1 for joints in self._joints.values())
        for group, joints in self._joints.items():
            chain = chains[group]
            for joint, child in joints:
                start = chain if len(joints) == 1 else []
                chains[child] = [*start, joint] if joint not in mimics else start
                lengths[child] = lengths[group] + self._step(child, origins) if start else 0.0
            if joints:
                too_long = len(joints) > 1 and len(chain) > LONGEST_WRIST
            else:
                # an only chain is a finger, or a small arm with one moving jaw
                most = LONGEST_WRIST if alone else LONGEST_FINGER
                too_long = len(chain) > most and lengths[group] > LEAST_ARM
            if too_long:
                arms[group] = chain
        return arms

    def _step(self, link: str, origins: Mapping[str, Vector3]) -> float:
        """Return the length [m] from the moving joint before a link's to that of the link."""
        joint, parent = self._above[link]
        length = math.hypot(*origins[joint])
        while parent != self._group[parent]:
            joint, parent = self._above[parent]
            length += math.hypot(*origins[joint])
        return length

    def _palms(self) -> list[str]:
        """Return candidates for the palm: links at which chains branch, none of them an arm.

        If there are arms, the links are at their ends.
        """
        carriers = set[str]()  # groups that carry arms
        for group in self._arms:
            while group != self._root:
                group = self._group[self._above[group][1]]
                carriers.add(group)
        inside = set[str]()  # groups of hands
        palms = dict[str, str]()
        for group, joints in self._joints.items():
            above = self._above.get(group)
            if above and self._group[above[1]] in inside:
                inside.add(group)
            elif len(joints) > 1 and group not in carriers:
                inside.add(group)
                parents = [self._above[child][1] for _, child in joints]
                palms[group] = max(parents, key=parents.count)
        on_arms = [palm for group, palm in palms.items() if group in self._arms]
        return on_arms or list(palms.values())

    def _hands(self, group: str) -> dict[str, list[str]]:
        """Return the links of a rigid group that carry several fingers, with all that they carry.

        None carries another.
        """
        carriers = [self._above[child][1] for _, child in self._joints[group]]
        hands = {
            name: self._descendants(name)
            for name in dict.fromkeys(carriers)
            if carriers.count(name) > 1
        }
        return {
            name: links
            for name, links in hands.items()
            if not any(other in links for other in hands if other != name)
        }

    def whole(self) -> Part:
        """Return the whole file as the hand, or raise an error if it has an arm."""
        if not self._arms:
            hands = self._hands(self._root)
            notes = (
                f"the links {names_of([*hands])} carry several fingers each, which are read as one hand; palm= reads those of one link",
            )
            return Part(self._root, self.links, notes=notes if len(hands) > 1 else ())
        group, chain = max(self._arms.items(), key=lambda item: len(item[1]))
        where = " and leads to a branching" if self._joints[group] else ""
        palms = " or ".join(f"palm={name!r}" for name in self._palms())
        remedy = f"Name the hand's palm, {palms}"
        jaw = self._above[group][1]
        nothing = f"If the last joint moves a jaw against the link {jaw!r}, name palm={jaw!r}; no link carries several fingers"
        raise InvalidInputError(
            f"this is an arm or a whole robot: the chain of {names_of(chain)} has {len(chain)} motors{where}. "
            f"{remedy if palms else nothing}; palm={self._root!r} reads all of it as one hand"
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
        links = self._descendants(top)
        hands = self._hands(self._group[palm])
        if palm in hands:
            others = {link for name in hands if name != palm for link in hands[name]}
            links = [link for link in links if link not in others]
        moving = [(joint, parent) for joint, parent, _ in self._ends if joint not in self._fixed]
        carried = {joint for joint, parent, _ in self._ends if parent in links}
        if not any(joint in carried for joint, _ in moving):
            carriers = list(dict.fromkeys(parent for _, parent in moving))
            raise InvalidInputError(
                f"the palm {palm!r} carries no joint that moves; links that do are {names_of(carriers)}"
            )
        arm = list[str]()
        link = top
        while link in self._above:
            joint, link = self._above[link]
            if joint not in self._fixed:
                arm.append(joint)
        limbs = [joint for joint, _ in moving if joint not in carried and joint not in arm]
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
    """Return the root link; if the links are not a tree, an error lists all faults."""
    joints: dict[str, str] = {}  # by their child links
    faults = list[str]()
    for joint, *pair in ends:
        faults += [
            f"joint {joint!r} names the link {link!r}, which is not in the file; links are {names_of(links)}"
            for link in pair
            if link and link not in links
        ]
        child = pair[1]
        if child and child in joints:
            faults.append(
                f"link {child!r} is the child of two joints, {joints[child]!r} and {joint!r}; a hand must be a tree, cut the loop"
            )
        joints[child] = joint
    roots = [link for link in dict.fromkeys(links) if link not in joints]
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
        known |= reached
        grew = bool(reached)
    if not faults and (rest := [joint for joint, parent, _ in ends if parent not in known]):
        faults.append(f"the joints {names_of(rest)} form a cycle apart from {roots[0]!r}; cut it")
    with AllFaults() as check:
        check.add(*faults)
    return roots[0]


def check_mimics(ends: Ends, fixed: Collection[str], mimics: Mapping[str, str]) -> None:
    """Check that the drivers of coupled joints move and that no couplings form a loop."""
    faults = list[str]()
    joints = [name for name, _, _ in ends]
    for joint, driver in mimics.items():
        if driver not in joints:
            faults.append(
                f"joint {joint!r} mimics {driver!r}, which is not a joint of the file; joints are {names_of(joints)}"
            )
        elif driver in fixed:
            faults.append(
                f"joint {joint!r} mimics {driver!r}, which does not move; make both of them fixed, or move {driver!r}"
            )
        chain = [joint]
        while chain[-1] in mimics and mimics[chain[-1]] not in chain:
            chain.append(mimics[chain[-1]])
        if mimics.get(chain[-1]) == joint:
            faults.append(
                f"the joints {names_of(sorted(chain))} mimic each other in a loop; one of them needs a motor"
            )
    with AllFaults() as check:
        check.add(*faults)
