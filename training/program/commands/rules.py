"""Start rules by their names on the command line."""

from __future__ import annotations

from grasp_env.errors import UnknownNameError
from grasp_env.force.initial import NAMES, InitialForceRule
from grasp_env.force.saved import is_saved


def rule(name: str) -> str | InitialForceRule:
    """Return a rule of the package, the shipped model ("learned"), or a saved one by its path."""
    if name in NAMES:
        return name
    from policies import LearnedInitialForce

    if name == "learned":
        return LearnedInitialForce.pretrained()
    if is_saved(name):
        return LearnedInitialForce.load(name)
    raise UnknownNameError(
        "initial-force rule", name, (*NAMES, "learned"), ", or give a saved model's path"
    )
