"""`python -m benchmarks`: every benchmark is described by known columns, is saved and compared;
wrong input gives one line."""

from __future__ import annotations

import json
from dataclasses import fields
from importlib import import_module

import numpy as np
import pytest
from engines import needs_bullet

from benchmarks import batch
from benchmarks.__main__ import BENCHMARKS, main
from benchmarks.benchmark import checked
from training.evaluation.results.columns import COLUMNS
from training.evaluation.results.table import numbers, read, summary


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[needs_bullet] if name == "env" else []) for name in BENCHMARKS],
)
def test_it_is_described_by_known_columns_and_settings(name, capsys):
    made = import_module(f"benchmarks.{name}").BENCHMARK
    for column in (*made.shown, *(claim.column for claim in made.claims)):
        base, _, statistic = column.rpartition("_")
        assert statistic in COLUMNS[base].statistics, column
    options = {part.name for part in fields(made.settings)}
    assert {*made.quick} <= options
    checked(made.settings)
    with pytest.raises(SystemExit) as stopped:
        main([name, "--help"])
    assert not stopped.value.code
    page = capsys.readouterr().out
    assert all(f"--{option}" in page for option in options)


def test_a_run_is_saved_told_and_compared(tmp_path, capsys):
    words = [
        "scaling",
        "--quick",
        "--contacts",
        "3",
        "4",
        "--passes",
        "1",
        "--out",
        str(tmp_path),
        "--name",
    ]
    assert main([*words, "a"]) == 0
    told = capsys.readouterr().out
    assert told.startswith("QUICK")
    assert told.endswith(f"compare rows of one run\n{tmp_path / 'a'}\n")
    about = json.loads((tmp_path / "a/run.json").read_text())
    assert (about["kind"], about["quick"], about["settings"]["contacts"]) == (
        "scaling",
        True,
        [3, 4],
    )
    assert main([*words, "b", "--compare", str(tmp_path / "a"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    before, now = (
        summary(read(tmp_path / name / "rows.csv.xz"))["microseconds_median"] for name in "ab"
    )
    assert [row["microseconds_median"] for row in found["rows"]] == now.tolist()
    ratios = [row["ratio"] for row in found["compared"] if row["measure"] == "microseconds_median"]
    assert ratios == pytest.approx((now / before).tolist())
    assert main([*words, "c", "--compare", str(tmp_path / "a")]) == 0
    assert "beside the earlier run" in capsys.readouterr().out


def test_batches(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    rows = batch.run(batch.BatchSettings(wrenches=200, rounds=2))
    assert rows["method"].value_counts().to_dict() == dict.fromkeys(batch.KINDS, 4) | {
        "peak of the process": 1
    }
    one, both = (numbers(rows[rows["workers"] == count], "per_second") for count in (1, 2))
    np.testing.assert_allclose(numbers(rows.dropna(subset="ratio"), "ratio"), one / both)
    assert {*rows["solves"].dropna()} == {200}
    assert {*rows["failures"].dropna()} == {0}
    assert 20.0 < rows["mebibytes"].max() < 10_000.0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["sovler"], "unknown benchmark 'sovler'"),
        (["scaling", "--contacts", "2"], "contacts must be at least 3"),
        (["batch", "--compare", "a" * 300], "holds no run: give the folder of an earlier"),
        (["batch", "--compare", "."], "is a run of kind 'scaling': give one of kind batch"),
        (["scaling", "--name", "."], "holds a finished run"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(words, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.json").write_text('{"kind": "scaling"}')
    assert main([*words, "--out", ".", "--json"]) == 2
    told = capsys.readouterr()
    assert told.err.startswith("benchmarks: ")
    assert told.err.count("\n") == 1
    error = json.loads(told.out)["error"]
    assert said in error["message"]
    assert error["exit_code"] == 2
