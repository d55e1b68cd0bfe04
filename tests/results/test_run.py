"""Run folders: files appear whole or not at all, finished runs stay, interrupted ones go on with their own settings only."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from grasp_env.errors import InvalidInputError
from training.results.run import Run, check_counts
from training.results.table import table


def test_an_interrupted_write_leaves_what_was_there(tmp_path):
    run = Run.create(tmp_path, "a")
    run.write_text("notes.txt", "whole")

    def breaks(path: Path) -> None:
        path.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run.write("notes.txt", breaks)
    assert run.path("notes.txt").read_text() == "whole"
    assert [path.name for path in run.folder.iterdir()] == ["notes.txt"]
    with pytest.raises(ValueError, match="JSON compliant"):
        run.write_json("numbers.json", {"a": float("nan")})


def test_a_finished_run_is_not_overwritten_and_says_how_it_was_made(tmp_path):
    run = Run.create(tmp_path, "a")
    run.save(table([{"case": "ball", "drift": 0.5}]), {"kind": "env", "settings": {"seed": 3}})
    about = json.loads((tmp_path / "a" / "run.json").read_text())
    assert about["columns"]["drift"].startswith("[mm] largest distance of the object")
    assert {"command", "time", "machine", "versions", "commit", "settings"} <= {*about}
    assert run.load()[0]["drift"].tolist() == [0.5]
    with pytest.raises(InvalidInputError, match="holds a finished run: choose another name or remove it"):
        Run.create(tmp_path, "a")
    with pytest.raises(InvalidInputError, match="is not a finished run"):
        Run.open(tmp_path / "nothing", "run.json")


def test_an_interrupted_run_goes_on_with_its_own_settings_only(tmp_path):
    run = Run.create(tmp_path, "a")
    for _ in range(2):
        run.begin({"seed": 1, "hands": ("allegro",)})
    with pytest.raises(InvalidInputError, match=r"was begun with other settings \(seed\)"):
        run.begin({"seed": 2, "hands": ("allegro",)})
    with pytest.raises(InvalidInputError, match="seed"):
        check_counts(type("Settings", (), {"seed": -1}), {"seed": 0})
