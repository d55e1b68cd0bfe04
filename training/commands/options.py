"""How options say what they take: closed lists, which help and a shell's completion show, and what may be left out."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from typing import Annotated, Any

import tyro

from grasp_env.errors import MissingExtraError


def one_of(names: Iterable[str]) -> tyro.constructors.PrimitiveConstructorSpec[str]:
    """What makes an `Annotated[str, ...]` one of these names, which stand elsewhere."""
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
    """An option whose default is no value of its own: what holds without it, and what it takes."""
    return tyro.conf.arg(metavar=what, help_behavior_hint=f"(default: {otherwise})")


Wrench = Annotated[
    tuple[float, float, float, float, float, float],
    tyro.conf.arg(metavar="FX FY FZ MX MY MZ"),
]
"""Six numbers, called by their names."""


def listed(module: str, table: str) -> Any:
    """`one_of` the names in a module's table, which may need an extra: without that, text, and the command names the extra."""
    try:
        return one_of(getattr(import_module(module), table))
    except MissingExtraError:
        return tyro.conf.arg(metavar="NAME")
