"""Comparison of this checkout with an earlier one, in short processes that take turns on one core.

`core_side.ROWS` lists the timed calls. Every process writes its rows, and this module joins them.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.benchmark import Benchmark, TimingSettings, tick
from benchmarks.core_side import ROWS
from benchmarks.problem import LEVER, problems
from grasp_env.errors import GraspError, InvalidInputError
from grasp_env.force import ForceOptimizer
from grasp_env.grasp import Grasp
from grasp_env.inputs.arguments import Array, unit_vectors
from grasp_env.quality import feasibility
from training.evaluation.results.claims import Claim
from training.evaluation.results.run import commit
from training.evaluation.results.table import join, pd

SIDE = Path(__file__).with_name("core_side.py")
STEP = 0.03
"""Step along a path [rad]: 200 calls make one turn."""
SHIFT, TILT = 2e-3, 0.05
"""Amplitudes of contacts [m] and of their normals [rad] along a path."""
ROOM = 1.1
"""Torque limits over the largest torques of a path."""
CALL = "call"
RATIO = "now over baseline, by rounds"
FIRST = "first solve of a process, newton"


@dataclass(frozen=True)
class CoreSettings(TimingSettings):
    """Settings of a benchmark.

    Attributes:
        baseline: folder of another checkout with a .venv (git worktree add PATH COMMIT; make -C
            PATH install); None: only this one is timed.
    """

    baseline: Path | None = None


def run(settings: CoreSettings, names: tuple[str, ...] = tuple(ROWS)) -> pd.DataFrame:
    """Time all rows in rounds, this checkout and the baseline in turns, never both at once.

    Returns:
        A row for each side, method and problem with the best of all rounds, and with two sides the
        difference of their objectives in `apart`; a row for each round with the ratio of medians; a
        row for each process with its first solve and the commit in `event`; a row with a reason for
        everything that a side cannot time.

    Raises:
        InvalidInputError: the baseline is no installed checkout.
        GraspError: a process ended.
    """
    sides = {"now": (SIDE.parents[1], Path(sys.executable))}
    if settings.baseline is not None:
        root = settings.baseline.absolute()
        sides["baseline"] = root, root / ".venv/bin/python"
    for root, python in sides.values():
        if not (root / "grasp_env").is_dir() or not python.exists():
            remedy = f"git worktree add {root} COMMIT, make -C {root} install"
            raise InvalidInputError(
                f"{root} is no installed checkout with a grasp_env and a {python}: {remedy}"
            )
    tables = []
    first = []
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch, "problems.npz")
        out = Path(scratch, "rows")
        for count in settings.contacts:
            tick(f"{count} contacts: problems")
            np.savez(file, **arrays(settings.seed, count, settings.wrenches))
            for turn in range(settings.rounds):
                for side, (root, python) in sides.items():
                    tick(f"{count} contacts, round {turn + 1} of {settings.rounds}: {side}")
                    words = map(str, (out, file, settings.passes, time.monotonic()))
                    about, *lines = process(python, root, [*words, *names])
                    row = {"case": FIRST, "side": side, "event": commit(root)}
                    first.append(row | {"milliseconds": about["milliseconds"]})
                    table = pd.DataFrame(lines).assign(side=side, contacts=count, turn=turn)
                    tables.append(table.astype(object))
    return join([*joined(pd.concat(tables, ignore_index=True)), pd.DataFrame(first)])


def arrays(seed: int, count: int, wrenches: int) -> dict[str, Any]:
    """Return the problems of the other benchmarks, and for each grasp a path with force closure."""
    rng = np.random.default_rng([seed, count, 1])
    out = {}
    for group, (grasp, loads) in enumerate(problems(seed, count, wrenches)):
        angle = STEP * np.arange(len(loads))[:, None, None]
        phase = rng.uniform(0.0, 2.0 * np.pi, (count, 1))
        shift, tilt = rng.uniform(-1.0, 1.0, (2, count, 3))
        amplitude = 1.0  # halved until closure is kept
        while True:
            points = grasp.positions + amplitude * SHIFT * shift * np.sin(angle + phase)
            normals = unit_vectors(grasp.normals + amplitude * TILT * tilt * np.cos(angle + phase))
            path = zip(points, normals, strict=True)
            steps = (Grasp.from_contacts(*pair, grasp.friction) for pair in path)
            if all(feasibility(step, np.zeros(6)).feasible for step in steps):
                break
            amplitude *= 0.5
        turning = np.cos(angle[:, 0]) * loads[0] + np.sin(angle[:, 0]) * loads[1]
        case = {
            "positions": grasp.positions,
            "normals": grasp.normals,
            "friction": grasp.friction,
            "wrenches": loads,
            "path_points": points,
            "path_normals": normals,
            "path_wrenches": turning,
        }
        turned = np.linalg.qr(rng.standard_normal((count, 3, 3)))[0]
        joints = LEVER * turned * (1.0 + 0.1 * np.sin(angle[:, :, None] + phase[:, :, None]))
        case["path_joints"] = joints
        case["torque_limit"] = strongest(grasp, points, normals, turning, joints)
        out |= {f"{group}/{name}": value for name, value in case.items()}
    return out


def strongest(grasp: Grasp, points: Array, normals: Array, wrenches: Array, joints: Array) -> Array:
    """Return (3N,) torque limits [N m] with which every step of a path is feasible.

    They are `ROOM` times the largest torques of optimal forces along it.
    """
    optimizer = ForceOptimizer(grasp)
    path = zip(wrenches, points, normals, joints, strict=True)
    torques = [
        np.einsum("nij,ni->nj", j, optimizer.solve(wrench, positions=p, normals=n).object_force)
        for wrench, p, n, j in path
    ]
    return ROOM * np.abs(torques).max(axis=0).reshape(-1)


def process(python: Path, root: Path, words: list[str]) -> list[dict[str, Any]]:
    """Run `core_side.py` in a checkout and return its lines, or raise a `GraspError`."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("PYTHON")
    }
    command = [str(python), "-c", SIDE.read_text(encoding="utf-8"), *words]
    environment["OPENBLAS_NUM_THREADS"] = "1"
    ended = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True)
    if ended.returncode:
        last = (ended.stderr.strip().splitlines() or ["nothing said"])[-1]
        raise GraspError(f"the process in {root} ended: {last}")
    lines = [json.loads(line) for line in Path(words[0]).read_text(encoding="utf-8").splitlines()]
    if not os.path.samefile(lines[0]["root"], root):
        raise InvalidInputError(f"{python} imports grasp_env from elsewhere: {lines[0]['root']}")
    return lines


def joined(lines: Any) -> list[pd.DataFrame]:
    """Join the lines of all processes: best times, ratios of each round, and missing rows."""
    keys = ["contacts", "method", "problem"]
    lines = lines.reindex(columns=[*keys, "side", "turn", "microseconds", "objective", "reason"])
    missing = lines.loc[
        lines["reason"].notna(), ["contacts", "method", "side", "reason"]
    ].drop_duplicates()
    lines = lines[~lines["method"].isin(missing["method"])].astype(
        {"microseconds": float, "objective": float}
    )
    best = lines.groupby([*keys, "side"], sort=False, as_index=False).agg(
        {"microseconds": "min", "objective": "last"}
    )
    best["failed"] = best["objective"].isna()
    if "baseline" not in set(best["side"]):
        return [best.drop(columns="objective").assign(case=CALL), missing]
    other = best.merge(best[best["side"] == "baseline"], on=keys, how="left")
    best["apart"] = (other["objective_x"] / other["objective_y"] - 1.0).abs()
    # both sides of a method in consecutive rows
    calls = best.drop(columns="objective").assign(case=CALL)
    pairs = [rows for _, rows in calls.groupby(keys[:2], sort=False)]
    medians = lines.pivot_table(
        "microseconds", ["contacts", "method", "turn"], "side", "median", sort=False
    )
    ratios = (medians["now"] / medians["baseline"]).rename("ratio").reset_index()
    return [*pairs, ratios.rename(columns={"turn": "problem"}).assign(case=RATIO), missing]


def _slower(name: str) -> Claim:
    query = f"case == '{RATIO}' and method == '{name}'"
    return Claim(f"{name}: time over the baseline's", query, "ratio_median", "<=", 1.05)


BENCHMARK = Benchmark(
    run,
    CoreSettings((3, 4, 5, 8, 16, 50), wrenches=400, rounds=10, passes=2),
    quick={"wrenches": 80, "rounds": 2},
    shown=(
        "microseconds_median",
        "microseconds_p99",
        "failed_sum",
        "apart_max",
        "ratio_median",
        "ratio_low",
        "ratio_high",
        "milliseconds_median",
    ),
    claims=(
        *map(_slower, ROWS),
        Claim(
            "first solve of a new process",
            f"case == '{FIRST}' and side == 'now'",
            "milliseconds_median",
            "<=",
            500.0,
            unit="ms",
        ),
    ),
    words={name: label for name, (label, _) in ROWS.items()},
)
