"""Window of `grasp live`: it handles events in order, draws the result, and records on demand."""

from __future__ import annotations

import html
import math
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from itertools import cycle
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
from viser.infra import StateSerializer

from grasp_env.inputs.arguments import Array
from grasp_env.inputs.files import file_fault, replacing
from training.program.live.answer import Answer, Mood
from training.program.live.look import BAD, COLORS, Color
from training.program.live.server import LocalServer

MAX_RECORDED = 120.0
"""Longest recording [s]."""
MOODS: dict[Mood, Color] = {"good": (46, 140, 84), "warning": (214, 148, 36), "bad": BAD}
_AWAY = np.array([2.0, 1.15, 2.4]) / np.linalg.norm([2.0, 1.15, 2.4])
"""Direction from the scene to the first camera."""


class Window:
    """Page in the browser. The thread that calls `run` handles all events and draws.

    Args:
        port: port of the page, as for `LocalServer`.
        hint: short instructions, in Markdown.

    Attributes:
        server: viser's server.
        scene: viser's scene.
        gui: viser's controls.
        period: time between two drawings without events [s]; None: it draws after events only.
    """

    period: float | None = None

    def __init__(self, port: int, hint: str) -> None:
        self.server = LocalServer(port, "grasp live")
        self.scene, self.gui = self.server.scene, self.server.gui
        self.scene.set_up_direction("+y")
        self.scene.world_axes.visible = False
        self.scene.configure_environment_map(None)
        self.scene.add_light_ambient("/light", intensity=1.2)
        self._status = self.scene.add_label("/status", "", anchor="bottom-center")
        self._panel = self.gui.add_html("")
        self.gui.add_markdown(hint)
        self._acts: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._recording: StateSerializer | None = None
        self._path = Path()
        self._began = 0.0
        self._drawn = 0.0

    def draw(self) -> None:
        """Update the scene and the panel."""
        raise NotImplementedError

    def on(
        self, register: Callable[[Any], object], act: Callable[[Any], object] = lambda event: None
    ) -> None:
        """Call `act` with each event, then draw; `register` is a handle's `on_click` or such."""

        async def note(event: Any) -> None:  # viser keeps the order of coroutines only
            self._acts.put(partial(act, event))

        register(note)

    def look_at(self, low: Array, high: Array) -> None:
        """Place camera, floor and status label for a box between two corners (3,), scene units."""
        centre = 0.5 * (low + high)
        size = float(np.linalg.norm(high - low))
        camera = self.server.initial_camera
        camera.fov = math.radians(36.0)
        camera.near = 0.02
        camera.position = centre + 1.8 * size * _AWAY
        camera.look_at = centre
        self.scene.add_grid(
            "/floor", plane="xz", position=(0.0, low[1] - 0.2, 0.0), fade_distance=4.0 * size
        )
        self._status.position = (0.0, high[1] + 0.15, 0.0)

    def show(self, answer: Answer, names: Sequence[str], advice: Iterable[str]) -> None:
        """Show an answer, with the names of its contacts, and advice."""
        title = (
            f'<b style="font-size:17px">{_dot(MOODS[answer.mood])}{html.escape(answer.status)}</b>'
        )
        texts = (answer.words, *(f"⚠ {text}" for text in advice))
        notes = "".join(f"<p>{html.escape(text)}</p>" for text in texts)
        table = _row("", *answer.columns) if names else ""
        rows = zip(*answer.columns.values(), strict=True)
        for name, color, row in zip(names, cycle(COLORS), rows, strict=False):
            table += _row(_dot(color) + html.escape(name), *(f"{number:.2f}" for number in row))
        lines = "".join(_row(*fact) for fact in answer.facts.items())
        tables = "".join(f'<table style="width:100%">{rows}</table>' for rows in (table, lines))
        self._panel.content = (
            f'<div style="font:13px sans-serif;padding:0 10px">{title}{notes}{tables}</div>'
        )
        self._status.text = "" if answer.mood == "good" else answer.status

    def run(self, seconds: float = math.inf, record: Path | None = None) -> None:
        """Show the page for `seconds` or until ctrl-C; `record` is an .html file to record into."""
        end = time.monotonic() + seconds
        hint = f"up to {MAX_RECORDED:.0f} s, to one HTML file in this folder"
        self._button = self.gui.add_button("Record", hint=hint)
        self._note = self.gui.add_markdown("")
        self.on(self._button.on_click, self._press)
        try:
            self._draw()
            if record is not None:
                self._record(record)
            address = f"http://{self.server.get_host()}:{self.server.get_port()}"
            sys.stdout.write(f"{address}  (Ctrl-C ends it)\n")
            sys.stdout.flush()
            while (left := end - time.monotonic()) > 0.0:
                self.step(min(left, self.period or 1.0))
        finally:
            self.server.stop()
            self._save()

    def step(self, timeout: float) -> None:
        """Wait for events, at most `timeout` [s]; handle all that came, and draw once."""
        acts: list[Callable[[], object]] = []
        with suppress(Empty):
            acts.append(self._acts.get(timeout=timeout))
            while True:
                acts.append(self._acts.get_nowait())
        if acts or self.period is not None:
            self._draw(acts)

    def _draw(self, acts: Iterable[Callable[[], object]] = ()) -> None:
        before = self._drawn
        self._drawn = time.monotonic()
        if self._recording is not None:
            self._recording.insert_sleep(self._drawn - before)
        with self.server.atomic():
            for act in acts:
                act()
            self.draw()
        self.server.flush()
        if self._recording is not None and self._drawn - self._began > MAX_RECORDED:
            self._press()

    def _press(self, _: Any = None) -> None:
        if self._recording is None:
            number = next(k for k in range(1, 10_000) if not Path(f"grasp-live-{k}.html").exists())
            self._record(Path(f"grasp-live-{number}.html").absolute())
        else:
            try:
                self._save()
                note = f"saved: {self._path.name}"
            except OSError as error:  # the page goes on
                note = f"not saved: {self._path.name}: {file_fault(error, 'folder to start in')}"
            self._button.label, self._note.content = "Record", note

    def _record(self, path: Path) -> None:
        self._recording = self.server.get_scene_serializer()
        self._path = path
        self._began = self._drawn = time.monotonic()
        self._button.label = "Stop and save"
        self._note.content = "recording …"

    def _save(self) -> None:
        recording, self._recording = self._recording, None
        if recording is not None:
            recording.insert_sleep(min(time.monotonic() - self._drawn, 1.0))
            with replacing(self._path) as temporary:
                temporary.write_text(recording.as_html(), encoding="utf-8")
            sys.stdout.write(f"{self._path}\n")
            sys.stdout.flush()


def _row(name: str, *cells: str) -> str:
    return f"<tr><td>{name}</td>{''.join(f'<td align=right>{cell}</td>' for cell in cells)}</tr>"


def _dot(color: Color) -> str:
    return f'<i style="background:rgb{color};width:10px;height:10px;display:inline-block;margin-right:6px"></i>'
