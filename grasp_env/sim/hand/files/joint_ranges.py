"""Judge the ranges of joints in a hand's file: degrees become radians, and ranges too wide for a finger are listed.

The bounds come from some 200 public files of hands and robots.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace

from grasp_env.sim.hand.files.elements import FileJoint, listed

LARGEST_TURN = 3.3  # largest plausible range of a joint [rad]: a hinge between two links folds by half a turn
HALF_TURN = 3.1  # smallest one-sided range [rad], as 0 to pi, that is a placeholder if three joints or more share it
DEGREES = 4.0 * math.pi  # median range [rad] above which all ranges are taken as degrees
LARGEST_STROKE = 0.5  # largest plausible range of a sliding joint [m]


def judge_ranges(
    joints: Sequence[FileJoint], given: Mapping[str, tuple[float, float]]
) -> tuple[list[FileJoint], list[str]]:
    """Return the joints with ranges in radians, and sentences on implausible ranges; those in `given` are not judged."""
    judged = [joint for joint in joints if not joint.fixed and joint.name not in given]
    spans = [joint.upper - joint.lower for joint in judged if not joint.sliding and math.isfinite(joint.lower)]
    notes, true = list[str](), "; give the true ones as joint_limits="
    if spans and statistics.median(spans) > DEGREES:
        turned = {
            joint.name: replace(joint, lower=math.radians(joint.lower), upper=math.radians(joint.upper))
            for joint in judged
            if not joint.sliding
        }
        joints, judged = ([turned.get(joint.name, joint) for joint in each] for each in (joints, judged))
        shown = listed([_range(joint) for joint in turned.values()])
        notes.append(f"ranges of more than two turns are taken as degrees: {shown}{true}")
    driven = [joint for joint in judged if joint.mimic is None]
    wide = [_range(joint) for joint in driven if _is_wide(joint, driven)]
    if wide:
        notes.append(f"ranges too wide for a finger's joint are kept: {listed(wide)}{true}")
    return list(joints), notes


def _is_wide(joint: FileJoint, others: Sequence[FileJoint]) -> bool:
    """Return True if a range is too wide for a hinge, or a one-sided half turn shared by several joints."""
    span = joint.upper - joint.lower
    if joint.sliding:
        return span > LARGEST_STROKE
    alike = sum((other.lower, other.upper) == (joint.lower, joint.upper) for other in others)
    one_side = max(-joint.lower, joint.upper) > 0.75 * span
    return span > LARGEST_TURN or (span > HALF_TURN and one_side and alike >= 3)


def _range(joint: FileJoint) -> str:
    if not math.isfinite(joint.lower):
        return f"{joint.name!r} (unlimited)"
    return f"{joint.name!r} ({joint.lower:.3g} to {joint.upper:.3g} {'m' if joint.sliding else 'rad'})"
