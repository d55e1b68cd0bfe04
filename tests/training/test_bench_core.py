import io
import json
import sys
from pathlib import Path

import pytest
from rich.console import Console

from grasp_env.errors import GraspError, InvalidInputError
from training.bench import core_sides, core_worker
from training.bench import show as pages
from training.bench.core import ROWS, claims, core
from training.bench.core_sides import Checkout, first_solve
from training.bench.timing import Effort
from training.cli import main

ROOT = Path(core_sides.__file__).parents[2]


def checkout(folder, packages=()):
    """A checkout that runs this interpreter: of links to this one, or of `packages`, {file: source}."""
    python = folder / ".venv/bin/python"
    python.parent.mkdir(parents=True)
    python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    if packages:
        (folder / "training/bench").mkdir(parents=True)
        for name, source in packages.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(source)
    else:
        for name in ("grasp_env", "policies", "training"):
            (folder / name).symlink_to(ROOT / name)
    return folder


def printed(result):
    console = Console(record=True, width=120, file=io.StringIO())
    pages.show(result, console)
    return console.export_text()


def test_against_itself(tmp_path, monkeypatch):
    rows = ("newton", "newton_python", "newton_previous", "pipeline_newton", "from_contacts", "unchecked", "nonsense")
    monkeypatch.setitem(ROWS, "nonsense", "a row that no side has")
    ticks = []
    result = core(Effort((3,), 8, 2, 1), baseline=checkout(tmp_path / "old"), rows=rows, tick=ticks.append)
    assert [row["method"] for row in result["rows"]] == list(rows[:-1])
    assert result["missing"] == {"nonsense": "now, 3 contacts: KeyError: 'nonsense'"}
    for row in result["rows"]:
        assert row["problems"] == 8
        assert row["failed"] == row["baseline_failed"] == 0
        assert row["apart_max"] == 0.0  # the same code
        assert (
            0.05 < row["ratio_p50"] == row["p50_us"] / row["baseline_p50_us"] < 20.0
        )  # rough: few calls, a busy machine
        assert row["p50_us"] <= row["p99_us"]
    assert result["baseline"]["versions"] == result["provenance"]["versions"]
    assert len(result["claims"]) == len(rows) - 1
    assert any("round 2 of 2: unchecked" in tick for tick in ticks)
    text = printed(json.loads(pages.save(result, tmp_path / "out").read_text()))
    for word in (
        "3 contacts, median / p99",
        "old us",
        "asked at most 1.05",
        "nonsense is left out",
        "objectives differ by 0e+00",
    ):
        assert word in text
    assert all(row in text for row in rows)


def test_alone_from_the_command_line(tmp_path, capsys):
    words = ["bench", "core", "--quick", "--contacts", "3", "--wrenches", "8", "--json", "--out", str(tmp_path)]
    assert main(words) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["baseline"] is None
    assert result["claims"] == []
    assert [row["method"] for row in result["rows"]] == list(ROWS) == list(core_worker.ROWS)
    text = printed(result)
    assert "old us" not in text
    assert "pipeline_flow" in text


def test_a_wrong_baseline_is_one_line(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    (tmp_path / "bare/training/bench").mkdir(parents=True)
    for name, said in (("none", "is not a folder"), ("empty", "is not a checkout"), ("bare", "is not installed")):
        assert main(["bench", "core", "--baseline", str(tmp_path / name), "--out", str(tmp_path / "out")]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line
        assert str(tmp_path / name) in line
    assert main(["bench", "batch", "--baseline", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "belong to grasp bench core" in capsys.readouterr().err


def test_a_worker_that_ends_says_why(tmp_path):
    broken = checkout(tmp_path / "broken", {"grasp_env/__init__.py": "raise SystemExit('no such thing')"})
    with pytest.raises(GraspError, match="ended: no such thing"):
        core(Effort((3,), 8, 1, 1), baseline=broken)


def test_other_problems_are_refused(tmp_path, monkeypatch):
    ask = core_sides.Side.ask

    def shifted(self, **request):
        answer = ask(self, **request)
        if self._checkout.root != ROOT and "problems" in answer:
            answer["problems"][0] += 1e-3
        return answer

    monkeypatch.setattr(core_sides.Side, "ask", shifted)
    with pytest.raises(InvalidInputError, match="other problems"):
        core(Effort((3,), 8, 1, 1), baseline=checkout(tmp_path / "old"))


def test_first_solve_of_a_process(tmp_path):
    optimizer = """
import scipy
from types import SimpleNamespace
class ForceOptimizer:
    def __init__(self, grasp, method):
        pass
    def solve(self, wrench):
        return SimpleNamespace(force=wrench, status=SimpleNamespace(name="{}"))
"""
    made = "from types import SimpleNamespace\npresets = SimpleNamespace(paper_cuboid=lambda: None)\n"
    files = {"grasp_env/__init__.py": "", "grasp_env/grasp.py": made}
    good = checkout(tmp_path / "good", {**files, "grasp_env/force.py": optimizer.format("OPTIMAL")})
    got = first_solve(Checkout.at(good), "newton")
    assert 0.0 < got["import_seconds"] <= got["seconds"] < 60.0
    assert got["loaded"] == ["scipy"]
    bad = checkout(tmp_path / "bad", {**files, "grasp_env/force.py": optimizer.format("STALLED")})
    with pytest.raises(GraspError, match="ended as STALLED"):
        first_solve(Checkout.at(bad), "newton")


def test_claims():
    rows = [{"method": "newton", "contacts": n, "ratio_p50": r} for n, r in ((3, 0.3), (4, 1.06), (50, 0.41))]
    rows += [{"method": "conic", "contacts": 4, "ratio_p50": 1.0}, {"method": "flow", "contacts": 4}]
    starts = [{"method": "newton", "side": side, "median_s": s} for side, s in (("now", 0.3), ("baseline", 60.0))]
    got = [(claim["asked"], claim["measured"], claim["met"]) for claim in claims(rows, starts)]
    assert got == [
        ("at most 1.05", "1.06 (N = 4, the worst)", False),
        ("at most 1.05", "1 (N = 4, the worst)", True),
        ("at most 0.5 s", "0.3 s", True),
    ]
