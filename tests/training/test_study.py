"""The study: its predictions hold, its folder is whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from grasp_env.force import Objective
from grasp_env.force.step_size import FixedStep
from grasp_env.grasp import presets
from grasp_env.grasp.wrench import PAPER_CONSTANT, sample_ball
from training.runs import Run
from training.study import study
from training.study.reproduce import reproduce
from training.study.study import FORMS, operations


def test_rates_are_the_predicted_ones() -> None:
    rates = study.rate_study(presets.paper_cuboid(), np.array(PAPER_CONSTANT))
    fixed, exact = rates["rates"]["fixed"], rates["rates"]["exact"]
    assert fixed["fitted"] == pytest.approx(fixed["predicted"], rel=0.02)
    assert exact["fitted"] <= exact["predicted"] * 1.01
    assert rates["rates"]["bb_short"]["fitted"] < exact["fitted"]
    assert max(rates["forms"].values()) < 1e-10
    assert all(gaps[-1] <= 1e-12 for gaps in rates["gaps"].values())


def test_tuned_step_is_never_halved_and_nearly_the_longest() -> None:
    cases = study.Cases(presets.paper_cuboid(), Objective(2.0, 0.1), sample_ball(np.random.default_rng(0), 8))
    size = cases.tuned_step()
    steps, trials = cases.iterations(FixedStep(size))
    np.testing.assert_array_equal(steps, trials)
    steps, trials = cases.iterations(FixedStep(size * 10.0**0.125))
    assert (steps != trials).any()


def test_reproduce_writes_a_folder_that_is_whole(tmp_path: Path) -> None:
    metrics = reproduce(tmp_path, quick=True, progress=False)
    run = Run.open(metrics["folder"], "run.json")
    page = run.path("report.md").read_text(encoding="utf-8")
    assert "QUICK RUN" in page
    for name in ("weights", "rates", "costs", "path_paper_cuboid", "path_five_finger_cuboid"):
        assert f"figures/{name}.png" in page
        assert run.path(f"figures/{name}.png").stat().st_size > 10_000
    saved = run.read_json("metrics.json")
    assert len(saved["weights"]) == study.ROWS
    assert [(row["form"], row["operations"]) for row in saved["costs"][3:6]] == [(f, operations(f, 4)) for f in FORMS]
    excess = [row["excess"]["median"] for row in saved["weights"] if row["omega"] == 1.0]
    assert np.all(np.diff(excess) > 0.0)
    assert min(excess) > 0.0
    assert saved["paths"]["paper_cuboid"]["methods"]["linear"]["excess"]["median"] > 0.0
