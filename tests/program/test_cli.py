"""The command line: exit codes, JSON, help, completion, and lazy imports."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from grasp_env.force.options import METHODS
from grasp_env.grasp import Grasp, load_grasp, presets, save_grasp
from grasp_env.grasp.presets import PRESETS
from training.program.cli import COMMANDS, EXIT_CODES, main
from training.program.commands.solve import Solve

ROOT = Path(__file__).parents[2]
LARGE = "--method reduced_flow --wrench 1000 500 -600 -100 200 0"
"""Too large for the flow to reach its tolerance."""
LIMITED = "--method newton --max-normal 5 --wrench 0 0 50 0 0 0"
"""No force within the limit balances it."""
LOAD = "--wrench 0 0 -1 0 0 0"


def run(words: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    """Exit code, stdout, stderr."""
    capsys.readouterr()
    return main(words.split()), *capsys.readouterr()


def page(words: str, capsys: pytest.CaptureFixture[str]) -> str:
    """The text of help, version or completion."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main(words.split())
    assert not stopped.value.code
    return capsys.readouterr().out


def answer(words: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any], str]:
    """Exit code, the one JSON object on stdout, stderr."""
    code, out, err = run(f"{words} --json", capsys)
    assert out.count("\n") == 1
    return code, json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON")), err


ENDS = {
    "slove": (2, "UnknownNameError", "did you mean 'solve'?"),
    "solve --method newtn": (2, "UsageError", "did you mean 'newton'?"),
    "solve --wrench 1 2": (2, "UsageError", "Expected 6 values, got 2"),
    "solve --wrench nan nan nan nan nan nan": (2, "InvalidInputError", "wrench must be finite"),
    "solve --tolerance 0": (2, "InvalidInputError", "tolerance must be a number > 0"),
    "solve --initial previous": (2, "InvalidInputError", "leave --initial out"),
    "solve --grasp nowhere.json": (2, "GraspFileError", "nowhere.json"),
    "solve --grasp my.json": (2, "InvalidInputError", "--grasp needs --wrench"),
    "object clear nowhere.obj": (2, "InvalidInputError", "leave it out"),
    f"solve {LIMITED}": (3, "InfeasibleWrenchError", "wrench [0.0, 0.0, 50.0"),
    f"solve {LARGE}": (4, "NotConvergedError", "max_iterations"),
}


@pytest.mark.parametrize("words", ENDS)
def test_errors_have_exit_codes_suggestions_and_json(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    save_grasp(presets.tripod(), "my.json")
    code, kind, message = ENDS[words]
    found, answered, err = answer(words, capsys)
    error = answered["error"]
    assert (found, error["kind"], error["exit_code"]) == (code, kind, code)
    assert re.search(r"\w", error["message"])
    assert ("allowed" in error) == (kind == "UnknownNameError")
    plain, out, same = run(words, capsys)
    assert (plain, same) == (code, err)  # stderr is the same with --json and without
    assert message in " ".join(err.split())
    assert err.count("did you mean") == message.count("did you mean")
    assert ("\n" not in err.strip()) == (kind != "UsageError")
    assert (out == "") == (code in (2, 3))  # a solve that did not converge is shown


def test_a_right_word_that_the_help_mentions_is_not_called_misspelt(capsys):
    """The help speaks of `errors`, and the message begins with "Error"."""
    code, _, err = run("evaluate errors --episodes 0.5", capsys)
    assert code == 2
    assert "Error parsing --episodes" in err
    assert "did you mean" not in err


def test_faults_and_interrupts_have_their_own_codes(monkeypatch, capsys):
    for code, error, message in (
        (1, ZeroDivisionError("by 0"), "Traceback"),
        (130, KeyboardInterrupt(), "interrupted"),
        (
            2,
            OSError(28, "disk full", "x"),
            "grasp: x: No space left on device; free some space or choose another path",
        ),
        (2, OSError(5, "bad disk"), "grasp: bad disk; choose another path"),
    ):

        def fail(options, error=error):
            raise error

        monkeypatch.setattr(Solve, "execute", fail)
        found, answered, err = answer("solve", capsys)
        assert answered["error"]["kind"] == type(error).__name__
        assert found == answered["error"]["exit_code"] == code
        assert message in err
    assert {code for code, *_ in ENDS.values()} | {0, 1, 130} == set(EXIT_CODES)


def test_json_answers_certify_and_limits_hold(capsys):
    code, found, err = answer("solve", capsys)
    grasp = presets.paper_cuboid()
    assert (code, found["status"], found["advice"], err) == (0, "optimal", [], "")
    assert found["equilibrium_residual"] < 1e-9
    assert grasp.residual(found["force"], found["wrench"]) < 1e-9
    assert np.sum(found["force_in_object_frame"], axis=0) == pytest.approx(
        -np.array(found["wrench"][:3])
    )
    normals = np.array(answer("solve --min-normal 3", capsys)[1]["force"])[:, 0]
    assert (normals > 3.0).all()
    assert np.min(found["force"], axis=0)[0] < 1.0
    code, found, _ = answer(f"solve {LIMITED}", capsys)
    assert (code, found["status"], found["force"]) == (3, "infeasible", None)
    assert found["wrench"] == [0, 0, 50, 0, 0, 0]
    assert np.dot(found["separating_twist"], found["wrench"]) > 0.0
    code, found, _ = answer(f"solve {LARGE}", capsys)
    assert (code, found["status"], np.shape(found["force"])) == (4, "iteration_limit", (4, 3))
    assert found["objective"] > 0.0
    assert found["lower_bound"] is None  # -inf is no JSON


CLOSED = {
    "solve": {"--method": METHODS, "--preset": PRESETS, "--criterion": ("sum", "max")},
    "demo": {
        "--task": ("hold", "move"),
        "--disturbance": ("random",),
        "--motion": ("lift",),
        "--shape": ("cuboid",),
    },
    "evaluate": {"--engines": ("bullet", "noslip")},
    "rl": {"--algorithm": ("ppo", "sac"), "--action": ("initial_force",)},
}


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_help_fits_eighty_columns(name, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    text = page(f"{name} --help", capsys)
    assert [line for line in text.splitlines() if len(line) > 80 and "{" not in line] == []
    for option, names in CLOSED.get(name, {}).items():
        (listed,) = re.findall(
            rf"{option} \[?{{(.*?)}}", re.sub(r"[\s│]", "", text).replace(option, f"{option} ")
        )
        assert set(names) <= set(listed.split(","))


def test_completion_knows_commands_options_and_choices(capsys):
    script = page("--tyro-print-completion bash", capsys)
    for word in (*COMMANDS, "--barrier-weight", *METHODS, *PRESETS, "tilting_gravity"):
        assert word in script


def test_own_contacts_are_solved_with_advice(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)
    assert main(["solve", "--preset", "tripod", "--save-grasp", "my.json"]) == 0
    assert np.array_equal(load_grasp("my.json").positions, presets.tripod().positions)
    code, out, _ = run(f"solve --grasp my.json {LOAD}", capsys)
    assert (code, "my.json, wrench 0 0 -1 0 0 0: optimal" in " ".join(out.split())) == (0, True)
    assert max(map(len, out.splitlines())) <= 80
    assert "torsion" not in out
    plain = presets.tripod()
    soft = Grasp.from_contacts(
        plain.positions, plain.normals, 0.5, contact_model="soft", torsional_friction=0.005
    )
    save_grasp(soft, "soft.json")
    assert "torsion [N m]" in run(f"solve --grasp soft.json {LOAD} --method newton", capsys)[1]
    odd = {"positions": 1000.0 * plain.positions, "normals": -plain.normals, "friction": 0.5}
    Path("odd.json").write_text(
        json.dumps({name: np.asarray(value).tolist() for name, value in odd.items()})
    )
    for words in (LOAD, LIMITED):  # whatever the outcome
        _, found, err = answer(f"solve --grasp odd.json {words}", capsys)
        for text in ("normals must point INTO the object", "divide millimetres by 1000"):
            assert text in err
            assert any(text in advice for advice in found["advice"])


def test_a_closed_pipe_is_no_error():
    command = f"{sys.executable} -m training --version; {sys.executable} -m training solve --json | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(
        ["bash", "-c", command], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert re.fullmatch(r"grasp \S+, core \S+ .*, Python 3\.\S+\n", done.stdout)
    assert 'grasp = "training.program.cli:main"' in (ROOT / "pyproject.toml").read_text(
        encoding="utf-8"
    )


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
"""Modules that neither help nor a plain solve needs."""


@pytest.mark.parametrize("words", ["--help", "solve"])
def test_a_command_imports_only_its_own_modules(words):
    script = f"import atexit, sys; atexit.register(lambda: print(*sys.modules, file=sys.stderr)); from training.program.cli import main; main({words.split()})"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    loaded = set(done.stderr.split())
    assert "training.program.cli" in loaded
    assert not {name.split(".")[0] for name in loaded} & (
        LATER | ({"numpy", "tyro"} if words == "--help" else set())
    )
    assert {f"training.program.commands.{name}" for name in COMMANDS} & loaded <= {
        f"training.program.commands.{words}"
    }
