"""The benchmark of forces: files, references, scores by hand, bounds and witnesses."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from mpmath import mp
from oracles import margin, pinch
from oracles.phi import phi

from benchmarks.force import check, generate, problems, references
from benchmarks.force.__main__ import main
from benchmarks.force.bounds import Measure
from benchmarks.force.package import grasp_of, margin_of, problem_of
from benchmarks.force.problems import SETS, Problem, load, names
from benchmarks.force.score import parts_of, score
from grasp_env.errors import InfeasibleWrenchError
from grasp_env.force import ForceLimits, ForceOptimizer, Margin
from grasp_env.grasp import Grasp, presets
from grasp_env.inputs.files import digest

TRACKS = names()
LARGEST_DISTANCE = {"double": 1e-10, "exact": 3e-16}
"""Largest relative difference between a stored optimum and one that is computed again: the gap that
doubles aim at, or their last bit."""
WRENCH = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])


def made(wrench=WRENCH, **other) -> Problem:
    return problem_of(presets.paper_cuboid(), wrench, **other)


PROBLEM = made()
MEASURE = Measure.of(PROBLEM)
OPTIMUM = ForceOptimizer(presets.paper_cuboid(), method="conic", tolerance=1e-10).solve(WRENCH)
FORCE = OPTIMUM.force.reshape(-1)
BEST = OPTIMUM.objective
PRELOAD = np.array([0.0, 1.0, 0.5, 2.0])
KEPT = {"friction_margin": np.array(0.7), "preload": PRELOAD}
NARROW = made(**KEPT)
SOFT = made(torsional_friction=np.array([0.01, 0.004, 0.0, 0.006]))
ONE_SIDE = np.tile(np.array(presets.paper_cuboid().frames)[0], (4, 1, 1))
"""Four fingers that push the same way: they cannot push back."""
PULLED = made([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], frames=ONE_SIDE)


@pytest.mark.parametrize("name", TRACKS)
def test_a_file_is_made_by_its_seed_and_its_references_hold(name):
    track = load(name)
    again = generate.generate(name, track.about["seed"])
    assert again.digest() == track.about["sha256"]
    for key in ("modes", "objectives"):
        assert again.about[key] == tuple(track.about[key])
    assert (
        again.about["place"]
        == track.about["place"]
        == TRACKS.index(name)
        == list(generate.TRACKS).index(name)
    )
    # a part of the sessions; `validate` checks all of them
    assert check.check(replace(track, sessions=track.sessions[::4])) == []


def test_the_first_tracks_keep_their_bytes(tmp_path):
    """Times of earlier runs stay comparable, and a description that is written again is the same."""
    files = [SETS / f"{name}{kind}" for name in TRACKS[:12] for kind in (".json", ".npz")]
    assert digest(*(path.read_bytes() for path in files)).startswith("e998b0895bc88b00")
    problems.save(load("soft"), tmp_path)
    assert (tmp_path / "soft.json").read_bytes() == (SETS / "soft.json").read_bytes()


def test_sessions_of_one_description_are_told_apart(tmp_path):
    """With seed 1, two pinches have the same size."""
    track = generate.generate("soft", 1)
    problems.save(track, tmp_path)
    assert load("soft", tmp_path).digest() == track.digest()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sha256": "0" * 64}, r"does not hold the problems of soft\.json"),
        ({"schema": 9}, "file has schema 9; this version reads schema 2; make it again"),
        ({"schema": 1}, "file has schema 1; this version reads schema 2; make it again"),
        ({"modes": ["hot"]}, r"its modes are \['hot'\], known are cold, persistent, warm"),
        (None, r"soft\.json lacks modes, objectives, sessions, sha256"),
    ],
)
def test_a_changed_file_is_refused(change, words, tmp_path):
    problems.save(load("soft"), tmp_path)
    about = json.loads((tmp_path / "soft.json").read_text())
    (tmp_path / "soft.json").write_text(
        json.dumps({"schema": 2} if change is None else about | change)
    )
    with pytest.raises(ValueError, match=words):
        load("soft", tmp_path)
    (tmp_path / "soft.json").write_text(json.dumps(about))
    (tmp_path / "soft.npz").write_bytes((tmp_path / "soft.npz").read_bytes()[:999])
    with pytest.raises(
        ValueError, match="is not a track of this version: File is not a zip file; make it again"
    ):
        load("soft", tmp_path)


def one_of(name: str, session: int = 0, m: int = 1) -> tuple[problems.Track, problems.Session]:
    """A track with one problem, and its session."""
    track = load(name)
    whole = track.sessions[session]
    arrays = {
        field: array[m : m + 1] if len(array) > 1 else array
        for field, array in whole.arrays.items()
    }
    references = {
        objective: problems.Reference(
            **{key: a[m : m + 1] for key, a in vars(stored).items() if a is not None}
        )
        for objective, stored in whole.references.items()
    }
    one = problems.Session("", arrays, references)
    return replace(track, sessions=[one]), one


@pytest.mark.parametrize(
    "field", ["value", "lower", "upper", "other", "force", "multipliers", "rest"]
)
@pytest.mark.parametrize("name", ["roll", "own", "soft", "hard", "infeasible", "margin", "loop"])
def test_a_falsified_reference_is_found(name, field):
    track, one = one_of(name)
    assert check.check(track) == []
    for objective, stored in one.references.items():
        right = getattr(stored, field)
        if right is None:
            continue
        if field in ("force", "multipliers", "rest"):
            numbers = (
                stored.multipliers
                if field == "multipliers"
                else np.nan_to_num(stored.force, nan=1.0)
            )
            change = (
                1e-3 * np.abs(numbers).max() * np.random.default_rng(0).standard_normal(right.shape)
            )
            wrong = (
                -right
                if right is stored.multipliers and name == "infeasible"
                else np.nan_to_num(right) + change
            )
        else:
            size = {"value": 3e-9, "other": 3e-8}.get(field, 1e-10)
            wrong = np.where(np.isfinite(right), right * (1.0 + size), 1.0)
        changed = replace(
            one, references=one.references | {objective: replace(stored, **{field: wrong})}
        )
        faults = check.check(replace(track, sessions=[changed]))
        assert faults, (objective, field)
        assert all(f"problem 0, {objective}: " in fault for fault in faults)


def remake(track: problems.Track, session: problems.Session) -> None:
    """References made anew hold, and have the stored optima; where there are many digits, also the
    same least Phi's force."""
    objectives = track.about["objectives"]
    digits = track.about["digits"]
    made = references.refer(session, objectives, digits)
    again = problems.Track(
        track.name, [replace(session, references=made)], {"objectives": objectives}
    )
    assert check.check(again) == []
    for objective, stored in session.references.items():
        assert references.distance(stored, made[objective]) <= LARGEST_DISTANCE[digits]
        if digits == "exact" and objective == "phi":
            forces = [
                all_digits(each.force, each.rest[:, : each.force.shape[1]])
                for each in (stored, made[objective])
            ]
            assert (np.abs(forces[1] - forces[0]).max(1) < 1e-18 * np.abs(forces[0]).max(1)).all()


def all_digits(high, low):
    with mp.workdps(references.DIGITS):
        return references.numbers(high) + references.numbers(low)


@pytest.mark.parametrize("name", TRACKS)
def test_references_are_made_again(name):
    remake(*one_of(name))


@pytest.mark.slow
@pytest.mark.parametrize("name", TRACKS)
def test_all_references_are_made_again(name):
    track = load(name)
    for session in track.sessions:
        remake(track, session)


def test_the_program_compares_references_with_stored_ones(tmp_path, capsys):
    track, one = one_of("soft")
    right = one.references["sum"]
    for factor, code in ((1.0, 0), (1.0 + 3e-8, 1)):
        wrong = replace(one, references={"sum": replace(right, value=factor * right.value)})
        problems.save(replace(track, sessions=[wrong]), tmp_path)
        assert main(["references", "--sets", str(tmp_path)]) == code
        assert "soft: the optima differ from the stored ones by at most" in capsys.readouterr().out
    for some in (right, one_of("infeasible")[1].references["sum"]):
        other = replace(some, value=np.where(np.isfinite(some.value), np.inf, 1.0))
        assert references.distance(some, other) == np.inf
    problems.save(replace(track, sessions=[replace(one, references={})]), tmp_path)
    assert main(["references", "--sets", str(tmp_path)]) == 2
    assert "stores no references of sum" in capsys.readouterr().err


def test_what_has_no_digits_is_told():
    soft = load("soft").sessions[0].problems[0]
    nothing = made(np.zeros(6))
    for problem, words in (
        (soft, "hard contacts without limits and margin"),
        (NARROW, "hard contacts without limits and margin"),
        (nothing, "no wrench"),
        (PULLED, "no force"),
    ):
        with pytest.raises(ArithmeticError, match=words):
            references.exact(problem, "sum")


@pytest.mark.parametrize(("track", "session"), [("smooth", 1), ("lost", 0)])
def test_many_digits_agree_with_the_package_s_bounds(track, session):
    """In tracks that doubles settle, many digits give the stored optimum, also if a contact does
    not touch. `other` is Clarabel's."""
    _, one = one_of(track, session, m=15)
    for objective, stored in one.references.items():
        found = references.exact(one.problems[0], objective)
        assert abs(found.value - stored.value[0]) <= 1e-11 * found.value
        assert abs(found.value - stored.other[0]) <= 1e-9 * found.value
        assert found.gap <= 1e-15
        force = all_digits(found.force, found.rest[: len(found.force)])
        with mp.workdps(references.DIGITS):
            # doubles leave 1e-16
            assert np.abs(references.exact_measure(one.problems[0]).missed(force)).max() < 1e-25


def test_a_problem_holds_the_package_s_matrices():
    """`matrix` and limits against `Grasp` and `ForceLimits`, which compute them elsewhere."""
    grasp = presets.paper_cuboid()
    np.testing.assert_allclose(PROBLEM.matrix, grasp.matrix, atol=1e-15)
    rng = np.random.default_rng(0)
    jacobian = rng.standard_normal((4, 6, 5))
    limit = rng.uniform(1.0, 2.0, 5)
    bias = 0.1 * rng.standard_normal(5)
    soft = Grasp.from_contacts(
        grasp.positions, grasp.normals, 0.4, contact_model="soft", torsional_friction=0.01
    )
    given = {
        "min_normal": np.array([0.0, 1.0, 0.5, 0.0]),
        "max_normal": np.array([5.0, np.inf, 4.0, 9.0]),
    }
    torques = {"jacobian": jacobian, "torque_limit": limit, "torque_bias": bias}
    problem = made(torsional_friction=np.full(4, 0.01), **given, **torques)
    rows = ForceLimits(**given, **torques).rows(soft)
    np.testing.assert_allclose(problem.limit_matrix, rows.matrix, atol=1e-14)
    np.testing.assert_allclose(problem.limit_bound, rows.bound, atol=1e-14)
    np.testing.assert_allclose(
        problem.matrix.reshape(6, 4, 4)[:, :, 3], soft.torsion_matrix, atol=1e-15
    )
    lost = made(touching=np.array([True, True, False, True]), **given, **torques)
    assert lost.limit_bound[1] == 0.0  # no least normal force
    assert not np.concatenate([lost.matrix, lost.limit_matrix])[:, 6:9].any()


def test_objectives_against_the_oracle():
    force = FORCE + np.tile([1.0, 0.0, 0.0], 4)
    x = presets.paper_cuboid().to_cone(force.reshape(4, 3))
    assert MEASURE.objective("phi", force) == pytest.approx(
        phi(x, np.tile([1.0, 0.01], (4, 1))), rel=1e-12
    )
    assert MEASURE.objective("sum", force) == pytest.approx(force[::3].sum(), rel=1e-14)


def test_scores_by_hand():
    good = score(PROBLEM, "sum", BEST, parts_of(PROBLEM, (FORCE, OPTIMUM.multipliers)))
    assert good["solved"]
    assert good["proved"]
    assert not score(PROBLEM, "sum", BEST, parts_of(PROBLEM, FORCE))["proved"]
    weak = (1.0 - 1e-5) * OPTIMUM.multipliers  # prove the optimum to 1e-5
    assert not score(PROBLEM, "sum", BEST, parts_of(PROBLEM, (FORCE, weak)))["proved"]
    pressed = FORCE * (1.0 + 1e-5)  # misses balance and the optimum by 1e-5
    missed = score(PROBLEM, "sum", BEST, parts_of(PROBLEM, pressed))
    assert (missed["solved"], missed["solved_coarse"]) == (False, True)
    assert missed["balance"] == pytest.approx(1e-5, rel=1e-3)
    assert missed["gap"] == pytest.approx(1e-5, rel=1e-3)
    slid = FORCE.copy()
    slid[1] += 2.0 * PROBLEM.friction[0] * FORCE[0]
    assert score(PROBLEM, "sum", BEST, parts_of(PROBLEM, slid))["violation"] > 0.1
    soft = made(torsional_friction=np.full(4, 0.01))
    # three times what it transmits beside no tangential force
    turned = np.column_stack([FORCE.reshape(4, 3), [0.0, 0.0, 0.0, -0.03 * FORCE[9]]])
    mu, gamma = np.repeat(soft.friction[:, None], 2, axis=1), soft.torsional_friction
    missed = -margin.cone_margin(turned, mu, gamma, 1.0, np.zeros(4))
    assert missed > 2.0 * mu[3, 0] * FORCE[9]
    assert Measure.of(soft).violation(turned) == pytest.approx(missed / FORCE[::3].max())
    held = made(max_normal=np.full(4, 2.0))
    over = score(held, "sum", BEST, parts_of(held, FORCE))["limit_excess"]
    assert over == pytest.approx(FORCE[::3].max() / 2.0 - 1.0)
    nothing = [("sum", BEST, OPTIMUM.multipliers), ("phi", 10.0, np.ones(6))]
    for name, best, multipliers in nothing:
        still = score(PROBLEM, name, best, parts_of(PROBLEM, (np.zeros(12), multipliers)))
        assert not any(still[what] for what in ("proved", "solved_coarse"))
    # without prices: they are zero
    assert not score(held, "sum", BEST, parts_of(held, (FORCE, OPTIMUM.multipliers)))["proved"]
    lost = made(touching=np.array([False, True, True, True]))
    assert not score(lost, "sum", BEST, parts_of(lost, FORCE))["solved_coarse"]


def test_a_force_is_judged_within_the_margin():
    optimizer = ForceOptimizer(
        presets.paper_cuboid(), method="conic", tolerance=1e-10, margin=Margin(0.7, PRELOAD)
    )
    kept = optimizer.solve(WRENCH)
    right = parts_of(NARROW, (kept.force, kept.multipliers))
    row = score(NARROW, "sum", kept.objective, right)
    assert row["solved"]
    assert row["proved"]
    assert Measure.of(NARROW).objective("sum", right.force) == kept.force[:, 0].sum()
    assert Measure.of(NARROW).inside(np.zeros(12))[::3].tolist() == PRELOAD.tolist()
    # the optimum without a margin is inside the given cones alone
    outer = score(NARROW, "sum", BEST, parts_of(NARROW, (FORCE, OPTIMUM.multipliers)))
    assert MEASURE.violation(FORCE) < 1e-9
    assert outer["gap"] < 1e-9
    assert not any(outer[what] for what in ("proved", "solved_coarse"))
    mu = np.repeat(NARROW.friction[:, None], 2, axis=1)
    spinless = np.column_stack([OPTIMUM.force, np.zeros(4)])
    missed = -margin.cone_margin(spinless, mu, np.zeros(4), 0.7, PRELOAD)
    missed = max(missed, (PRELOAD - FORCE[::3]).max())
    assert outer["violation"] == pytest.approx(missed / FORCE[::3].max(), rel=1e-9)
    soft = Measure.of(made(torsional_friction=np.full(4, 0.01), **KEPT))
    force = np.tile([10.0, 0.0, 0.0, 0.0], (4, 1))
    force[2, 3] = 3.0 * 0.7 * 0.01 * 9.5  # three times what the contact transmits
    assert soft.violation(force) == pytest.approx(2.0 * 0.7 * NARROW.friction[2] * 9.5 / 10.0)
    # a contact that does not touch has no preload
    lost = made(touching=np.array([True, True, True, False]), **KEPT)
    assert lost.shift.tolist() == [0.0, 1.0, 0.5, 0.0]


PINCH = {
    "positions": pinch.POSITIONS,
    "frames": pinch.FRAMES,
    "friction": np.full(2, pinch.MU),
    "torsional_friction": np.full(2, pinch.GAMMA),
}
HELD = 3.0, 0.08
"""Force [N] and moment [N m] that the pinch holds with 5 N each, and with 4 N if its bounds of
friction and torsion were apart."""


@pytest.mark.parametrize("margin_of_it", [{}, {"friction_margin": 0.8, "preload": 1.5}])
def test_friction_and_torsion_share_a_cone(margin_of_it):
    """Scores, bounds and the reference of a pinch whose optimum is known."""
    arrays = {name: np.array(value) for name, value in margin_of_it.items()}
    if arrays:
        arrays["preload"] = arrays["preload"].repeat(2)
    problem = Problem(**PINCH, **arrays, wrench=pinch.wrench(*HELD))
    measure = Measure.of(problem)
    share, preload = margin_of_it.get("friction_margin", 1.0), margin_of_it.get("preload", 0.0)
    normal = pinch.least_normal(*HELD, share, preload)
    slope = pinch.multipliers(*HELD) / share
    right = pinch.forces(normal, *HELD).ravel()
    row = score(problem, "sum", 2.0 * normal, parts_of(problem, (right, slope)))
    assert row["solved"]
    assert row["proved"]
    assert max(row[name] for name in ("gap", "balance", "violation")) < 1e-15
    assert measure.lower("sum", slope) == pytest.approx(2.0 * normal, rel=1e-14)
    assert measure.upper("sum", right, slope) == pytest.approx(2.0 * normal, rel=1e-14)
    # the optimum of bounds apart is outside the cone, and raised into it by the bound
    corner = pinch.least_normal_apart(*HELD) / share + preload
    wrong = pinch.forces(corner, *HELD).ravel()
    row = score(problem, "sum", 2.0 * corner, parts_of(problem, (wrong, slope)))
    assert not row["solved_coarse"]
    assert row["violation"] == pytest.approx(pinch.MU * share * (normal - corner) / corner)
    np.testing.assert_allclose(measure.inside(wrong), right, rtol=1e-14)
    best = references.package(problem, "sum")
    assert best.gap < 1e-9
    assert best.value == pytest.approx(2.0 * normal, rel=1e-9)


def test_a_witness_needs_the_cone_of_both():
    """The pinch needs 5 N: a limit of 4.9 N makes it infeasible. Separate bounds on friction and
    torsion would allow it."""
    witness = np.concatenate([-pinch.multipliers(*HELD), np.ones(2)])
    for most, proves in ((4.9, True), (5.1, False)):
        problem = Problem(**PINCH, wrench=pinch.wrench(*HELD), max_normal=np.full(2, most))
        assert (Measure.of(problem).witness(witness) > 0.0) == proves
        assert (references.package(problem, "sum").lower == np.inf) == proves


def test_a_contact_without_torsional_friction_is_hard():
    problem = Problem(
        **PINCH | {"torsional_friction": np.array([pinch.GAMMA, 0.0])}, wrench=pinch.wrench(*HELD)
    )
    measure = Measure.of(problem)
    force = pinch.forces(6.0, *HELD)
    assert measure.violation(force.ravel()) == pytest.approx(0.04 / measure.length / 6.0)
    assert measure.inside(force.ravel()).reshape(2, 4)[:, 3].tolist() == [-0.04, 0.0]
    force[1, 3] = 0.0
    assert measure.violation(force.ravel()) == 0.0
    assert references.package(problem, "sum").value == pytest.approx(
        np.hypot(1.5 / pinch.MU, 0.08 / pinch.GAMMA) * 2.0, rel=1e-9
    )


def test_a_shifted_problem_has_the_optimum_of_the_margin():
    """Limits of all kinds, soft contacts, a lost one, and a preload above its least normal force."""
    rng = np.random.default_rng(0)
    limits = {
        "min_normal": np.array([2.0, 0.7, 0.0, 3.0]),
        "max_normal": np.array([15.0, np.inf, 5.3, 15.0]),
        "jacobian": 0.05 * rng.standard_normal((4, 6, 5)),
        "torque_limit": np.full(5, 2.0),
        "torque_bias": 0.1 * rng.standard_normal(5),
    }
    soft = {"torsional_friction": np.full(4, 0.01), **limits, **KEPT}
    for problem in (NARROW, made(**soft), made(touching=np.arange(4) != 3, **soft)):
        shifted = problem.shifted()
        whole = np.zeros((6, 4, 4))
        whole[:, :, : problem.width] = problem.matrix.reshape(6, 4, -1)
        rows = problem.limit_matrix.reshape(-1, 4, problem.width)
        wrench = margin.shifted_wrench(whole, problem.wrench, PRELOAD)
        np.testing.assert_allclose(shifted.wrench, wrench, atol=1e-15)
        bound = margin.shifted_bound(rows, problem.limit_bound, PRELOAD)
        np.testing.assert_allclose(shifted.limit_bound, bound, atol=1e-14)
        assert shifted.limit_matrix.tolist() == problem.limit_matrix.tolist()
        best = references.package(problem, "sum")
        assert best.gap < 1e-9
        # an optimizer takes the fields, entrants of other solvers the rows
        grasp, fields = grasp_of(shifted)
        assert margin_of(shifted) is None
        optimizer = ForceOptimizer(grasp, method="conic", limits=fields, tolerance=1e-11)
        inner = optimizer.solve(shifted.wrench, contacts=shifted.touching)
        assert inner.objective + problem.shift.sum() == pytest.approx(best.value, rel=1e-9)
        force = np.column_stack([inner.force, inner.torsion])[:, : problem.width].copy()
        assert (shifted.limit_matrix @ force.ravel() <= shifted.limit_bound + 1e-9).all()
        force[:, 0] += problem.shift
        assert score(problem, "sum", best.value, parts_of(problem, force))["solved"]


def test_a_witness_tells_what_no_margin_allows():
    """Without the margin the same limits allow a force."""
    most = {"max_normal": np.full(4, 1.2 * FORCE[::3].max())}
    narrow = made(**most, **KEPT)
    grasp, limits = grasp_of(narrow)
    optimizer = ForceOptimizer(grasp, method="conic", limits=limits, margin=margin_of(narrow))
    with pytest.raises(InfeasibleWrenchError) as error:
        optimizer.solve(WRENCH)
    proof = error.value.solution
    witness = np.concatenate([proof.multipliers, proof.limit_multipliers])
    assert Measure.of(narrow).witness(witness) > 0.0
    assert Measure.of(made(**most)).witness(witness) <= 0.0
    assert Measure.of(narrow.shifted()).witness(witness) > 0.0


@pytest.mark.parametrize(
    "answer",
    [None, np.full(12, np.nan), np.zeros(11), (FORCE, None, "failed"), (FORCE, None, "no"), "text"],
)
def test_what_is_no_answer_has_failed(answer):
    row = score(PROBLEM, "sum", BEST, parts_of(PROBLEM, answer))
    assert row["status"] == "failed"
    assert not any(row[name] for name in ("solved", "solved_coarse", "proved", "wrong"))


def test_verdicts_need_their_witness():
    twist = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    assert PULLED.matrix[2, ::3].min() > 0.9  # every finger pushes along z
    answers = [
        (None, twist, "infeasible"),
        (None, None, "infeasible"),
        (None, -twist, "infeasible"),
        (np.ones(12), None, "solved"),
    ]
    rows = [score(PULLED, "sum", np.inf, parts_of(PULLED, answer)) for answer in answers]
    assert [row["solved"] for row in rows] == [True, False, False, False]
    assert [row["wrong"] for row in rows] == [False, False, False, True]
    feasible = score(PROBLEM, "sum", BEST, parts_of(PROBLEM, (None, twist, "infeasible")))
    assert (feasible["wrong"], feasible["solved"]) == (True, False)


def test_negative_prices_count_as_none():
    """A multiplier of an inequality is at least 0; one below would prove anything."""
    problem = replace(PROBLEM, max_normal=np.full(4, 1e3))
    twists = np.random.default_rng(1).standard_normal((50, 6))
    measure = Measure.of(problem)
    for twist in twists:
        plain = measure.witness(np.concatenate([twist, np.zeros(4)]))
        assert measure.witness(np.concatenate([twist, np.full(4, -1.0)])) == plain


def test_no_witness_against_a_feasible_wrench():
    twists = [
        *np.random.default_rng(0).standard_normal((200, 6)),
        OPTIMUM.multipliers,
        -OPTIMUM.multipliers,
    ]
    for scale in (1e-6, 1.0, 1e6):
        for margins in ({}, KEPT, {"torsional_friction": np.full(4, 0.01)}):
            measure = Measure.of(made(scale * WRENCH, **margins))
            assert max(measure.witness(twist) for twist in twists) <= 0.0


@pytest.mark.parametrize("problem", [PROBLEM, NARROW, SOFT])
def test_bounds_bracket_every_balanced_force(problem):
    rng = np.random.default_rng(0)
    measure = Measure.of(problem)
    scale = np.ones((4, problem.width))
    scale[:, 3:] = problem.lever[:, None]  # torsions are small, or none
    scale = scale.ravel()
    null = np.linalg.svd(problem.matrix * scale)[2][6:] * scale
    middle = ForceOptimizer(
        grasp_of(problem)[0], barrier_weight=10.0, margin=margin_of(problem)
    ).solve(WRENCH)
    inner = np.column_stack([middle.force, middle.torsion])[:, : problem.width].ravel()
    for objective in ("sum", "phi") if problem.width == 3 else ("sum",):
        forces = [inner + null.T @ rng.standard_normal(len(null)) for _ in range(400)]
        values = [measure.objective(objective, f) for f in forces if measure.violation(f) <= 0.0]
        assert len(values) > 20
        best = references.package(problem, objective)
        assert best.gap < 1e-9
        assert best.value <= min(values)
        drawn = [best.multipliers * (1.0 + 0.5 * rng.standard_normal(6)) for _ in range(200)]
        assert max(measure.lower(objective, each) for each in drawn) <= min(values)


def test_the_loop_has_what_a_hand_meets():
    """Limits bind in a third of the ticks, one in twenty is infeasible, fingers lift and land, and
    contacts and Jacobian move in every tick."""
    track = load("loop")
    binding = []
    infeasible = []
    lifts = landings = 0
    for session in track.sessions:
        force = session.references["sum"].force
        infeasible += np.isnan(force).all(axis=1).tolist()
        for problem, f in zip(session.problems, force, strict=True):
            spare = (problem.limit_bound - problem.limit_matrix @ f) / problem.limit_size
            binding.append(bool((spare < 1e-6).any()))
        for name in ("positions", "frames", "jacobian", "torque_bias", "wrench"):
            moved = np.diff(session.arrays[name], axis=0).reshape(len(force) - 1, -1)
            assert np.abs(moved).max(axis=1).all(), (session.name, name)
        change = np.diff(session.arrays["touching"].astype(int), axis=0)
        lifts += (change < 0).sum()
        landings += (change > 0).sum()
        path = session.arrays["wrench"]
        steps = np.abs(np.diff(path, axis=0)) / np.abs(path).max(axis=0)
        assert steps.max() < 0.2
    assert track.size == len(binding) == 588
    assert 0.2 < np.mean(binding) < 0.4
    assert 0.02 < np.mean(infeasible) < 0.06
    assert lifts == landings == 15
