"""Start rules as the command line names them."""

from __future__ import annotations

from pathlib import Path

from grasp_env.errors import UnknownNameError
from grasp_env.force import RULES, InitialForceRule
from policies import LearnedInitialForce


def rule(name: str) -> str | InitialForceRule:
    """A rule's name, "learned", or the path of a model that `grasp fit` saved."""
    if name == "learned":
        return LearnedInitialForce.pretrained()
    if name in RULES or name == "previous":
        return name
    if name.endswith((".json", ".safetensors")) or Path(f"{name}.json").is_file():
        return LearnedInitialForce.load(name)
    raise UnknownNameError(
        "initial-force rule", name, (*RULES, "previous", "learned"), ", or give a saved model's path"
    )
