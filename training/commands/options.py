"""Types of options: closed lists, which help and a shell's completion show, and options that may be left out."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from typing import Annotated, Any

import tyro

from grasp_env.errors import MissingExtraError


def one_of(names: Iterable[str]) -> tyro.constructors.PrimitiveConstructorSpec[str]:
    """Makes an `Annotated[str, ...]` one of these names, as `Literal` does of names that are written out."""
    allowed = tuple(names)
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(allowed)}}}",
        instance_from_str=lambda words: words[0],
        is_instance=lambda value: isinstance(value, str),
        str_from_instance=lambda value: [value],
        choices=allowed,
    )


def left_out(otherwise: str, what: str | None = None) -> Any:
    """Shows `otherwise` as the default of an option whose default is no value of its own, and `what` as what it takes."""
    return tyro.conf.arg(metavar=what, help_behavior_hint=f"(default: {otherwise})")


Wrench = Annotated[tuple[float, float, float, float, float, float], tyro.conf.arg(metavar="FX FY FZ MX MY MZ")]
"""Force [N] and moment [N m]."""


def listed(module: str, table: str) -> Any:
    """`one_of` the names in a module's table. Without the extra that the module needs any text, as the command then names the extra."""
    try:
        return one_of(getattr(import_module(module), table))
    except MissingExtraError:
        return tyro.conf.arg(metavar="NAME")
