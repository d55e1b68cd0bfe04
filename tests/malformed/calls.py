"""Public calls with good arguments, each of which the tests replace by something else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env import force as f
from grasp_env import quality as q
from grasp_env.config import EnvConfig
from grasp_env.config.env import as_config
from grasp_env.env.env import FourFingerGrasp
from grasp_env.env.plan import make_plan
from grasp_env.force.initial import LinearCombination
from grasp_env.force.rules import CoreRule
from grasp_env.grasp import (
    Grasp,
    gravity_wrench,
    presets,
    save_grasp,
    transform_wrench,
    transformed,
    wrench,
    wrench_about,
)
from grasp_env.grasp.advice import advise
from grasp_env.grasp.null_space import null_space_basis, reference_basis
from grasp_env.task.disturbance import DISTURBANCES
from grasp_env.task.tasks import TASKS
from policies import LearnedInitialForce, ZeroPolicy

CUBOID = presets.paper_cuboid()
SOFT = Grasp.from_contacts(
    CUBOID.positions, CUBOID.normals, 0.4, contact_model="soft", torsional_friction=0.005
)
PAPER = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])
FORCE = np.array([[9.0, 0.0, 0.0], [3.6, 0.0, 0.0], [2.7, 0.0, 0.0], [2.7, 0.0, 0.0]])
SOLVED = f.optimize_force(CUBOID, PAPER, method="newton")
PLACE: dict[str, Any] = {
    "positions": CUBOID.positions,
    "normals": CUBOID.normals,
    "friction": CUBOID.friction,
}
JACOBIAN = 0.1 * np.random.default_rng(0).standard_normal((4, 3, 5))
LIMITED = f.ForceLimits(jacobian=JACOBIAN, torque_limit=2.0)


@dataclass(frozen=True)
class Call:
    """A public callable and keywords that it accepts."""

    run: Callable[..., Any]
    good: dict[str, Any] = field(default_factory=dict)


def _solve(method: str, grasp: Grasp = CUBOID, **more: Any) -> Call:
    good = {
        "grasp": grasp,
        "wrench": PAPER,
        "initial": None,
        "method": method,
        "criterion": "sum",
        "limits": None,
        "force_weight": 1.0,
        "barrier_weight": None if method == "conic" else 0.01,
        "tolerance": 1e-4,
        "max_iterations": 500,
        "step_rule": None,
        "optimum": None,
        "trace": False,
        "elastic": False,
    }
    return Call(f.optimize_force, good | more)


@cache
def _optimizer(method: str) -> f.ForceOptimizer:
    method, _, initial = method.partition(", ")
    return f.ForceOptimizer(CUBOID, method=method, initial=initial or None)


@cache
def _learned() -> LearnedInitialForce:
    return LearnedInitialForce.pretrained()


def _with(make: Callable[[], Any], name: str) -> Callable[..., Any]:
    """A method of an object that is made when it is called."""
    return lambda **keywords: getattr(make(), name)(**keywords)


def _plan(**settings: Any) -> Any:
    return make_plan(EnvConfig().override(**settings).resolved(), np.random.default_rng(0), 0.2)


def _quality(**keywords: Any) -> Any:
    found = q.quality(**keywords)
    return [found.closure_margin, found.min_singular_value, found.isotropy]


def _rows(**keywords: Any) -> Any:
    limits = f.ForceLimits(**keywords)
    return limits.rows(CUBOID).bound, limits.slack(CUBOID, FORCE)[0]


def _started(rule: Any) -> Callable[..., Any]:
    return lambda grasp, wrench: rule()(grasp, wrench)


@cache
def _env() -> FourFingerGrasp:
    env = FourFingerGrasp()
    env.reset(seed=0)
    return env


def _step(action: Any) -> Any:
    seen, reward, over, ended, _ = _env().step(action)
    if over or ended:
        _env().reset(seed=0)
    return seen, reward


def calls(folder: Path) -> dict[str, Call]:
    """All calls by name; `folder` is for files."""
    contacts = {
        "positions": CUBOID.positions,
        "normals": CUBOID.normals,
        "friction": 0.4,
        "contact_model": "soft",
        "torsional_friction": 0.005,
        "tangents": np.tile([1.0, 0.2, 0.0], (4, 1)),
    }
    worst = {"criterion": "sum", "tolerance": 0.3, "starts": 2, "points": 64, "seed": 0}
    settings = {item.name: getattr(EnvConfig(), item.name) for item in fields(EnvConfig)}
    state = {"grasp": CUBOID, "wrench": PAPER}
    return {
        "Grasp.from_contacts": Call(Grasp.from_contacts, contacts),
        "Grasp.from_contacts, hard": Call(
            lambda **k: Grasp.from_contacts(**k).pseudoinverse,
            {k: contacts[k] for k in ("positions", "normals", "friction")},
        ),
        "Grasp.wrench": Call(CUBOID.wrench, {"force": FORCE, "torsion": np.zeros(4)}),
        "Grasp.residual": Call(
            CUBOID.residual, {"force": FORCE, "wrench": PAPER, "torsion": np.zeros(4)}
        ),
        "Grasp.to_object_frame": Call(CUBOID.to_object_frame, {"force": FORCE}),
        "preset": Call(presets.preset, {"name": "tripod", "friction": 0.5}),
        "transformed": Call(
            transformed, {"grasp": SOFT, "rotation": np.eye(3), "translation": np.zeros(3)}
        ),
        "transform_wrench": Call(
            transform_wrench, {"wrench": PAPER, "rotation": np.eye(3), "translation": np.zeros(3)}
        ),
        "wrench_about": Call(wrench_about, {"wrench": PAPER, "point": np.zeros(3)}),
        "gravity_wrench": Call(
            gravity_wrench,
            {"mass": 0.2, "com": np.zeros(3), "rotation": np.eye(3), "gravity": (0.0, 0.0, -9.81)},
        ),
        "paper_path": Call(wrench.paper_path, {"time": 0.1}),
        "advise": Call(advise, {"grasp": CUBOID}),
        "save_grasp": Call(
            save_grasp, {"grasp": CUBOID, "path": str(folder / "saved" / "grasp.json")}
        ),
        **{
            f"optimize_force, {method}": _solve(method)
            for method in ("reduced_flow", "newton", "conic")
        },
        "optimize_force, full_flow": _solve("full_flow", max_iterations=20),
        "optimize_force, soft newton": _solve("newton", SOFT),
        "optimize_force, limits": _solve("newton", limits=f.ForceLimits(max_normal=50.0)),
        "optimize_force, elastic": _solve(
            "newton", limits=f.ForceLimits(max_normal=2.0), elastic=True
        ),
        "optimize_force, learned": _solve("newton", initial=_learned()),
        "optimize_force, from a force": _solve("newton", initial=FORCE, wrench=np.zeros(6)),
        **{
            f"ForceOptimizer.solve, {m}": Call(
                _with(lambda m=m: _optimizer(m), "solve"),
                {"wrench": PAPER, "initial": None, "optimum": None, "trace": False},
            )
            for m in ("reduced_flow", "newton", "conic")
        },
        "ForceOptimizer.start": Call(
            _with(lambda: _optimizer("newton"), "start"), {"wrench": PAPER, "initial": "lagrange"}
        ),
        "ForceOptimizer.update": Call(
            _with(lambda: f.ForceOptimizer(CUBOID, limits=LIMITED), "update"),
            {**PLACE, "jacobian": JACOBIAN, "torque_bias": np.zeros(5)},
        ),
        "ForceOptimizer.solve there": Call(
            _with(lambda: f.ForceOptimizer(CUBOID, limits=LIMITED), "solve"),
            {
                "wrench": PAPER,
                **PLACE,
                "jacobian": JACOBIAN,
                "torque_bias": np.zeros(5),
                "contacts": np.ones(4, dtype=bool),
            },
        ),
        "optimize_forces": Call(
            f.optimize_forces,
            {
                "grasps": CUBOID,
                "wrenches": np.tile(PAPER, (3, 1)),
                "method": "newton",
                "workers": 1,
                "tolerance": 1e-4,
                "initial": None,
            },
        ),
        "optimize_forces, many grasps": Call(
            f.optimize_forces,
            {
                "grasps": [CUBOID, SOFT],
                "wrenches": np.tile(PAPER, (2, 1)),
                "method": "conic",
                "limits": None,
            },
        ),
        "ForceLimits": Call(
            _rows,
            {
                "min_normal": 0.1,
                "max_normal": 9.0,
                "jacobian": JACOBIAN,
                "torque_limit": 2.0,
                "torque_bias": np.zeros(5),
            },
        ),
        "ForceLimits.slack": Call(
            f.ForceLimits(max_normal=5.0).slack,
            {"grasp": CUBOID, "force": FORCE, "torsion": np.zeros(4)},
        ),
        "Objective": Call(f.Objective, {"force_weight": 1.0, "barrier_weight": [0.01] * 4}),
        **{
            f"Objective.{name}": Call(getattr(f.Objective(), name), {"x": FORCE.reshape(-1)})
            for name in ("value", "gradient", "hessian")
        },
        "Objective.lower_bound": Call(
            f.Objective().lower_bound,
            {"multipliers": -PAPER, "cone_matrix": CUBOID.cone_matrix, "wrench": PAPER},
        ),
        "Repair": Call(
            lambda objective, **k: f.Repair(objective)(**k),
            {**state, "candidate": FORCE, "objective": f.Objective()},
        ),
        "LinearCombination": Call(_started(LinearCombination), state),
        **{
            name: Call(_started(partial(CoreRule, name)), state)
            for name in ("single_value", "lagrange", "phase_one")
        },
        "FixedStep": Call(f.FixedStep, {"size": 0.3}),
        "ArmijoStep": Call(f.ArmijoStep, {"first": 0.3, "shrink": 0.5, "slope": 1e-4}),
        "AdaptiveStep": Call(f.AdaptiveStep, {"first": 0.3, "grow": 1.5, "shrink": 0.5}),
        "BarzilaiBorweinStep": Call(
            f.BarzilaiBorweinStep, {"first": 0.3, "shrink": 0.5, "variant": "short"}
        ),
        "ExactStep": Call(f.ExactStep, {"precision": 1e-3}),
        "description_matrix": Call(
            f.description_matrix, {"force": FORCE, "friction": CUBOID.friction}
        ),
        "joint_torques": Call(
            f.joint_torques,
            {"jacobian": JACOBIAN, "force": FORCE, "bias": np.zeros(5), "moment": None},
        ),
        "force_closure": Call(q.force_closure, {"grasp": CUBOID, "limits": None}),
        "feasibility": Call(q.feasibility, {**state, "limits": None}),
        "singular_values": Call(q.singular_values, {"grasp": CUBOID, "length": 0.05}),
        "epsilon": Call(q.epsilon, {"grasp": CUBOID, "length": 0.05, **worst}),
        "quality": Call(
            _quality, {"grasp": CUBOID, **{k: v for k, v in worst.items() if k != "criterion"}}
        ),
        "worst_case": Call(
            q.worst_case,
            {"grasp": CUBOID, "wrenches": np.tile(PAPER, (2, 1)), "limits": None, **worst},
        ),
        "worst_case, ball": Call(
            q.worst_case,
            {"grasp": CUBOID, "wrenches": q.WrenchBall(1.0, 0.05), "limits": None, **worst},
        ),
        "WrenchBall": Call(q.WrenchBall, {"force": 1.0, "moment": 0.05, "shape": "product"}),
        "pretrained": Call(LearnedInitialForce.pretrained, {"remembers": False}),
        **{
            f"learned, {method}": Call(_with(_learned, method), state)
            for method in ("__call__", "covers", "raw")
        },
        "EnvConfig": Call(EnvConfig, settings),
        "EnvConfig.override": Call(
            EnvConfig().override,
            {
                "friction": 0.4,
                "size": (0.1, 0.1, 0.1),
                "sensors": {"delay": 0.0},
                "disturbance": {"name": "random", "force": 1.0},
            },
        ),
        **{
            f"plan of {name}": Call(
                lambda limits, controller, name=name, place=place, **k: _plan(
                    **{place: {"name": name, **k}},
                    limits={"duration": limits},
                    controller={"rate": controller},
                ),
                {item.name: item.default for item in fields(record)}
                | {"limits": 1.0, "controller": 250},
            )
            for place, table in (("disturbance", DISTURBANCES), ("task", TASKS))
            for name, record in table.items()
        },
        **{
            f"EnvConfig of {name}": Call(
                lambda name=name, **k: EnvConfig().override(**{name: k}),
                vars(getattr(EnvConfig(), name)),
            )
            for name in ("sensors", "solver", "controller", "agent", "reward", "limits", "pictures")
        },
        "as_config": Call(as_config, {"config": EnvConfig().to_json()}),
        "EnvConfig.drawn": Call(
            lambda **k: EnvConfig().override(randomize=k).drawn(np.random.default_rng(0)),
            {
                "mass": (0.1, 0.2),
                "size": (0.07, 0.12),
                "gravity": lambda rng: (0.0, -9.81, 0.0),
                "shape": True,
            },
        ),
        "null_space_basis": Call(
            null_space_basis, {"grasp": CUBOID, "reference": reference_basis(CUBOID)}
        ),
        "ZeroPolicy": Call(
            lambda action_size, observation: ZeroPolicy(action_size).predict(observation)[0],
            {"action_size": 6, "observation": np.zeros(10)},
        ),
        "reset": Call(lambda **k: _env().reset(**k)[0], {"seed": 0, "options": {"wrench": PAPER}}),
        "step": Call(_step, {"action": np.zeros(6, dtype=np.float32)}),
    }
