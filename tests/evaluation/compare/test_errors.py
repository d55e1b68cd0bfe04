"""Controllers under errors: the same grasps for all, and settings chosen on other episodes."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from docs import fill
from grasp_env.errors import UnknownNameError
from training.evaluation.compare import holds
from training.evaluation.compare.errors import APART, Errors, choices, equal_forces
from training.evaluation.compare.holds import HoldsConfig, draw_grasp, run, settings_of
from training.evaluation.compare.scenarios import (
    ENGINES,
    EQUAL,
    GROUPS,
    LABELS,
    RIVALS,
    ROBUST,
    Scenario,
)
from training.evaluation.report.errors_page import settings_text
from training.evaluation.report.page import write
from training.evaluation.results.run import Run
from training.evaluation.results.table import chosen, summary, table

PLAN = Errors(("four_finger", "leap"), ("bullet", "mujoco"), 2, 3)
SMALL = HoldsConfig("errors", ("four_finger",), ("bullet", "mujoco"), episodes=3, tuning=2)
ONE = replace(SMALL, engines=("bullet",))
BEST = {ROBUST: 0.65, "constant_squeeze": 40.0, "pd": 20.0}
"""Setting with which each rival holds, in made-up episodes."""


def made_up(settings, random_objects, seed, rule=None, soft=False, same_grasp=None):
    """An episode that is held by the best candidates; the force is that of the controller."""
    kind = settings.get("controller.kind", ROBUST)
    squeeze = settings.get("controller.squeeze", 0.0)
    value = squeeze or settings["controller.friction_margin"]
    held = value == BEST[kind] and seed != 1
    force = squeeze or 10.0 / value
    return {
        "held": held,
        "failure": None if held else "slid",
        "no_start": False,
        "normal_force": force,
        "commanded_force": force + seed % 2,
        "end_slip": 0.1 * seed,
        "drift": 0.2 if held else None,
    }


@pytest.fixture
def fake(monkeypatch):
    monkeypatch.setattr(holds, "trial", made_up)
    monkeypatch.setattr(holds, "_speeds", lambda plan: {})
    return monkeypatch


@pytest.fixture(scope="module")
def rows():
    """A run of made-up episodes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(holds, "trial", made_up)
        patch.setattr(holds, "_speeds", lambda plan: {})
        return run(SMALL, on="inline")[0]


def seeds(scenario: Scenario) -> set[int]:
    return {scenario.skipped + k for k in range(scenario.episodes)}


def test_errors_and_rivals_are_sound():
    cases = [case for group in GROUPS.values() for case in group.errors]
    assert len({*cases}) == len(cases)
    for key, group in GROUPS.items():
        assert {*group.tuned_on} <= {*group.errors}
        tried = {len(rival.candidates[key]) for rival in RIVALS.values() if rival.candidates}
        assert tried == {1, 4}  # all that are tuned have as many candidates
    assert not RIVALS[EQUAL].candidates


def test_a_plan_has_unique_names_and_other_seeds_for_the_report(rows):
    tuned, compared, equal = (stage(rows) for stage in SMALL.stages())
    everything = [*tuned, *compared, *equal]
    assert len({one.name for one in everything}) == len(everything)
    assert {one.case for one in everything} <= {*LABELS}
    json.dumps([asdict(one) for one in everything], allow_nan=False)
    for one in everything:
        settings_of({**ENGINES[one.engines[0]], **one.settings})
    assert not set.union(*map(seeds, tuned)) & set.union(*map(seeds, [*compared, *equal]))
    long = Errors(("four_finger",), ("bullet",), 3 * APART, 1)
    assert not seeds(long.tuned(rows)[0]) & seeds(long.compared(rows)[0])
    assert HoldsConfig("errors", quick=True).stages()
    with pytest.raises(UnknownNameError, match="engine"):
        HoldsConfig("errors", engines=("faces",))


@pytest.mark.parametrize("hand", ["four_finger", "leap"])
def test_all_rivals_meet_the_same_grasp(hand):
    plan = Errors((hand,), ("bullet", "mujoco"), 2, 3)
    five = [one for one in plan.tuned(table([])) if one.case == "five"]
    five += [
        plan.scenario("report", "five", rival, (hand, engine), {})
        for rival in RIVALS
        for engine in plan.engines
    ]
    assert len(five) == 2 * (3 * 4 + len(RIVALS))
    assert {one.settings["controller.friction_margin"] for one in five} >= {0.4, 0.5, 0.85}
    drawn = [
        draw_grasp(
            3, settings_of({**ENGINES[one.engines[0]], **one.settings}), one.same_grasp or 0.0
        )
        for one in (five if hand == "four_finger" else five[::9])
    ]
    first, redrawn = drawn[0]
    for config, count in drawn[1:]:
        assert (config.object, count) == (first.object, redrawn)
        assert config.hand_description == first.hand_description
        np.testing.assert_array_equal(config.contact_points, first.contact_points)
    assert first.hand_description.placed
    again = settings_of({**ENGINES["bullet"], **five[0].settings})
    other = draw_grasp(3, again, 0.85)[0]
    assert other.contact_points != first.contact_points  # the margin of the group matters


def test_the_candidate_that_holds_most_is_chosen_and_ties_go_to_the_smaller_force():
    def tuning(case, margin, preload, held, force, hand="leap"):
        keys = {"part": "tuning", "case": case, "hand": hand, "engine": "bullet"}
        values = {"friction_margin": margin, "preload": preload, "normal_force": force}
        return {**keys, "controller": ROBUST, **values, "held": held}

    candidates = [(0.85, 1.0), (0.75, 1.0), (0.65, 1.0), (0.75, 0.5)]
    more = [
        tuning(case, *pair, held, force)
        for case in ("noise", "drift")
        for pair, flags, force in zip(
            candidates, ([1, 0], [1, 1], [1, 1], [1, 0]), (9.0, 14.0, 13.0, 8.0), strict=True
        )
        for held in map(bool, flags)
    ]
    # errors on which nothing is chosen, and another hand, do not count
    more += [tuning("none", 0.85, 1.0, True, 9.0)] * 9
    more += [tuning(case, 0.75, 0.5, True, 9.0, "allegro") for case in ("noise", "drift")]
    picked = choices(summary(table(more)))
    best = picked["leap", "bullet", "known_10", ROBUST]
    assert best.settings == {"friction_margin": 0.65, "preload": 1.0}
    assert (best.held, best.episodes, best.force) == (4, 4, 13.0)
    assert settings_text(best.settings) == "margin 0.65, preload 1 N"
    assert picked["allegro", "bullet", "known_10", ROBUST].settings["preload"] == 0.5
    assert picked["leap", "bullet", "known_10", "paper"].settings == {}
    nothing = [{**row, "normal_force": None, "held": False} for row in more]
    assert choices(summary(table(nothing)))["leap", "bullet", "known_10", ROBUST].force is None


@pytest.mark.parametrize(("held", "margin"), [(97, 0.85), (96, 0.75)])
def test_a_smaller_force_is_better_than_two_episodes_of_a_hundred(held, margin):
    """0.75 holds 99 of 100, 0.85 needs less force."""
    keys = {"part": "tuning", "hand": "leap", "engine": "bullet", "controller": ROBUST}
    rows = [
        {**keys, **settings, "case": case, "seed": seed, "held": seed < most, "normal_force": force}
        for settings, most, force in (
            ({"friction_margin": 0.85, "preload": 1.0}, held, 10.0),
            ({"friction_margin": 0.75, "preload": 1.0}, 99, 12.0),
        )
        for case in GROUPS["known_10"].tuned_on
        for seed in range(100)
    ]
    picked = choices(summary(table(rows)))
    assert picked["leap", "bullet", "known_10", ROBUST].settings["friction_margin"] == margin


def test_a_run_chooses_then_compares_then_squeezes_as_hard(rows):
    means = summary(rows)
    report = chosen(means, "part == 'report'")
    assert len(report) == 2 * 10 * len(RIVALS)
    assert {*report["n"]} == {3}
    assert "friction_margin" not in report.dropna(axis=1, how="all").columns
    for case, force in (("none", 10.0 / 0.65), ("five", 10.0 / 0.6)):
        mine = chosen(report, f"case == '{case}' and engine == 'mujoco'").set_index("controller")
        assert mine.loc[ROBUST, "normal_force_mean"] == pytest.approx(force)
        commanded = force + 1.0 / 3.0  # seeds 100 to 102
        assert equal_forces(means)["four_finger", "mujoco", case] == round(commanded, 2)
        assert mine.loc[EQUAL, "normal_force_mean"] == round(commanded, 2)
        assert mine.loc["pd", "normal_force_mean"] == BEST["pd"]
    tuning = chosen(rows, "part == 'tuning'")
    assert {*tuning["case"]} == {"noise", "drift", "five"}
    assert {*tuning["controller"]} == {ROBUST, "constant_squeeze", "pd"}


def test_begun_runs_continue_in_every_stage(tmp_path, fake, rows):
    folder = Run.create(tmp_path, "run")
    played = []

    def broken(*arguments, stop=None, **options):
        played.append(arguments)
        if len(played) == stop:
            raise KeyboardInterrupt
        return made_up(*arguments, **options)

    for stop in (15, 100, 50):  # within the tuning, the report and the equal forces
        played.clear()
        fake.setattr(holds, "trial", lambda *a, stop=stop, **o: broken(*a, stop=stop, **o))
        with pytest.raises(KeyboardInterrupt):
            run(ONE, folder, on="inline")
    fake.setattr(holds, "trial", broken)
    played.clear()
    again, about = run(ONE, folder, on="inline")
    assert again.equals(table(chosen(rows, "engine == 'bullet'")))
    assert 0 < len(played) < 0.3 * len(again)
    fake.setattr(holds, "trial", None)  # finished shards are kept
    assert run(ONE, folder, on="inline")[0].equals(again)
    picked = {(one["group"], one["controller"]): one for one in about["chosen"]}
    assert len(picked) == 2 * 3
    assert picked["known_10", "pd"]["settings"] == {"squeeze": 20.0}
    assert picked["known_10", "pd"]["held"] == 2  # of the seeds 0 and 1, on two errors


def test_the_page_shows_every_error_and_rival(tmp_path, fake):
    folder = Run.create(tmp_path, "run")
    folder.save(*run(SMALL, folder, on="inline"))
    path, verdicts = write(folder)
    text = path.read_text()
    assert text.count("<figure") == 2
    for place in ("four_finger in bullet", "four_finger in mujoco"):
        assert f"Episodes held: {place}" in text
    for group in GROUPS.values():
        assert all(error.label in text for error in group.errors.values())
    assert all(rival.label in text for rival in RIVALS.values())
    assert "<td>3 of 3 at 15.4 N (44 to 100 %)</td>" in text
    assert "margin 0.65, preload 1 N" in text
    assert len(verdicts) > 10
    assert all(row.met is not None for row in verdicts)
    fake.setattr(fill, "RESULTS", tmp_path / "results")
    fill.saved.cache_clear()
    fill.save(folder.folder)
    block = fill.errors()
    fill.saved.cache_clear()
    assert "Episodes held: four_finger in mujoco:\n\n| error | " in block
    assert "| 3 of 3 at 15.4 N (44 to 100 %) |" in block
    assert block.count("| margin 0.65, preload 1 N | 2 of 4 at 15.4 N |") == 2
