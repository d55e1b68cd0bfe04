"""Physics engines by name, and their settings."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, ClassVar

from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs.arguments import as_array
from grasp_env.inputs.extras import need
from grasp_env.inputs.ranges import Range
from grasp_env.settings import Kind, Settings, any_of, integer, one_of, real, setting

_POSITIVE = Range(1e-12, 1e9)
_MAX_SWEEPS = 100_000
_RATE = "Steps per simulated second; a multiple of `controller.rate`."


@dataclass(frozen=True)
class EngineSettings(Settings):
    """Settings of a physics engine."""

    extra: ClassVar[str] = "sim"  # of `pyproject.toml`, which installs the engine
    simulator: ClassVar[tuple[str, str]] = ("", "")  # module and class that implement `Simulator`
    painter: ClassVar[tuple[str, str]] = ("", "")  # module and class that implement `Painter`
    overlap: ClassVar[float] = 1e-5
    """Depth at which tips without clearance start in the object [m]; see `SceneConfig`."""

    rate: int = setting(250, integer(1), _RATE, unit="Hz")


@dataclass(frozen=True)
class BulletEngine(EngineSettings):
    """PyBullet.

    Example:
        >>> BulletEngine(solver_iterations=50).rate
        250
    """

    name: ClassVar[str] = "bullet"
    simulator: ClassVar[tuple[str, str]] = ("grasp_env.sim.bullet", "Bullet")
    painter: ClassVar[tuple[str, str]] = ("grasp_env.sim.picture.bullet", "BulletPainter")

    solver_iterations: int = setting(
        20,
        integer(1, _MAX_SWEEPS),
        "Sweeps of the contact solver in one step; at least 40 if a finger has more than three joints, 60 if contacts are "
        "soft, 800 if a finger has fewer than three motors, and as many as leave a thousandth of the error of sticking contacts, "
        "up to 2000.",
    )
    mesh_contacts: str | None = setting(
        None,
        one_of(("pieces", "faces")),
        "Collision shape of an object's mesh: its convex pieces, or its faces, which are exact and make a step 3 to 20 times as long.",
        none="the pieces; the faces of a mesh whose pieces stand out by more than a tenth of its size",
    )


def _impedance(value: Any, name: str) -> tuple[float, ...]:
    least, greatest, width, middle, power = as_array(value, (5,), name).tolist()
    if not (
        0.0 < least <= greatest < 1.0 and width > 0.0 and 0.0 <= middle <= 1.0 and power >= 1.0
    ):
        raise InvalidInputError(
            f"{name} must be (least, greatest, overlap [m], middle, power) with 0 < least <= greatest < 1, overlap above 0, middle "
            f"in [0, 1] and power >= 1, got {shown(value)}"
        )
    return least, greatest, width, middle, power


@dataclass(frozen=True)
class MujocoEngine(EngineSettings):
    """MuJoCo, as stiff as the time step allows.

    Its contacts are springs; its manual describes them under `solref` and `solimp`.

    Example:
        >>> MujocoEngine(cone="pyramidal").rate
        1000
    """

    name: ClassVar[str] = "mujoco"
    extra: ClassVar[str] = "mujoco"
    simulator: ClassVar[tuple[str, str]] = ("grasp_env.sim.mujoco", "Mujoco")
    painter: ClassVar[tuple[str, str]] = ("grasp_env.sim.picture.mujoco", "MujocoPainter")

    rate: int = setting(1000, integer(1), _RATE, unit="Hz")
    cone: str = setting(
        "elliptic",
        one_of(("elliptic", "pyramidal")),
        "Friction cones; a pyramidal one is an inner approximation with four sides, eight if contacts are soft, and slips below "
        "the given friction.",
    )
    impratio: float = setting(
        10.0, real(_POSITIVE), "Ratio of the stiffness of friction to that of the normal force."
    )
    integrator: str = setting(
        "implicitfast", one_of(("implicitfast", "implicit", "Euler")), "Integrator of MuJoCo."
    )
    time_constant: float = setting(
        0.0,
        real(Range(0.0, 1.0)),
        "Time constant of overlaps; 0 for two steps, the smallest stable value.",
        unit="s",
    )
    damping_ratio: float = setting(1.0, real(_POSITIVE), "Damping ratio of overlaps.")
    impedance: tuple[float, ...] = setting(
        (0.99, 0.999, 1e-4, 0.5, 2.0),
        Kind(_impedance, "5 numbers"),
        "Impedance of a contact: least, greatest, overlap [m] over which it changes between them, midpoint and power.",
    )
    noslip_iterations: int = setting(
        0, integer(0, _MAX_SWEEPS), "Additional sweeps that remove the creep of friction."
    )
    solver_iterations: int = setting(
        200, integer(1, _MAX_SWEEPS), "Largest number of Newton iterations in one step."
    )
    tolerance: float = setting(1e-12, real(_POSITIVE), "Tolerance of the Newton method.")


ENGINES: dict[str, type[EngineSettings]] = {
    engine.name: engine for engine in (BulletEngine, MujocoEngine)
}
"""Every engine. To add one, write its settings class here and the modules that the class names."""
ENGINE = any_of(
    ENGINES, EngineSettings, ", or give its settings, BulletEngine(...) or MujocoEngine(...)"
)
"""Kind of a setting that holds an engine."""


def engine_of(engine: Any = None, quiet: bool = False) -> EngineSettings:
    """Return the settings of an engine.

    Args:
        engine: Settings, a name in `ENGINES`, or None: PyBullet if it is installed, otherwise
            MuJoCo.
        quiet: Do not log that MuJoCo is the default; otherwise it is logged once in a process.

    Raises:
        UnknownNameError: No engine has that name.

    Example:
        >>> engine_of("bullet").solver_iterations
        20
    """
    if engine is not None:
        return ENGINE.take(engine, "engine")
    if find_spec("pybullet") is not None:
        return BulletEngine()
    if not quiet:
        _log_mujoco()
    return MujocoEngine()


def class_of(engine: EngineSettings, role: str) -> Any:
    """Import the class of an engine's "simulator" or "painter".

    Raises:
        MissingExtraError: The engine is not installed.
    """
    module, name = getattr(engine, role)
    with need(engine.extra):
        return getattr(import_module(module), name)


@cache
def _log_mujoco() -> None:
    # no warning, which `python -W error` would turn into an error
    logging.getLogger(__name__).warning(
        "pybullet is not installed, so the default engine is MuJoCo"
    )
