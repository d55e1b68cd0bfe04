"""Comparison of the force layer with other differentiable layers, forward and backward on one core.

Every problem has other contacts, friction and wrench. Our layer takes them and returns gradients
with respect to all of them. The times of other layers (`layer_peers.py`) start at the matrices that
they need.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.benchmark import Benchmark, tick
from benchmarks.layer_peers import CONTACTS, PEERS, Call, Contestant, Tensors, cone_form
from benchmarks.problem import LEVER
from grasp_env.force import ForceLimits, optimize_forces
from grasp_env.grasp import Grasp
from grasp_env.grasp.wrench import sample_ball
from grasp_env.inputs.arguments import Array
from grasp_env.inputs.extras import need
from training.data.grasps import BENCH
from training.evaluation.results.claims import Claim
from training.evaluation.results.table import join, pd

with need("train"):
    import torch

JOINTS = 3
"""Joints of each finger."""
ROOM = (0.8, 1.6)
"""Range of a torque limit over the largest torque without limits; below 1, for a quarter, it binds."""
PATCH = (0.002, 0.01)
"""Range of torsional friction [m]."""
BALANCED = 1e-3
"""Largest residual A x + w of a valid result, relative to the largest component of w."""
BASE = ("positions", "normals", "friction", "wrench")
CASES = {
    "hard": BASE,
    "limits": (*BASE, "jacobian", "torque_limit"),
    "soft": (*BASE, "torsional_friction"),
}
"""Inputs of the layer in each case."""
ANSWERS = "hard, answers"
"""The case in which answers are compared."""


def draw(seed: int, count: int) -> tuple[list[Grasp], Tensors]:
    """Draw grasps with force closure, and problems with all inputs of all `CASES`.

    A finger's joints move only its own contact. Limits are drawn around the largest torque of the
    optimum without limits, and raised until a force within them exists.
    """
    rng = np.random.default_rng([seed, CONTACTS])
    grasps = [BENCH.closed(rng, CONTACTS) for _ in range(count)]
    wrenches = sample_ball(rng, count)
    joints = np.zeros((count, CONTACTS, 3, CONTACTS * JOINTS))
    for finger in range(CONTACTS):
        rotations = np.linalg.qr(rng.standard_normal((count, 3, 3)))[0]
        joints[:, finger, :, finger * JOINTS : (finger + 1) * JOINTS] = LEVER * rotations
    forces = optimize_forces(grasps, wrenches, method="newton", workers=1)
    limits = rng.uniform(*ROOM, count)
    for k, grasp in enumerate(grasps):
        limits[k] *= np.abs(np.einsum("nij,ni->j", joints[k], forces[k].object_force)).max()
        options: dict[str, Any] = {"method": "newton", "workers": 1}
        while True:
            torque_limit = np.full(joints.shape[3], limits[k])
            options["limits"] = ForceLimits(jacobian=joints[k], torque_limit=torque_limit)
            if optimize_forces(grasp, wrenches[k][None], **options).optimal[0]:
                break
            limits[k] *= 1.1
    inputs = {
        "positions": [grasp.positions for grasp in grasps],
        "normals": [grasp.normals for grasp in grasps],
        "friction": [grasp.friction for grasp in grasps],
        "wrench": wrenches,
        "jacobian": joints,
        "torque_limit": np.repeat(limits[:, None], CONTACTS * JOINTS, axis=1),
        "torsional_friction": rng.uniform(*PATCH, (count, CONTACTS)),
    }
    arrays = {name: np.array(values, dtype=float) for name, values in inputs.items()}
    return grasps, {name: torch.from_numpy(array) for name, array in arrays.items()}


def ours(batch: int) -> Call:
    """Return the layer with its defaults."""
    from policies import grasp_force

    return lambda **inputs: grasp_force(**inputs).force


FORWARD, LAYER = "layer_forward", "layer"
OURS = {
    LAYER: Contestant("ours, to 1e-10, gradients with respect to all inputs", ours),
    FORWARD: Contestant("ours, to 1e-10, without gradients", ours),
}
CONTESTANTS = OURS | PEERS


@dataclass(frozen=True)
class LayerSettings:
    """Settings of a benchmark.

    Attributes:
        batches: numbers of problems in a call.
        calls: largest number of calls in a pass, each with new problems as far as available.
        rounds: rounds in which the contestants take turns.
        passes: passes in a round; the time of a call is the best of them.
        seed: seed of the problems.
    """

    batches: tuple[int, ...] = (1, 32, 1000)
    calls: int = 50
    rounds: int = 5
    passes: int = 2
    seed: int = 0


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch to one thread on one core, because some layers start threads."""
    threads = torch.get_num_threads()
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    torch.set_num_threads(1)
    try:
        if cores:
            os.sched_setaffinity(0, {max(cores)})
        yield
    finally:
        torch.set_num_threads(threads)
        if cores:
            os.sched_setaffinity(0, cores)


def run(settings: LayerSettings) -> pd.DataFrame:
    """Time all layers in rounds, and check the answers to a batch of the largest size.

    Returns:
        A row for each case, batch, layer, round and call: `ratio` is its time over that of ours in
        the same round. A row for each layer and problem with the excess over the least sum of
        normal forces, and, where the layer minimises Phi, with the differences from ours.
    """
    most = max(settings.batches)
    tick(f"drawing {most} problems")
    grasps, problems = draw(settings.seed, most)
    rows: list[dict[str, Any]] = []
    missing: dict[str, str] = {}
    with one_thread():
        for batch in settings.batches:
            for case, names in CASES.items():
                built = _built(CONTESTANTS if case == "hard" else OURS, batch, missing)
                data = {name: problems[name] for name in names}
                rows += timed(settings, case, batch, built, data)
        data = {name: problems[name] for name in BASE}
        checks = list(compared(grasps, data, _built(CONTESTANTS, most, missing)))
    rows += [{"method": name, "reason": reason} for name, reason in missing.items()]
    return join([pd.DataFrame(rows), *checks])


def _built(
    contestants: dict[str, Contestant], batch: int, missing: dict[str, str]
) -> dict[str, Call]:
    built: dict[str, Call] = {}
    for name, contestant in contestants.items():
        try:
            built[name] = contestant.build(batch)
        except ImportError as error:
            if name in OURS:
                raise
            missing[name] = f"{error}: pip install {contestant.packages}"
    return built


def timed(
    settings: LayerSettings, case: str, batch: int, built: dict[str, Call], data: Tensors
) -> Iterator[dict[str, Any]]:
    """Yield the rows of a case and a batch size."""
    starts = range(0, len(data["wrench"]) - batch + 1, batch)[: settings.calls]
    batches = [{name: values[k : k + batch] for name, values in data.items()} for k in starts]
    differentiable = [leaves(batch_data) for batch_data in batches]
    cones = [leaves(cone_form(**batch_data)[0]) for batch_data in batches] if case == "hard" else []
    for turn in range(settings.rounds):
        reference = np.empty(0)
        for name, call in built.items():
            tick(f"{case}, batch of {batch}, round {turn + 1} of {settings.rounds}: {name}")
            backward = name != FORWARD
            inputs = cones if name in PEERS else differentiable if backward else batches
            times = seconds(call, inputs, backward, settings.passes)
            reference = times if name == LAYER else reference
            for k, time_of_call in enumerate(times):
                yield {
                    "case": case,
                    "batch": batch,
                    "method": name,
                    "problem": k,
                    "microseconds": 1e6 * time_of_call / batch,
                    "ratio": time_of_call / reference[k] if name in PEERS else None,
                }


def leaves(inputs: Tensors) -> Tensors:
    """Return copies of the tensors that require gradients."""
    return {name: values.detach().clone().requires_grad_() for name, values in inputs.items()}


def seconds(call: Call, inputs: list[Tensors], backward: bool, passes: int) -> Array:
    """Return (calls,) seconds of data call, the best of the passes, without the first call."""
    best = np.full(len(inputs), np.inf)
    step(call, inputs[0], backward)
    for _ in range(passes):
        for k, data in enumerate(inputs):
            begin = time.perf_counter()
            step(call, data, backward)
            best[k] = min(best[k], time.perf_counter() - begin)
    return best


def step(call: Call, inputs: Tensors, backward: bool) -> None:
    """Make one call, if `backward` with the gradient of the sum of squared forces."""
    if not backward:
        with torch.no_grad():
            call(**inputs)
        return
    force = call(**inputs)
    torch.autograd.grad(force, list(inputs.values()), 2.0 * force.detach(), allow_unused=True)


def compared(grasps: list[Grasp], data: Tensors, built: dict[str, Call]) -> Iterator[pd.DataFrame]:
    """Yield the rows of the answers to all problems, as one batch."""
    cone, axes = cone_form(**data)
    exact = optimize_forces(
        grasps, data["wrench"].numpy(), method="conic", tolerance=1e-10, workers=1
    )
    least = np.array([solution.force[:, 0].sum() for solution in exact])
    force, gradients = answers(built[LAYER], data, False)
    for name, call in built.items():
        if name == FORWARD:
            continue
        tick(f"checking {name}")
        other, other_gradients = answers(call, data, name in PEERS)
        x = (other[..., None, :] * axes).sum(dim=-1) / axes.square().sum(dim=-1)
        residual = (cone["matrix"] @ x.flatten(1)[..., None])[..., 0] + cone["load"]
        balance = (residual.abs().amax(dim=1) / cone["load"].abs().amax(dim=1)).numpy()
        rows = pd.DataFrame(
            {
                "balance": balance,
                "failed": ~(balance <= BALANCED),
                "force_excess": (x[..., 0] * cone["cost"]).sum(dim=1).numpy() / least - 1.0,
            }
        )
        if CONTESTANTS[name].phi and name != LAYER:
            differences = torch.stack(list(map(_difference, other_gradients, gradients)))
            rows["force_difference"] = _difference(other, force).numpy()
            rows["gradient_difference"] = differences.amax(dim=0).numpy()
        yield rows.assign(case=ANSWERS, batch=len(grasps), method=name, problem=rows.index)


def answers(call: Call, data: Tensors, cone: bool) -> tuple[Any, tuple[Any, ...]]:
    """Return the forces (n, N, 3) [N] and the gradients of the sum of their squares.

    Args:
        call: a layer.
        data: inputs of ours.
        cone: True if the layer takes the problem in cone coordinates.
    """
    inputs = leaves(data)
    if cone:
        problem, axes = cone_form(**inputs)
        force = (call(**problem).unflatten(1, (-1, 3))[..., None] * axes).sum(dim=-2)
    else:
        force = call(**inputs)
    return force.detach(), torch.autograd.grad(force, list(inputs.values()), 2.0 * force.detach())


def _difference(values: Any, known: Any) -> Any:
    """Return the largest differences (n,), relative to the largest known components."""
    return (values - known).flatten(1).abs().amax(dim=1) / known.flatten(1).abs().amax(dim=1)


def _takes(case: str, method: str, batch: int, most: float) -> Claim:
    query = f"case == '{case}' and method == '{method}' and batch == {batch}"
    label = f"{method}, {case}, batch of {batch}"
    return Claim(label, query, "microseconds_median", "<=", most, unit="us")


def _faster(method: str, batch: int, least: float) -> Claim:
    query = f"case == 'hard' and method == '{method}' and batch == {batch}"
    label = f"time of {method} over ours, batch of {batch}"
    return Claim(label, query, "ratio_median", ">=", least)


def _close(kind: str, most: float) -> Claim:
    query = f"case == '{ANSWERS}' and method == 'cvxpylayers_clarabel'"
    label = f"{kind}s of cvxpylayers_clarabel: difference from ours"
    return Claim(label, query, f"{kind}_difference_max", "<=", most)


BENCHMARK = Benchmark(
    run,
    LayerSettings(),
    quick={"batches": (1, 32), "rounds": 2, "calls": 10},
    shown=(
        "microseconds_median",
        "microseconds_p99",
        "ratio_median",
        "ratio_low",
        "ratio_high",
        "failed_sum",
        "balance_max",
        "force_difference_max",
        "gradient_difference_median",
        "gradient_difference_max",
        "force_excess_max",
    ),
    claims=(
        _takes("hard", LAYER, 1000, 4.0),
        _takes("limits", LAYER, 1000, 8.0),
        _takes("soft", LAYER, 1000, 10.0),
        _takes("hard", FORWARD, 1, 60.0),
        *(
            _faster(name, batch, least)
            for name, targets in {
                "cvxpylayers": (50.0, 100.0, 200.0),
                "cvxpylayers_clarabel": (50.0, 100.0, 200.0),
                "moreau": (1.5, 15.0, 30.0),
            }.items()
            for batch, least in zip((1, 32, 1000), targets, strict=True)
        ),
        _close("force", 1e-4),
        _close("gradient", 1e-3),
    ),
    words={name: contestant.setting for name, contestant in CONTESTANTS.items()},
)
