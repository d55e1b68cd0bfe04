"""`grasp live` in a headless Chromium: what it loads, shows and complains about, and what a mouse does to it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser, browser, find_browser
from PIL import Image

from grasp_env.config import EnvConfig
from grasp_env.grasp import presets
from grasp_env.sim.hand.description import HANDS
from training.commands.rules import rule
from training.live.contacts import BareContacts
from training.live.hand import SimulatedHand
from training.live.window import Window

EXECUTABLE = find_browser()
pytestmark = pytest.mark.skipif(
    EXECUTABLE is None, reason="no Chromium here: install Debian's (apt-get install chromium) or run .ci/run"
)
OF_VISER = ("THREE.Clock", "preventDefault inside passive")
"""Warnings of the libraries in viser's page, about themselves."""
LOAD = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])


@pytest.fixture(scope="module")
def tab() -> Iterator[Browser]:
    assert EXECUTABLE is not None
    with browser(EXECUTABLE, local=True) as made:
        yield made


@contextmanager
def shown(tab: Browser, page: Window) -> Iterator[None]:
    """A page in the tab; at the end it has asked nobody else for anything, and complained of nothing."""
    own = f"http://127.0.0.1:{page.server.get_port()}/"
    tab.requests.clear()
    tab.errors.clear()
    try:
        tab.show(own, 1280, 800)
        page.draw()
        until(tab, page, "document.body.innerText.includes('held') && document.querySelector('canvas') !== null")
        yield
        assert {request.removeprefix("blob:")[: len(own)] for request in tab.requests} == {own}
        assert [error for error in tab.errors if not any(known in error for known in OF_VISER)] == []
    finally:
        tab.show("about:blank", 1280, 800)
        page.server.stop()


def until(tab: Browser, page: Window, condition: str) -> None:
    """Handles what the browser sends until a JavaScript condition holds in it."""
    end = time.monotonic() + 60.0
    while not tab.value(condition):
        assert time.monotonic() < end, (condition, tab.value("document.body.innerText"))
        page.step(0.05)


def on_screen(tab: Browser, page: Window, point: Any) -> np.ndarray:
    """Where the first camera sees a point of the scene [pixels]."""
    left, top, width, height = tab.value("(r => [r.left, r.top, r.width, r.height])(document.querySelector('canvas').getBoundingClientRect())")  # fmt: skip
    camera = page.server.initial_camera
    back = (camera.position - camera.look_at) / np.linalg.norm(camera.position - camera.look_at)
    right = np.cross([0.0, 1.0, 0.0], back) / np.hypot(back[0], back[2])
    away = np.asarray(point) - camera.position
    focal = 0.5 * height / np.tan(0.5 * camera.fov) / -(away @ back)
    return np.array([left + 0.5 * width + focal * (away @ right), top + 0.5 * height - focal * (away @ np.cross(back, right))])  # fmt: skip


def drag(tab: Browser, page: Window, start: np.ndarray, end: np.ndarray, condition: str) -> None:
    """The left button is pressed at `start`, moved to `end` [pixels], and let go once a condition holds."""

    def mouse(kind: str, at: np.ndarray, held: int) -> None:
        tab.call("Input.dispatchMouseEvent", type=kind, x=at[0], y=at[1], button="left" if held else "none", buttons=held, clickCount=1)  # fmt: skip
        tab.value("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        page.step(0.02)

    mouse("mouseMoved", start, 0)
    mouse("mousePressed", start, 1)
    for part in np.linspace(0.125, 1.0, 8):
        mouse("mouseMoved", start + part * (end - start), 1)
    until(tab, page, condition)
    mouse("mouseReleased", end, 1)


def share(tab: Browser, out: Path, red: bool = False) -> float:
    """Part of the picture, where the scene is, that is red, or that is anything but nearly white."""
    tab.picture(out, whole=False)
    picture = np.asarray(Image.open(out).convert("RGB"))[160:, :900].astype(int)
    r, g, b = np.moveaxis(picture, -1, 0)
    return float(((r > 1.25 * g) & (r > 1.25 * b)).mean() if red else (picture.min(axis=2) < 225).mean())


def test_load_and_contacts_follow_the_mouse_and_a_recording_opens_from_disk(tab, tmp_path):
    page = BareContacts(0, presets.paper_cuboid(), LOAD, "newton", rule)
    with shown(tab, page):
        before = share(tab, tmp_path / "held.png", red=True)
        assert share(tab, tmp_path / "held.png") > 0.05
        ball = on_screen(tab, page, 0.95 * LOAD[:3] / np.linalg.norm(LOAD[:3]))
        drag(tab, page, ball, ball - (150.0, 120.0), "!document.body.innerText.includes('4.98')")  # of the thumb
        assert page.force.value[1] > 0.7  # upwards, as the mouse went
        start, end = (on_screen(tab, page, point) for point in ([0.0, 0.0, -0.5], [0.5, -0.2, 0.1]))
        drag(tab, page, start, end, "document.body.innerText.includes('cannot be held')")
        np.testing.assert_allclose(page.positions[0], [0.05, -0.02, 0.01], atol=0.006)  # where it was let go
        assert share(tab, tmp_path / "lost.png", red=True) > max(0.1, 3.0 * before)
        page.run(0.5, tmp_path / "live.html")
    tab.show(tmp_path / "live.html", 1280, 800)
    end = time.monotonic() + 60.0
    while share(tab, tmp_path / "live.png", red=True) < 0.1:
        assert time.monotonic() < end, "nothing is drawn"
    assert [request for request in tab.requests if not request.startswith(("file:///", "blob:", "http://127"))] == []
    assert [error for error in tab.errors if not any(known in error for known in (*OF_VISER, "WebSocket"))] == []


def test_the_hand_is_pulled_with_the_mouse(tab, tmp_path):
    page = SimulatedHand(0, EnvConfig().override(hand=HANDS["four_finger"](), method="newton"), rule)
    with shown(tab, page):
        assert share(tab, tmp_path / "hand.png") > 0.1
        start = on_screen(tab, page, [0.5, -0.3, 0.3])
        drag(tab, page, start, start - (-180.0, 90.0), "document.body.innerText.includes('5.0 N')")
        until(tab, page, "document.body.innerText.includes('0.0 N')")
