"""What a mouse does to the page of `grasp live` in a headless Chromium."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import viser
from browser import Browser

from grasp_env.grasp import presets
from training.commands.rules import rule
from training.live.bare import BarePage
from training.live.newest import Newest
from training.live.page import address, close_server, open_server
from training.live.question import Question


def bare(server: viser.ViserServer) -> BarePage:
    """The page of bare contacts, the paper's grasp under the paper's wrench."""
    grasp = presets.paper_cuboid()
    return BarePage(
        server, Question(grasp.positions, grasp.normals, 0.4, np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])), rule
    )


@contextmanager
def opened(tab: Browser, make: Any, size: tuple[int, int]) -> Iterator[tuple[viser.ViserServer, Any, Newest]]:
    """A page served and drawn by its worker, in the tab once it says that the object is held; closed at the end."""
    server = open_server(0, "grasp live")
    page = make(server)
    page.draw()
    worker = Newest(page.draw, page.every)
    page.watch(worker.wake)
    try:
        tab.show(address(server), *size)
        until(tab, "document.body.innerText.includes('held') && document.querySelector('canvas') !== null")
        yield server, page, worker
    finally:
        worker.close()
        close_server(server)
        tab.show("about:blank", *size)


def until(tab: Browser, condition: str, seconds: float = 60.0) -> None:
    """Waits in the page until a JavaScript condition holds."""
    end = time.monotonic() + seconds
    while not tab.value(f"new Promise(done => setTimeout(() => done({condition}), 50))"):
        assert time.monotonic() < end, (condition, tab.value("document.body.innerText"))


def on_screen(tab: Browser, server: viser.ViserServer, point: Any) -> tuple[float, float]:
    """Where the first camera sees a point of the scene [pixels]."""
    box = tab.value("(() => { const r = document.querySelector('canvas').getBoundingClientRect(); return [r.left, r.top, r.width, r.height]; })()")  # fmt: skip
    camera = server.initial_camera
    back = camera.position - camera.look_at
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    away = np.asarray(point) - camera.position
    focal = 0.5 * box[3] / math.tan(0.5 * camera.fov) / -(away @ back)
    return box[0] + 0.5 * box[2] + focal * (away @ right), box[1] + 0.5 * box[3] - focal * (
        away @ np.cross(back, right)
    )


def mouse(tab: Browser, kind: str, at: tuple[float, float], held: bool) -> None:
    button = "left" if kind != "mouseMoved" or held else "none"
    tab.call("Input.dispatchMouseEvent", type=kind, x=at[0], y=at[1], button=button, buttons=int(held), clickCount=1)


@contextmanager
def dragged(tab: Browser, start: tuple[float, float], end: tuple[float, float], steps: int = 8) -> Iterator[None]:
    """The left button is down from `start` to `end`, and up after the block."""
    frame = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
    mouse(tab, "mouseMoved", start, False)
    tab.value(frame)
    mouse(tab, "mousePressed", start, True)
    for k in range(1, steps + 1):
        mouse(
            tab,
            "mouseMoved",
            (start[0] + (end[0] - start[0]) * k / steps, start[1] + (end[1] - start[1]) * k / steps),
            True,
        )
        tab.value(frame)
    yield
    mouse(tab, "mouseReleased", end, False)
