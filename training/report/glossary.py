"""The words of the reports, each in a sentence: one table, of which a page folds those that it uses."""

from __future__ import annotations

from training.cases.set_table import SETS, TOLERANCE
from training.report.page import Fold, Table
from training.runs.words import small

TERMS: dict[str, str] = {
    "Φ (Phi)": "What the forces minimise: ω tr P + λ tr P⁻¹. The first part is squeeze; the second grows without bound at the friction cones.",
    "gap": f"How far Φ is above its least value, relative to it; iterations are counted to {small(TOLERANCE)}.",
    "certified gap": "A bound on the gap that a call knows by itself, from a dual bound: its proof of how good the force is.",
    "flow": "The paper's reduced gradient flow on Φ. Its iterations are accepted steps.",
    "Newton": "Newton's method on the same Φ: a step costs more than one of the flow, and few are needed.",
    "start": "The force from which a method begins: in balance with the wrench and strictly inside the friction cones.",
    "12-basis": "The paper's start: a combination, never negative, of the optimal forces of twelve unit wrenches, made once per grasp.",
    "control": "The 12-basis after as many plain Newton steps as a learned start may take inside: what is better than that is learned.",
    "network alone": "What a network of one grasp says, without any step; put back towards the 12-basis where it lies outside the cones.",
    "learned, fixed": "The shipped model: four_finger, a network of one grasp.",
    "previous": "The last solution, carried over to the new wrench.",
    "tangent, G⁺": "How a solution is carried over: along a Newton step of Φ within balance (tangent), or the shortest way (G⁺).",
    "cold": "Without a previous solution.",
    "ball": f"A set of wrenches, {SETS['ball'].label.partition(': ')[2]}; held out: its seeds train nothing.",
    "fixed grasp": "The contacts of presets.paper_cuboid(): a thumb against three fingers on a 0.1 m cuboid.",
    "p50, p99": "The median, and what 99 of 100 cases stay below.",
    "held": "The object was neither dropped nor away from its place by more than the task allows, to the end of the episode.",
    "friction margin": "The part of the friction that the solver is told it may use: a reserve against friction estimated too high.",
    "squeeze": "The total of the normal forces.",
    "drift": "How far the object is from where it should be.",
    "torque margin": "How far the joints' torques stay from their limits.",
    "zero policy": "An agent that does nothing: the environment's own start and force loop.",
    "interquartile mean": "The mean of the middle half: less moved by single episodes than a mean, and by more of them than a median.",
}
"""In the order in which they are read."""
COMPARISON = tuple(TERMS)[:16]
HOLDS = ("held", "friction margin", "squeeze", "drift", "torque margin", "12-basis")
LEARNING = ("zero policy", "12-basis", "held", "squeeze", "drift", "interquartile mean")


def glossary(terms: tuple[str, ...]) -> Fold:
    """The words of a page, closed until asked for."""
    return Fold(
        "Words used here", [Table("Words", ("word", "what it means"), [[term, TERMS[term]] for term in terms], words=2)]
    )
