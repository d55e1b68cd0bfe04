"""Judge the joint ranges of a hand's file, and find rods among its fingertips.

The bounds come from some 200 public files of hands and robots.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np
from scipy.optimize import linprog

from grasp_env.inputs.arguments import Array
from grasp_env.sim.hand.files.elements import FileJoint, listed, names_of
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.solids import outline
from grasp_env.sim.hand.tree import UNITS, Fingertip, Link

LARGEST_TURN = 3.3  # largest plausible range of a joint [rad]; a hinge folds by half a turn
# smallest one-sided range [rad], as 0 to pi, that is a placeholder if three joints or more share it
HALF_TURN = 3.1
DEGREES = 4.0 * math.pi  # median range [rad] above which all ranges are taken as degrees
# ranges to either side that are assumed if the file gives none [rad], [m]
ASSUMED_TURN, ASSUMED_WAY = 0.5 * math.pi, 0.02
LARGEST_STROKE = 0.5  # largest plausible range of a sliding joint [m]
# smallest share of a motor's range that coupled joints may leave it, or their limits are ignored
_LEAST_RANGE = 0.25
_POSTURES = (0.1, 0.3, 0.5, 0.7, 0.9)  # shares of the motors' ranges at which links are compared
_PINNED = 0.002  # largest gap between two links joined by a pin [m], as shapes are coarse
_MOST_FINGERS = 6  # largest number of fingers of a hand
_SHORTER = 0.9  # largest reach of a rod over that of the finger that it moves


def fill_ranges(
    joints: Sequence[FileJoint], given: Collection[str]
) -> tuple[list[FileJoint], list[str]]:
    """Return the joints with an assumed range if the file gives none of them one, and a sentence.

    Exporters of CAD programs write lower = upper = 0 for all joints. The sentence leaves out those
    in `given`, whose ranges the caller knows.
    """
    empty = [joint for joint in joints if not joint.fixed and joint.mimic is None]
    if not empty or any(joint.lower != 0.0 or joint.upper != 0.0 for joint in empty):
        return list(joints), []
    filled = list[FileJoint]()
    for joint in joints:
        end = ASSUMED_WAY if joint.sliding else ASSUMED_TURN
        if joint.mimic is not None:
            end = math.inf  # its driver's range counts
        filled.append(joint if joint.fixed else replace(joint, lower=-end, upper=end))
    assumed = [joint.name for joint in empty if joint.name not in given]
    if not assumed:
        return filled, []
    names = names_of(assumed)
    return filled, [
        f"no joint has a range, all are 0 to 0: assumed is {-ASSUMED_TURN:.3g} to {ASSUMED_TURN:.3g} rad, and {-ASSUMED_WAY:g} to {ASSUMED_WAY:g} m of "
        f"a sliding one, for {names}; give the true ranges as joint_limits="
    ]


def judge_ranges(
    joints: Sequence[FileJoint], given: Mapping[str, tuple[float, float]]
) -> tuple[list[FileJoint], list[str]]:
    """Return the joints with ranges in radians, and sentences on implausible ranges.

    Degrees become radians; ranges too wide for a finger are only listed. Ranges in `given` are not
    judged.
    """
    judged = [joint for joint in joints if not joint.fixed and joint.name not in given]
    spans = [
        joint.upper - joint.lower
        for joint in judged
        if not joint.sliding and math.isfinite(joint.lower)
    ]
    notes = list[str]()
    remedy = "; give the true ones as joint_limits="
    if spans and statistics.median(spans) > DEGREES:
        turned = {
            joint.name: replace(
                joint, lower=math.radians(joint.lower), upper=math.radians(joint.upper)
            )
            for joint in judged
            if not joint.sliding
        }
        joints = [turned.get(joint.name, joint) for joint in joints]
        judged = [turned.get(joint.name, joint) for joint in judged]
        ranges = listed([_range(joint) for joint in turned.values()])
        notes.append(f"ranges of more than two turns are taken as degrees: {ranges}{remedy}")
    driven = [joint for joint in judged if joint.mimic is None]
    wide = [_range(joint) for joint in driven if _is_wide(joint, driven)]
    if wide:
        notes.append(f"ranges too wide for a finger's joint are kept: {listed(wide)}{remedy}")
    return list(joints), notes


def _is_wide(joint: FileJoint, others: Sequence[FileJoint]) -> bool:
    """Return True if a range is too wide for a hinge, or a half turn that several joints share."""
    span = joint.upper - joint.lower
    if joint.sliding:
        return span > LARGEST_STROKE
    alike = sum((other.lower, other.upper) == (joint.lower, joint.upper) for other in others)
    one_side = max(-joint.lower, joint.upper) > 0.75 * span
    return span > LARGEST_TURN or (span > HALF_TURN and one_side and alike >= 3)


def _range(joint: FileJoint) -> str:
    if not math.isfinite(joint.lower):
        return f"{joint.name!r} (unlimited)"
    unit = UNITS[joint.sliding][0]
    return f"{joint.name!r} ({joint.lower:.3g} to {joint.upper:.3g} {unit})"


def free_ranges(
    joints: Sequence[FileJoint], given: Collection[str]
) -> tuple[list[FileJoint], list[str]]:
    """Return the joints with ranges that fit their couplings, and a sentence on changes.

    Other programs only use the limits of the joint with the motor, so wrong limits of coupled
    joints go unnoticed. If these would leave the motor less than `_LEAST_RANGE` of its range, they
    are replaced by the image of the motor's range, except for the joints in `given`.
    """
    drivers = {joint.name: joint for joint in joints}
    coupled = [(joint, joint.mimic) for joint in joints if joint.mimic is not None]
    left = {joint.name: (joint.lower, joint.upper) for joint in joints}
    for joint, mimic in coupled:
        ends = [(end - mimic.offset) / mimic.ratio for end in (joint.lower, joint.upper)]
        lower, upper = left[mimic.joint]
        left[mimic.joint] = max(lower, min(ends)), min(upper, max(ends))
    changed = dict[str, FileJoint]()
    for joint, mimic in coupled:
        driver = drivers[mimic.joint]
        lower, upper = left[mimic.joint]
        if (
            joint.name not in given
            and math.isfinite(driver.lower)
            and upper - lower < _LEAST_RANGE * (driver.upper - driver.lower)
        ):
            lower, upper = sorted((mimic.angle(driver.lower), mimic.angle(driver.upper)))
            changed[joint.name] = replace(joint, lower=lower, upper=upper)
    text = "the limits of coupled joints leave their motor hardly any range and are ignored"
    fitting = [changed.get(joint.name, joint) for joint in joints]
    return fitting, [f"{text}: {names_of(list(changed))}"] if changed else []


def find_rods(links: Sequence[Link], tips: Sequence[Fingertip]) -> set[str]:
    """Return names of the fingertips that are rods: they end at a pin in another finger.

    The same motors move that finger, the rod touches it in every posture, and it reaches farther.
    With more than `_MOST_FINGERS` tips, the file has motors for the joints of linkages. Then other
    motors may move the finger, and the rod touches it with all joints at 0.
    """
    chains = [_chain(links, tip.link) for tip in tips]
    motors = [
        frozenset(link.mimic.joint if link.mimic else link.joint for link in chain)
        for chain in chains
    ]
    alike = list[tuple[int, int]]()
    others = list[tuple[int, int]]()
    for rod, finger in permutations(range(len(tips)), 2):
        (alike if motors[rod] == motors[finger] else others).append((rod, finger))
    compared: list[tuple[list[tuple[int, int]], Sequence[float | None]]] = [(alike, _POSTURES)]
    if len(tips) > _MOST_FINGERS:
        compared.append((others, (None,)))
    rods = set[str]()
    for pairs, shares in compared:
        postures = [frames_at(links, share) for share in shares] if pairs else []
        reach = [_reach(tip, postures) for tip in tips]
        for rod, finger in pairs:
            driven = [link for link in chains[finger] if link not in chains[rod]]
            if reach[rod] < _SHORTER * reach[finger] and any(
                all(_touch(chains[rod][0], other, frames) for frames in postures)
                for other in driven
            ):
                rods.add(tips[rod].name)
    return rods if len(rods) < len(tips) else set()


def _reach(tip: Fingertip, postures: Sequence[Mapping[str, Frame]]) -> float:
    """Return the largest distance [m] of a tip from the origin of the palm."""
    return max(
        (
            float(np.linalg.norm(frames[tip.link].rotation @ tip.center + frames[tip.link].origin))
            for frames in postures
        ),
        default=0.0,
    )


def _chain(links: Sequence[Link], name: str) -> list[Link]:
    """Return a link and its ancestors."""
    by_name = {link.name: link for link in links}
    chain = [by_name[name]]
    while chain[-1].parent in by_name:
        chain.append(by_name[chain[-1].parent])
    return chain


def frames_at(links: Sequence[Link], share: float | None) -> dict[str, Frame]:
    """Return the frames of the links in the palm's, all motors at a share of their ranges or at 0."""
    angles = dict[str, float]()
    for link in links:
        lower = max(link.lower, -math.pi)
        angles[link.joint] = (
            0.0 if share is None else lower + share * (min(link.upper, math.pi) - lower)
        )
    frames = dict[str, Frame]()
    for link in links:
        mimic = link.mimic
        angle = angles[link.joint] if mimic is None else mimic.angle(angles[mimic.joint])
        motion = Frame.of_joint(np.array(link.axis), angle, link.sliding)
        place = Frame.of(link.origin, link.rotation) @ motion
        frames[link.name] = frames[link.parent] @ place if link.parent in frames else place
    return frames


def _touch(one: Link, other: Link, frames: dict[str, Frame]) -> bool:
    """Return True if two links are within `_PINNED` of each other."""
    solids = [
        [
            outline(shape) @ frames[link.name].rotation.T + frames[link.name].origin
            for shape in link.collision
        ]
        for link in (one, other)
    ]
    return any(_near(first, second) for first in solids[0] for second in solids[1])


def _near(first: Array, second: Array) -> bool:
    """Return True if no slab of thickness `_PINNED` fits between the hulls of points (K, 3)."""
    middle = 0.5 * (first.mean(axis=0) + second.mean(axis=0))
    # a normal n with |n_i| <= 1, an offset d and the largest half width m:
    # n @ a >= d + m, n @ b <= d - m
    rows = np.vstack(
        [
            np.column_stack([middle - first, np.ones(len(first)), np.ones(len(first))]),
            np.column_stack([second - middle, -np.ones(len(second)), np.ones(len(second))]),
        ]
    )
    bounds = [(-1.0, 1.0)] * 3 + [(None, None), (0.0, None)]
    gain = (0.0, 0.0, 0.0, 0.0, -1.0)
    slab = linprog(gain, A_ub=rows, b_ub=np.zeros(len(rows)), bounds=bounds, method="highs").x
    if slab is None:
        return True
    return float(2.0 * slab[4]) < _PINNED * max(float(np.linalg.norm(slab[:3])), 1e-12)
