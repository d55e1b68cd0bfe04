"""What is drawn anew at each reset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from grasp_env._check import as_array, as_list, as_text, choice, is_a
from grasp_env.config.records import Controller, Sensors
from grasp_env.errors import GraspError, InvalidInputError, shown
from grasp_env.settings import Kind, described
from grasp_env.sim.objects.description import ObjectDescription, random_object

OBJECT: dict[str, Any] = {
    "object.shape": True,
    "object.size": (0.07, 0.12),
    "object.mass": (0.05, 0.5),
    "object.friction": (0.3, 0.8),
}
"""What of the object may be drawn, and the range where none is given; [m], [kg], [1]."""
SHORT = {path.partition(".")[2]: path for path in OBJECT}
_RECORDS = {"object": ObjectDescription, "sensors": Sensors, "controller": Controller}
RANDOM = {
    path: about.kind for name, kind in _RECORDS.items() for path, _, about in described(kind, name) if about.random
}
"""Settings that may be drawn at a reset, and what each may be; gravity besides."""
ALLOWED = (*SHORT, *RANDOM, "gravity")


def _rules(value: Any, name: str) -> tuple[tuple[str, Any], ...]:
    if is_a(value, dict):
        given = dict(value)
    else:
        named = [value] if is_a(value, str) else as_list(value)
        if named is None:
            raise InvalidInputError(
                f"{name} must be a list of some of {', '.join(SHORT)}, or a dict from paths to ranges, got {shown(value)}"
            )
        pairs = [each if is_a(each, tuple) and len(each) == 2 else (each, True) for each in named]
        given = {as_text(path) or shown(path): rule for path, rule in pairs}
    return tuple(
        (path := SHORT.get(choice(each, name, ALLOWED), each), _rule(path, rule)) for each, rule in given.items()
    )


def _rule(path: str, rule: Any) -> Any:
    """(low, high), a function, or True for a shape."""
    if callable(rule):
        return rule
    if rule is True and path in OBJECT:
        return OBJECT[path]
    if path in ("gravity", "object.shape"):
        raise InvalidInputError(
            f"randomize[{path!r}] must be a function of a generator{', or True' if path in OBJECT else ''}, got {shown(rule)}"
        )
    low, high = as_array(rule, (2,), f"randomize[{path!r}], (low, high),").tolist()
    for bound in (low, high):
        RANDOM[path].take(bound, path)
    if not low <= high or (path == "object.size" and low <= 0.0):
        raise InvalidInputError(f"randomize[{path!r}] must be (low, high) with low <= high, got {(low, high)}")
    return low, high


RANDOMIZE = Kind(_rules, "names, or dict from paths")
"""What `EnvConfig.randomize` may be; kept as pairs of path and rule."""


def draw(rules: Mapping[str, Any], base: ObjectDescription, rng: np.random.Generator) -> dict[str, Any]:
    """What an episode has instead of the settings: "object", and others by path.

    What is drawn of the object comes first, by one `random_object`, whatever of it is kept; then the others in their order.

    Args:
        rules: by path, as `EnvConfig` keeps them.
        base: the object of the settings.
        rng: generator of the episode.

    Raises:
        InvalidInputError: a function that fails, or returns what the object may not be.
    """
    made: dict[str, Any] = {"object": _object(base, rules, rng)} if rules.keys() & OBJECT.keys() else {}
    for path, rule in rules.items():
        if path not in OBJECT:
            made[path] = _called(path, rule, rng) if callable(rule) else rng.uniform(*rule)
    return made


def _object(base: ObjectDescription, rules: Mapping[str, Any], rng: np.random.Generator) -> ObjectDescription:
    own = {path.partition(".")[2]: rules[path] for path in OBJECT if callable(rules.get(path))}
    size, mass, friction = (
        rules[path] if path in rules and not callable(rules[path]) else OBJECT[path] for path in list(OBJECT)[1:]
    )
    kept = {name for name, path in SHORT.items() if path not in rules}
    if base.shape == "mesh":
        found = {"mass": float(rng.uniform(*mass)), "friction": float(rng.uniform(*friction))}
        changes = {name: value for name, value in found.items() if name not in kept}
    else:
        shapes = {}
        if "shape" in own:
            shapes = {"shapes": (_called("object.shape", own.pop("shape"), rng),)}
        elif "shape" in kept:
            shapes = {"shapes": (base.shape,)}
        made = random_object(rng, size=size, mass=mass, friction=friction, **shapes)
        changes = {name: getattr(made, name) for name in ("mass", "friction") if name not in kept}
        if made.shape != base.shape or "size" not in kept:
            changes |= {"shape": made.shape, "size": made.size, "inertia": None}
    changes |= {name: _called(f"object.{name}", rule, rng) for name, rule in own.items()}
    return base.replaced(changes, "object")


def _called(path: str, rule: Any, rng: np.random.Generator) -> Any:
    try:
        return rule(rng)
    except GraspError:
        raise
    except Exception as error:  # somebody else's
        raise InvalidInputError(
            f"randomize[{path!r}] fails with {type(error).__name__}: {str(error)[:200]}; it takes a numpy generator and returns the setting"
        ) from error
