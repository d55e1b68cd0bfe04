"""Cut closed loops in a file, so that one joint carries each link."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Mapping
from typing import NamedTuple

from grasp_env.sim.hand.files.elements import Ends, listed, names_of


class Cut(NamedTuple):
    """Joints and links that are left out of a file, and sentences on them."""

    joints: frozenset[str] = frozenset()
    links: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()


def cut_loops(
    links: Collection[str],
    ends: Ends,
    fixed: Collection[str],
    mimics: Mapping[str, str],
    palm: str | None = None,
    tips: Collection[str] = (),
) -> Cut:
    """Return what must be left out so that a file's links become a tree.

    Each link keeps the joint on the way from the root with the fewest motors, of several the
    shortest, then the first in the file. Links that only closed a loop inside a finger are left
    out, except the `tips` and those whose joints drive others. Nothing is left out if a loop begins
    at the palm, as its other way may be a finger, if a joint that is cut drives another, or if
    there are other faults. `part.find_root` reports these.
    """
    children = [child for _, _, child in ends]
    roots = [link for link in dict.fromkeys(links) if link not in children]
    names = {joint for joint, _, _ in ends}
    pairs = {(parent, child) for _, parent, child in ends}
    wrong = any(end not in links for _, *pair in ends for end in pair)
    if wrong or len(roots) != 1 or len(set(children)) == len(children):
        return Cut()
    if len(names) < len(ends) or len(pairs) < len(ends) or len(set(links)) < len(links):
        return Cut()
    ways = _shortest(roots[0], ends, fixed, mimics)
    if len(ways) < len(links) - 1:
        return Cut()
    kept = {joint for joint, _ in ways.values()}
    cut = [(joint, parent, child) for joint, parent, child in ends if joint not in kept]
    palms = {roots[0], *_rigid(palm or roots[0], ways, fixed)}
    below = dict[str, list[str]]()
    for link, (_, parent) in ways.items():
        below.setdefault(parent, []).append(link)
    left = set[str]()
    for _, parent, child in cut:
        above = {child, *_above(child, ways)}
        way = [parent, *_above(parent, ways)]
        if child in way:
            continue  # the joint leads back
        other = way[: next(place for place, link in enumerate(way) if link in above)]
        if other and not palms.isdisjoint(_rigid(ways[other[-1]][1], ways, fixed)):
            return Cut()
        for link in other:
            if link in left:
                continue
            limb = _limb(link, below, left)
            inner = {ways[each][0] for each in limb if each != link} - set(fixed)
            rest = (joint for each, (joint, _) in ways.items() if each not in left | limb)
            drives = ways[link][0] in map(mimics.get, rest)
            if inner or drives or not limb.isdisjoint({palm, *tips}):
                break
            left |= limb
    joints = {joint for joint, _, _ in cut} | {ways[link][0] for link in left}
    if any(driver in joints for joint, driver in mimics.items() if joint not in joints):
        return Cut()
    rows = [
        f"{child!r} by {ways[child][0]!r}, not by {joint!r}"
        for joint, _, child in cut
        if child not in left
    ]
    notes = [
        f"links in closed loops are carried by one joint each, that on the way with the fewest motors: {listed(rows)}; the joints of a loop "
        "turn independently, couple them with <mimic> if they do not"
    ]
    if left:
        alone = [link for link in links if link in left]
        notes.append(f"links that only closed a loop are left out: {names_of(alone)}")
    return Cut(frozenset(joints), frozenset(left), tuple(notes))


def _shortest(
    root: str, ends: Ends, fixed: Collection[str], mimics: Mapping[str, str]
) -> dict[str, tuple[str, str]]:
    """Return joint and parent of each link on its way from the root, for links that it reaches."""
    steps = dict[str, list[tuple[int, str, str]]]()
    for number, (joint, parent, child) in enumerate(ends):
        steps.setdefault(parent, []).append((number, joint, child))
    ways = dict[str, tuple[str, str]]()
    # number of motors, of joints, and of the last joint; motors; link, its joint and parent
    queue = [(0, 0, -1, frozenset[str](), root, "", "")]
    while queue:
        _, length, _, motors, link, joint, parent = heapq.heappop(queue)
        if link in ways:
            continue
        ways[link] = joint, parent
        for number, step, child in steps.get(link, []):
            more = motors if step in fixed else motors | {mimics.get(step, step)}
            heapq.heappush(queue, (len(more), length + 1, number, more, child, step, link))
    del ways[root]
    return ways


def _above(link: str, ways: Mapping[str, tuple[str, str]]) -> list[str]:
    """Return the links on the way to a link, its parent first, the root last."""
    above = list[str]()
    while link in ways:
        link = ways[link][1]
        above.append(link)
    return above


def _rigid(link: str, ways: Mapping[str, tuple[str, str]], fixed: Collection[str]) -> list[str]:
    """Return a link and those on its way to which it is fixed."""
    links = [link]
    while links[-1] in ways and ways[links[-1]][0] in fixed:
        links.append(ways[links[-1]][1])
    return links


def _limb(link: str, below: Mapping[str, list[str]], without: Collection[str]) -> set[str]:
    """Return a link and all that it carries, without those that are left out."""
    limb = [link]
    for each in limb:
        limb += [child for child in below.get(each, []) if child not in without]
    return set(limb)
