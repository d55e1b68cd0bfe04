"""Two checkouts beside each other: this one against itself, joined lines by hand, and what cannot
be compared."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.core import BENCHMARK, CALL, FIRST, RATIO, CoreSettings, joined, run
from benchmarks.core_side import ROWS
from grasp_env.errors import GraspError, InvalidInputError
from training.evaluation.results.claims import judge
from training.evaluation.results.table import join, pd, summary

ROOT = Path(__file__).parents[2]


def checkout(folder: Path, source: str = "") -> Path:
    """A checkout that runs this interpreter and notes each time that it does: this one's grasp_env,
    or one of that source."""
    python = folder / ".venv/bin/python"
    python.parent.mkdir(parents=True)
    python.write_text(f'#!/bin/sh\necho >>"{folder}/runs"\nexec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    if source:
        (folder / "grasp_env").mkdir()
        (folder / "grasp_env/__init__.py").write_text(source)
    else:
        (folder / "grasp_env").symlink_to(ROOT / "grasp_env")
    return folder


def test_against_itself(tmp_path):
    old = checkout(tmp_path / "old")
    rows = run(CoreSettings((3,), 8, 2, 1, baseline=old), (*ROWS, "nonsense"))
    assert (old / "runs").read_text() == "\n\n"  # a process a round
    found = summary(rows[rows["reason"].isna()])
    calls, ratios, first = (found[found["case"] == case] for case in (CALL, RATIO, FIRST))
    assert calls["method"].tolist() == [name for name in ROWS for _ in ("now", "baseline")]
    assert calls["n"].eq(8).all()
    assert calls["failed_sum"].eq(0).all()
    assert calls["apart_max"].eq(0.0).all()  # the same code
    assert (calls["microseconds_median"] > 0.1).all()
    assert (ratios["ratio_median"] > 0.0).all()
    assert (first["milliseconds_median"] > 10.0).all()
    assert all(row.met is not None for row in judge(BENCHMARK.claims, found))
    lacking = rows.loc[rows["reason"].notna(), ["side", "reason"]].to_numpy().tolist()
    assert lacking == [["now", "KeyError: 'nonsense'"], ["baseline", "KeyError: 'nonsense'"]]


def test_lines_are_joined():
    keys = ("side", "turn", "problem", "microseconds", "objective")
    lines = [
        ("now", 0, 0, 2.0, 1.1),
        ("now", 0, 1, 4.0, None),
        ("baseline", 0, 0, 1.0, 1.0),
        ("baseline", 0, 1, 3.0, 5.0),
        ("now", 1, 0, 3.0, 1.1),
        ("now", 1, 1, 1.0, None),
        ("baseline", 1, 0, 2.0, 1.0),
        ("baseline", 1, 1, 2.0, 5.0),
    ]
    given = pd.DataFrame(lines, columns=keys).assign(method="a", contacts=4)
    lost = pd.DataFrame([{"method": "b", "contacts": 4, "side": "baseline", "reason": "no b"}])
    rows = join(joined(pd.concat([given.astype(object), given[:1].assign(method="b"), lost])))
    calls = rows[rows["case"] == CALL]
    assert calls[["side", "problem", "microseconds", "failed"]].to_numpy().tolist() == [
        ["now", 0, 2.0, False],
        ["now", 1, 1.0, True],
        ["baseline", 0, 1.0, False],
        ["baseline", 1, 2.0, False],
    ]
    assert calls["apart"].tolist() == pytest.approx([0.1, np.nan, 0.0, 0.0], nan_ok=True)
    # medians of a round: 3 over 2, then 2 over 2
    assert rows.loc[rows["case"] == RATIO, "ratio"].tolist() == [1.5, 1.0]
    assert rows.loc[rows["method"] == "b", ["side", "reason"]].to_numpy().tolist() == [
        ["baseline", "no b"]
    ]


def test_what_cannot_be_compared_says_why(tmp_path):
    ends = checkout(tmp_path / "ends", "raise SystemExit('no such thing')")
    import_it = f"import sys; sys.path.insert(0, {str(ROOT)!r}); del sys.modules['grasp_env']; import grasp_env"
    for baseline, kind, said in (
        (tmp_path / "none", InvalidInputError, r"none is no installed checkout .* make -C"),
        (ends, GraspError, "ended: no such thing"),
        (
            checkout(tmp_path / "elsewhere", import_it),
            InvalidInputError,
            "imports grasp_env from elsewhere",
        ),
    ):
        with pytest.raises(kind, match=said):
            run(CoreSettings((3,), 8, 1, 1, baseline=baseline), ("newton",))
