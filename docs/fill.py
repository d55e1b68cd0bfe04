"""The measured tables of README.md and of the pages: filled in from saved runs, so that no number is typed by hand.

python docs/fill.py                 writes every block <!-- results: NAME --> ... <!-- /results --> anew
python docs/fill.py --check         names the blocks that differ from the saved runs; exit code 1
python docs/fill.py --save FILE...  keeps what the tables need of a run's metrics.json or rl.json, or a benchmark's JSON

A table is a function of `TABLES`; what it reads of a run is a path of `KEPT`. The runs lie in docs/results.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from grasp_env._files import replacing
from training.runs.words import number

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
BLOCK = re.compile(r"(<!-- results: (\w+) -->\n)(.*?)(<!-- /results -->)", re.DOTALL)

SETS = {
    "ball": "standard ball: force 2 N, moment 0.05 N m",
    "ball_double": "twice that",
    "smooth": "random walk, 3 % a step",
    "paper_path": "W_ext(t), full size",
    "jump_50": "jumps of 50 %",
    "friction": "friction 0.2, 0.7, 0.8",
    "positions": "contacts moved up to 10 mm",
    "random_3": "random grasps, 3 contacts",
    "random_4": "4 contacts",
    "random_5": "5 contacts",
    "rollout_cold": "hand, first solve on a random object",
    "rollout_impulses": "hand, impacts",
    "rollout_changes": "hand, a finger lost, landed, slipped",
}
STARTS = {
    "linear_combination": "12-basis (the paper)",
    "previous_tangent": "previous, tangent",
    "nearest_tangent": "nearest of 10,000, tangent",
    "basis_newton": "12-basis + 4 Newton",
    "learned_fixed": "**four_finger**",
    "learned_any": "**any_grasp**",
}
SOLVERS = {
    "conic": "**ours, `conic`, compiled call**",
    "conic_python": "**ours, `conic`, `ForceOptimizer.solve`**",
    "newton": "ours, `newton` on Phi to 1e-8, compiled",
    "newton_python": "ours, `newton` on Phi, from Python",
    "qocogen_fast": "C: QOCOGEN, -Ofast -flto, no refinement",
    "qocogen": "C: QOCOGEN, -O3 -march=native",
    "qoco": "Python: QOCO, update",
    "clarabel": "Python: Clarabel, update",
    "ecos": "Python: ECOS",
    "moreau": "Python: Moreau",
    "slsqp": "SciPy SLSQP",
}

_KEPT_STARTS = "|".join((*STARTS, "network*", "basis_*"))
_FEW = 20
"""Cases below which a percentile says nothing."""
_LIMIT = 5000
"""Iterations after which a flow of the comparison is cut off."""

_RUN = ("run|provenance", "command|time|machine|versions|commit|config|episodes", "**")
KEPT: dict[str, tuple[tuple[str, ...], ...]] = {
    "starts": (
        ("starts", "*", "|".join(SETS), _KEPT_STARTS, "cases|no_start|not_converged|not_applicable"),
        ("starts", "*", "|".join(SETS), _KEPT_STARTS, "iterations|start_gap", "median|p99"),
        ("timing", "repeats|wrenches"),
        ("timing", "total", "*", "*", "best", "median|p99"),
        ("claims", "**"),
    ),
    "solver": (("rows", "*", "solver|contacts|problems|failed|p50_us|p99_us|gap_max|balance_max|violation_max"),),
    "batch": (("wrenches",), ("rows", "**"), ("peak_gib",)),
    "env_speed": (
        ("rows", "*", "method|per_second|ratio_median"),
        ("resets", "**"),
        ("memory", "**"),
        ("claims", "**"),
    ),
}
"""By saved run: paths of keys to keep; `*` is any part of a name, `|` between alternatives, `**` all below."""


def pruned(tree: Any, paths: Sequence[tuple[str, ...]]) -> Any:
    """What lies on the paths; numbers with six digits.

    Example:
        >>> pruned({"a": {"x": 1, "y": 2.00000004}, "b": 3}, [("a|c", "y")])
        {'a': {'y': 2.0}}
    """
    if any(path == () or path[0] == "**" for path in paths) or not isinstance(tree, (dict, list)):
        return _short(tree)
    if isinstance(tree, list):
        below = [path[1:] for path in paths if path[0] == "*"]
        return [pruned(part, below) for part in tree]
    kept = {}
    for key, value in tree.items():
        below = [path[1:] for path in paths if any(_fits(key, part) for part in path[0].split("|"))]
        if below:
            kept[key] = pruned(value, below)
    return kept


def _fits(key: str, part: str) -> bool:
    return re.fullmatch(part.replace("*", ".*"), key) is not None


def _short(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _short(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_short(part) for part in tree]
    return float(f"{tree:.6g}") if isinstance(tree, float) else tree


def save(path: Path) -> str:
    """Keeps what the tables need of a run's file; the name that it has in docs/results."""
    tree = json.loads(path.read_text(encoding="utf-8"))
    kind = tree.get("kind") or tree["run"]["kind"]
    name = "env_speed" if kind == "env" and "rows" in tree else {"env": "hold"}.get(kind, kind)
    if name not in KEPT:
        raise SystemExit(f"{path} is a run of {kind!r}; tables are made of {', '.join(KEPT)}")
    if tree.get("quick") or tree.get("run", {}).get("quick"):
        raise SystemExit(f"{path} is a quick run, whose numbers are not quoted: run it in full")
    RESULTS.mkdir(exist_ok=True)
    with replacing(RESULTS / f"{name}.json") as target:
        text = json.dumps(pruned(tree, (_RUN, *KEPT[name])), indent=1, sort_keys=True, allow_nan=False)
        target.write_text(text + "\n", encoding="utf-8")
    return name


@cache
def saved(name: str) -> Any:
    """A saved run."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def source(name: str) -> str:
    """What measured it: the last line of a block."""
    run = saved(name).get("run") or saved(name)["provenance"]
    machine = run["machine"]
    return (
        f"\n`{run['command']}` at {run['commit']}, {run['time'][:10]}: {machine['processor']}, {machine['cores']} cores, "
        f"Python {machine['python']}."
    )


def pair(part: dict[str, Any] | None, digits: int = 3) -> str:
    """Median / p99; a dash where there is none."""
    return "–" if not part else f"{number(part['median'], digits)} / {number(part['p99'], digits)}"


def iterations(found: dict[str, Any] | None) -> str:
    """Of the flow, median / p99; a dash where the start does not apply or hardly ever does."""
    if not found or found["cases"] - found["not_applicable"] - found["no_start"] < _FEW:
        return "–"
    return " / ".join(f"> {_LIMIT}" if value > _LIMIT else f"{value:.0f}" for value in found["iterations"].values())


def starts() -> str:
    """Iterations of the flow per set of cases."""
    flow = saved("starts")["starts"]["reduced_flow"]
    rows = [[label, *(iterations(flow[case].get(start)) for start in STARTS)] for case, label in SETS.items()]
    return table(["cases", *STARTS.values()], rows) + "\n" + source("starts")


def calls() -> str:
    """The whole public call."""
    total = saved("starts")["timing"]["total"]
    chosen = {key: STARTS[key] for key in ("linear_combination", "previous_tangent", "learned_fixed", "learned_any")}
    chosen["learned_previous"] = "any_grasp, remembering"
    rows = [
        [label, *(pair(total[method][start]["best"]) for method in ("reduced_flow", "newton"))]
        for start, label in chosen.items()
    ]
    return table(["start", "with the reduced flow, us", "with Newton, us"], rows) + "\n" + source("starts")


def network() -> str:
    """The network alone and after plain Newton steps, beside the 12-basis after as many."""
    ball = saved("starts")["starts"]["reduced_flow"]["ball"]
    pairs = [
        ("linear_combination", "network"),
        ("basis_tangent", "network_newton_1"),
        ("basis_newton_2", "network_newton_2"),
    ]
    rows = [
        [str(steps), *(text for key in both for text in (iterations(ball[key]), pair(ball[key]["start_gap"], 2)))]
        for steps, both in enumerate(pairs)
    ]
    return (
        table(["plain Newton steps first", "12-basis", "its gap", "network", "its gap"], rows) + "\n" + source("starts")
    )


def solvers() -> str:
    """Against other solvers, by number of contacts."""
    found = {(row["solver"], row["contacts"]): row for row in saved("solver")["rows"]}
    sizes = sorted({count for _, count in found})
    rows = []
    for solver, label in SOLVERS.items():
        cells = (found.get((solver, count)) for count in sizes)
        rows.append([label, *("–" if not row else f"{row['p50_us']:.1f} / {row['p99_us']:.1f}" for row in cells)])
    failed = [f"{SOLVERS[solver].strip('*')} failed on {row['failed']} of {row['problems']} at N = {count}"
              for (solver, count), row in found.items() if row["failed"] and solver in SOLVERS]  # fmt: skip
    ours = [row for row in saved("solver")["rows"] if row["solver"].startswith(("conic", "newton"))]
    told = (
        f"Of ours {sum(row['failed'] for row in ours)} failed, balance within {max(row['balance_max'] for row in ours):.0e} of the "
        f"wrench, cones violated by at most {max(row['violation_max'] for row in ours):.0e}. {'; '.join(failed) or 'None failed'}."
    )
    return (
        table(["solver, median / p99 us", *(f"N = {count}" for count in sizes)], rows)
        + f"\n\n{told}\n"
        + source("solver")
    )


def batch() -> str:
    """Solves per second."""
    by = {(row["method"], row["workers"]): row["per_second"] for row in saved("batch")["rows"]}
    methods = dict.fromkeys(method for method, _ in by)
    cores = sorted({workers for _, workers in by})
    rows = [[method, *(f"{by[method, count] / 1e6:.1f}" for count in cores)] for method in methods]
    return (
        table(["million certified solves per second", *(f"{n} core{'s' * (n > 1)}" for n in cores)], rows)
        + "\n"
        + source("batch")
    )


def env_speed() -> str:
    """Claims of the environment's benchmark: asked beside measured."""
    return asked("env_speed") + "\n" + source("env_speed")


def asked(name: str) -> str:
    """Claims of a run, the missed ones first."""
    claims = sorted(saved(name)["claims"], key=lambda row: (row["met"] is not False, row["met"] is True))
    said = {True: "yes", False: "**NO**", None: "not measured"}
    rows = [[row["claim"], row["asked"], row["measured"], said[row["met"]]] for row in claims]
    return table(["", "asked", "measured", "met"], rows)


TABLES: dict[str, Callable[[], str]] = {
    "starts": starts, "calls": calls, "network": network, "solvers": solvers, "batch": batch, "env_speed": env_speed,
    "starts_claims": lambda: asked("starts") + "\n" + source("starts"),
}  # fmt: skip


def filled(text: str) -> tuple[str, list[str]]:
    """The text with its blocks made anew, and the names of those that changed."""
    changed = []

    def block(match: re.Match[str]) -> str:
        start, name, before, end = match.groups()
        if name not in TABLES:
            raise SystemExit(f"no table {name!r}; there are {', '.join(TABLES)}")
        now = TABLES[name]() + "\n"
        if now != before:
            changed.append(name)
        return start + now + end

    return BLOCK.sub(block, text), changed


def main(arguments: Sequence[str] | None = None) -> int:
    """See above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--save", nargs="+", type=Path, default=[])
    given = parser.parse_args(arguments)
    for path in given.save:
        sys.stdout.write(f"{path} -> docs/results/{save(path)}.json\n")
    differ = 0
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        text, changed = filled(page.read_text(encoding="utf-8"))
        differ += len(changed)
        for name in changed:
            sys.stdout.write(f"{page.name}: {name}{' differs from docs/results' if given.check else ''}\n")
        if changed and not given.check:
            with replacing(page) as target:
                target.write_text(text, encoding="utf-8")
    return int(given.check and differ > 0)


if __name__ == "__main__":
    sys.exit(main())
