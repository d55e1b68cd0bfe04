"""`EnvConfig`: all settings of the environment, from keywords, dicts and JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env.config.randomize import RANDOMIZE, draw
from grasp_env.config.records import (
    AgentSettings,
    ControllerSettings,
    EpisodeLimits,
    MotorSettings,
    PictureSettings,
    RewardSettings,
    SensorSettings,
    SolverSettings,
)
from grasp_env.errors import InvalidInputError, UnknownSettingError, shown
from grasp_env.inputs.arguments import AllFaults, as_array, warn
from grasp_env.settings import (
    ANY,
    About,
    Kind,
    Settings,
    described,
    numbers,
    one_of,
    record,
    setting,
    to_json,
    without_json,
    written,
)
from grasp_env.sim.engine import ENGINE, EngineSettings, engine_of
from grasp_env.sim.grasping.approach import DIRECTIONS, as_approach
from grasp_env.sim.grasping.pads import PATCH_RADIUS, SOFT_PAIR, with_soft_contacts
from grasp_env.sim.grasping.record import HandGrasp, hand_grasp_of
from grasp_env.sim.hand.description import HANDS, HandDescription
from grasp_env.sim.hand.plain import hand_of, hand_to_plain, is_built_in
from grasp_env.sim.objects.description import ObjectDescription
from grasp_env.task.disturbance import DISTURBANCE, Disturbance, NoDisturbance
from grasp_env.task.tasks import TASK, Hold, Task

SCHEMA = 1
"""Version of the JSON of an `EnvConfig`."""
KEYWORDS = {
    "shape": "object.shape",
    "size": "object.size",
    "mass": "object.mass",
    "friction": "object.friction",
    "method": "solver.method",
    "initial_force": "solver.initial_force",
    "duration": "limits.duration",
    "action_mode": "agent.action_mode",
    "observation": "agent.observation",
}
"""The plain keywords of `gym.make`, and the setting that each one sets."""
MEANT = {
    "wrench": ("disturbance", "sensors.wrench"),
    "render_size": ("pictures.size",),
    "render_force": ("pictures.force",),
    "render_moment": ("pictures.moment",),
}
"""Keywords that users try, and the settings that they mean."""
_MAX_TICKS = 1_000_000
"""Largest number of control ticks of an episode; its plan takes 0.7 kB per tick."""


def _contact_points(value: Any, name: str) -> tuple[tuple[float, ...], ...]:
    points = as_array(value, None, name, ANY)
    return tuple(map(tuple, as_array(points, (None, 3), name).tolist())) if points.size else ()


def _written_hand(value: Any, name: str) -> Any:
    if isinstance(value, HandDescription):
        if type(value) is not HandDescription:  # it would be read as another class
            raise without_json(value, name)
        return hand_to_plain(value)
    return to_json(value, name)


_HANDS = one_of(
    HANDS,
    "a HandDescription, such as HandDescription.from_file('my_hand.urdf')",
    lambda value: isinstance(value, HandDescription),
)
HAND = Kind(
    lambda value, name: (
        hand_of(value, name) if isinstance(value, dict) else _HANDS.take(value, name)
    ),
    f"{_HANDS.text}, or the dict of its fields",
    write=_written_hand,
)
"""Kind of a setting that holds a hand."""


def _hand_grasp(value: Any, name: str) -> HandGrasp:
    if isinstance(value, HandGrasp):
        return value
    if isinstance(value, dict):
        return hand_grasp_of(value, name)
    if not isinstance(value, str | os.PathLike):
        raise InvalidInputError(
            f"{name} must be a HandGrasp, its dict, or the path of its file, got {shown(value)}"
        )
    return HandGrasp.load(Path(value))


def _written_grasp(value: Any, name: str) -> Any:
    return value.to_dict() if isinstance(value, HandGrasp) else to_json(value, name)


@dataclass(frozen=True)
class EnvConfig(Settings):
    """Settings of `FourFingerGrasp-v0`.

    Every field is a keyword of `gym.make`, as a record or as a dict of its settings.

    Raises:
        UnknownNameError: a task, shape, ... of no such name; the message lists those that exist.
        InvalidInputError: values out of range; the message lists all of them with their paths, such
            as `sensors.delay`.

    Example:
        >>> config = EnvConfig(task={"name": "move", "motion": "lift"}, sensors=SensorSettings(delay=0.004))
        >>> config.override(friction=0.8, sensors={"pose_noise": 1e-5}).sensors.delay
        0.004
        >>> as_config(config.to_json()) == config
        True
    """

    hand: str | HandDescription = setting(
        "four_finger", HAND, "The hand. If not `placed`, `place_hand` puts it around the object."
    )
    object: ObjectDescription = setting(
        ObjectDescription(),
        record(ObjectDescription),
        "The object to hold. For two fingers without `torsional_friction`, soft pads of 12 mm radius are assumed, with a warning.",
    )
    approach: str | tuple[float, float, float] | None = setting(
        None,
        Kind(as_approach, f"{', '.join(f'`{name}`' for name in DIRECTIONS)}, or 3 numbers"),
        "Direction from the palm to the object, world frame, for a hand that is placed around it; met within 30 degrees.",
        none="any",
    )
    contact_points: tuple[tuple[float, float, float], ...] = setting(
        (),
        Kind(_contact_points, "(N, 3)"),
        "Contact points of the tips on the object's surface, object frame, in the hand's order; (): chosen automatically.",
        unit="m",
    )
    grasp: HandGrasp | None = setting(
        None,
        Kind(
            _hand_grasp,
            "HandGrasp, or the path of its file",
            write=_written_grasp,
        ),
        "How the hand holds the object, in place of `hand`, `approach` and `contact_points`: from `place_hand`, from another "
        "environment's `env.unwrapped.grasp`, or the file of one.",
        none="searched for",
    )
    randomize: tuple[tuple[str, Any], ...] = setting(
        (),
        RANDOMIZE,
        "Settings drawn at each reset: names of the object's settings, or a dict from paths to (low, high) or to functions of the "
        "episode's generator.",
    )
    task: Task = setting(Hold(), TASK, "Task of an episode.")
    disturbance: Disturbance | None = setting(
        None,
        DISTURBANCE,
        "Disturbance of the object, besides gravity: a record, its name, or any function, see `grasp_env.task.Disturbance`.",
        none="the task's own",
    )
    gravity: tuple[float, float, float] = setting(
        (0.0, -9.81, 0.0), numbers(3), "World frame; y points up.", unit="m/s^2", random=True
    )
    engine: EngineSettings | None = setting(
        None, ENGINE, "Physics engine: its name, or its settings.", none="the default engine"
    )
    sensors: SensorSettings = setting(
        SensorSettings(), record(SensorSettings), "Sensors of the controller."
    )
    solver: SolverSettings = setting(
        SolverSettings(), record(SolverSettings), "Force optimisation."
    )
    controller: ControllerSettings = setting(
        ControllerSettings(), record(ControllerSettings), "Controller: from forces to torques."
    )
    motors: MotorSettings = setting(
        MotorSettings(), record(MotorSettings), "Motors and their errors."
    )
    agent: AgentSettings = setting(
        AgentSettings(), record(AgentSettings), "Actions and observations of an agent."
    )
    reward: RewardSettings = setting(RewardSettings(), record(RewardSettings), "Reward of a step.")
    limits: EpisodeLimits = setting(
        EpisodeLimits(), record(EpisodeLimits), "Limits that end an episode."
    )
    pictures: PictureSettings = setting(
        PictureSettings(), record(PictureSettings), "Pictures that `render` draws."
    )

    def agree(self) -> None:
        """Check settings against each other."""
        rates = (
            ("agent.rate", self.agent.rate),
            ("controller.rate", self.controller.rate),
            ("engine.rate", engine_of(self.engine, quiet=True).rate),
        )
        for (slow, low), (fast, high) in pairwise(rates):
            if high < low or high % low:
                raise InvalidInputError(
                    f"{fast} must be a multiple of {slow}, got {high} and {low}"
                )
        for name, seconds in (
            ("limits.duration", self.limits.duration or 0.0),
            ("sensors.delay", self.sensors.delay),
        ):
            if seconds * self.controller.rate > _MAX_TICKS:
                raise InvalidInputError(
                    f"{name} must be at most {_MAX_TICKS / self.controller.rate:g} s, {_MAX_TICKS} control ticks, got "
                    f"{seconds} s: make episodes shorter, or lower controller.rate"
                )
        resized = dict(self.randomize).keys() & {"object.shape", "object.size"}
        if resized and self.object.shape == "mesh":
            raise InvalidInputError(
                "a mesh keeps its shape and size: use randomize=('mass', 'friction'), or another object.shape"
            )
        if resized and (self.contact_points or self.grasp is not None):
            raise InvalidInputError(
                "contact_points and grasp belong to one shape and size: leave them out if these are randomised"
            )
        if self.grasp is not None and (
            self.hand != EnvConfig.hand or self.approach is not None or self.contact_points
        ):
            raise InvalidInputError(
                "grasp has a hand and its contact points: leave hand, approach and contact_points out"
            )
        if self.approach is not None and self.pose_is_given:
            reason = (
                "contact_points are given" if self.contact_points else "the hand is placed already"
            )
            raise InvalidInputError(
                f"approach={shown(self.approach)} is for a hand that is put around the object, and {reason}: leave one of them out"
            )
        if self.task.pushes and not isinstance(self.disturbance, NoDisturbance | None):
            raise InvalidInputError(
                f"task {self.task.name!r} pushes by itself, got disturbance={shown(self.disturbance)}: leave it out, or use task 'hold'"
            )

    def override(self, **settings: Any) -> EnvConfig:
        """Return a copy with some settings replaced.

        Args:
            **settings: fields, keywords of `KEYWORDS`, or paths, `**{"sensors.delay": 0.01}`. A
                dict changes some settings of a record; with a "name" it makes a new one.

        Raises:
            UnknownSettingError: no setting of that name; also a TypeError.
            UnknownNameError: no task, shape, ... of that name.
            InvalidInputError: invalid values; the message lists all of them with their paths.
        """
        kinds = {item.name: all_settings()[item.name].kind for item in fields(self)}
        values: dict[str, Any] = {}
        changes: dict[str, dict[str, Any]] = {}
        for name, value in settings.items():
            field, _, inner = KEYWORDS.get(name, name).partition(".")
            if field not in kinds:
                raise UnknownSettingError(name, (*kinds, *KEYWORDS), _similar(name))
            if inner:
                changes.setdefault(field, {})[inner] = value
            elif (
                isinstance(value, dict)
                and "name" not in value
                and isinstance(getattr(self, field), Settings)
            ):
                changes.setdefault(field, {}).update(value)
            else:
                values[field] = value

        def changed(field: str) -> Settings:
            value = values.get(field, getattr(self, field))
            base = None if value is None else kinds[field].take(value, field)
            if not isinstance(base, Settings):
                raise InvalidInputError(
                    f"{field} is {shown(value)}, which has no {', '.join(changes[field])}: give {field} a name, too, {{'name': ..., ...}}"
                )
            return base.replaced(changes[field], field)

        with AllFaults() as check:
            records = {field: check(changed, field) for field in changes}
        return replace(self, **values | records)

    def resolved(self) -> EnvConfig:
        """Return a copy with the defaults of the task, the engine and two fingers filled in.

        Warns:
            GraspWarning: the torsional friction assumed for two fingers.
        """
        task, limits = self.task, self.limits
        defaults = {
            name: getattr(task, name)
            for name in ("duration", "max_drift", "max_tilt")
            if getattr(limits, name) is None
        }
        if limits.end_at_fault is None:
            defaults["end_at_fault"] = self.agent.sets_forces
        item = with_soft_contacts(self.object, self.hand_description)
        if item is not self.object:
            warn(
                f"two fingers hold with soft contacts: assumed is torsional_friction={item.torsional_friction:.3g} m, 2/3 of friction "
                f"{item.friction:g} times the {1e3 * PATCH_RADIUS:g} mm radius of a soft pad; give the true one as "
                "object={'torsional_friction': ...}"
            )
        return replace(
            self,
            engine=engine_of(self.engine),
            object=item,
            agent=replace(self.agent, action_mode=self.action_mode),
            disturbance=task.disturbance if self.disturbance is None else self.disturbance,
            limits=replace(limits, **defaults),
        )

    def drawn(self, rng: np.random.Generator) -> EnvConfig:
        """Return the settings of one episode, with the randomised ones drawn from its generator.

        Raises:
            GraspError: a function fails, or returns an invalid value.

        Example:
            >>> config = EnvConfig(randomize={"mass": (0.1, 0.2), "sensors.delay": lambda rng: rng.choice([0.0, 0.004])})
            >>> episode = config.drawn(np.random.default_rng(0))
            >>> round(episode.object.mass, 3), episode.sensors.delay
            (0.102, 0.004)
        """
        return self.override(**draw(dict(self.randomize), self.object.shape, rng))

    @property
    def action_mode(self) -> str:
        """The mode of the agent's actions; by default a start, with two fingers the grip."""
        # two fingers have soft contacts: Newton optimises, which hardly depends on its start
        usual = "grip" if self.hand_description.finger_count == SOFT_PAIR else "initial_force"
        return self.agent.action_mode or usual

    @property
    def pose_is_given(self) -> bool:
        """True if the hand stays where it is: contact points are given, or a place of the hand."""
        hand = self.hand_description
        given = self.grasp is not None or bool(self.contact_points)
        return given or (hand.placed and not is_built_in(hand))

    @property
    def hand_description(self) -> HandDescription:
        """The hand's description, also if the setting is a name or a grasp is given."""
        if self.grasp is not None:
            return self.grasp.hand
        return self.hand if isinstance(self.hand, HandDescription) else HANDS[self.hand]()

    def to_dict(self) -> dict[str, Any]:
        """Return all settings as JSON values, with the version of the schema, for `as_config`.

        Raises:
            InvalidInputError: a function or a record of your own class, which have no JSON.
        """
        return {"schema": SCHEMA, **to_json(self)}

    def to_json(self) -> str:
        """Return `to_dict()` as text."""
        return json.dumps(self.to_dict(), indent=2)


def as_config(config: EnvConfig | dict[str, Any] | str | None) -> EnvConfig:
    """Return settings, their `to_dict()` or their `to_json()` as a record; None: the defaults.

    Settings that are missing have their defaults.

    Raises:
        InvalidInputError: not settings, or another schema; also the errors of `override`.

    Example:
        >>> as_config({"schema": 1, "sensors": {"delay": 0.004}}).sensors.delay
        0.004
    """
    if config is None or isinstance(config, EnvConfig):
        return EnvConfig() if config is None else config
    values: Any = config
    if isinstance(values, str):
        try:
            values = json.loads(values)
        except (ValueError, RecursionError) as error:
            raise InvalidInputError(f"config must be JSON: {error}, got {shown(values)}") from None
    schema = values.get("schema") if isinstance(values, dict) else None
    if type(schema) is not int:
        raise InvalidInputError(
            f'config must be an EnvConfig, or a dict or JSON with "schema": {SCHEMA}, got {shown(values)}; give single settings as keywords'
        )
    if schema != SCHEMA:
        newer = "written by a newer version: install that one" if schema > SCHEMA else "too old"
        raise InvalidInputError(
            f"config has schema {schema}, this version reads {SCHEMA}: it is {newer}"
        )
    return EnvConfig().override(
        **{str(name): value for name, value in values.items() if name != "schema"}
    )


def keywords_to_json(kwargs: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return keywords of `gym.make` as JSON values, and why some have no JSON.

    Records come first, since as dicts they would undo earlier keywords of their settings.
    """
    kinds = {item.name: all_settings()[item.name].kind for item in fields(EnvConfig)}
    keywords = dict[str, Any]()
    faults = list[str]()
    for name, value in sorted(kwargs.items(), key=lambda item: not isinstance(item[1], Settings)):
        keywords[name] = value
        try:
            if name == "config":
                keywords[name], more = _config_to_json(value)
                faults += more
            elif name in kinds:
                keywords[name] = written(kinds[name], value, name)
            elif name in KEYWORDS or name.partition(".")[0] in kinds:
                keywords[name] = to_json(value, name)
        except InvalidInputError as fault:
            faults.append(str(fault))
    return keywords, faults


def _config_to_json(value: Any) -> tuple[Any, list[str]]:
    if isinstance(value, dict):
        return keywords_to_json(value)
    return (value.to_dict() if isinstance(value, EnvConfig) else to_json(value, "config")), []


@cache
def all_settings() -> dict[str, About]:
    """Return the description of every setting by its path; the first of those that share one.

    Example:
        >>> about = all_settings()["sensors.delay"]
        >>> about.default, about.unit, about.kind.text
        (0.0, 's', '>= 0')
    """
    settings = dict[str, About]()
    for path, _, about in described(EnvConfig):
        settings.setdefault(path, about)
    return settings


def _similar(name: str) -> list[str]:
    """Return settings with the same last part as an unknown name, or else with a similar path."""
    if name in MEANT:
        return list(MEANT[name])
    words = {path.replace(".", "_"): path for path in (*all_settings(), *KEYWORDS)}
    same = [path for path in all_settings() if path.rpartition(".")[2] == name]
    return same or [words[match] for match in get_close_matches(name, words, 3, 0.6)]
