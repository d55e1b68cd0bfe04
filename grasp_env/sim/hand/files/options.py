"""Check the values that a caller gives for a hand in a file; each overrides the file."""

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
_UNITS = "[N m, of sliding joints N]"


class Inertial(NamedTuple):
    """Mass [kg], centre [m] and inertia about it [kg m^2] of a link with everything fixed to it."""

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
        """Return the name of the palm's link, if given."""
        return None if self.palm is None else word(self.palm, "palm")

    def radius(self) -> float | None:
        """Return the radius of tips without a sphere [m], if given."""
        return None if self.tip_radius is None else positive(self.tip_radius, "tip_radius [m]")

    def expansion(self) -> tuple[bool | None, dict[str, str]]:
        """Return whether xacro expands the file (None: by its name), and xacro's arguments."""
        values = {} if self.xacro_args is None else self.xacro_args
        if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
            raise InvalidInputError(
                f"xacro_args={shown(values)} must be a dict from names of arguments to their values"
            )
        with AllFaults() as check:
            texts = {
                str(name): check(_argument, value, f"xacro_args of {name!r}")
                for name, value in values.items()
            }
            return None if self.xacro is None else check(flag, self.xacro, "xacro"), texts

    def tips(self) -> dict[str, Ball | None] | None:
        """Return the sphere, or None, of each fingertip by its link; None: no tips are given."""
        tips = self.fingertips
        if tips is None:
            return None
        names = list(tips) if isinstance(tips, dict | list | tuple) else []
        pairs = list(tips.values()) if isinstance(tips, dict) else []
        paired = all(isinstance(pair, list | tuple) and len(pair) == 2 for pair in pairs)
        if not names or not paired or not all(isinstance(name, str) for name in names):
            raise InvalidInputError(
                f"fingertips={shown(tips)} must be a list of one link name or more, or {{link: (point, radius)}} [m]"
            )
        balls = dict[str, Ball | None].fromkeys(map(str, names))
        if len(balls) < len(names):
            twice = max(names, key=names.count)
            raise InvalidInputError(f"two fingertips are called {twice!r}; give each its own link")
        for name, (point, radius) in zip(balls, pairs, strict=False):
            x, y, z = numbers(point, 3, f"fingertips: point [m] of {name!r}")
            balls[name] = Ball((x, y, z), positive(radius, f"fingertips: radius [m] of {name!r}"))
        return balls

    def torques(self, joints: Sequence[str], drivers: Mapping[str, str]) -> dict[str, float]:
        """Return the given torque limits [N m], or [N] of sliding joints, by moving joint.

        `drivers` names the driver of each coupled joint, which has no limit of its own.
        """
        torques = self.torque_limit
        if torques is None or isinstance(torques, dict):
            if coupled := [name for name in torques or () if name in drivers]:
                raise InvalidInputError(
                    f"torque_limit: {names_of(coupled)} have no motor of their own; give that of {names_of([drivers[name] for name in coupled])}"
                )
            return _by_name(
                torques,
                joints,
                "torque_limit",
                "joint",
                lambda value, what: positive(value, f"{what} {_UNITS}"),
            )
        if not isinstance(torques, list | tuple | np.ndarray):
            return dict.fromkeys(joints, positive(torques, f"torque_limit {_UNITS}"))
        values = numbers(
            torques, len(joints), f"torque_limit {_UNITS}, one per joint ({names_of(joints)})"
        )
        with AllFaults() as check:
            return {
                name: check(positive, value, f"torque_limit {_UNITS} of {name!r}")
                for name, value in zip(joints, values, strict=True)
            }

    def ranges(self, joints: Sequence[str]) -> dict[str, tuple[float, float]]:
        """Return the given ranges by joint [rad], of sliding joints [m]."""

        def checked(value: Any, what: str) -> tuple[float, float]:
            if not isinstance(value, list | tuple) or len(value) != 2:
                raise InvalidInputError(f"{what}={shown(value)} must be (lower, upper)")
            return limits(value[0], value[1], what)

        return _by_name(self.joint_limits, joints, "joint_limits", "joint", checked)

    def bodies(self, links: Sequence[str]) -> dict[str, float | Inertial]:
        """Return the given masses [kg], or whole inertials, by link."""

        def checked(value: Any, what: str) -> float | Inertial:
            if not isinstance(value, list | tuple):
                return positive(value, f"{what}: mass [kg]")
            if len(value) != 3:
                raise InvalidInputError(
                    f"{what}={shown(value)} must be a mass [kg], or (mass, center, inertia)"
                )
            mass, center, inertia = value
            x, y, z = numbers(center, 3, f"{what}: center [m]")
            mass = positive(mass, f"{what}: mass [kg]")
            return Inertial(mass, (x, y, z), inertia_of(inertia, what))

        return _by_name(self.inertials, links, "inertials", "moving link", checked)


def _argument(value: Any, what: str) -> str:
    """Return the text of a xacro argument; numbers and bools as Python writes them."""
    if isinstance(value, str):
        return value
    if isinstance(value, bool | np.bool_):
        return str(bool(value))
    number = value if isinstance(value, int) else as_number(value)
    if number is None:
        raise InvalidInputError(f"{what}={shown(value)} must be text, a number, True or False")
    return str(number)


def _by_name(
    values: Any, names: Sequence[str], what: str, kind: str, check: Callable[[Any, str], T]
) -> dict[str, T]:
    """Return values by name, each checked by `check`, which gets the value and its description."""
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise InvalidInputError(
            f"{what}={shown(values)} must be a dict with names of {kind}s as keys"
        )
    unknown = [name for name in values if name not in names]
    if unknown:
        raise InvalidInputError(
            f"{what}: no {kind} is called {names_of(unknown)}; {kind}s are {names_of(names)}"
        )
    with AllFaults() as faults:
        return {
            str(name): faults(check, value, f"{what} of {str(name)!r}")
            for name, value in values.items()
        }
