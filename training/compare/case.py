"""A case of the comparison of starts."""

from __future__ import annotations

from dataclasses import dataclass

from grasp_env._check import Wrench
from grasp_env.grasp import Grasp

Problem = tuple[Grasp, Wrench]
"""A grasp and the wrench on the object (6,) [N, N m]."""


@dataclass(frozen=True, eq=False)
class Case:
    """One optimisation.

    Attributes:
        grasp: the contacts.
        wrench: (6,) [N, N m].
        before: the problem that was solved before it; None: a cold start.
        group: the path, episode or grasp that it belongs to.
        event: what happened since `before`, or which variant it is.
    """

    grasp: Grasp
    wrench: Wrench
    before: Problem | None = None
    group: int = 0
    event: str = ""
