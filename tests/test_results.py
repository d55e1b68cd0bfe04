"""The measured tables are those of the saved runs, and every saved run is whole."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from docs import fill
from docs.tables import KEPT, RESULTS, TABLES
from grasp_env.force import RULES

ROOT = Path(__file__).parents[1]


def test_no_table_differs_from_its_saved_run(capsys):
    assert fill.main(["--check"]) == 0, capsys.readouterr().out


def test_every_table_can_be_made_and_stands_on_some_page():
    pages = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")))
    for name, table in TABLES.items():
        assert "| --- |" in table()
        assert f"<!-- results: {name} -->" in pages, f"no page has the table {name}"


def test_saved_runs_are_those_that_tables_know_and_are_full_ones():
    files = {path.stem for path in RESULTS.glob("*.json")}
    assert files == set(KEPT)
    for name in files:
        run = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
        told = run.get("run") or run.get("provenance") or run
        assert "--quick" not in told["command"]
        assert len(told["commit"]) >= 7, f"{name} does not say which commit was measured"


def test_a_block_is_filled_between_its_marks_only():
    text = "before\n<!-- results: batch -->\nold\n<!-- /results -->\nafter\n"
    now, changed = fill.filled(text)
    assert changed == ["batch"]
    assert now.startswith("before\n<!-- results: batch -->\n| ")
    assert now.endswith("<!-- /results -->\nafter\n")
    assert fill.filled(now) == (now, [])
    with pytest.raises(SystemExit, match="no table 'unknown'"):
        fill.filled("<!-- results: unknown -->\n<!-- /results -->")


def test_quick_runs_and_other_files_are_not_kept(tmp_path):
    quick = tmp_path / "metrics.json"
    quick.write_text(json.dumps({"run": {"kind": "starts", "quick": True}}), encoding="utf-8")
    with pytest.raises(SystemExit, match="quick run"):
        fill.save(quick)
    quick.write_text(json.dumps({"kind": "core"}), encoding="utf-8")
    with pytest.raises(SystemExit, match="'core'"):
        fill.save(quick)


def test_the_choice_of_a_start_names_every_rule():
    page = (ROOT / "docs" / "choosing.md").read_text(encoding="utf-8")
    assert [name for name in RULES if name not in page] == []
