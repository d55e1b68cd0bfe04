"""`grasp replay` runs a recording again, tells how it differs, and draws it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("gymnasium", reason="the extra sim is not installed")
pytest.importorskip("matplotlib", reason="the extra report is not installed")

from grasp_env.control import HandController, HandControllerSettings, HandState, Recording
from grasp_env.sim import HandDescription
from training.program.cli import main
from training.program.commands.replay_picture import COLORS, write_picture

PERIOD = 1e-3


def recorded(updates: int = 200) -> Recording:
    """Hold, lose the messages, hold again, and begin anew."""
    hand = HandDescription.allegro()
    controller = HandController()
    controller.configure(hand, HandControllerSettings(friction=0.6, grace=0.02, fade=0.02))
    controller.record(1.0)
    state = HandState(hand.joint_count, hand.finger_count)
    angles = 0.5 * np.pi * np.arange(hand.finger_count)
    outwards = np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    state.angles[:] = hand.home
    state.touching[:] = 1.0
    state.positions[:], state.normals[:] = 0.03 * outwards, -outwards
    state.wrench[2] = -0.5
    controller.activate(state)
    for tick in range(updates):
        state.ages[:] = 1.0 if 50 <= tick < 100 else PERIOD
        if tick == 150:
            controller.activate(state)
        controller.update(state, PERIOD)
    return Recording.of(controller)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return recorded()


def replayed(words: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    """Exit code, stdout without line breaks and frames, stderr."""
    capsys.readouterr()
    code = main(["replay", *words.split()])
    out, err = capsys.readouterr()
    return code, " ".join(out.replace("│", " ").split()), err


def colors(path: Path) -> set[str]:
    """The colours of statuses in a picture."""
    with Image.open(path) as picture:
        assert picture.format == "PNG"
        pixels = np.array(picture.convert("RGB")) @ np.array([1 << 16, 1 << 8, 1])
    found = {f"#{color:06x}" for color in np.unique(pixels).tolist()}
    return {name for name, color in COLORS.items() if color in found and name != "inactive"}


def test_a_recording_comes_back_and_is_drawn(recording, tmp_path, capsys):
    path = recording.save(tmp_path / "run.csv")
    code, out, err = replayed(str(path), capsys)
    assert (code, err) == (0, "")
    for words in (
        "updates 200",
        "time 0.200 s",
        "holding 150 (75.0%)",
        "coasting 39 (19.5%)",
        "released 11",
        "rows that differ none: bit for bit",
        "largest share of friction 0.",
        "largest share of a torque limit 0.",
        "longest update",
        "us, here",
    ):
        assert words in out
    assert "another build" not in out
    assert colors(tmp_path / "run.png") == {"holding", "coasting", "released"}
    words = f"{path} --save {tmp_path / 'other.png'} --output {tmp_path / 'again.csv'}"
    assert replayed(words, capsys)[0] == 0
    assert colors(tmp_path / "other.png") == colors(tmp_path / "run.png")
    assert replayed(str(tmp_path / "again.csv"), capsys)[0] == 0


def test_differences_are_told_and_change_the_exit_code(recording, tmp_path, capsys):
    rows = recording.rows.copy()
    rows[31, recording.columns.index("torques.2 [N m]")] += 0.125
    path = Recording(recording.columns, rows, recording.text).save(tmp_path / "run.csv")
    code, out, _ = replayed(f"{path} --save {tmp_path / 'a.png'}", capsys)
    assert code == 1
    for words in (
        "rows that differ 1 of 203",
        "row 31, at 0.031 s",
        "0.125 N m in torques",
        "0 in status",
        "it is another build, or another kind of processor",
    ):
        assert words in out
    with pytest.raises(SystemExit):
        main(["replay", "--help"])
    help_text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "Exit code 0: all that the controller did comes out bit for bit; 1: not" in help_text


def test_errors_are_one_line_and_nothing_is_written(recording, tmp_path, capsys):
    path = recording.save(tmp_path / "run.csv")
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    for words, message in {
        f"{tmp_path}/none.csv": "No such file",
        f"{tmp_path}/run.txt": "must end with .csv, got",
        f"{tmp_path}/other.csv": "is not a complete recording",
        f"{path} --save {tmp_path}/a.pdf": "--save must end with .png",
        f"{path} --output {path}": "--output must be another file",
        f"{path} --output {tmp_path}/again.txt": "must end with .csv, got",
        f"{path} --save /nowhere/a.png": "/nowhere",
    }.items():
        code, _, err = replayed(words, capsys)
        assert (code, err.count("\n")) == (2, 1)
        assert message in err
    assert {each.name for each in tmp_path.iterdir()} == {"run.csv", "other.csv"}


def test_odd_recordings_are_drawn(recording, tmp_path, capsys):
    """One row, and numbers that are infinite, nan or huge."""
    path = recorded(0).save(tmp_path / "short.csv")
    code, out, _ = replayed(str(path), capsys)
    assert (code, "updates 0" in out) == (0, True)
    rows = recording.rows.copy()
    for name, value in (("force.0 [N]", 1e300), ("torques.1 [N m]", np.nan)):
        rows[20:30, recording.columns.index(name)] = value
    rows[:, recording.columns.index("friction_used.1 [1]")] = np.inf
    odd = Recording(recording.columns, rows, recording.text)
    write_picture(odd, tmp_path / "odd.png")
    assert replayed(str(odd.save(tmp_path / "odd.csv")), capsys)[0] == 1
