"""Settings that are drawn at each reset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from grasp_env.config.records import ControllerSettings, MotorSettings, SensorSettings
from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs.arguments import as_array, call_user, choice
from grasp_env.settings import Kind, described, to_json
from grasp_env.sim.objects.description import SHAPES, SHAPES_WITHOUT_MESH, SIZES, ObjectDescription

OBJECT: dict[str, Any] = {
    "object.shape": True,
    "object.size": (0.07, 0.12),
    "object.mass": (0.05, 0.5),
    "object.friction": (0.3, 0.8),
}
"""Object settings that may be drawn, with their default ranges [m], [kg], [1]."""
SHORT = {path.partition(".")[2]: path for path in OBJECT}
_RECORDS = {
    "object": ObjectDescription,
    "sensors": SensorSettings,
    "controller": ControllerSettings,
    "motors": MotorSettings,
}
RANDOM = {
    path: about.kind
    for name, kind in _RECORDS.items()
    for path, _, about in described(kind, name)
    if about.random
}
"""Settings that may be drawn at a reset, and their kinds; gravity may be drawn, too."""
ALLOWED = (*SHORT, *RANDOM, "gravity")


def _checked_rules(value: Any, name: str) -> tuple[tuple[str, Any], ...]:
    entries = [value] if isinstance(value, str) else value
    if isinstance(value, dict):
        entries = list(value.items())
    if not isinstance(entries, list | tuple):
        raise InvalidInputError(
            f"{name} must be a list of some of {', '.join(SHORT)}, or a dict from paths to ranges, got {shown(value)}"
        )
    rules: dict[str, Any] = {}
    for entry in entries:
        path, rule = entry if isinstance(entry, tuple | list) and len(entry) == 2 else (entry, True)
        path = choice(path, name, ALLOWED)
        path = SHORT.get(path, path)
        rules[path] = _checked_rule(path, rule)
    return tuple(rules.items())


def _checked_rule(path: str, rule: Any) -> Any:
    """Return a rule: (low, high), a function, or True for a shape."""
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
        raise InvalidInputError(
            f"randomize[{path!r}] must be (low, high) with low <= high, got {(low, high)}"
        )
    return low, high


def _written_rules(value: Any, name: str) -> Any:
    """Return checked rules as a dict from paths, and any other value by `to_json`."""
    pairs = isinstance(value, tuple) and all(
        isinstance(entry, tuple) and len(entry) == 2 for entry in value
    )
    rules = dict(value) if pairs else value
    if not isinstance(rules, dict):
        return to_json(rules, name)
    return {str(path): to_json(rule, f"{name}[{path!r}]") for path, rule in rules.items()}


RANDOMIZE = Kind(_checked_rules, "names, or dict from paths", write=_written_rules)
"""Kind of `EnvConfig.randomize`, stored as pairs of path and rule."""


def draw(rules: Mapping[str, Any], shape: str, rng: np.random.Generator) -> dict[str, Any]:
    """Draw the settings of an episode by path, first those of an object of a `shape`.

    If one number of the object is drawn, all are drawn, used or not. The later draws then do not
    depend on which ones are used.
    """
    settings: dict[str, Any] = {}
    if rules.keys() & OBJECT.keys():
        ranges = OBJECT | {path: rule for path, rule in rules.items() if not callable(rule)}
        if shape != "mesh":
            drawn = shape
            if "object.shape" in rules:
                drawn = _draw_one("object.shape", rules["object.shape"], rng)
                drawn = choice(drawn, "object.shape", SHAPES)
            low, high = ranges["object.size"]
            sides = rng.uniform(low, high, 3).tolist()[: len(SIZES[drawn])]
            if drawn != shape or "object.size" in rules:
                size = sorted(sides) if drawn == "capsule" else sides
                settings |= {"object.shape": drawn, "object.size": size, "object.inertia": None}
        for path in ("object.mass", "object.friction"):
            value = rng.uniform(*ranges[path])
            if path in rules:
                settings[path] = value
    for path in dict.fromkeys((*OBJECT, *rules)):
        if path not in rules or path == "object.shape":
            continue
        if path not in OBJECT or callable(rules[path]):
            settings[path] = _draw_one(path, rules[path], rng)
    return settings


def _draw_one(path: str, rule: Any, rng: np.random.Generator) -> Any:
    if rule is True:
        return SHAPES_WITHOUT_MESH[int(rng.integers(len(SHAPES_WITHOUT_MESH)))]
    if not callable(rule):
        return rng.uniform(*rule)
    takes = "it takes a numpy generator and returns the setting"
    return call_user(rule, rng, what=f"randomize[{path!r}]", takes=takes)
