"""A hand as JSON values: a dict of its name if it is built in, otherwise of all its parts."""

from __future__ import annotations

import math
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from typing import Any

from grasp_env.errors import InvalidInputError, UnknownSettingError, shown
from grasp_env.inputs.arguments import choice
from grasp_env.sim.hand.description import (
    HANDS,
    Fingertip,
    Geometry,
    HandDescription,
    Link,
    Mimic,
    Palm,
)

_LISTS: dict[str, type[Any]] = {
    "links": Link,
    "fingertips": Fingertip,
    "collision": Geometry,
    "visual": Geometry,
}
_SINGLE: dict[str, type[Any]] = {"palm": Palm, "mimic": Mimic}
_UNLIMITED = {"lower": -math.inf, "upper": math.inf}  # null in JSON


def hand_to_plain(hand: HandDescription) -> dict[str, Any]:
    """Return the dict that `hand_of` reads.

    Example:
        >>> hand_to_plain(HandDescription.allegro())
        {'name': 'allegro'}
        >>> moved = HandDescription.allegro().moved((0.0, 0.1, 0.0))
        >>> hand_of(hand_to_plain(moved), "hand") == moved
        True
    """
    name = _names().get(hand)
    return _plain(hand) if name is None else {"name": name}


def hand_of(value: Any, name: str) -> HandDescription:
    """Return the hand in a dict of its fields, or of a built-in hand's name alone.

    Fields with a default may be left out.

    Args:
        value: dict, as from `hand_to_plain`.
        name: name of the argument, for messages.

    Raises:
        UnknownNameError: no built-in hand has that name.
        UnknownSettingError: a part has no field of that name.
        InvalidInputError: a field is missing or has another kind, or the hand is not valid.
    """
    if isinstance(value, dict) and list(value) == ["name"]:
        return HANDS[
            choice(value["name"], name, HANDS, ", or give all fields of a HandDescription")
        ]()
    return _build(HandDescription, value, name)


def is_built_in(hand: HandDescription) -> bool:
    """True if a hand is one of `HANDS`, at its own place."""
    return hand in _names()


@cache
def _names() -> dict[HandDescription, str]:
    return {make(): name for name, make in HANDS.items()}


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {item.name: _plain(getattr(value, item.name)) for item in fields(value)}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return None if value in _UNLIMITED.values() else value


def _build(kind: type[Any], value: Any, name: str) -> Any:
    if not isinstance(value, dict):
        raise InvalidInputError(
            f"{name} must be a dict of the fields of a {kind.__name__}, got {shown(value)}"
        )
    known = {item.name: item.default is MISSING for item in fields(kind)}
    for key in value:
        if key not in known:
            raise UnknownSettingError(f"{name}.{key}", [f"{name}.{field}" for field in known])
    required = [key for key, is_required in known.items() if is_required]
    if missing := [f"{name}.{key}" for key in required if key not in value]:
        raise InvalidInputError(
            f"{', '.join(missing)} must be given: the dict of a {kind.__name__} needs them"
        )
    return kind(**{key: _field(key, item, f"{name}.{key}") for key, item in value.items()})


def _field(key: str, value: Any, name: str) -> Any:
    if key in _UNLIMITED and value is None:
        return _UNLIMITED[key]
    if key in _SINGLE and value is not None:
        return _build(_SINGLE[key], value, name)
    if key == "file" and not isinstance(value, str):
        raise InvalidInputError(f"{name} must be the path of a mesh, got {shown(value)}")
    if key not in _LISTS:
        return value
    if not isinstance(value, list | tuple):
        raise InvalidInputError(f"{name} must be a list of dicts, got {shown(value)}")
    kind = _LISTS[key]
    return tuple(_build(kind, item, f"{name}[{index}]") for index, item in enumerate(value))
