"""The simulated hand: its first control tick after a reset, and what becomes of many short episodes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from golden.record import Case, Outcome, named

from policies import LearnedInitialForce

if TYPE_CHECKING:
    import gymnasium as gym

ENV = "grasp_env:FourFingerGrasp-v0"
HELD = ("is_success", "steps", "drift", "total_force")
"""Of each episode: success, steps, largest drift [m], mean commanded total normal force [N]."""


@contextmanager
def torques_of(env: gym.Env[Any, Any]) -> Iterator[list[np.ndarray]]:
    """All joint torques [N m] that reach the simulator meanwhile, in order: looked at where pybullet takes them."""
    import pybullet  # after the environment, which imports it in silence

    told: list[np.ndarray] = []
    original = pybullet.setJointMotorControlArray

    def listen(*given: Any, **more: Any) -> Any:
        if given[2] == pybullet.TORQUE_CONTROL:
            told.append(np.array(more["forces"]))
        return original(*given, **more)

    pybullet.setJointMotorControlArray = listen
    try:
        yield told
    finally:
        pybullet.setJointMotorControlArray = original


def first_tick(seed: int, learned: bool = False, adjust: float = 0.0, **settings: Any) -> list[Outcome]:
    """A reset and one control tick, which is one agent step here."""
    if learned:
        settings["initial_force"] = LearnedInitialForce.pretrained()
    import gymnasium as gym  # the other groups need the solver only

    env = gym.make(ENV, **{"agent.rate": 250, **settings})
    try:
        # the second reset of an environment, so that nothing depends on what the process did before
        env.reset(seed=seed + 1)
        observed, info = env.reset(seed=seed)
        rows = [_array("observation at reset", observed), *_of_info("at reset", info)]
        assert env.action_space.shape is not None
        with torques_of(env) as told:
            action = np.full(env.action_space.shape, adjust, dtype=np.float32)
            observed, _, _, _, info = env.step(action)
        rows += [_array("torques", told[0]), _array("observation", observed), *_of_info("after a tick", info)]
        rows.append(_array("peak torque", [info["peak_torque"]]))
        # not the status: rounding decides whether a solve to the last digit stalls
        names = (info["failure"], info["object_shape"], str(info["contacts"]))
        rows.append(Outcome("ends", ", ".join(names)))
        return rows
    finally:
        env.close()


def _of_info(when: str, info: dict[str, Any]) -> list[Outcome]:
    names = ("wrench", "commanded_force", "measured_force")
    return [
        *(_array(f"{name} {when}", info[name]) for name in names),
        _array(f"object {when}", [info["object_mass"], info["object_friction"], info["object_size"]]),
    ]


def _array(name: str, values: Any) -> Outcome:
    return Outcome("array", name, extra=np.asarray(values, dtype=np.float64).reshape(-1))


def episodes(count: int, **settings: Any) -> list[Outcome]:
    """(count, 4) `HELD` of episodes with seeds 0, 1, ..., each to its end."""
    import gymnasium as gym  # the other groups need the solver only

    env = gym.make(ENV, **settings)
    table = np.zeros((count, len(HELD)))
    try:
        assert env.action_space.shape is not None
        zero = np.zeros(env.action_space.shape, dtype=np.float32)
        for k in range(count):
            env.reset(seed=k)
            forces, drift, over = [], 0.0, False
            while not over:
                _, _, terminated, truncated, info = env.step(zero)
                forces.append(float(info["commanded_force"][:, 0].sum()))
                drift, over = max(drift, info["drift"]), terminated or truncated
            table[k] = float(info["is_success"]), len(forces), drift, np.mean(forces)
    finally:
        env.close()
    return [Outcome("episodes", f"{count}", extra=table.reshape(-1))]


EXACT = {"method": "newton", "solver.tolerance": 1e-15}
"""So that what the force is does not hang on how many steps it took."""
FLOW = {"method": "reduced_flow", "solver.tolerance": 1e-12}
CLOSE = {
    "newton from learned": 1e-7, "reduced_flow": 1e-6, "reduced_flow from single_value": 1e-6, "full_flow": 1e-6,
    "conic": 1e-3, "sphere": 1e-7, "cylinder": 5e-2,
}  # fmt: skip
"""Other than 1e-9 of the largest: a learned start within the tolerance ends the solve, the flows creep, the exact problem is flat;
and the fingers settle on a sphere to 1e-9, on a cylinder, whose round side the simulator makes of facets, to 2 %."""
RANDOM = ("shape", "size", "mass", "friction")


def cases() -> dict[str, Case]:
    """All of them."""
    settings: dict[str, dict[str, Any]] = {
        "newton": {},
        "newton from previous": {"initial_force": "previous"},
        "newton, adjusted": {"adjust": 0.3},
        "newton from learned": {"learned": True},
        "reduced_flow": FLOW,
        "reduced_flow from single_value": {**FLOW, "initial_force": "single_value"},
        "full_flow": {**FLOW, "method": "full_flow"},
        "conic": {"method": "conic", "solver.tolerance": 1e-9},
        "random object": {"randomize": RANDOM},
        "three fingers": {"hand": "three_finger"},
        "five fingers": {"hand": "five_finger"},
        "four joints a finger": {"hand": "four_finger_4dof"},
        "cylinder": {"shape": "cylinder"},
        "sphere": {"shape": "sphere", "friction": 0.8},
        "capsule": {"shape": "capsule", "friction": 0.8},
        "paper path": {"disturbance": "paper_path"},
        "random wrench": {"disturbance": "random"},
        "impulses": {"disturbance": "impulses"},
        "tilting": {"disturbance": "tilting_gravity"},
        "moving": {"task": {"name": "move", "motion": "shake"}},
        "payload": {"task": "payload"},
        "six directions": {"task": "six_directions"},
        "estimated": {"sensors.wrench": "estimated"},
        "late and noisy": {
            "sensors.delay": 0.008,
            "sensors.tactile_noise": 0.05,
            "sensors.pose_noise": 1e-5,
            "controller.force_noise": 0.01,
        },
        "unequal friction": {
            "controller": {"friction_error": 0.1, "friction_margin": 0.7},
            "solver.barrier_weight": 0.05,
        },
        "contact forces": {"action_mode": "contact_force", "adjust": 0.1},
        "constant squeeze": {"controller.kind": "constant_squeeze"},
        "pd": {"controller.kind": "pd"},
    }
    out = [
        Case(f"first tick, {name}", lambda o={**EXACT, **each}: first_tick(5, **o), close=CLOSE.get(name, 1e-9))
        for name, each in settings.items()
    ]
    many: dict[str, dict[str, Any]] = {
        "default": {"randomize": RANDOM, "disturbance": "random"},
        "newton": {"randomize": RANDOM, "disturbance": "random", "method": "newton", "initial_force": "previous"},
        "estimated": {"disturbance": "impulses", "sensors.wrench": "estimated", "sensors.tactile_noise": 0.02},
        "three fingers": {"hand": "three_finger", "disturbance": "random", "method": "conic"},
    }
    for name, each in many.items():
        for count in (4, 50):
            out.append(Case(f"{count} episodes, {name}", lambda c=count, o=each: episodes(c, duration=1.0, **o)))
    return named(out)
