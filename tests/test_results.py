"""The measured tables are those of the saved runs, and every saved run is whole."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from docs import fill
from docs.fill import PROVENANCE, RESULTS, TABLES
from grasp_env.force.rules import RULES
from training.evaluation.results.run import Run
from training.evaluation.results.table import described, read, table

ROOT = Path(__file__).parents[1]


def test_no_table_differs_from_its_saved_run(capsys):
    assert fill.main(["--check"]) == 0, capsys.readouterr().out


def test_every_table_stands_on_a_page():
    pages = "".join(
        page.read_text(encoding="utf-8")
        for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md"))
    )
    assert [name for name in TABLES if f"<!-- results: {name} -->" not in pages] == []
    assert fill.BLOCK.findall(pages)
    assert all("| --- |" in block for _, _, block, _ in fill.BLOCK.findall(pages))


def test_saved_runs_are_full_ones_whose_columns_are_documented():
    for file in RESULTS.glob("*.json"):
        kept = next(
            each
            for each in (file.with_suffix(".csv"), file.with_suffix(".csv.xz"))
            if each.exists()
        )
        about = json.loads(file.read_text(encoding="utf-8"))
        means = read(kept)
        assert fill.part_of(about) == file.stem
        assert "--quick" not in about["command"]
        assert len(about["commit"]) >= 7, f"{file.stem} does not say which commit was measured"
        assert all(described(means.columns).values()), described(means.columns)
        assert len(means) > 0


def test_a_block_is_filled_between_its_marks_only():
    text = "before\n<!-- results: batch -->\nold\n<!-- /results -->\nafter\n"
    new, changed = fill.filled(text)
    assert changed == ["batch"]
    assert new.startswith("before\n<!-- results: batch -->\n| ")
    assert new.endswith("<!-- /results -->\nafter\n")
    assert fill.filled(new) == (new, [])
    with pytest.raises(SystemExit, match="no table 'unknown'"):
        fill.filled("<!-- results: unknown -->\n<!-- /results -->")


def test_a_run_is_kept_as_its_summary_and_quick_ones_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(fill, "RESULTS", tmp_path / "results")
    folder = Run.create(tmp_path, "run")
    rows = table([{"case": "a", "held": True}, {"case": "a", "held": False}])
    folder.save(
        rows, {"kind": "env", "settings": {"hands": ["/home/me/robots/hand.urdf", "allegro"]}}
    )
    assert fill.save(folder.folder) == "env"
    kept = json.loads((tmp_path / "results" / "env.json").read_text())
    assert {*kept} <= {*PROVENANCE}
    # a path says something about one machine only
    assert kept["settings"]["hands"] == ["hand.urdf", "allegro"]
    assert read(tmp_path / "results" / "env.csv")[["n", "held_sum"]].to_numpy().tolist() == [
        [2, 1.0]
    ]
    part = Run.create(tmp_path, "part")
    settings = {"hands": ["my/leap.urdf"], "engines": ["mujoco"]}
    part.save(rows, {"kind": "errors", "settings": settings})
    assert fill.save(part.folder) == "errors-leap-mujoco"
    assert fill.parts("errors") == ["errors-leap-mujoco"]
    quick = Run.create(tmp_path, "quick")
    quick.save(rows, {"kind": "env", "quick": True})
    with pytest.raises(SystemExit, match="quick run"):
        fill.save(quick.folder)


def test_the_choice_of_a_start_names_every_rule():
    page = (ROOT / "docs" / "choosing.md").read_text(encoding="utf-8")
    assert [name for name in RULES if name not in page] == []
