"""Tables: typed columns, files that keep every value, summaries and claims that a plain recomputation agrees with."""

from __future__ import annotations

import numpy as np
import pytest

from grasp_env.errors import InvalidInputError
from training.results.claims import Claim, judge, lines
from training.results.columns import COLUMNS, KEYS
from training.results.table import STATISTICS, chosen, described, join, pd, read, summary, table, write, write_csv


def made() -> pd.DataFrame:
    rng = np.random.default_rng(0)
    rows = [
        {"case": case, "start": start, "problem": k, "iterations": int(rng.integers(0, 99)), "start_gap": rng.random(),
         "held": bool(rng.random() < 0.7), "status": "optimal"}
        for case in ("ball", "jump") for start in ("paper", "network") for k in range(50)
    ]  # fmt: skip
    rows[3] |= {"iterations": None, "status": "no_start", "start_gap": None, "held": None}
    return table(rows)


def test_files_keep_every_value_and_type(tmp_path):
    rows = made()
    write(tmp_path / "rows.parquet", rows)
    write_csv(tmp_path / "rows.csv", rows)
    pd.testing.assert_frame_equal(read(tmp_path / "rows.parquet"), rows, check_exact=True)
    pd.testing.assert_frame_equal(read(tmp_path / "rows.csv"), rows, rtol=1e-6)  # seven digits
    odd = table([{"start_gap": value} for value in (1e-300, -2.5, 0.0, np.inf, 123456789.123, 1e300)])
    write_csv(tmp_path / "odd.csv", odd)
    pd.testing.assert_frame_equal(read(tmp_path / "odd.csv"), odd, rtol=1e-6)
    (tmp_path / "odd.csv").unlink()
    write(tmp_path / "again.parquet", rows)
    assert (tmp_path / "again.parquet").read_bytes() == (tmp_path / "rows.parquet").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again.parquet", "rows.csv", "rows.parquet"]


def test_columns_stand_in_their_order_with_their_types_and_unknown_ones_are_refused():
    rows = table([{"held": True, "iterations": 3, "case": "ball", "gap": None}])
    assert list(rows.columns) == ["case", "iterations", "held"]
    assert [str(kind) for kind in rows.dtypes] == ["string", "Int64", "boolean"]
    with pytest.raises(InvalidInputError, match="unknown columns speed: add them to COLUMNS"):
        table([{"speed": 1.0}])
    with pytest.raises(InvalidInputError, match="does not fit the kind of its column"):
        table([{"iterations": "many"}])
    joined = join([table([{"case": "a"}]), table([{"iterations": 2}])])
    assert str(joined["iterations"].dtype) == "Int64"
    assert joined["case"].isna().tolist() == [False, True]


def test_the_summary_is_what_numpy_says_of_every_group():
    rows = made()
    found = summary(rows)
    assert found[["case", "start", "n"]].to_numpy().tolist() == [
        ["ball", "paper", 50], ["ball", "network", 50], ["jump", "paper", 50], ["jump", "network", 50],
    ]  # fmt: skip
    for _, row in found.iterrows():
        mine = rows[(rows["case"] == row["case"]) & (rows["start"] == row["start"])]
        steps = np.sort(mine["iterations"].dropna().to_numpy(float))
        assert row["iterations_missing"] == 50 - len(steps)
        assert row["iterations_median"] == np.median(steps)
        # p99 by its definition: linear between order statistics
        place = 0.99 * (len(steps) - 1)
        assert row["iterations_p99"] == pytest.approx(np.interp(place, np.arange(len(steps)), steps))
        held = mine["held"].dropna().to_numpy(float)
        assert row["held_sum"] == held.sum()
        assert row["held_rate_low"] < held.mean() < row["held_rate_high"]
        assert row["iterations_low"] <= row["iterations_median"] <= row["iterations_high"]


def test_every_column_is_documented_and_summarised_by_known_statistics():
    for name, column in COLUMNS.items():
        assert column.text, name
        assert set(column.statistics) <= {*STATISTICS, "missing"}, name
        assert not (column.key and column.statistics), name
    assert "start" in KEYS
    told = described([*summary(made()).columns, "start_gap_p99"])
    assert all(told.values()), told
    assert told["start_gap_p99"] == "99th percentile: relative gap of Phi at the start"


@pytest.mark.parametrize(
    ("claim", "measured", "met"),
    [
        (Claim("a", "case == 'ball'", "iterations_median", "<=", 60), 50.0, True),
        (Claim("the worst row counts", "start == 'paper'", "iterations_median", "<=", 60), 70.0, False),
        (Claim("a ratio of pairs", "start == 'net'", "iterations_median", "<", 0.2, "start == 'paper'"), 0.1, True),
        (Claim("a difference", "start == 'net'", "iterations_median", "within", 50, "start == 'paper'", True), -63.0, False),
        (Claim("least", "start == 'net'", "iterations_median", ">=", 6), 5.0, False),
        (Claim("no such start", "start == 'other'", "iterations_median", "<=", 60), None, None),
        (Claim("no such column", "case == 'ball'", "drift_max", "<=", 60), None, None),
        (Claim("no such key", "hand == 'ball'", "iterations_median", "<=", 60), None, None),
    ],
)  # fmt: skip
def test_a_claim_holds_in_every_row_of_its_query(claim, measured, met):
    rows = pd.DataFrame({
        "case": ["ball", "ball", "jump", "jump"], "start": ["paper", "net", "net", "paper"],
        "iterations_median": [50.0, 5.0, 7.0, 70.0],
    })  # fmt: skip
    (judged,) = judge([claim], rows)
    assert (judged.measured, judged.met) == (measured, met)


def test_a_claim_is_missed_where_some_cases_have_no_number():
    few = Claim("few steps", "start == 'net'", "iterations_median", "<=", 8)
    for missing, met in ((0, True), (1, False)):
        rows = pd.DataFrame(
            {"start": ["net", "paper"], "iterations_median": [4.0, 45.0], "iterations_missing": [missing, 0]}
        )
        assert judge([few], rows)[0].met is met


def test_a_missing_number_is_a_missed_claim_and_missed_claims_come_first():
    rows = pd.DataFrame({"case": ["ball", "jump"], "drift_max": [np.nan, 0.5]})
    claims = [
        Claim("met", "case == 'jump'", "drift_max", "<=", 1, unit="mm"),
        Claim("unknown", "case == 'other'", "drift_max", "<=", 1, unit="mm"),
        Claim("missed", "case == case", "drift_max", "<=", 1, unit="mm"),
    ]
    judged = judge(claims, rows)
    assert [(row.claim.name, row.met) for row in judged] == [("missed", False), ("unknown", None), ("met", True)]
    text = "\n".join(lines(judged))
    assert text.startswith("MISSED  missed\n        asked <= 1 mm; measured 0.5 mm\n        unknown")
    assert "not measured in this run" in text
    assert chosen(rows, "nothing_here == 1 and hand == 'x'").empty
