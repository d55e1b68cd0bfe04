"""Which episodes compare engines and hands: scenarios, engines, objects, disturbances. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from training.trials.hold_plan import ALL_ERRORS, ERRORS, RANDOM_WRENCH

ENGINES: dict[str, dict[str, Any]] = {
    "bullet": {},
    "mujoco": {"engine": "mujoco"},
    "bullet_1000": {"physics_rate": 1000},
    "pyramidal": {"engine": "mujoco", "engine_settings": {"cone": "pyramidal"}},
    "soft": {"engine": "mujoco", "engine_settings": {"time_constant": 0.02, "impedance": (0.9, 0.95, 1e-3, 0.5, 2.0), "impratio": 1.0}},
    "noslip": {"engine": "mujoco", "engine_settings": {"noslip_iterations": 20}},
}  # fmt: skip
"""Settings of the environment by name; `engine_settings` are the fields of the engine's own record."""
ENGINE_LABELS = {
    "bullet": "Bullet",
    "mujoco": "MuJoCo",
    "bullet_1000": "Bullet (physics at 1000 Hz)",
    "pyramidal": "MuJoCo (pyramidal cones)",
    "soft": "MuJoCo (contacts as soft as its default)",
    "noslip": "MuJoCo (20 sweeps against creep)",
}
BOTH = ("bullet", "mujoco")
PRESETS = ("four_finger", "allegro", "leap")
"""Hands of the comparison of engines where none are named."""
SMALL_OBJECTS: dict[str, Any] = {
    "size_range": (0.04, 0.08), "mass_range": (0.05, 0.3), "friction_range": (0.5, 1.0),
}  # fmt: skip
"""What hands of a human's size hold."""
WEAK_WRENCH: dict[str, Any] = {"disturbance": "random", "random_force": 0.6, "random_moment": 0.02, "duration": 4.0}
OBJECTS: dict[str, dict[str, Any]] = {
    "cube": {"shape": "cuboid", "size": (0.05, 0.05, 0.05), "object_mass": 0.15, "friction": 0.7},
    "sphere": {"shape": "sphere", "size": (0.06,), "object_mass": 0.15, "friction": 0.7},
    "random": SMALL_OBJECTS,
}
OBJECT_LABELS = {
    "cube": "cube of 50 mm",
    "sphere": "sphere of 60 mm",
    "random": "random objects",
}
PUSHES: dict[str, dict[str, Any]] = {
    "gravity": {"disturbance": "none", "duration": 4.0},
    "random": WEAK_WRENCH,
    "six_directions": {"task": "six_directions"},
}
PUSH_LABELS = {
    "gravity": "gravity",
    "random": "random wrench",
    "six_directions": "six pushes",
}


@dataclass(frozen=True)
class Scenario:
    """One hand under one disturbance, played in some engines with the same seeds.

    Attributes:
        name: Unique in a plan. hand: a name, or the path of a URDF. label: what it is in a table.
        engines: keys of `ENGINES`, the first the one that others are compared with.
        episodes: of each. settings: of the environment, JSON-able.
        random_objects: whether each seed draws its object.
    """

    name: str
    hand: str
    label: str
    engines: tuple[str, ...]
    episodes: int
    settings: dict[str, Any]
    random_objects: bool = True


def transfer_plan(hands: Sequence[str], episodes: int) -> list[Scenario]:
    """The same hand, object and controller in both engines; what contacts are made of is varied with the four-finger hand alone.

    Args:
        hands: names or paths of URDFs.
        episodes: of each hand's random objects under a random wrench; the other scenarios have a third.
    """
    plan: list[Scenario] = []
    for hand in hands:
        if hand != "four_finger":
            settings = {**SMALL_OBJECTS, **WEAK_WRENCH}
            plan.append(
                Scenario(
                    f"{short_name(hand)}/objects", hand, "random objects, weak random wrench", BOTH, episodes, settings
                )
            )
            continue
        more = ("bullet", "mujoco", "bullet_1000", "noslip", "pyramidal", "soft")
        safe, third = {"friction_margin": 0.6}, max(1, episodes // 3)

        def four(name: str, label: str, engines: Iterable[str], count: int, **settings: Any) -> None:
            plan.append(Scenario(f"four_finger/{name}", "four_finger", label, tuple(engines), count, settings))

        four("objects", "random objects, random wrench", BOTH, episodes, **RANDOM_WRENCH)
        four("contacts", "random wrench, contacts of other kinds", more, third, **RANDOM_WRENCH)
        four(
            "margin",
            "random wrench, friction margin 0.7",
            (*BOTH, "pyramidal", "soft"),
            third,
            **RANDOM_WRENCH,
            friction_margin=0.7,
        )
        four("six_directions", "six pushes of 10 N/kg", BOTH, third, task="six_directions")
        four("estimated", "wrench estimated", (*BOTH, "bullet_1000"), episodes, **RANDOM_WRENCH, wrench="estimated")
        wrong = {**ERRORS["friction"], **ERRORS["force"]}
        four("friction", "friction +25 %, torque noise 5 %, margin 0.6", BOTH, third, **RANDOM_WRENCH, **wrong, **safe)
        four("all", "all four errors, margin 0.6", BOTH, third, **RANDOM_WRENCH, **ALL_ERRORS, **safe)
        four("squeeze", "constant squeeze", BOTH, third, **RANDOM_WRENCH, controller="constant_squeeze")
        four("pd", "PD only", BOTH, third, **RANDOM_WRENCH, controller="pd")
    return plan


def hands_plan(hands: Sequence[str], engines: Sequence[str], episodes: int) -> list[Scenario]:
    """Hands x objects x disturbances.

    Args:
        hands: names or paths of URDFs.
        engines: keys of `ENGINES`.
        episodes: of each scenario in which something is random; where nothing is, one says it all.
    """
    return [
        Scenario(
            f"{short_name(hand)}/{item}/{push}", hand, f"{OBJECT_LABELS[item]}, {PUSH_LABELS[push]}", tuple(engines),
            1 if item != "random" and push != "random" else episodes, {**OBJECTS[item], **PUSHES[push]}, item == "random",
        )
        for hand in hands for item in OBJECTS for push in PUSHES
    ]  # fmt: skip


def short_name(hand: str) -> str:
    """Of a hand in names of files and tables: that of a URDF's file.

    Example:
        >>> short_name("/robots/leap/leap_right.urdf"), short_name("allegro")
        ('leap_right', 'allegro')
    """
    return hand.replace("\\", "/").rsplit("/", 1)[-1].removesuffix(".urdf")
