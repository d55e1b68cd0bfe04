"""Records of settings that check themselves.

A setting is described once, at its field. The record's docstring, the page of all settings, the
help of the command line and the error messages are made from this description.

Example:
    >>> @dataclass(frozen=True)
    ... class Lamp(Settings):
    ...     '''A lamp.'''
    ...     power: float = setting(10.0, real(ranges.Range(0.0, 100.0)), "Electric power.", unit="W")
    >>> Lamp(power=5).power
    5.0
    >>> Lamp().replaced({"power": -1.0}, "hall.lamp")
    Traceback (most recent call last):
    grasp_env.errors.InvalidInputError: hall.lamp.power [W] must be a number >= 0, <= 100, got -1.0
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import Field, dataclass, field, fields, replace
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from grasp_env.errors import GraspError, InvalidInputError, UnknownSettingError, shown
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import AllFaults, as_array, as_number, choice, instance, whole
from grasp_env.inputs.ranges import Range

ANY, POSITIVE, NOT_NEGATIVE = Range(-1e9, 1e9), Range(1e-9, 1e9), Range(0.0, 1e9)
"""Ranges of settings of which only the sign is restricted; no sensible value is larger."""
S = TypeVar("S", bound="Settings")
_ABOUT = "about"
_PATH: ContextVar[str] = ContextVar("path", default="")
"""Path of the record under construction, for error messages."""


class Kind(NamedTuple):
    """The values that a setting accepts.

    Attributes:
        take: function (value, name) that returns the value to store, or raises a `GraspError` with
            the name.
        text: the accepted values in words, for the page of settings.
        records: the accepted classes, if the setting is a record.
        write: function (value, name) that returns an accepted value as JSON values, which `take`
            reads; None: `to_json`.
    """

    take: Callable[[Any, str], Any]
    text: str
    records: tuple[type[Settings], ...] = ()
    write: Callable[[Any, str], Any] | None = None


class About(NamedTuple):
    """Description of a setting; its fields are the arguments of `setting`."""

    default: Any
    kind: Kind
    doc: str
    unit: str
    none: str
    random: bool


def setting(
    default: Any, kind: Kind, doc: str, *, unit: str = "", none: str = "", random: bool = False
) -> Any:
    """Declare a field of a `Settings` record.

    Args:
        default: its default.
        kind: the accepted values.
        doc: one sentence.
        unit: the unit of its numbers.
        none: the meaning of None; if empty, None is an error.
        random: True if it may be drawn at each reset.
    """
    about = About(default, kind, f"{doc} None: {none}." if none else doc, unit, none, random)
    return field(default=default, metadata={_ABOUT: about})


@dataclass(frozen=True)
class Settings:
    """Base class of the records: every field is a `setting`; one error reports all faults.

    Attributes:
        name: name of a record that is one of several, such as the disturbance "random".
    """

    name: ClassVar[str] = ""

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        cls.__doc__ = inspect.cleandoc(vars(cls).get("__doc__") or "")
        # inherited fields, and those that `dataclass` has not processed yet
        known = {**getattr(cls, "__dataclass_fields__", {}), **vars(cls)}
        abouts = {
            name: item.metadata.get(_ABOUT)
            for name, item in known.items()
            if isinstance(item, Field)
        }
        lines = [_sentence(name, about) for name, about in abouts.items() if about]
        if lines:
            cls.__doc__ += "\n\nAttributes:\n" + "\n".join(lines)

    def __post_init__(self) -> None:
        known = [(item.name, item.metadata[_ABOUT]) for item in fields(self)]
        with AllFaults() as check:
            values = {
                name: check(_checked, about, getattr(self, name), name) for name, about in known
            }
        for name, value in values.items():
            object.__setattr__(self, name, value)
        self.agree()

    def agree(self) -> None:
        """Raise an error if checked values contradict each other."""

    def replaced(self: S, changes: Mapping[str, Any], path: str = "") -> S:
        """Return a copy with some settings replaced; `path` of the record is for error messages.

        Raises:
            UnknownSettingError: the record has no setting of that name.
            InvalidInputError: invalid values; the message lists all of them.
        """
        before = _PATH.set(path)
        try:
            known = [item.name for item in fields(self)]
            for name in changes:
                if name not in known:
                    raise UnknownSettingError(placed(str(name)), map(placed, known or ["(none)"]))
            return replace(self, **changes)
        finally:
            _PATH.reset(before)


def described(
    record: type[Settings], path: str = ""
) -> Iterator[tuple[str, type[Settings], About]]:
    """Yield path, class and description of all settings of a record at a `path`, also nested."""
    for item in fields(record):
        about = item.metadata[_ABOUT]
        here = f"{path}.{item.name}" if path else item.name
        yield here, record, about
        for inner in about.kind.records:
            yield from described(inner, here)


def real(within: Range = ANY) -> Kind:
    """A number within a range."""

    def take(value: Any, name: str) -> float:
        result = as_number(value)
        if result is None or not within.low <= result <= within.high:
            beyond = result is not None and result > within.high >= 1e9
            most = f" and up to {within.high:g}" if beyond else ""
            raise InvalidInputError(
                f"{name} must be a number {_range_text(within)}{most}, got {shown(value)}"
            )
        return result

    return Kind(take, _range_text(within))


def integer(low: int, high: int = ranges.ITERATIONS) -> Kind:
    """A whole number."""
    return Kind(lambda value, name: whole(value, name, low, high), f"integer >= {low}")


def truth() -> Kind:
    """True or False."""
    return Kind(lambda value, name: instance(value, bool, name), "True or False")


def one_of(
    names: Iterable[str], instead: str = "", fits: Callable[[Any], bool] = lambda _: False
) -> Kind:
    """One of several names, or another value that `fits`, which `instead` puts in words."""
    allowed = tuple(names)

    def take(value: Any, name: str) -> Any:
        if not isinstance(value, str) and fits(value):
            return value
        return choice(value, name, allowed, instead and f", or give {instead}")

    return Kind(take, ", ".join(f"`{name}`" for name in allowed) + (instead and f", or {instead}"))


def numbers(count: int, within: Range = ANY) -> Kind:
    """A tuple of numbers."""
    return Kind(
        lambda value, name: tuple(as_array(value, (count,), name, within).tolist()),
        f"{count} numbers, {_range_text(within)}",
    )


def record(kind: type[Settings]) -> Kind:
    """A record of this class, or a dict of its settings."""

    def take(value: Any, name: str) -> Any:
        if isinstance(value, dict):
            return kind().replaced(value, name)
        if not isinstance(value, kind):
            meant = [
                item for item in described(kind) if isinstance(value, str) and _takes(item, value)
            ]
            hint = f"; did you mean {{{meant[0][0]!r}: {value!r}}}?" if meant else ""
            raise InvalidInputError(
                f"{name} must be of class {kind.__name__}, or a dict of its settings, got {shown(value)}{hint}"
            )
        return value

    def write(value: Any, name: str) -> Any:
        return _written_record(value, name, kind)

    return Kind(take, f"{kind.__name__} or dict", (kind,), write)


def any_of(
    table: Mapping[str, type[Settings]], base: type[Settings], hint: str, calls: bool = False
) -> Kind:
    """One of several records by name, as a dict of its name and settings, or of their base class.

    `hint` ends the error message about an unknown name; `calls` accepts a function, too.
    """

    def take(value: Any, name: str) -> Any:
        if isinstance(value, base) or (calls and callable(value)):
            return value
        named = value
        settings = {}
        if isinstance(value, dict):
            if "name" not in value:
                raise InvalidInputError(
                    f"{name} needs a name, one of {', '.join(map(repr, table))}, got {shown(value)}"
                )
            named = value["name"]
            settings = {key: item for key, item in value.items() if key != "name"}
        return table[choice(named, name, table, hint)]().replaced(settings, name)

    def write(value: Any, name: str) -> Any:
        return _written_record(
            value, name, table.get(value.name) if isinstance(value, Settings) else None
        )

    text = ", ".join(f"`{name}`" for name in table)
    more = ", or a function" if calls else ""
    return Kind(take, f"{text}, {base.__name__} or dict{more}", tuple(table.values()), write)


def placed(name: str) -> str:
    """Return a setting's full path, with that of the record under construction."""
    return f"{_PATH.get()}.{name}" if _PATH.get() else name


def to_json(value: Any, path: str = "") -> Any:
    """Return settings at a `path` as JSON values by `Kind.write`, also values not yet checked.

    Raises:
        InvalidInputError: a value without JSON, such as a function.
    """
    start = path and f"{path}."
    if isinstance(value, Settings):
        values = {"name": value.name} if value.name else {}
        for item in fields(value):
            kind = item.metadata[_ABOUT].kind
            values[item.name] = written(kind, getattr(value, item.name), start + item.name)
        return values
    if isinstance(value, dict):
        return {str(key): to_json(item, f"{start}{key}") for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_json(item, path) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return to_json(value.tolist(), path)
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if value is None or isinstance(value, str | int | float | bool):
        return value
    raise without_json(value, path)


def written(kind: Kind, value: Any, path: str) -> Any:
    """Return the value of a setting at a `path` as JSON values; see `to_json`."""
    return (kind.write or to_json)(value, path)


def _written_record(value: Any, path: str, kind: type[Settings] | None) -> Any:
    """Return `to_json`; raise for a record of another class than `kind`, which reads it."""
    if isinstance(value, Settings) and type(value) is not kind:
        raise without_json(value, path)
    return to_json(value, path)


def without_json(value: Any, path: str) -> InvalidInputError:
    """Return the error that a value at a `path` has no JSON."""
    return InvalidInputError(
        f"{path} is {shown(value)}, which has no JSON: files hold built-in names only; give your own when the environment is made"
    )


def _takes(item: tuple[str, type[Settings], About], value: Any) -> bool:
    """True if a setting accepts a value."""
    path, _, about = item
    try:
        about.kind.take(value, path)
    except GraspError:
        return False
    return True


def _checked(about: About, value: Any, name: str) -> Any:
    if value is None and about.none:
        return None
    return about.kind.take(value, placed(name) + (about.unit and f" [{about.unit}]"))


def _range_text(within: Range) -> str:
    if within == ANY:
        return "of any size"
    least = "> 0" if 0.0 < within.low <= 1e-9 else f">= {within.low:g}"
    return least if within.high >= 1e9 else f"{least}, <= {within.high:g}"


def _sentence(name: str, about: About) -> str:
    allowed = " ".join(text for text in (about.kind.text, about.unit) if text)
    return f"    {name}: {about.doc} ({allowed})"
