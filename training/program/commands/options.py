"""Types of options: closed lists, and options that may be left out."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import fields
from importlib import import_module
from typing import Annotated, Any

import tyro

from grasp_env.errors import InvalidInputError, MissingExtraError


def one_of(names: Iterable[str]) -> tyro.constructors.PrimitiveConstructorSpec[str]:
    """Restrict an `Annotated[str, ...]` to these names, as `Literal` does for names written out."""
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
    """Show `otherwise` in the help as the default of an option, and `what` as its metavar."""
    return tyro.conf.arg(metavar=what, help_behavior_hint=f"(default: {otherwise})")


def setting_help(path: str, otherwise: str | None = None) -> Any:
    """Take an option's help from the environment's setting; `otherwise` as in `left_out`."""
    try:
        text = import_module("grasp_env.config.env").all_settings()[path].doc
    except MissingExtraError:  # the command names the extra
        text = "see the page of settings."
    hint = None if otherwise is None else f"(default: {otherwise})"
    return tyro.conf.arg(help=text, help_behavior_hint=hint)


def settings_of(words: Iterable[str]) -> dict[str, Any]:
    """Parse words PATH=VALUE into settings of the environment. A value that is not JSON is text.

    Raises:
        InvalidInputError: a word without "=".

    Example:
        >>> settings_of(["controller.kind=pd", "sensors.delay=0.01"])
        {'controller.kind': 'pd', 'sensors.delay': 0.01}
    """
    settings: dict[str, Any] = {}
    form = "a setting is given as PATH=VALUE, such as sensors.delay=0.01"
    for path, text in pairs_of(words, form).items():
        try:
            settings[path] = json.loads(text)
        except (ValueError, RecursionError):
            settings[path] = text
    return settings


def pairs_of(words: Iterable[str], form: str) -> dict[str, str]:
    """Split words NAME=VALUE. An InvalidInputError for a word without "=" begins with `form`."""
    pairs: dict[str, str] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            raise InvalidInputError(f"{form}, got {word!r}")
        pairs[name] = text
    return pairs


def misplaced(command: Any, options: Mapping[str, Iterable[str]], what: str) -> str | None:
    """Return the first given option that belongs only to other entries than `what`, or None."""
    others = {name for names in options.values() for name in names} - {*options[what]}
    given = (item.name for item in fields(command) if getattr(command, item.name) != item.default)
    return next((name for name in given if name in others), None)


def _six(words: list[str]) -> tuple[float, ...]:
    numbers = tuple(map(float, words))
    if len(numbers) != 6:
        raise ValueError(f"Expected 6 values, got {len(numbers)}")
    return numbers


SIX = tyro.constructors.PrimitiveConstructorSpec[Any](
    nargs="*",
    metavar="FX FY FZ MX MY MZ",
    instance_from_str=_six,
    is_instance=lambda value: value is None or (isinstance(value, tuple) and len(value) == 6),
    str_from_instance=lambda value: [] if value is None else list(map(str, value)),
)
"""Reader of an option with six numbers, or None; a union would hide how many are missing."""
Wrench = Annotated[tuple[float, float, float, float, float, float], SIX]
"""Force [N] and moment [N m]."""


def listed(module: str, table: str) -> Any:
    """Restrict an option to the names in a module's table; any text if its extra is missing."""
    try:
        return one_of(getattr(import_module(module), table))
    except MissingExtraError:
        return tyro.conf.arg(metavar="NAME")
