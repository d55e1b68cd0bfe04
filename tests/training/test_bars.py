"""Progress on a terminal of 80 columns: no line is wrapped, no number is cut; elsewhere there is none."""

from __future__ import annotations

import fcntl
import io
import os
import re
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest
from rich.console import Console

from training.compare.scenarios import ENGINES, PRESETS, controllers_plan, hands_plan
from training.results.bars import progress

ROOT = Path(__file__).parents[2]
ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
FIT = ["--steps", "4", "--samples", "400", "--batch-size", "64", "--quick"]
COMMANDS = {
    "demo": ["demo", "--video", "hand.gif", "--seconds", "0.2", "--size", "64", "64"],
    "fit": ["fit", *FIT, "--hidden", "8", "--out", "model"],
}


def on_a_terminal(words: list[str], folder: Path) -> tuple[int, str]:
    """Exit code and what a terminal of 80 columns was sent."""
    ours, theirs = os.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    settings = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES", "CI", "NO_COLOR")}
    environment = {**settings, "PYTHONPATH": str(ROOT), "TERM": "xterm"}
    command = [sys.executable, "-m", "training", *words]
    sent = bytearray()
    with subprocess.Popen(command, cwd=folder, env=environment, stdin=theirs, stdout=theirs, stderr=theirs) as process:
        os.close(theirs)
        while True:
            try:
                part = os.read(ours, 1 << 16)
            except OSError:  # the other end is closed
                part = b""
            if not part:
                break
            sent += part
    os.close(ours)
    return process.returncode, sent.decode("utf-8", "replace")


@pytest.mark.parametrize("name", COMMANDS)
def test_bars_fit_a_terminal(name: str, tmp_path: Path) -> None:
    code, sent = on_a_terminal(COMMANDS[name], tmp_path)
    lines = [ESCAPES.sub("", line) for line in re.split(r"[\r\n]+|\x1b\[1A", sent)]
    assert code == 0, sent
    assert any("━" in line for line in lines)
    assert [line for line in lines if len(line) > 80 or "…" in line] == []


def drawn(name: str, total: int, note: str = "") -> list[str]:
    """The lines of one bar, half done, on a terminal of 80 columns."""
    out = io.StringIO()
    console = Console(file=out, width=80, force_terminal=True, color_system=None, legacy_windows=False)
    bars = progress(console)
    bars.update(bars.add_task(name, total=total, note=note), completed=total // 2)
    console.print(bars.get_renderable())
    return out.getvalue().splitlines()


def test_names_as_long_as_they_come_leave_room() -> None:
    cells = [one.name for one in (*controllers_plan(500), *hands_plan(PRESETS, tuple(ENGINES), 100))]
    for name in (
        *(f"episodes: {cell}/00000" for cell in cells),
        "ppo contact_force seed 1000000",
        "x" * 300,
    ):
        (line,) = drawn(name, 10_000_000)
        assert len(line) <= 80
        assert "5000000/10000000" in line
        assert line.endswith("0:00:00 -:--:--")
        assert "━" in line


def test_a_note_has_a_line_of_its_own() -> None:
    bar, note = drawn("fit", 480, "held-out gaps, median p95 p99: " + "1e-02 " * 20)
    assert "240/480" in bar
    assert note.startswith("held-out gaps")
    assert len(note) == 80


def test_no_bar_where_nobody_looks() -> None:
    out = io.StringIO()
    with progress(Console(file=out)) as bars:
        bars.advance(bars.add_task("work", total=1))
    assert out.getvalue() == ""
