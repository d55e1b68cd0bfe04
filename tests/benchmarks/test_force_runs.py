"""The benchmark of forces: both kinds of entrants, their times, the program, and the tables of
known rows."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles import pinch
from scipy.spatial import ConvexHull

from benchmarks.force import build, problems, report, run
from benchmarks.force.__main__ import main
from benchmarks.force.bounds import Measure
from benchmarks.force.entrant import Library, Task
from benchmarks.force.entrants import ENTRANTS, qocogen
from benchmarks.force.entrants.clarabel import Clarabel
from benchmarks.force.entrants.forms import Dual, Primal
from benchmarks.force.entrants.ours import ConicPython
from benchmarks.force.entrants.pyramids import directions
from benchmarks.force.package import problem_of
from benchmarks.force.problems import Problem, load
from grasp_env.force import ForceOptimizer
from grasp_env.grasp import presets
from training.evaluation.results.table import read, table
from training.evaluation.results.words import number

WRENCH = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])


def made(wrench=WRENCH, **other) -> Problem:
    return problem_of(presets.paper_cuboid(), wrench, **other)


ECHO = """
#include "force.h"
void *echo_setup(const force_problem *p, const char *objective) { return objective[0] == 's' ? (void *)p->friction : 0; }
int echo(void *context, const force_problem *p, const double *start, double *force, double *multipliers, int *iterations) {
    double sum = 0.0;
    for (int k = 0; k < 3 * p->contacts; ++k) sum += p->positions[k] + p->normals[k];
    for (int k = 0; k < 6 * p->contacts * p->joints; ++k) sum += p->jacobian[k];
    for (int k = 0; k < 6 * p->contacts * p->width; ++k) sum += p->matrix[k];
    for (int k = 0; k < p->limits; ++k) sum += p->limit_bound[k];
    if (p->preload) sum += *p->friction_margin + p->preload[p->contacts - 1];
    for (int k = 0; k < p->contacts * p->width; ++k) force[k] = start ? start[k] + 1.0 : sum;
    for (int k = 0; k < 6 + p->limits; ++k) multipliers[k] = p->touching + 100.0 * p->moved;
    if (iterations) *iterations = p->limits;
    return p->wrench[0] > 0.0 ? 0 : 2;
}
"""


@pytest.fixture(scope="module")
def echo(tmp_path_factory):
    if not shutil.which("gcc"):
        pytest.skip("there is no gcc")
    folder = tmp_path_factory.mktemp("echo")
    source = folder / "echo.c"
    source.write_text(ECHO)
    return build.library(
        "echo", [source], ["-O1", "-Wall", "-Werror", f"-I{Path(run.__file__).parent}"]
    )


def test_c_sees_the_problem_and_is_timed_in_c(echo):
    rng = np.random.default_rng(0)
    torques = {
        "jacobian": rng.standard_normal((4, 6, 5)),
        "torque_limit": np.full(5, 2.0),
        "torque_bias": np.zeros(5),
    }
    margin = {"friction_margin": np.array(0.7), "preload": np.arange(4.0)}
    problem = made(touching=np.array([True, True, False, True]), moved=True, **torques, **margin)
    library = Library(str(echo), "echo")
    with pytest.raises(NotImplementedError):
        library.setup(Task("", "phi", "persistent", problem))
    library.setup(Task("", "sum", "persistent", problem))
    force, multipliers, status = library.solve(problem)
    arrays = (
        problem.positions,
        problem.normals,
        problem.jacobian,
        problem.matrix,
        problem.limit_bound,
        problem.friction_margin,
        problem.preload[-1:],
    )
    np.testing.assert_allclose(force, sum(array.sum() for array in arrays if array is not None))
    assert set(multipliers) == {0b1011 + 100.0}
    assert (status, len(multipliers)) == ("solved", 16)
    assert library.solve(problem, np.ones(12))[0].tolist() == [2.0] * 12
    each = [made([1.0, k, 0.0, 0.0, 0.0, 0.0]) for k in range(3)]
    first = library.solve(each[0])[0][0]
    for mode, more in (("persistent", [0.0] * 3), ("warm", [0.0, 1.0, 2.0]), ("cold", [0.0] * 3)):
        timed = run.Timed(Library(str(echo), "echo"), Task("", "sum", mode, each[0]), each)
        timed.passes(4)
        assert [answer.force[0] - first for (answer,) in timed.answers] == pytest.approx(more)
        assert (timed.seconds < 1e-3).all()
        assert timed.iterations.tolist() == [0.0, 0.0, 0.0]


class Told:
    """Answers with the force it was started from plus one; the clock that it is timed by goes as it
    says."""

    name, division = "told", "learned"

    def __init__(self, now: list[int]) -> None:
        self.now = now
        self.took = [1, 5, 7, 9, 2, 6, 3, 8]

    def setup(self, task):
        self.iterations = 0

    def solve(self, problem, start=None):
        self.now[0] += 1000 * self.took.pop(0)
        self.iterations += 1
        if problem.wrench[0] > 2.0:
            raise ZeroDivisionError("none")
        return np.zeros(12) if start is None else start + 1.0

    def solve_many(self, problems):
        return [np.zeros(12)] * len(problems)


@pytest.mark.parametrize("mode", ["persistent", "warm", "cold"])
def test_python_is_timed_by_the_least_of_its_passes(mode, monkeypatch):
    now = [0]
    monkeypatch.setattr("time.perf_counter_ns", lambda: now[0])
    each = [made([wrench, 0.0, 0.0, 0.0, 0.0, 0.0]) for wrench in (1.0, 2.0, 3.0)]
    timed = run.Timed(Told(now), Task("", "sum", mode, each[0]), each)
    timed.passes(2)
    np.testing.assert_allclose(1e6 * timed.seconds, [5.0, 3.0, 8.0])
    # counted since `setup`
    assert timed.iterations.tolist() == ([1.0] * 3 if mode == "cold" else [2.0, 3.0, 4.0])
    assert [answer.status for (answer,) in timed.answers] == ["solved", "solved", "failed"]
    assert timed.answers[2][0].message == "ZeroDivisionError: none"
    assert timed.answers[1][0].force[0] == (mode == "warm")
    assert timed.calls == 2
    assert (timed.many is None) == (mode != "persistent")


@pytest.mark.parametrize("factor", [1.01, None])
def test_the_answers_of_all_passes_are_scored(factor):
    """An entrant whose later passes give another force, or none, has not solved the problem."""
    best = ForceOptimizer(presets.paper_cuboid(), method="conic", tolerance=1e-10).solve(WRENCH)

    class Once:
        def __init__(self):
            self.answers = [best.force, best.force]  # a pass begins with a call that does not count

        def setup(self, task):
            pass

        def solve(self, problem, start=None):
            later = factor and factor * best.force
            return self.answers.pop() if self.answers else later

    optimum = problems.Reference(
        *np.full((3, 1), best.objective), best.force.reshape(1, -1), np.array([best.multipliers])
    )
    arrays = {
        name: np.array([getattr(made(), name)])
        for name in ("positions", "frames", "friction", "wrench")
    }
    session = problems.Session("", arrays, {"sum": optimum})
    track = problems.Track("one", [session], {"objectives": ["sum"], "modes": ["persistent"]})
    for passes, solved in ((1, True), (2, False)):
        rows = run.measured(
            [track], {"once": Once}, run.Effort(rounds=1, seconds=1.0, passes=passes)
        )[0]
        assert [row["solved"] for row in rows if row["method"] == "once"] == [solved]


class Shifted(ConicPython):
    """Our entrant without its own margin."""

    margins = False

    def solve(self, problem, start=None):
        assert not problem.has_margin
        return super().solve(problem, start)


def test_a_margin_is_given_or_the_problem_is_shifted():
    """Contacts and margins that move, and three times one problem, which is also solved at once."""
    track = load("margin")
    moving = track.sessions[12]
    one = {name: array[:1] for name, array in moving.arrays.items()}
    one["wrench"] = one["wrench"].repeat(3, axis=0)
    optimum = problems.Reference(
        **{
            name: array[:1].repeat(3, axis=0)
            for name, array in vars(moving.references["sum"]).items()
            if array is not None
        }
    )
    still = replace(moving, arrays=one, references={"sum": optimum})
    track = replace(track, sessions=[moving, still])
    rows, _ = run.measured(
        [track], {"given": ConicPython, "shifted": Shifted}, run.Effort(rounds=1, seconds=0.0)
    )
    ran = [row for row in rows if row["method"] != "empty"]
    assert len(ran) == 2 * 18
    assert all(row["solved"] and row["proved"] for row in ran)
    assert sum("many_microseconds" in row for row in ran) == 2 * 3


HELD = [(3.0, 0.08), (4.0, 0.01), (-1.0, 0.1)]
"""Forces [N] and moments [N m] that the pinch holds."""


def pinched(name: str, joints: int = 0, **margin: float) -> problems.Track:
    """A track of pinches, whose optima are known without a solver: torques of joints are far from
    their limits."""
    arrays = {
        "positions": pinch.POSITIONS[None],
        "frames": pinch.FRAMES[None],
        "friction": np.full((1, 2), pinch.MU),
        "torsional_friction": np.full((1, 2), pinch.GAMMA),
        "wrench": np.array([pinch.wrench(*each) for each in HELD]),
    }
    if joints:
        draw = np.random.default_rng(0).uniform(-1.0, 1.0, (1, 2, 6, joints))
        arrays |= {"jacobian": draw, "torque_limit": np.full((1, joints), 100.0)}
    if margin:
        arrays["friction_margin"] = np.array([margin["margin"]])
        arrays["preload"] = np.full((1, 2), margin["preload"])
    normals = [pinch.least_normal(*each, **margin) for each in HELD]
    forces = [
        pinch.forces(normal, *each).ravel() for normal, each in zip(normals, HELD, strict=True)
    ]
    slopes = [np.append(pinch.multipliers(*each), np.zeros(2 * joints)) for each in HELD]
    best = 2.0 * np.array(normals)
    optimum = problems.Reference(best, best, best, np.array(forces), np.array(slopes))
    session = problems.Session("", arrays, {"sum": optimum})
    about = {"objectives": ["sum"], "modes": ["persistent"]}
    return problems.Track(name, [session], about)


def test_bounds_of_friction_and_torsion_apart_solve_nothing():
    class Apart:
        """The optimum of separate bounds, in closed form."""

        def setup(self, task):
            pass

        def solve(self, problem, start=None):
            force, moment = problem.wrench[[1, 3]]
            least = pinch.least_normal_apart(abs(force), abs(moment))
            return pinch.forces(least, force, moment)

    rows, _ = run.measured([pinched("pinch")], {"apart": Apart}, run.Effort(rounds=1, seconds=0.0))
    ran = [row for row in rows if row["method"] == "apart"]
    assert len(ran) == len(HELD)
    assert not any(row["solved_coarse"] for row in ran)
    assert min(row["violation"] for row in ran) > 1e-3


@pytest.mark.parametrize(("dimensions", "edges", "held"), [(2, 8, 0.92), (3, 26, 0.88)])
def test_pyramids_lie_inside_their_cones(dimensions, edges, held):
    """All edges are on the cone, and hold a ball of this share of it."""
    rays = directions(dimensions)
    assert rays.shape == (edges, 1 + dimensions)
    np.testing.assert_allclose(np.linalg.norm(rays[:, 1:], axis=1), rays[:, 0], rtol=1e-15)
    sphere = np.random.default_rng(0).standard_normal((2000, dimensions))
    sphere /= np.linalg.norm(sphere, axis=1)[:, None]
    hull = ConvexHull(rays[:, 1:])  # a . x + b <= 0
    assert -hull.equations[:, -1].max() > held
    assert (hull.equations[:, :-1] @ (held * sphere).T <= -hull.equations[:, -1:]).all()


SMALL = ["--tracks", "smooth", "soft", "--quick"]


def test_an_entrant_of_one_file_is_run_saved_and_reported(tmp_path, capsys):
    """The worked example of the page, beside ours, in runs that `report` compares."""
    entrants = ["--solver", "benchmarks/force/example.py:Mine", "--against", "conic_python"]
    assert main(["run", *SMALL, *entrants, "--out", str(tmp_path), "--name", "a"]) == 0
    told = capsys.readouterr().out
    assert "mine did not enter soft: hard contacts without limits" in told
    rows = read(tmp_path / "a/rows.csv.xz")
    ran = rows[rows["status"].notna() & (rows["method"] != "empty")]
    assert ran[ran["method"] == "conic_python"]["solved"].all()
    assert ran["solved"].mean() > 0.97  # SLSQP leaves a few at 2e-6
    entered = {*zip(ran["method"], ran["case"], strict=True)}
    assert entered == {("mine", "smooth"), ("conic_python", "smooth"), ("conic_python", "soft")}
    about = json.loads((tmp_path / "a/run.json").read_text())
    assert about["tracks"]["smooth"] == load("smooth").about["sha256"]
    # pictures hold plain text
    assert "mathdefault" not in (tmp_path / "a/profiles.svg").read_text()
    assert main(["report", str(tmp_path / "a"), str(tmp_path / "a")]) == 0
    assert "before" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "--tracks", "smoth"], "no track 'smoth'"),
        (["run", "--solver", "nowhere.py:Mine"], "there is no file nowhere.py"),
        (
            ["run", "--solver", "benchmarks/force/example.py:np"],
            "has no setup and no solve: see Entrant in",
        ),
        (["generate", "soft", "--seed", "-1"], "the seed must be at least 0, got -1"),
        (["report", "nowhere"], "not a finished run"),
        (["validate", "--sets", "docs"], "holds no track"),
    ],
)
def test_mistakes_are_told_in_one_line(words, said, capsys):
    assert main(words) == 2
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1


@pytest.fixture(scope="module")
def tracks():
    """Three problems each: of contacts that move, within torque limits, soft, and with a margin;
    and pinches of known optima."""
    loaded = [load(name) for name in ("random", "own", "soft", "margin")]
    narrow = pinched("pinch, margin", margin=0.8, preload=1.5)
    return [*loaded, pinched("pinch"), narrow, pinched("pinch, many limits", joints=6)]


@pytest.mark.parametrize("name", ENTRANTS)
def test_an_entrant_agrees_or_shows_its_failures(name, tracks, monkeypatch, tmp_path):
    """Entrants with pyramids miss the optimum, and what cannot run here is skipped with its reason."""
    if name in ("conic", "newton", "flow"):
        pytest.skip(
            "compiling the C++ front takes minutes: `python -m benchmarks.force validate --solver conic`"
        )
    monkeypatch.setattr(build, "BUILD", tmp_path)
    monkeypatch.setattr("gc.collect", lambda: None)  # half of the time
    monkeypatch.setattr(qocogen.Qocogen, "flags", ("-O0",))  # a fifth of the time
    monkeypatch.setattr(qocogen.QocogenFast, "flags", ("-Ofast",))
    if name == "qocogen_fast":
        tracks = [replace(tracks[0], about=tracks[0].about | {"objectives": ["sum"]})]
    rows, _ = run.measured(
        tracks, run.entrants([name]), run.Effort(rounds=1, seconds=0.0, sessions=1, problems=3)
    )
    rows = table(rows)
    ran = rows[(rows["method"] == name) & rows["status"].notna()]
    if ran.empty:
        pytest.skip(str(rows["reason"].dropna().iloc[-1]))
    assert not ran["wrong"].any()
    if name in ("highs", "piqp"):
        assert 0.0 < ran["gap"].median() < 0.1
        assert ran["balance"].max() < 1e-4
        assert ran["violation"].max() < 1e-6  # they are inside the cones
    else:
        assert ran["solved"].all()
    # no library makes this process flush small numbers to zero
    assert np.full(9, 5e-324).max() > 0.0


@pytest.mark.parametrize("form", [Dual, Primal])
def test_either_form_shows_that_no_force_exists(form):
    pytest.importorskip("clarabel")
    for session in load("infeasible").sessions[::3]:  # without closure, weak motors, soft pinches
        problem = session.problems[0]
        solver = Clarabel()
        solver.form = form(problem)
        solver.build()
        force, witness, status = solver.form.answer(*solver.run(False))
        assert (force, status) == (None, "infeasible")
        assert Measure.of(problem).witness(witness) > 0.0


def test_tables_of_known_rows():
    rng = np.random.default_rng(0)
    keys = ("case", "objective", "mode", "language", "division", "event")
    base = dict(zip(keys, ("smooth", "sum", "persistent", "Python", "closed", "4"), strict=True))
    rows = []
    for k in range(100):
        common = {
            "problem": k,
            "solved_coarse": True,
            "proved": True,
            "wrong": False,
            "iterations": 5,
        }
        time = rng.uniform(1.0, 2.0)
        rows += [
            base | common | {"method": "fast", "microseconds": time, "solved": True},
            base
            | common
            | {"method": "same", "microseconds": time * rng.uniform(0.98, 1.03), "solved": True},
            base
            | common
            | {"method": "slow", "microseconds": 10.0 * time, "solved": k > 0, "iterations": 50},
            base | common | {"method": "empty", "microseconds": 0.1, "solved": False},
        ]
    made = table(rows)
    found = report.standings(made).set_index("method")
    assert found["solved"].to_dict() == {"fast": 100, "same": 100, "slow": 99}
    assert found.index[-1] == "slow"
    assert found.loc["slow", "p50_ratio"] == pytest.approx(10.0, rel=0.05)
    assert found["first"].to_dict() == {
        "fast": "success, p50, p99",
        "same": found.loc["same", "first"],
        "slow": "",
    }
    assert "p50" in found.loc["same", "first"]
    times = made[made["method"] == "slow"]["microseconds"].to_numpy(float)
    logs = np.log(np.append(times[1:], report.PENALTY) + 1.0)
    assert found.loc["slow", "mean"] == pytest.approx(np.exp(logs.mean()) - 1.0)
    factors, share = report.profile(made, "iterations")["slow"]
    assert factors.tolist() == [10.0] * 99
    assert share[-1] == pytest.approx(0.99)
    again = made.assign(microseconds=2.0 * made["microseconds"])
    both = report.beside(again, made).set_index("method")
    assert both.loc["fast", ["ratio", "tie"]].tolist() == [2.0, False]
    assert report.beside(made, made)["tie"].all()
    assert any("an empty call: 0.1 us" in line for line in report.lines(made, 1000.0))
    p50, p99 = np.percentile(times[1:], [50.0, 99.0])
    (line,) = report.by_track(made[made["method"].isin(["slow", "fast"])], "sum", {"slow"}).to_dict(
        "records"
    )
    assert line["ours, Python"] == f"{number(p50)} / {number(p99)} (slow, 99 of 100)"
    assert line["fastest other, Python"].endswith(" (fast)")
    assert line["ours, C"] == "–"
