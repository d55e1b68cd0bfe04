"""Run folders, tables, summaries and claims."""

from __future__ import annotations

import json
import lzma
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import trim_mean

from grasp_env.errors import InvalidInputError
from training.evaluation.results.claims import Claim, judge, lines
from training.evaluation.results.columns import COLUMNS
from training.evaluation.results.run import ROWS, Run, check_counts
from training.evaluation.results.statistics import iqm, ratio_interval
from training.evaluation.results.table import (
    STATISTICS,
    described,
    join,
    pd,
    read,
    summary,
    table,
    write,
    write_summary,
)


def made() -> pd.DataFrame:
    rng = np.random.default_rng(0)
    rows = [
        {
            "case": case,
            "start": start,
            "problem": k,
            "iterations": int(rng.integers(0, 99)),
            "start_gap": rng.random(),
            "held": bool(rng.random() < 0.7),
            "status": "optimal",
        }
        for case in ("ball", "jump")
        for start in ("paper", None)
        for k in range(50)
    ]
    rows[3] |= {"iterations": None, "status": "no_start", "start_gap": None, "held": None}
    return table(rows)


def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    run = Run.create(tmp_path, "a")
    run.write_text("notes.txt", "whole")

    def breaks(path: Path, text: str, encoding: str) -> None:
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", breaks)
        with pytest.raises(KeyboardInterrupt):
            run.write_text("notes.txt", "all new")
    assert run.path("notes.txt").read_text() == "whole"
    assert [path.name for path in run.folder.iterdir()] == ["notes.txt"]
    with pytest.raises(ValueError, match="JSON compliant"):
        run.write_json("numbers.json", {"a": float("nan")})


def test_a_finished_run_records_how_it_was_made(tmp_path):
    run = Run.create(tmp_path, "a")
    run.begin({"seed": 1, "hands": ("allegro",)})
    run.begin({"seed": 1, "hands": ("allegro",)})
    write(run.path("shards/ball.csv"), table([{"case": "ball"}]))
    run.save(table([{"case": "ball", "drift": 0.5}]), {"kind": "env", "settings": {"seed": 3}})
    about = json.loads((tmp_path / "a" / "run.json").read_text())
    assert about["columns"]["drift"].startswith("[mm] largest distance of the object")
    assert {"command", "time", "machine", "versions", "commit", "settings"} <= {*about}
    assert run.load()[0]["drift"].tolist() == [0.5]
    # no shards of what is finished
    assert [path.name for path in run.folder.iterdir() if path.is_dir()] == []
    for call, message in (
        (
            lambda: run.begin({"seed": 2, "hands": ("allegro",)}),
            r"was begun with other settings \(seed\)",
        ),
        (
            lambda: Run.create(tmp_path, "a"),
            "holds a finished run: choose another name or remove it",
        ),
        (lambda: Run.open(tmp_path / "nothing"), "is not a finished run"),
        (lambda: check_counts(type("Settings", (), {"seed": -1}), {"seed": 0}), "seed"),
        (lambda: table([{"speed": 1.0}]), "unknown columns speed: add them to COLUMNS"),
        (lambda: table([{"iterations": "many"}]), "does not fit the kind of its column"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            call()
    write(run.path(ROWS), table([{"case": "ball", "drift": 0.5}]).iloc[:0])
    with pytest.raises(
        InvalidInputError, match=r"rows\.csv\.xz has 0 of 1 rows: copy the run again"
    ):
        run.load()


@pytest.mark.parametrize("end", [".csv", ".csv.xz"])
def test_files_keep_every_value_and_type(tmp_path, end):
    rng = np.random.default_rng(1)
    odd = [
        -0.0,
        np.inf,
        -np.inf,
        5e-324,
        *rng.normal(size=300) * 10.0 ** rng.integers(-300, 300, 300),
    ]
    # what readers of CSV take for something else
    texts = ["NA", "nan", "true", " a ", "a\rb", 'a\n"b",', "\u2028"]
    rows = join(
        [
            made(),
            table([{"start_gap": each} for each in odd]),
            table([{"detail": each} for each in texts]),
        ]
    )
    for name in ("rows", "again"):
        write(tmp_path / f"{name}{end}", rows)
    found = read(tmp_path / f"rows{end}")
    pd.testing.assert_frame_equal(found, rows, check_exact=True)
    assert found["start_gap"].to_numpy().tobytes() == rows["start_gap"].to_numpy().tobytes()
    assert (tmp_path / f"again{end}").read_bytes() == (tmp_path / f"rows{end}").read_bytes()


def test_summaries_have_seven_digits(tmp_path):
    means = pd.DataFrame(
        {"case": ["a"], "n": [12345678], "gap_max": [123456789.123], "gap_min": [1 / 3]}
    )
    write_summary(tmp_path / "summary.csv", means)
    assert (
        tmp_path / "summary.csv"
    ).read_text() == "case,n,gap_max,gap_min\na,12345678,1.234568e+08,0.3333333\n"


def test_damaged_tables_are_refused(tmp_path, monkeypatch):
    plain = tmp_path / "rows.csv"
    packed = tmp_path / "rows.csv.xz"
    for path, message in ((plain, "its last line is cut off"), (packed, "it is cut off, or has")):
        write(path, made())
        blob = path.read_bytes()
        for size in range(len(blob) - 20, len(blob)):
            path.write_bytes(blob[:size])
            with pytest.raises(InvalidInputError, match=f"is not a table of results: {message}"):
                read(path)
    for text, message in (
        ("case,speed\na,1\n", "it has the unknown column 'speed'"),
        ("iterations\nmany\n", "many"),
        ("held\n2.5\n", "2.5"),
        ("gap\nsmall\n", "small"),
        ("case,gap\na,1\na,1,2\n", "fields"),
    ):
        plain.write_text(text)
        with pytest.raises(
            InvalidInputError,
            match=f"is not a table of results: .*{message}.*; give a run's rows.csv.xz",
        ):
            read(plain)
    monkeypatch.setattr("training.evaluation.results.table.WEIGHTS", 1000)
    packed.write_bytes(lzma.compress(b"case\n" + b"a\n" * 10_000))
    with pytest.raises(InvalidInputError, match="or has more than 0 MB when unpacked"):
        read(packed)


def test_columns_are_ordered_and_described():
    rows = table([{"held": True, "iterations": 3, "case": "ball", "gap": None}])
    assert {name: str(kind) for name, kind in rows.dtypes.items()} == {
        "case": "string",
        "iterations": "Int64",
        "held": "boolean",
    }
    assert [*rows.columns] == ["case", "iterations", "held"]
    joined = join([table([{"case": "a"}]), table([{"iterations": 2}])])
    assert str(joined["iterations"].dtype) == "Int64"
    assert joined["case"].isna().tolist() == [False, True]
    for name, column in COLUMNS.items():
        assert column.text, name
        assert set(column.statistics) <= {*STATISTICS, "missing"}, name
        assert not (column.key and column.statistics), name
    assert all(described(summary(made()).columns).values())


def test_the_summary_is_recomputed_by_numpy():
    rows = made()
    found = summary(rows)
    keys = found.fillna({"start": ""})[["case", "start", "n"]].to_numpy().tolist()
    assert keys == [[case, start, 50] for case in ("ball", "jump") for start in ("paper", "")]
    for _, row in found.iterrows():
        start = rows["start"].isna() if pd.isna(row["start"]) else rows["start"] == row["start"]
        mine = rows[(rows["case"] == row["case"]) & start]
        steps = np.sort(mine["iterations"].dropna().to_numpy(float))
        assert row["iterations_missing"] == 50 - len(steps)
        assert row["iterations_median"] == np.median(steps)
        place = 0.99 * (len(steps) - 1)  # p99 by its definition: linear between order statistics
        assert row["iterations_p99"] == pytest.approx(
            np.interp(place, np.arange(len(steps)), steps)
        )
        held = mine["held"].dropna().to_numpy(float)
        assert row["held_sum"] == held.sum()
        assert row["held_rate_low"] < held.mean() < row["held_rate_high"]
        assert row["iterations_low"] <= row["iterations_median"] <= row["iterations_high"]
    values = np.random.default_rng(1).normal(size=(4, 5)) ** 3
    assert iqm(values) == pytest.approx(np.sort(values.ravel())[5:15].mean())  # the middle half


@pytest.mark.parametrize("count", range(1, 18))
def test_the_interquartile_mean_cuts_quarters(count):
    """Also where a quarter is no whole number of values."""
    values = np.random.default_rng(count).normal(size=count) ** 3
    assert iqm(values) == pytest.approx(trim_mean(values, 0.25), rel=1e-12)  # the order of sums


def test_ends_of_a_ratio_leave_out_a_fortieth():
    rng = np.random.default_rng(2)
    seen = list[np.ndarray]()
    numerator = rng.uniform(1.0, 3.0, 50)
    denominator = rng.uniform(1.0, 2.0, 50)

    def recorded(values, axis):
        seen.append(values.mean(axis=axis))
        return seen[-1]

    middle, low, high = ratio_interval(numerator, denominator, of=recorded)
    ratios = seen[0] / seen[1]
    assert len(np.unique(ratios)) == len(ratios)  # no ties blur the shares
    # an end is one of the resamples, so that the share beyond it is known to one of them
    beyond = [(ratios < low).sum(), (ratios > high).sum()]
    assert beyond == pytest.approx([0.025 * len(ratios)] * 2, abs=1.0)
    assert middle == pytest.approx(numerator.mean() / denominator.mean())
    # resamples of pairs: the ratio of proportional samples is known exactly
    assert ratio_interval(3.0 * denominator, denominator) == pytest.approx((3.0, 3.0, 3.0))


def median(query: str, *target: Any) -> Claim:
    return Claim("a", query, "iterations_median", *target)


CLAIMS = [
    (median("case == 'ball'", "<=", 60), 50.0, True),
    (median("start == 'paper'", "<=", 60), 70.0, False),  # the worst row counts
    # a ratio of pairs, and a difference
    (median("start == 'net'", "<", 0.2, "start == 'paper'"), 0.1, True),
    (median("start == 'net'", "within", 50, "start == 'paper'", True), -63.0, False),
    (median("start == 'net'", ">=", 6), 5.0, False),
    (median("start == 'other'", "<=", 60), None, None),
    (Claim("a", "case == 'ball'", "drift_max", "<=", 60), None, None),
    (median("hand == 'ball'", "<=", 60), None, None),  # no such key
]


@pytest.mark.parametrize(("claim", "measured", "met"), CLAIMS)
def test_a_claim_holds_in_every_row_of_its_query(claim, measured, met):
    rows = pd.DataFrame(
        {
            "case": ["ball", "ball", "jump", "jump"],
            "start": ["paper", "net", "net", "paper"],
            "iterations_median": [50.0, 5.0, 7.0, 70.0],
        }
    )
    (judged,) = judge([claim], rows)
    assert (judged.measured, judged.met) == (measured, met)


def test_missing_numbers_miss_a_claim():
    rows = pd.DataFrame(
        {
            "case": ["ball", "jump"],
            "drift_max": [np.nan, 0.5],
            "gap_p99": [4.0, 4.0],
            "gap_missing": [1, 0],
        }
    )
    claims = [
        Claim("met", "case == 'jump'", "drift_max", "<=", 1, unit="mm"),
        Claim("unknown", "case == 'other'", "drift_max", "<=", 1, unit="mm"),
        Claim("missed", "case == case", "drift_max", "<=", 1, unit="mm"),
        Claim("one case lacks it", "case == 'ball'", "gap_p99", "<=", 8),
        Claim("no case lacks it", "case == 'jump'", "gap_p99", "<=", 8),
    ]
    judged = judge(claims, rows)
    assert [(row.claim.name, row.met) for row in judged] == [
        ("missed", False),
        ("one case lacks it", False),
        ("unknown", None),
        ("met", True),
        ("no case lacks it", True),
    ]
    text = "\n".join(lines(judged))
    assert text.startswith("MISSED  missed\n        target <= 1 mm; measured 0.5 mm\n")
    assert "not measured in this run" in text
