"""Cases of the comparison of starts."""

from __future__ import annotations

from dataclasses import dataclass

from grasp_env.grasp import Grasp
from grasp_env.inputs.arguments import Wrench

Problem = tuple[Grasp, Wrench]
"""A grasp and the wrench on the object (6,) [N, N m]."""


@dataclass(frozen=True, eq=False)
class Case:
    """One optimisation problem.

    Attributes:
        grasp: the contacts.
        wrench: (6,) [N, N m].
        before: the problem solved before it; None: a cold start.
        group: number of the path, episode or grasp it belongs to.
        event: event since `before`, or name of the variant.
    """

    grasp: Grasp
    wrench: Wrench
    before: Problem | None = None
    group: int = 0
    event: str = ""
