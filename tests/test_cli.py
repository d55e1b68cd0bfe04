"""The command line: exit codes, JSON, suggestions, closed choices, completion, advice, and what is imported when."""

from __future__ import annotations

import json
import os
import re
import signal
import statistics
import subprocess
import sys
from pathlib import Path
from subprocess import PIPE
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from processes import start

from grasp_env.force import METHODS, RULES
from grasp_env.grasp import Grasp, load_grasp, presets, save_grasp
from grasp_env.grasp.presets import PRESETS
from training.cli import COMMANDS, EXIT_CODES, UsageError, main
from training.commands.solve import Solve

ROOT = Path(__file__).parents[1]
LARGE = "--method reduced_flow --wrench 1000 500 -600 -100 200 0"
"""Too large for the flow to reach its tolerance."""
LIMITED = "--method newton --max-normal 5 --wrench 0 0 50 0 0 0"
"""No force within the limit balances it."""
LOAD = "--wrench 0 0 -1 0 0 0"


def said(words: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    """Exit code, stdout, stderr."""
    capsys.readouterr()
    return main(words.split()), *capsys.readouterr()


def page(words: str, capsys: pytest.CaptureFixture[str]) -> str:
    """What is printed instead of running: help, version, completion."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main(words.split())
    assert not stopped.value.code
    return capsys.readouterr().out


def answer(words: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any], str]:
    """Exit code, the one JSON object on stdout, stderr."""
    code, out, told = said(f"{words} --json", capsys)
    assert out.count("\n") == 1
    return code, json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON")), told


ENDS = {
    "slove": (2, "UnknownNameError", "did you mean 'solve'?"),
    "evalute": (2, "UnknownNameError", "did you mean 'evaluate'?"),
    "--halp": (2, "UnknownNameError", "choose one of 'solve', 'hand'"),
    "solve --metod newton": (2, "UsageError", "--method {reduced_flow"),
    "solve --method newtn": (2, "UsageError", "did you mean 'newton'?"),
    "solve --preset tripot": (2, "UsageError", "did you mean 'tripod'?"),
    "solve --wrench 1 2": (2, "UsageError", "Expected 6 values"),
    "solve --tolerance small": (2, "UsageError", "--tolerance"),
    "demo --task hodl": (2, "UsageError", "did you mean 'hold'?"),
    "evaluate env --hands leap --engines bulet": (2, "UsageError", "did you mean 'bullet'?"),
    "evaluate env --hands four_fingr": (2, "UnknownNameError", "did you mean 'four_finger'?"),
    "object shwo": (2, "UsageError", "did you mean 'show'?"),
    "object show": (2, "InvalidInputError", "needs a FILE"),
    "object show nowhere.obj": (2, "InvalidInputError", "nowhere.obj"),
    "object clear nowhere.obj": (2, "InvalidInputError", "leave it out"),
    "hand lepa": (2, "UnknownNameError", "did you mean 'leap'?"),
    "solve --initial lagrang": (2, "UnknownNameError", "did you mean 'lagrange'?"),
    "solve --initial previous": (2, "InvalidInputError", "leave --initial out"),
    "solve --friction -1": (2, "InvalidInputError", "-1"),
    "solve --grasp nowhere.json": (2, "GraspFileError", "nowhere.json"),
    "report nowhere": (2, "GraspError", "nowhere"),
    f"solve {LIMITED}": (3, "InfeasibleWrenchError", "wrench [0.0, 0.0, 50.0"),
    f"solve {LARGE}": (4, "NotConvergedError", "max_iterations"),
}


@pytest.mark.parametrize("words", ENDS)
def test_errors_have_exit_codes_suggestions_and_json(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, kind, told = ENDS[words]
    if kind != "UsageError" and words.split()[0] in ("evaluate", "hand", "report"):
        found, out, people = said(words, capsys)  # they have no --json
    else:
        found, answered, people = answer(words, capsys)
        error = answered["error"]
        assert (error["kind"], error["exit_code"]) == (kind, code)
        assert re.search(r"\w", error["message"])
        assert not re.search("[│─╭]", error["message"])
        assert ("allowed" in error) == (kind == "UnknownNameError")
        plain, out, same = said(words, capsys)
        assert (plain, same) == (code, people)  # stderr is for people, with --json and without
    assert found == code
    assert told in " ".join(people.split())
    assert people.count("did you mean") == told.count("did you mean")
    assert ("\n" not in people.strip()) == (kind != "UsageError")
    assert (out == "") == (code in (2, 3))  # what did not converge is shown


def test_what_the_option_parser_prints_is_json_without_frame_and_colour() -> None:
    shown = "\x1b[31m╭─ Bad ─────╮\x1b[0m\n│ \x1b[1mno 'newtn'\x1b[0m │\n│ ('newton') │\n╰───────────╯\n"
    error = UsageError(shown, ["newtn"])
    assert str(error) == "Bad no 'newtn' ('newton')"
    assert error.page == f"{shown}grasp: did you mean 'newton'?\n"


def test_faults_and_interrupts_have_their_own_codes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for code, error in ((1, ZeroDivisionError("by 0")), (130, KeyboardInterrupt()), (2, OSError(28, "disk full", "x"))):
        monkeypatch.setattr(Solve, "execute", Mock(side_effect=error))
        found, told, people = answer("solve", capsys)
        assert (found, told["error"]["exit_code"], told["error"]["kind"]) == (code, code, type(error).__name__)
        assert ("Traceback" in people, "interrupted" in people, "x: disk full" in people) == (code == 1, code == 130, code == 2)  # fmt: skip
    assert {code for code, *_ in ENDS.values()} | {0, 1, 130} == set(EXIT_CODES)


def test_ctrl_c_ends_the_program_where_the_tests_ignore_it() -> None:
    script = """
import sys, time
from training.cli import main
from training.commands.solve import Solve
Solve.execute = lambda self: (print("begun", flush=True), time.sleep(30.0))
sys.exit(main(["solve"]))
"""
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with start([sys.executable, "-c", script], cwd=ROOT, text=True, stdout=PIPE, stderr=PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "begun\n"
            process.send_signal(signal.SIGINT)
            _, people = process.communicate(timeout=20)
    finally:
        signal.signal(signal.SIGINT, handler)
    assert (process.returncode, people) == (130, "grasp: interrupted\n")


def test_answers_for_machines_certify(capsys: pytest.CaptureFixture[str]) -> None:
    code, told, people = answer("solve", capsys)
    grasp = presets.paper_cuboid()
    assert (code, told["status"], told["advice"], people) == (0, "optimal", [], "")
    assert told["equilibrium_residual"] < 1e-9
    assert grasp.residual(told["force"], told["wrench"]) < 1e-9
    assert np.sum(told["force_in_object_frame"], axis=0) == pytest.approx(-np.array(told["wrench"][:3]))
    code, told, _ = answer(f"solve {LIMITED}", capsys)
    assert (code, told["status"], told["force"], told["wrench"]) == (3, "infeasible", None, [0, 0, 50, 0, 0, 0])
    assert np.dot(told["separating_twist"], told["wrench"]) > 0.0
    code, told, _ = answer(f"solve {LARGE}", capsys)
    assert (code, told["status"], np.shape(told["force"])) == (4, "iteration_limit", (4, 3))
    assert told["objective"] > 0.0
    assert told["lower_bound"] is None  # -inf is no JSON


CLOSED = {
    "solve": {"--method": METHODS, "--preset": PRESETS, "--criterion": ("sum", "max")},
    "demo": {"--task": ("hold", "move"), "--disturbance": ("random",), "--motion": ("lift",), "--shape": ("cuboid",)},
    "evaluate": {"--engines": ("bullet", "noslip")},
    "fit": {"--preset": PRESETS},
    "rl": {"--algorithm": ("ppo", "sac"), "--action": ("initial_force",)},
    "live": {"--preset": PRESETS},
}


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_help_lists_choices_and_fits_eighty_columns(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = page(f"{name} --help", capsys)
    assert [line for line in text.splitlines() if len(line) > 80 and "{" not in line] == []
    for option, names in CLOSED.get(name, {}).items():
        (listed,) = re.findall(rf"{option} \[?{{(.*?)}}", re.sub(r"[\s│]", "", text).replace(option, f"{option} "))
        assert set(names) <= set(listed.split(","))
    if not name:
        lines = [line.split(maxsplit=1) for line in text.splitlines() if line.startswith("  ")]
        assert lines == [*([each, line] for each, (_, line) in COMMANDS.items()), *([str(code), meaning] for code, meaning in EXIT_CODES.items())]  # fmt: skip


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_knows_commands_options_and_choices(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    script = page(f"--tyro-print-completion {shell}", capsys)
    for word in (*COMMANDS, "--barrier-weight", *METHODS, *PRESETS, "tilting_gravity"):
        assert word in script


@pytest.mark.parametrize("program", [["-m", "training"], ["-m", "training.cli"]], ids=" ".join)
def test_modules_are_the_script(program: list[str]) -> None:
    command = [sys.executable, *program, "--version"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert re.fullmatch(r"grasp \S+, core \S+ .*, Python 3\.\S+\n", done.stdout)
    assert 'grasp = "training.cli:main"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def test_own_contacts(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)
    assert "--save-grasp my.json" in page("solve --help", capsys)
    assert main(["solve", "--preset", "tripod", "--save-grasp", "my.json"]) == 0
    assert np.array_equal(load_grasp("my.json").positions, presets.tripod().positions)
    code, _, people = said("solve --grasp my.json", capsys)  # the wrench of another object would say nothing
    assert (code, "--grasp needs --wrench" in people) == (2, True)
    code, out, _ = said(f"solve --grasp my.json {LOAD}", capsys)
    assert (code, "my.json, wrench 0 0 -1 0 0 0: optimal" in " ".join(out.split())) == (0, True)
    for text in ("normal [N]", "o [N]", "t [N]", "margin [N]", "tangent plane"):
        assert text in out
    assert max(map(len, out.splitlines())) <= 80
    assert "torsion" not in out
    plain = presets.tripod()
    soft = Grasp.from_contacts(plain.positions, plain.normals, 0.5, contact_model="soft", torsional_friction=0.005)
    save_grasp(soft, "soft.json")
    assert "torsion [N m]" in said(f"solve --grasp soft.json {LOAD} --method newton", capsys)[1]
    Path("odd.json").write_text(
        '{"positions": [[40, 0, 0], [-20, 30, 0], [-20, -30, 0]], "friction": 0.5, '
        '"normals": [[1, 0, 0], [-0.6, 0.8, 0], [-0.6, -0.8, 0]]}'
    )
    for words in (LOAD, LIMITED):  # whatever comes out
        _, told, people = answer(f"solve --grasp odd.json {words}", capsys)
        for text in ("normals must point INTO the object", "divide millimetres by 1000"):
            assert text in people
            assert any(text in advice for advice in told["advice"])
    assert all(name in said("solve --initial previous", capsys)[2] for name in RULES)


def test_a_reader_that_has_read_enough_is_no_error() -> None:
    run = f"{sys.executable} -m training solve --json | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", run], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


LATER = {
    "scipy",
    "torch",
    "gymnasium",
    "pybullet",
    "matplotlib",
    "PIL",
    "mujoco",
    "viser",
    "trimesh",
    "coacd",
    "pymeshfix",
    "stable_baselines3",
    "pandas",
}
"""What neither help nor a plain solve has any need of."""


@pytest.mark.parametrize("words", ["--version", "--help", "solve --help", "solve"])
def test_only_what_is_asked_for_is_imported(words: str) -> None:
    script = f"import atexit, sys; atexit.register(lambda: print(*sys.modules, file=sys.stderr)); from training.cli import main; main({words.split()})"  # fmt: skip
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    loaded = set(done.stderr.split())
    assert "training.cli" in loaded
    assert not {name.split(".")[0] for name in loaded} & (LATER | ({"numpy", "tyro"} if words == "--help" else set()))
    assert {f"training.commands.{name}" for name in COMMANDS} & loaded <= {f"training.commands.{words.split()[0]}"}


@pytest.mark.slow
@pytest.mark.parametrize("words", [["--help"], ["solve", "--help"]], ids=" ".join)
def test_help_comes_at_once(words: list[str]) -> None:
    """0.3 s asked for on a quiet machine; processor time, which others on it disturb less than the clock."""
    taken = []
    for _ in range(11):
        before = os.times()
        command = [sys.executable, "-m", "training", *words]
        subprocess.run(command, cwd=ROOT, stdout=subprocess.DEVNULL, check=True, timeout=60)
        after = os.times()
        taken.append(after.children_user + after.children_system - before.children_user - before.children_system)
    assert statistics.median(taken) < 0.3
