"""The sets of cases: one row each. Imports nothing."""

from __future__ import annotations

from dataclasses import dataclass

TOLERANCE = 1e-4
"""Relative gap of Phi to which iterations are counted where nothing else is said."""


@dataclass(frozen=True)
class SetInfo:
    """What a set is.

    Attributes:
        label: for tables.
        group: a key of `GROUPS`.
        grasp: "fixed", "near" (the fixed one with other friction or places), "random" or "recorded".
        note: what its "previous solution" is.
        share: of the number of cases asked for.
    """

    label: str
    group: str
    grasp: str
    note: str
    share: float = 1.0


GROUPS = {
    "paper": "The paper's two examples",
    "wrenches": "Wrenches on the fixed grasp",
    "jumps": "Jumps of the wrench on the fixed grasp",
    "grasps": "Friction, contact places and grasps that no training set holds",
    "rollouts": "Recorded from the simulated hand: moving contacts, impacts, changes of contact",
}
_DRAW = "the draw before it, an unrelated wrench"
_STEP = "the step before it"
_COLD = "none: every case is a cold start"
SETS: dict[str, SetInfo] = {
    "constant": SetInfo("the paper's constant wrench", "paper", "fixed", "the same wrench, 3 % smaller", 0.0),
    "paper_path": SetInfo("the paper's W_ext(t), full size, 2 s in 200 samples", "paper", "fixed", _STEP, 0.0),
    "ball": SetInfo("ball: force <= 2 N, moment <= 0.05 N m, independent draws", "wrenches", "fixed", _DRAW),
    "ball_double": SetInfo("the same ball, twice as large", "wrenches", "fixed", _DRAW),
    "ball_half": SetInfo("the same ball, half as large", "wrenches", "fixed", _DRAW),
    "smooth": SetInfo("random walk in the ball, 3 % of its radius per step", "wrenches", "fixed", _STEP),
    "trajectories": SetInfo("sums of sines through the ball, 100 samples per second", "wrenches", "fixed", _STEP),
    "directions": SetInfo(
        "18 directions: 6 axes both ways, 6 pairs; of 0.5, 1 and 2 N or 0.025, 0.05 and 0.1 N m", "wrenches", "fixed",
        "the solution for no wrench", 0.0,
    ),
    "jump_10": SetInfo("jumps of 10 % of the ball's radius", "jumps", "fixed", "the wrench before the jump", 0.6),
    "jump_50": SetInfo("jumps of 50 %", "jumps", "fixed", "the wrench before the jump", 0.6),
    "jump_100": SetInfo("jumps of 100 %", "jumps", "fixed", "the wrench before the jump", 0.6),
    "friction": SetInfo("friction 0.2, 0.7 and 0.8, the ball", "grasps", "near", _DRAW, 0.6),
    "positions": SetInfo("every contact up to 10 mm off on its face, the ball", "grasps", "near", _DRAW, 0.6),
    "random_4": SetInfo("random grasps of 4 contacts, the ball", "grasps", "random", _COLD),
    "random_3": SetInfo("random grasps of 3 contacts, the ball", "grasps", "random", _COLD, 0.4),
    "random_5": SetInfo("random grasps of 5 contacts, the ball", "grasps", "random", _COLD, 0.4),
    "rollout_cold": SetInfo("first optimisation of an episode, random object", "rollouts", "recorded", _COLD, 0.15),
    "rollout_moving": SetInfo("random wrench, moving contacts, 50 per second", "rollouts", "recorded", _STEP),
    "rollout_impulses": SetInfo(
        "impacts on random objects: the wrench moves by a quarter of the ball's radius or more in a step", "rollouts", "recorded", _STEP, 0.4
    ),
    "rollout_fixed": SetInfo(
        "the same impacts on the 0.1 m cuboid, contacts near the fixed grasp's", "rollouts", "recorded", _STEP, 0.4
    ),
    "rollout_changes": SetInfo(
        "changes of contact: a finger lost, landed or slipped 3 to 10 mm", "rollouts", "recorded",
        "the solution with the contacts before, the finger that lands with its own optimum of no load", 0.6,
    ),
}  # fmt: skip
"""All sets, in the order of the report."""
