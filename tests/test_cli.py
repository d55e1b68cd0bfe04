"""The command line: exit codes, JSON, suggestions, closed choices, completion, advice, and how soon it answers."""

from __future__ import annotations

import json
import os
import re
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from grasp_env.force import METHODS, RULES
from grasp_env.grasp import Grasp, load_grasp, presets, save_grasp
from grasp_env.grasp.presets import PRESETS
from training.cli import main
from training.commands import exits
from training.commands.program import COMMANDS, command

ROOT = Path(__file__).parents[1]
LARGE = ("--wrench", "1000", "500", "-600", "-100", "200", "0")
"""Too large for the flow to reach its tolerance."""
LIMITED = ("--method", "newton", "--max-normal", "5", "--wrench", "0", "0", "50", "0", "0", "0")
LOAD = ["--wrench", "0", "0", "-1", "0", "0", "0"]
"""No force within the limit balances it."""


def said(words: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    """Exit code, stdout, stderr."""
    capsys.readouterr()
    return main(words), *capsys.readouterr()


def page(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What is printed instead of running: help, version, completion."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert not stopped.value.code
    return capsys.readouterr().out


def answer(words: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any], str]:
    """Exit code, the one JSON object on stdout, stderr."""
    code, out, told = said([*words, "--json"], capsys)

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    assert out.count("\n") == 1
    return code, json.loads(out, parse_constant=refuse), told


ENDS: list[tuple[int, str, list[str]]] = [
    (2, "UnknownNameError", ["slove"]),
    (2, "UsageError", ["solve", "--metod", "newton"]),
    (2, "UsageError", ["solve", "--wrench", "1", "2"]),
    (2, "UsageError", ["solve", "--tolerance", "small"]),
    (2, "UsageError", ["solve", "--preset", "hexapod"]),
    (2, "UnknownNameError", ["solve", "--initial", "best"]),
    (2, "InvalidInputError", ["solve", "--friction", "-1"]),
    (2, "GraspFileError", ["solve", "--grasp", "nowhere.json"]),
    (2, "InvalidInputError", ["solve", "--initial", "previous"]),
    (2, "InvalidInputError", ["bench", "solver", "--contacts", "2"]),
    (3, "InfeasibleWrenchError", ["solve", *LIMITED]),
    (4, "NotConvergedError", ["solve", *LARGE]),
]


@pytest.mark.parametrize(("code", "kind", "words"), ENDS, ids=lambda given: given if isinstance(given, str) else None)
def test_errors_have_exit_codes_and_are_json_for_machines(
    code: int, kind: str, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    found, told, people = answer(words, capsys)
    assert (found, told["error"]["kind"], told["error"]["exit_code"]) == (code, kind, code)
    assert told["error"]["message"]
    assert not re.search("[│─╭]", told["error"]["message"])
    assert people  # stderr is for them, with --json and without
    plain, out, same = said(words, capsys)
    assert (plain, same) == (code, people)
    assert (out == "") == (code in (2, 3))  # what did not converge is shown


def test_faults_and_interrupts_have_their_own_codes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def end(error: BaseException) -> Any:
        def execute(self: Any) -> None:
            raise error

        return execute

    for code, error in ((1, ZeroDivisionError("by nothing")), (130, KeyboardInterrupt()), (2, OSError(28, "disk full", "x"))):  # fmt: skip
        monkeypatch.setattr(command("solve"), "execute", end(error))
        found, told, people = answer(["solve"], capsys)
        assert (found, told["error"]["exit_code"], told["error"]["kind"]) == (code, code, type(error).__name__)
        assert ("Traceback" in people) == (code == 1)


def test_the_table_of_exit_codes_is_in_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    text = " ".join(page(["--help"], capsys).split())
    for code, meaning in exits.EXIT_CODES.items():
        assert f"{code} {meaning}" in text
    assert {code for code, *_ in ENDS} | {0, 1, 130} == set(exits.EXIT_CODES)


def test_an_infeasible_wrench_comes_with_its_proof(capsys: pytest.CaptureFixture[str]) -> None:
    code, told, _ = answer(["solve", *LIMITED], capsys)
    twist, wrench = np.array(told["separating_twist"]), np.array(told["wrench"])
    assert (code, told["status"], told["force"]) == (3, "infeasible", None)
    assert twist @ wrench > 0.0
    assert wrench.tolist() == [0, 0, 50, 0, 0, 0]


def test_what_did_not_converge_comes_with_its_bound(capsys: pytest.CaptureFixture[str]) -> None:
    code, told, _ = answer(["solve", *LARGE], capsys)
    assert (code, told["status"]) == (4, "iteration_limit")
    assert "lower_bound" in told
    assert np.array(told["force"]).shape == (4, 3)


def test_a_solution_for_machines_balances(capsys: pytest.CaptureFixture[str]) -> None:
    code, told, people = answer(["solve"], capsys)
    grasp = presets.paper_cuboid()
    assert (code, told["status"], told["advice"], people) == (0, "optimal", [], "")
    assert told["equilibrium_residual"] < 1e-9
    assert grasp.residual(told["force"], told["wrench"]) < 1e-9
    assert np.sum(told["force_in_object_frame"], axis=0) == pytest.approx(-np.array(told["wrench"][:3]))


MEANT = {
    "slove": "solve",
    "evalute": "evaluate",
    "fit any_grsp": "any_grasp",
    "solve --metod newton": "--method",
    "solve --method newtn": "newton",
    "solve --preset tripot": "tripod",
    "solve --initial lagrang": "lagrange",
    "demo --task hodl": "hold",
    "demo --hand alegro": "allegro",
    "evaluate env --hands four_fingr": "four_finger",
    "evaluate env --hands leap --engines bulet": "bullet",
    "hand lepa": "leap",
}


@pytest.mark.parametrize("words", MEANT)
def test_misspelt_names_are_guessed(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, told = said(words.split(), capsys)
    assert (code, out) == (2, "")
    asked = rf"did you mean '{MEANT[words]}'\?" if not MEANT[words].startswith("-") else f"you meant:.*{MEANT[words]} "
    assert re.search(asked, told, re.DOTALL)


CLOSED = {
    "solve": {"--method": METHODS, "--preset": PRESETS, "--criterion": ("sum", "max")},
    "demo": {"--task": ("hold", "move"), "--disturbance": ("random",), "--motion": ("lift",), "--shape": ("cuboid",)},
    "evaluate": {"--engines": ("bullet", "noslip")},
    "fit four_finger": {"--preset": PRESETS},
    "rl": {"--algorithm": ("ppo", "sac"), "--action": ("initial_force",)},
    "live": {"--preset": PRESETS},
}


@pytest.mark.parametrize("name", CLOSED)
def test_closed_choices_are_in_the_help(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = page([*name.split(), "--help"], capsys)
    for option, names in CLOSED[name].items():
        (listed,) = re.findall(rf"{option} \[?{{(.*?)}}", re.sub(r"[\s│]", "", text).replace(option, f"{option} "))
        assert set(names) <= set(listed.split(","))


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_knows_commands_options_and_choices(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    script = page(["--tyro-print-completion", shell], capsys)
    for word in (*COMMANDS, "--barrier-weight", *METHODS, *PRESETS, "tilting_gravity"):
        assert word in script


@pytest.mark.parametrize("name", [*COMMANDS, "fit four_finger", "fit any_grasp", ""])
def test_help_fits_eighty_columns(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = page([*name.split(), "--help"], capsys).splitlines()
    assert [line for line in lines if len(line) > 80 and "{" not in line] == []


def test_version_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    text = page(["--version"], capsys)
    assert re.fullmatch(r"grasp \S+, core \S+ .*, Python 3\.\S+\n", text)


def test_module_and_script_are_the_same() -> None:
    for module in ("training", "training.cli"):
        done = subprocess.run(
            [sys.executable, "-m", module, "--version"], cwd=ROOT, capture_output=True, text=True, timeout=60
        )
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout.startswith("grasp ")
    assert 'grasp = "training.cli:main"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def test_suspicious_contacts_are_told_whatever_comes_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.json"
    file.write_text(
        '{"positions": [[40, 0, 0], [-20, 30, 0], [-20, -30, 0]], "friction": 0.5, '
        '"normals": [[1, 0, 0], [-0.6, 0.8, 0], [-0.6, -0.8, 0]]}'
    )
    for words in (["solve", "--grasp", str(file), *LOAD], ["solve", "--grasp", str(file), *LOAD, *LIMITED]):
        _, told, people = answer(words, capsys)
        for text in ("normals must point INTO the object", "divide millimetres by 1000"):
            assert text in people
            assert any(text in advice for advice in told["advice"])


def test_a_file_to_start_from(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "my.json"
    assert main(["solve", "--preset", "tripod", "--save-grasp", str(file)]) == 0
    assert np.array_equal(load_grasp(file).positions, presets.tripod().positions)
    assert main(["solve", "--grasp", str(file)]) == 2  # the wrench of another object would say nothing
    assert "--grasp needs --wrench" in capsys.readouterr().err
    assert main(["solve", "--grasp", str(file), *LOAD]) == 0
    assert "my.json, wrench 0 0 -1 0 0 0: optimal" in " ".join(capsys.readouterr().out.split())
    assert "--save-grasp my.json" in page(["solve", "--help"], capsys)


def test_a_single_solve_has_no_previous_one(capsys: pytest.CaptureFixture[str]) -> None:
    _, _, told = said(["solve", "--initial", "previous"], capsys)
    assert "leave --initial out" in told
    assert all(name in told for name in RULES)


def test_the_table_names_its_units_and_axes(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    _, out, _ = said(["solve"], capsys)
    for text in ("normal [N]", "o [N]", "t [N]", "margin [N]", "tangent plane"):
        assert text in out
    assert max(map(len, out.splitlines())) <= 80


def test_soft_contacts_show_their_torsion(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = presets.tripod()
    soft = Grasp.from_contacts(plain.positions, plain.normals, 0.5, contact_model="soft", torsional_friction=0.005)
    file = save_grasp(soft, tmp_path / "soft.json")
    _, out, _ = said(["solve", "--grasp", str(file), *LOAD, "--method", "newton"], capsys)
    assert "torsion [N m]" in out


def test_a_reader_that_has_read_enough_is_no_error() -> None:
    run = f"{sys.executable} -m training solve --json | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", run], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


LATER = {"scipy", "torch", "gymnasium", "pybullet", "matplotlib", "PIL", "mujoco", "viser", "stable_baselines3"}
"""What neither help nor a plain solve has any need of."""


@pytest.mark.parametrize("words", [["--version"], ["--help"], ["solve", "--help"], ["solve"]], ids=" ".join)
def test_only_what_is_asked_for_is_imported(words: list[str]) -> None:
    script = f"""
import sys
from training.cli import main
try:
    main({words})
except SystemExit:
    pass
print(*sorted(sys.modules), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    loaded = set(done.stderr.split())
    assert not {name.split(".")[0] for name in loaded} & LATER
    others = {f"training.commands.{name}" for name in COMMANDS} - {f"training.commands.{words[0]}"}
    assert not loaded & others
    if words[0] == "--help":
        assert "numpy" not in loaded


@pytest.mark.slow
@pytest.mark.parametrize("words", [["--help"], ["solve", "--help"]], ids=" ".join)
def test_help_comes_at_once(words: list[str]) -> None:
    """0.3 s asked for on a quiet machine; processor time, which others on it disturb less than the clock."""
    taken = []
    for _ in range(11):
        before = os.times()
        subprocess.run([sys.executable, "-m", "training", *words], cwd=ROOT, stdout=subprocess.DEVNULL, check=True)
        after = os.times()
        taken.append(after.children_user + after.children_system - before.children_user - before.children_system)
    assert statistics.median(taken) < 0.3
