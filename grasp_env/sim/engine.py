"""The physics engines by name, and the settings that each has of its own."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, ClassVar

from grasp_env import ranges
from grasp_env._check import as_array, choice, is_a, number, positive, together, whole
from grasp_env._extras import need
from grasp_env.errors import InvalidInputError, shown

_CONES = ("elliptic", "pyramidal")
_INTEGRATORS = ("implicitfast", "implicit", "Euler")
_POSITIVE = ranges.Range(1e-12, 1e9)
_FACTORS = ("impratio", "damping_ratio", "tolerance")
_SMALL = ranges.Range(0.0, 1.0)
_MOST_SWEEPS = 100_000


@dataclass(frozen=True)
class Engine:
    """Settings of a physics engine; its simulator is one file behind `Simulator`, its pictures are one behind `Painter`.

    Attributes:
        name: In `ENGINES`. extra: of `pyproject.toml` that brings it. simulator, painter: module and class that run it and draw it.
        rate: [Hz] of its steps where nobody asks for another.
        overlap: [m] by which tips start inside the object without clearance: at distance zero it falls and slips for a step.
    """

    name: ClassVar[str] = ""
    extra: ClassVar[str] = "sim"
    simulator: ClassVar[tuple[str, str]] = ("", "")
    painter: ClassVar[tuple[str, str]] = ("", "")
    rate: ClassVar[int] = 250
    overlap: ClassVar[float] = 1e-5


@dataclass(frozen=True)
class BulletEngine(Engine):
    """PyBullet.

    Attributes:
        solver_iterations: Sweeps of its contact solver in one step.

    Example:
        >>> BulletEngine(solver_iterations=50).rate
        250
    """

    solver_iterations: int = 20
    name: ClassVar[str] = "bullet"
    simulator: ClassVar[tuple[str, str]] = ("grasp_env.sim.bullet", "Bullet")
    painter: ClassVar[tuple[str, str]] = ("grasp_env.sim.picture.bullet", "BulletPainter")

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "solver_iterations", whole(self.solver_iterations, "solver_iterations", 1, _MOST_SWEEPS)
        )


@dataclass(frozen=True)
class MujocoEngine(Engine):
    """MuJoCo, as stiff as its steps allow: contacts are springs there, which `solref` and `solimp` of its manual describe.

    Attributes:
        cone: "elliptic", or "pyramidal": an inner approximation with four sides, which slips at less than the friction told.
        impratio: Stiffness of friction over that of the normal force.
        integrator: "implicitfast", "implicit" or "Euler".
        time_constant: [s] in which overlaps go; 0: two steps, the least that is stable. damping_ratio: of that.
        impedance: Of a contact: least, greatest, overlap [m] between the two, their middle and power.
        noslip_iterations: Sweeps that take the creep of friction away, after the solver's.
        solver_iterations, tolerance: Of its Newton method.

    Example:
        >>> MujocoEngine(cone="pyramidal").rate
        1000
    """

    cone: str = "elliptic"
    impratio: float = 10.0
    integrator: str = "implicitfast"
    time_constant: float = 0.0
    damping_ratio: float = 1.0
    impedance: tuple[float, ...] = (0.99, 0.999, 1e-4, 0.5, 2.0)
    noslip_iterations: int = 0
    solver_iterations: int = 200
    tolerance: float = 1e-12
    name: ClassVar[str] = "mujoco"
    extra: ClassVar[str] = "mujoco"
    simulator: ClassVar[tuple[str, str]] = ("grasp_env.sim.mujoco", "Mujoco")
    painter: ClassVar[tuple[str, str]] = ("grasp_env.sim.picture.mujoco", "MujocoPainter")
    rate: ClassVar[int] = 1000

    def __post_init__(self) -> None:
        checked = together(
            lambda: ("cone", choice(self.cone, "cone", _CONES)),
            lambda: ("integrator", choice(self.integrator, "integrator", _INTEGRATORS)),
            lambda: ("impedance", _impedance(self.impedance)),
            *(lambda name=name: (name, positive(getattr(self, name), name, _POSITIVE)) for name in _FACTORS),
            lambda: ("time_constant", number(self.time_constant, "time_constant", _SMALL)),
            lambda: ("noslip_iterations", whole(self.noslip_iterations, "noslip_iterations", 0, _MOST_SWEEPS)),
            lambda: ("solver_iterations", whole(self.solver_iterations, "solver_iterations", 1, _MOST_SWEEPS)),
        )
        for name, value in checked:
            object.__setattr__(self, name, value)


def _impedance(values: Any) -> tuple[float, ...]:
    least, greatest, width, middle, power = as_array(values, (5,), "impedance").tolist()
    if not (0.0 < least <= greatest < 1.0 and width > 0.0 and 0.0 <= middle <= 1.0 and power >= 1.0):
        raise InvalidInputError(
            "impedance must be (least, greatest, overlap [m], middle, power) with 0 < least <= greatest < 1, overlap above 0, middle "
            f"in [0, 1] and power from 1 on, got {shown(values)}"
        )
    return least, greatest, width, middle, power


ENGINES: dict[str, type[Engine]] = {made.name: made for made in (BulletEngine, MujocoEngine)}
"""All there are; another one is a class here and the file that it names."""


def engine_of(engine: Any = None, quiet: bool = False) -> Engine:
    """The settings that are given, or the engine's own where only its name is.

    Args:
        engine: Settings, a name in `ENGINES`, or None: PyBullet where it is installed, otherwise MuJoCo.
        quiet: Otherwise MuJoCo by default is logged, once in a process.

    Raises:
        UnknownNameError: no engine of that name.

    Example:
        >>> engine_of("bullet").solver_iterations
        20
    """
    if is_a(engine, Engine):
        return engine
    if engine is None:
        return _default(quiet)
    return ENGINES[
        choice(engine, "engine", ENGINES, ", or give its settings, BulletEngine(...) or MujocoEngine(...)")
    ]()


def class_of(engine: Engine, role: str) -> Any:
    """The class that is an engine's "simulator" or "painter"; its module is imported here.

    Raises:
        MissingExtraError: The engine is not installed.
    """
    module, name = getattr(engine, role)
    with need(engine.extra):
        return getattr(import_module(module), name)


def _default(quiet: bool) -> Engine:
    if find_spec("pybullet") is not None:
        return BulletEngine()
    if not quiet:
        _say_mujoco()
    return MujocoEngine()


@cache
def _say_mujoco() -> None:
    """Once in a process; not a warning, which `python -W error` makes an error of."""
    logging.getLogger(__name__).warning("pybullet is not installed, so the default engine is MuJoCo")
