"""Fills the tables of measurements in README.md and the pages from saved runs.

python -m docs.fill                writes every block <!-- results: NAME --> ... <!-- /results -->
python -m docs.fill --check        lists the blocks that differ from saved runs; exit code 1
python -m docs.fill --save RUN...  saves the summaries of runs of `grasp` or of the benchmarks

docs/results/KIND.csv is the summary of a run (columns: training/evaluation/results/columns.py),
KIND.json its settings and machine, KIND.svg its picture, if it has one. Long runs are saved in
parts: KIND-PART.csv. Of the force benchmark
force.csv.xz holds all rows. This module is long because it contains one short function for each
table, a query on these files; `TABLES` lists them by the names of the blocks.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from benchmarks.algorithms import ALGORITHMS
from benchmarks.force.entrants import ENTRANTS
from benchmarks.force.problems import load, names
from benchmarks.force.report import by_contacts, by_entrant, by_track, pair_of
from grasp_env.inputs.files import replacing
from training.evaluation.compare.scenarios import short_name
from training.evaluation.report import errors_page, holds_page, starts_page
from training.evaluation.report.page import cell, claims_of
from training.evaluation.report.reproduce_page import RULES
from training.evaluation.report.rl_page import AGENTS, SPEEDS, place, squeeze_saved
from training.evaluation.report.starts_page import pair
from training.evaluation.results.claims import Verdict, judge
from training.evaluation.results.run import Run
from training.evaluation.results.table import (
    Rows,
    chosen,
    numbers,
    pd,
    read,
    summary,
    write,
    write_summary,
)
from training.evaluation.results.words import number
from training.fit.in_environment import BASIS, CASES, REPAIRED

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results"
FORCE = RESULTS / "force.csv.xz"
BLOCK = re.compile(r"(<!-- results: (\w+) -->\n)(.*?)(<!-- /results -->)", re.DOTALL)
PROVENANCE = (
    *("kind", "command", "time", "machine", "versions", "commit", "settings", "quick", "given"),
    *("claims", "unit", "tracks", "entrants"),
)

LAYERS = {
    "layer": "**ours, gradients with respect to all inputs**",
    "layer_forward": "ours, forward alone",
    "cvxpylayers": "cvxpylayers (SCS)",
    "cvxpylayers_clarabel": "cvxpylayers (Clarabel)",
    "cvxpylayers_moreau": "cvxpylayers (Moreau)",
    "moreau": "Moreau, exact cones",
    "qplayer": "ProxSuite, pyramids",
}
PLAIN = {
    **{
        f"time of {method} over ours, batch of 1": (f"speed-up over {name}, batch of 1", "x")
        for method, name in LAYERS.items()
        if method.startswith("cvxpylayers")
    },
    "cost of a step over the bare PyBullet calls, median of pairs": (
        "environment step time / time of its PyBullet calls",
        "",
    ),
}
"""Plain names of claims in the table of README.md, with units."""
VERDICTS = {True: "yes", False: "**NO**", None: "not measured"}


@cache
def force_rows() -> tuple[Rows, dict[str, Any]]:
    """Return all rows of the force benchmark, with its settings and machine."""
    return read(FORCE), json.loads((RESULTS / "force.json").read_text(encoding="utf-8"))


def parts(kind: str) -> list[str]:
    """Return the names of the saved runs of a kind, without suffixes."""
    whole = [file.stem for file in RESULTS.glob(f"{kind}.json")]
    names = sorted(file.stem for file in RESULTS.glob(f"{kind}-*.json"))
    if whole and names:
        raise SystemExit(f"{kind} is saved as a whole and in parts, {', '.join(names)}: remove one")
    return whole + names


def part_of(about: dict[str, Any]) -> str:
    """Return the name under which a run is saved: its kind, or a part of it."""
    kind, settings = about["kind"], about.get("settings", {})
    names = [*settings["hands"], *settings["engines"]] if kind == "errors" else []
    return "-".join([kind, *map(short_name, names)])


@cache
def saved(kind: str) -> tuple[Rows, dict[str, Any]]:
    """Return the summary of the saved runs of a kind, with settings and machine of the first."""
    names = parts(kind)
    rows = pd.concat([read(RESULTS / f"{name}.csv") for name in names], ignore_index=True)
    return rows, json.loads((RESULTS / f"{names[0]}.json").read_text(encoding="utf-8"))


def judged(kind: str) -> list[Verdict]:
    """Return the claims of a saved run, missed ones first."""
    means, about = saved(kind)
    return judge(claims_of(about), means)


def markdown(kind: str | None, table: Rows, note: str = "") -> str:
    """Return a table with the command and machine of its run below; `kind` None: no run."""
    lines = [
        list(table.columns),
        ["---"] * len(table.columns),
        *([cell(value) for value in row] for row in table.itertuples(index=False)),
    ]
    paragraphs = ["\n".join("| " + " | ".join(line) + " |" for line in lines), note]
    if kind:
        about = json.loads((RESULTS / f"{kind}.json").read_text(encoding="utf-8"))
        machine = about["machine"]
        paragraphs.append(
            f"`{about['command']}` at {about['commit']}, {about['time'][:10]}: {machine['processor']}, {machine['cores']} cores, Python "
            f"{machine['python']}."
        )
    return "\n\n".join(filter(None, paragraphs))


def reported(kind: str, make: Callable[[Rows, Rows], Rows]) -> Callable[[], str]:
    """Return a table of the report of a kind of run, from the saved summary."""
    return lambda: markdown(kind, make(pd.DataFrame(), saved(kind)[0]))


def targets(kind: str) -> Callable[[], str]:
    """Return the claims of a saved run with their targets, missed ones first."""

    def table() -> str:
        rows = [(row.claim.name, row.target, row.result, VERDICTS[row.met]) for row in judged(kind)]
        return markdown(kind, pd.DataFrame(rows, columns=["", "target", "measured", "met"]))

    return table


def force_tracks() -> str:
    """Return the tracks of the force benchmark, from their files."""
    rows = [
        {
            "track": f"`{track.name}`",
            "description": track.about["about"],
            "problems": track.size,
            "modes": ", ".join(track.about["modes"]),
        }
        for track in map(load, names())
    ]
    return markdown(None, pd.DataFrame(rows))


def force(objective: str) -> Callable[[], str]:
    """Return the results of the force benchmark by track and mode, for one objective."""
    ours = {name for name, where in ENTRANTS.items() if where.rpartition(":")[0].endswith(".ours")}
    note = "Median / 99 % in us of the problems solved to 1e-6."
    return lambda: markdown("force", by_track(force_rows()[0], objective, ours), note)


def force_entrants() -> str:
    """Return the entrants of the force benchmark over all tracks."""
    rows, about = force_rows()
    return markdown("force", by_entrant(rows, about["entrants"]))


def solvers() -> str:
    """Return the times of all solvers by number of contacts."""
    note = "Median / 99 % in us, 25 random grasps each."
    return markdown("force", by_contacts(force_rows()[0]), note)


def batch() -> str:
    """Return solves per second by method and number of cores."""
    means = saved("batch")[0]
    table = means.assign(millions=means["per_second_median"] / 1e6).pivot(
        index="method", columns="workers", values="millions"
    )
    table.columns = [f"{count} core{'' if count == 1 else 's'}" for count in table.columns]
    table = table.reindex(means["method"].unique())
    return markdown("batch", table.reset_index(names="million certified solves per second"))


def algorithms() -> str:
    """Return the times of the core's algorithms and the reasons why they exist."""
    means = saved("algorithms")[0]
    means["place"] = [list(ALGORITHMS).index(method) for method in means["method"]]
    rows = [
        {
            "algorithm": f"`{row['method']}`",
            "why it exists": ALGORITHMS[row["method"]],
            "problem": row["case"],
            "us, median / p99": pair(row, "microseconds"),
        }
        for row in means.sort_values("place", kind="stable").to_dict("records")
    ]
    for row, before in reversed(list(zip(rows[1:], rows, strict=False))):
        if row["algorithm"] == before["algorithm"]:
            row["algorithm"] = row["why it exists"] = ""
    return markdown("algorithms", pd.DataFrame(rows))


def step_rules() -> str:
    """Return the flow from the 12-basis and from the network with every step rule."""
    times = chosen(saved("reproduce")[0], "case == 'times'").set_index(["start", "rule"])
    columns = (("iterations", "iterations"), ("microseconds", "compiled call, us"))
    starts = (("linear_combination", "12-basis"), ("learned_fixed", "network"))
    rows = [
        {"step rule, median / p99": label}
        | {
            f"{start}: {name}": pair(times.loc[key, rule].to_dict(), column)
            for column, name in columns
            for key, start in starts
        }
        for rule, label in RULES.items()
    ]
    return markdown("reproduce", pd.DataFrame(rows))


def table_one() -> str:
    """Return Table I of the paper and our values on the reference grasp."""
    means = saved("reproduce")[0]
    ours, paper = (
        chosen(means, f"case == '{case}'").set_index("start")
        for case in ("table_one", "table_one_paper")
    )
    rows = [
        {
            "start": str(start).replace("_", " "),
            "sum of normal forces, paper [N]": paper.loc[start, "force_sum_median"],
            "ours [N]": row["force_sum_median"],
            "steps, paper": paper.loc[start, "iterations_median"],
            "ours": row["iterations_median"],
        }
        for start, row in ours.iterrows()
    ]
    return markdown("reproduce", pd.DataFrame(rows))


def fitted() -> str:
    """Return iterations in environments from the starts that a fitted model competes with."""
    means = saved("fitted")[0]
    rows = []
    for environment in means["environment"].unique():
        for case in CASES:
            here = chosen(means, f"case == '{case}'")
            starts = here[here["environment"] == environment].set_index("start")
            counts = {
                start: " / ".join(cell(row[f"iterations_{name}"]) for name in ("median", "p99"))
                for start, row in starts.iterrows()
            }
            shares = (
                starts.loc[REPAIRED, f"iterations_{name}"] / starts.loc[BASIS, f"iterations_{name}"]
                for name in ("median", "p99")
            )
            rows.append(
                {"environment": place(environment), "contacts": case}
                | counts
                | {"repaired network, of the 12-basis's": " / ".join(map(cell, shares))}
            )
    return markdown("fitted", pd.DataFrame(rows))


def rl() -> str:
    """Return agents beside the policies that learn nothing."""
    means = chosen(saved("rl")[0], "case == 'held_out'")
    rows = []
    for environment in means["environment"].unique():
        here = means[means["environment"] == environment].set_index("agent")
        for agent, (label, _) in AGENTS.items():
            if agent not in here.index:
                continue
            row = here.loc[agent]
            held = "none"
            if row["held_mean"]:
                held = f"{row['held_sum']:.0f} of {row['held_sum'] / row['held_mean']:.0f}"
            counts = "–"
            if not pd.isna(row["iterations_median"]):
                counts = " / ".join(cell(row[f"iterations_{name}"]) for name in ("median", "p99"))
            share = 100.0 * squeeze_saved(here, agent) if "/" in agent else float("nan")
            rows.append(
                {
                    "environment": place(environment),
                    "policy": label,
                    "held": held,
                    "squeeze [N]": row["commanded_force_mean"],
                    "squeeze saved [%]": "–"
                    if pd.isna(share)
                    else f"{share:.1f}".replace("-0.0", "0.0"),
                    "iterations, median / p99": counts,
                    "return, interquartile mean": row["return_iqm"],
                }
            )
    return markdown("rl", pd.DataFrame(rows))


def rl_speed() -> str:
    """Return steps per second and training times."""
    means = saved("rl")[0]
    rows = []
    for environment in chosen(means, "case == 'with training'")["environment"].unique():
        here = means[means["environment"] == environment]
        for agent, (label, _) in AGENTS.items():
            mine = here[here["agent"] == agent].set_index("case")
            if "with training" in mine.index:
                rows.append(
                    {"environment": place(environment), "agent": label}
                    | {
                        f"steps/s, {case}": round(mine.loc[case, "per_second_median"])
                        for case in SPEEDS
                    }
                    | {
                        "longest training [s of a core]": round(
                            mine.loc["training", "cpu_seconds_max"]
                        )
                    }
                )
    return markdown("rl", pd.DataFrame(rows))


def layer() -> str:
    """Return times of the force layer and of other differentiable layers, forward and backward."""
    summary = saved("layer")[0]
    means = summary[summary["microseconds_median"].notna()]
    case = {"hard": "", "limits": ", within the limits of 12 joints", "soft": ", soft contacts"}
    table = means.assign(
        text=[
            number(row["microseconds_median"])
            + (f" ({row['ratio_median']:.0f}x)" if row["ratio_median"] > 0 else "")
            for row in means.to_dict("records")
        ],
        name=[LAYERS[row["method"]] + case[row["case"]] for row in means.to_dict("records")],
    )
    order = table["name"].unique()
    table = table.pivot(index="name", columns="batch", values="text").reindex(order).fillna("–")
    table.columns = [f"batch of {size}" for size in table.columns]
    answers = chosen(summary, "case == 'hard, answers' and method == 'cvxpylayers_clarabel'")
    note = "Forward and backward in us per problem, in brackets relative to ours, on one core, four contacts. "
    for row in answers.to_dict("records"):
        note += f"Forces differ from Clarabel's by at most {row['force_difference_max']:.0e}, gradients by {row['gradient_difference_median']:.0e} in the median."
    return markdown("layer", table.reset_index(names="layer"), note)


def hand_loop() -> str:
    """Return latencies and losses of the hardware example."""
    means = saved("hand_loop")[0]
    names = {"cpp": "C++", "python": "Python"}
    rows = [
        {"controller": names[row["method"]], "time": row["case"], "n": row["n"], **latencies(row)}
        for row in chosen(means, "case != 'run'").to_dict("records")
    ]
    sentences = [
        f"{names[row['method']]}: {row['lost_sum']:.0f} messages lost, {row['unanswered_sum']:.0f} replaced by a newer one, {row['late_sum']:.0f} updates "
        f"after a missed deadline, {row['over_budget_sum']:.0f} over budget, the simulated hand late in {row['behind_sum']:.0f} steps; "
        f"the ball moved by at most {row['drift_max']:.2f} mm."
        for row in chosen(means, "case == 'run'").to_dict("records")
    ]
    return markdown("hand_loop", pd.DataFrame(rows), "\n".join(sentences))


def latencies(row: dict[str, Any]) -> dict[str, str]:
    """Return the statistics of a latency [us] by their headings."""
    names = {"median": "median [us]", "p99": "99 %", "p999": "99.9 %", "max": "largest"}
    return {label: cell(row[f"latency_{name}"]) for name, label in names.items()}


def objects() -> str:
    """Return the real objects that hands held under gravity and under the random wrench."""
    means = saved("objects")[0]
    keys = ["object", "hand", "engine"]
    pairs = means.pivot(index=keys, columns="case", values=["held_sum", "n"])
    table: dict[str, dict[str, str]] = {}
    for (name, hand, engine), row in pairs.iterrows():
        if engine == "bullet":
            gravity = "held" if row["held_sum", "mesh_gravity"] else "**lost**"
            random = f"{row['held_sum', 'mesh_random']:.0f} of {row['n', 'mesh_random']:.0f}"
            line = table.setdefault(name, {"gravity; random wrench, in Bullet": name})
            line[hand] = f"{gravity}; {random}"
    labels = {
        "mesh_gravity": "gravity",
        "mesh_random": "random wrench",
        "mesh_six_directions": "six pushes",
    }
    sentences = []
    for engine, group in means.groupby("engine", sort=False):
        sums = group.groupby("case")[["held_sum", "n"]].sum()
        counts = (
            f"{label} {sums.loc[case, 'held_sum']:.0f} of {sums.loc[case, 'n']:.0f}"
            for case, label in labels.items()
        )
        sentences.append(f"{engine}: {', '.join(counts)}")
    note = f'All pairs, by engine (`faces`: Bullet with `mesh_contacts="faces"`). {"; ".join(sentences)}.'
    return markdown("objects", pd.DataFrame(table.values()), note)


def errors() -> str:
    """Return the controllers under errors, a table for each hand and engine, and their settings."""
    blocks = list[str]()
    for part in parts("errors"):
        means = read(RESULTS / f"{part}.csv")
        for title, _, make in errors_page.held_tables(means):
            blocks.append(f"{title}:\n\n{markdown(None, make(means, means))}")
        settings = markdown(part, errors_page.chosen_settings(means, means))
        blocks.append(f"Chosen settings:\n\n{settings}")
    return "\n\n".join(blocks)


def overview() -> str:
    """Return the table of README.md: the main numbers with targets or comparisons."""

    def row(kind: str, query: str) -> dict[str, Any]:
        return chosen(saved(kind)[0], query).to_dict("records")[0]

    def varied(start: str, method: str, column: str) -> str:
        query = f"case == 'ball_frictions' and start == '{start}' and method == '{method}'"
        return pair(row("starts", query), column)

    def layer(method: str) -> dict[str, Any]:
        return row("layer", f"case == 'hard' and method == '{method}' and batch == 1000")

    constant = row(
        "reproduce", "case == 'times' and rule == 'fixed' and start == 'linear_combination'"
    )
    engines = max(judged("transfer"), key=lambda claim: abs(claim.measured or 0.0))
    objects = row("env", "case == 'objects' and controller == 'paper'")
    rows = [
        *(
            [
                f"conic optimum (least sum of normal forces) with certificate, 3 to 5 contacts, from {language}, median / p99",
                f"{fixed_contacts(method)} us",
                f"fastest other solver (generated C): {fixed_contacts('qocogen_fast')} us",
            ]
            for language, method in (("Python", "conic_python"), ("C++", "conic"))
        ),
        [
            "optimum of Phi from Python, Newton, cold start, median / p99",
            f"{varied('internal_force', 'newton', 'microseconds')} us",
            f"the paper's flow from the 12-basis: {varied('linear_combination', 'reduced_flow', 'microseconds')} us",
        ],
        [
            "optimum of Phi from Python, Newton, learned start, median / p99",
            f"{varied('learned_fixed', 'newton', 'microseconds')} us",
            f"the paper's flow from the learned start: {varied('learned_fixed', 'reduced_flow', 'microseconds')} us",
        ],
        [
            "iterations of the paper's flow from the 12-basis, median / p99",
            varied("linear_combination", "reduced_flow", "iterations"),
            f"with a constant step: {pair(constant, 'iterations')}",
        ],
        [
            "iterations of the paper's flow from the network's prediction alone, median / p99",
            varied("network", "reduced_flow", "iterations"),
            "target: at most 3 / 15",
        ],
        [
            "optimum of Phi and its gradients in torch, batch of 1000",
            f"{number(layer('layer')['microseconds_median'])} us a problem",
            f"speed-up over cvxpylayers (Clarabel): {layer('cvxpylayers_clarabel')['ratio_median']:.0f}x",
        ],
        [
            "random objects held for 4 s under a random wrench",
            f"{objects['held_sum']:.0f} of {objects['n']}",
            "target: at least 99 %",
        ],
        [
            "largest difference of the holding rate between MuJoCo and Bullet",
            engines.result,
            f"target: {engines.target}",
        ],
        *(
            [f"**missed**: {name}", claim.result + unit, f"target: {claim.target}{unit}"]
            for kind in ("starts", "layer", "env", "errors", "env_speed")
            for claim in judged(kind)
            if claim.met is False
            for name, unit in [PLAIN.get(claim.claim.name, (claim.claim.name, ""))]
        ),
    ]
    columns = ["quantity", "measured", "target or comparison"]
    return markdown("starts", pd.DataFrame(rows, columns=columns))


def fixed_contacts(method: str) -> str:
    """Return p50 / p99 [us] of an entrant on jumps of the wrench, 3 to 5 fixed contacts."""
    cell = "objective == 'sum' and case == 'jumps' and mode == 'persistent'"
    rows = chosen(force_rows()[0], f"{cell} and method == '{method}'")
    return pair_of(numbers(rows, "microseconds"))


TABLES: dict[str, Callable[[], str]] = {
    "summary": overview,
    "hand_loop": hand_loop,
    "solvers": solvers,
    "force_tracks": force_tracks,
    "force_sum": force("sum"),
    "force_phi": force("phi"),
    "force_entrants": force_entrants,
    "algorithms": algorithms,
    "batch": batch,
    "starts": reported("starts", starts_page.hardest_sets),
    "calls": reported("starts", starts_page.all_starts),
    "network": reported("starts", starts_page.learned_steps),
    "newton_first": reported("starts", starts_page.newton_first),
    "starts_claims": targets("starts"),
    "hold": reported("env", holds_page.grid),
    "errors": errors,
    "hands": reported("hands", holds_page.grid),
    "objects": objects,
    "transfer": reported("transfer", holds_page.grid),
    "soft": reported("soft", holds_page.grid),
    "env_speed": targets("env_speed"),
    "step_rules": step_rules,
    "layer": layer,
    "table_one": table_one,
    "fitted": fitted,
    "rl": rl,
    "rl_speed": rl_speed,
}


def save(folder: Path) -> str:
    """Save the summary and the picture of a run folder, and return the kind of the run."""
    rows, about = Run.open(folder).load()
    if about.get("quick"):
        raise SystemExit(f"{folder} is a quick run, whose numbers are not quoted: run it in full")
    RESULTS.mkdir(exist_ok=True)
    name = part_of(about)
    if name == "force":
        write(FORCE, rows)
    else:
        write_summary(RESULTS / f"{name}.csv", summary(rows))
    with replacing(RESULTS / f"{name}.json") as target:
        text = json.dumps({name: about[name] for name in PROVENANCE if name in about}, indent=1)
        # a path belongs to one machine
        text = re.sub(r"(?<![\w.])/[^\s\"]*/(?=[^\s\"])", "", text)
        target.write_text(text + "\n", encoding="utf-8")
    for picture in folder.glob("*.svg"):
        with replacing(RESULTS / f"{name}.svg") as target:
            target.write_bytes(picture.read_bytes())
    return name


def filled(text: str) -> tuple[str, list[str]]:
    """Return the text with new blocks, and the names of the blocks that changed."""
    changed = []

    def block(match: re.Match[str]) -> str:
        start, name, before, end = match.groups()
        if name not in TABLES:
            raise SystemExit(f"no table {name!r}; there are {', '.join(TABLES)}")
        new = TABLES[name]() + "\n"
        if new != before:
            changed.append(name)
        return start + new + end

    return BLOCK.sub(block, text), changed


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program, see the module."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--save", nargs="+", type=Path, default=[])
    args = parser.parse_args(arguments)
    for path in args.save:
        sys.stdout.write(f"{path} -> docs/results/{save(path)}.csv\n")
    differ = 0
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        text, changed = filled(page.read_text(encoding="utf-8"))
        differ += len(changed)
        for name in changed:
            fault = " differs from docs/results" if args.check else ""
            sys.stdout.write(f"{page.name}: {name}{fault}\n")
        if changed and not args.check:
            with replacing(page) as target:
                target.write_text(text, encoding="utf-8")
    return int(args.check and differ > 0)


if __name__ == "__main__":
    sys.exit(main())
