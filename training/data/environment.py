"""Environments that commands take as text: a name, or JSON of settings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from grasp_env.errors import InvalidInputError, UnknownNameError
from grasp_env.inputs.arguments import instance

if TYPE_CHECKING:
    from grasp_env.config import EnvConfig


def environment(
    text: str, usual: Mapping[str, Any] | None = None, elsewhere: Mapping[str, str] | None = None
) -> EnvConfig:
    """Return the settings of an environment.

    Args:
        text: UncertainGrasp or another environment with a name, or JSON of settings as keywords of
            `gym.make`. The default is the cuboid, held under a random wrench.
        usual: settings where the JSON gives none; an environment with a name keeps its own.
        elsewhere: settings that the JSON must not give, with the option that sets each.

    Raises:
        UnknownNameError: no environment of that name.
        InvalidInputError: it is not JSON either, or holds invalid settings.

    Example:
        >>> environment('{"shape": "sphere", "size": [0.06]}').object.size
        (0.06,)
    """
    from grasp_env.config import EnvConfig  # needs the extra sim
    from grasp_env.env.named import PROBLEMS

    if (name := text.removesuffix("-v0")) in PROBLEMS:
        return PROBLEMS[name].settings()
    try:
        settings = json.loads(text)
    except ValueError as error:
        if text.isidentifier():
            hint = ', or give settings as {"shape": "sphere"}'
            raise UnknownNameError("environment", text, PROBLEMS, hint) from None
        raise InvalidInputError(
            f'env is not JSON ({error}); give settings as {{"shape": "sphere"}}, or one of {", ".join(PROBLEMS)}'
        ) from None
    given = instance(settings, dict, "env")
    for name, option in (elsewhere or {}).items():
        if name in given:
            raise InvalidInputError(
                f"env has {name} {given[name]!r}: leave it out, {option} sets it"
            )
    disturbed = {} if "task" in given else {"disturbance": "random"}
    return EnvConfig().override(**{**disturbed, **(usual or {}), **given})
