"""Check the values that a caller gives for a hand in a file: palm, fingertips, torques, ranges and
masses. Each overrides the file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np

from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs.arguments import AllFaults, as_number, flag
from grasp_env.sim.hand.check import Vector3, limits, numbers, positive, word
from grasp_env.sim.hand.files.elements import names_of
from grasp_env.sim.hand.inertia import Inertia, inertia_of
from grasp_env.sim.hand.tips import Ball

T = TypeVar("T")


class Inertial(NamedTuple):
    """Mass [kg], centre of mass [m], link frame, and inertia about it [kg m^2] of a link with
    everything fixed to it.
    """

    mass: float
    center: Vector3
    inertia: Inertia


@dataclass(frozen=True)
class HandOptions:
    """Values that a caller gives for a hand; `HandDescription.from_file` describes each."""

    fingertips: Any = None
    tip_radius: float | None = None
    torque_limit: Any = None
    joint_limits: Any = None
    inertials: Any = None
    palm: str | None = None
    rotor_inertia: float | None = None
    xacro: Any = None
    xacro_args: Any = None

    def checked_palm(self) -> str | None:
        """Return the name of the palm's link; None: not given."""
        return None if self.palm is None else word(self.palm, "palm")

    def radius(self) -> float | None:
        """Return the radius of tips without a sphere [m]; None: not given."""
        return None if self.tip_radius is None else positive(self.tip_radius, "tip_radius [m]")

    def expansion(self) -> tuple[bool | None, dict[str, str]]:
        """Return whether the file is expanded by xacro, None: by its name, and the arguments' texts
        by name.
        """
        given = {} if self.xacro_args is None else self.xacro_args
        if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
            raise InvalidInputError(
                f"xacro_args={shown(given)} must be a dict from names of arguments to their values"
            )
        with AllFaults() as check:
            texts = {
                str(name): check(_argument, value, f"xacro_args of {name!r}")
                for name, value in given.items()
            }
            return None if self.xacro is None else check(flag, self.xacro, "xacro"), texts

    def tips(self) -> dict[str, Ball | None] | None:
        """Return the fingertips by the names of their links, each with its sphere or None; None:
        not given.
        """
        if (given := self.fingertips) is None:
            return None
        names = list(given) if isinstance(given, dict | list | tuple) else []
        pairs = list(given.values()) if isinstance(given, dict) else []
        paired = all(isinstance(pair, list | tuple) and len(pair) == 2 for pair in pairs)
        if not names or not paired or not all(isinstance(name, str) for name in names):
            raise InvalidInputError(
                f"fingertips={shown(given)} must be a list of one link name or more, or {{link: (point, radius)}} [m]"
            )
        tips = dict[str, Ball | None].fromkeys(map(str, names))
        if len(tips) < len(names):
            twice = max(names, key=names.count)
            raise InvalidInputError(f"two fingertips are called {twice!r}; give each its own link")
        for name, pair in zip(tips, pairs, strict=False):
            x, y, z = numbers(pair[0], 3, f"fingertips: point [m] of {name!r}")
            tips[name] = Ball((x, y, z), positive(pair[1], f"fingertips: radius [m] of {name!r}"))
        return tips

    def torques(self, joints: Sequence[str], drivers: Mapping[str, str]) -> dict[str, float]:
        """Return the given torque limits [N m] by moving joint; coupled joints, whose `drivers` are
        given by joint, have none.
        """
        given = self.torque_limit
        if given is None or isinstance(given, dict):
            if idle := [name for name in dict(given or {}) if name in drivers]:
                raise InvalidInputError(
                    f"torque_limit: {names_of(idle)} have no motor of their own; give that of {names_of([drivers[name] for name in idle])}"
                )
            return _by_name(
                given,
                joints,
                "torque_limit",
                "joint",
                lambda value, of: positive(value, f"{of} [N m]"),
            )
        if not isinstance(given, list | tuple | np.ndarray):
            return dict.fromkeys(joints, positive(given, "torque_limit [N m]"))
        each = numbers(
            given, len(joints), f"torque_limit [N m], one per joint ({names_of(joints)})"
        )
        pairs = zip(joints, each, strict=True)
        with AllFaults() as check:
            return {
                name: check(positive, value, f"torque_limit [N m] of {name!r}")
                for name, value in pairs
            }

    def ranges(self, joints: Sequence[str]) -> dict[str, tuple[float, float]]:
        """Return the given ranges by joint [rad], of sliding joints [m]."""

        def both(value: Any, of: str) -> tuple[float, float]:
            if not isinstance(value, list | tuple) or len(value) != 2:
                raise InvalidInputError(f"{of}={shown(value)} must be (lower, upper)")
            return limits(value[0], value[1], of)

        return _by_name(self.joint_limits, joints, "joint_limits", "joint", both)

    def bodies(self, links: Sequence[str]) -> dict[str, float | Inertial]:
        """Return the given masses [kg], or masses with centres and inertias, by link."""

        def body(value: Any, of: str) -> float | Inertial:
            if not isinstance(value, list | tuple):
                return positive(value, f"{of}: mass [kg]")
            if len(value) != 3:
                raise InvalidInputError(
                    f"{of}={shown(value)} must be a mass [kg], or (mass, center, inertia)"
                )
            x, y, z = numbers(value[1], 3, f"{of}: center [m]")
            return Inertial(
                positive(value[0], f"{of}: mass [kg]"), (x, y, z), inertia_of(value[2], of)
            )

        return _by_name(self.inertials, links, "inertials", "moving link", body)


def _argument(value: Any, what: str) -> str:
    """Return the text of a xacro argument; numbers, True and False are written as Python writes
    them.
    """
    if isinstance(value, str):
        return value
    if isinstance(value, bool | np.bool_):
        return str(bool(value))
    if isinstance(value, int):
        return str(value)
    found = as_number(value)
    if found is None:
        raise InvalidInputError(f"{what}={shown(value)} must be text, a number, True or False")
    return str(found)


def _by_name(
    given: Any, names: Sequence[str], what: str, kind: str, check: Callable[[Any, str], T]
) -> dict[str, T]:
    """Return values by name, each checked by `check`, which gets the value and its description."""
    if given is None:
        return {}
    if not isinstance(given, dict):
        raise InvalidInputError(
            f"{what}={shown(given)} must be a dict with names of {kind}s as keys"
        )
    unknown = [name for name in given if name not in names]
    if unknown:
        raise InvalidInputError(
            f"{what}: no {kind} is called {names_of(unknown)}; {kind}s are {names_of(names)}"
        )
    with AllFaults() as faults:
        return {
            str(name): faults(check, value, f"{what} of {str(name)!r}")
            for name, value in given.items()
        }
