"""`grasp live` in a headless Chromium."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from browser import Browser, browser, find_browser
from PIL import Image

from grasp_env.grasp import presets
from training.program.commands.rules import rule
from training.program.live.contacts import BareContacts

EXECUTABLE = find_browser()
OF_VISER = ("THREE.Clock", "preventDefault inside passive")
"""Warnings of the libraries in viser's page, about themselves."""
LOAD = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])
CANVAS = "(r => [r.left, r.top, r.width, r.height])(document.querySelector('canvas').getBoundingClientRect())"
FRAMES = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"


def until(tab: Browser, page: BareContacts, condition: str) -> None:
    """Handle events until a JavaScript condition holds."""
    end = time.monotonic() + 60.0
    while not tab.value(condition):
        assert time.monotonic() < end, (condition, tab.value("document.body.innerText"))
        page.step(0.05)


def on_screen(tab: Browser, page: BareContacts, point: Any) -> np.ndarray:
    """Position [pixels] of a point of the scene, seen by the initial camera."""
    left, top, width, height = tab.value(CANVAS)
    camera = page.server.initial_camera
    back = (camera.position - camera.look_at) / np.linalg.norm(camera.position - camera.look_at)
    right = np.cross([0.0, 1.0, 0.0], back) / np.hypot(back[0], back[2])
    away = np.asarray(point) - camera.position
    focal = 0.5 * height / np.tan(0.5 * camera.fov) / -(away @ back)
    across = away @ np.array([right, -np.cross(back, right)]).T
    return np.array([left + 0.5 * width, top + 0.5 * height]) + focal * across


@pytest.mark.skipif(EXECUTABLE is None, reason="no Chromium is installed")
def test_contacts_follow_the_mouse(tmp_path):
    page = BareContacts(0, presets.paper_cuboid(), LOAD, "newton", rule)
    own = f"http://127.0.0.1:{page.server.get_port()}/"
    with browser(EXECUTABLE or "", local=True) as tab:

        def mouse(kind: str, at: np.ndarray, held: int) -> None:
            button = {"button": "left" if held else "none", "buttons": held, "clickCount": 1}
            tab.call("Input.dispatchMouseEvent", type=kind, x=at[0], y=at[1], **button)
            tab.value(FRAMES)
            page.step(0.02)

        def red() -> float:
            tab.picture(tmp_path / "page.png")
            seen = np.asarray(Image.open(tmp_path / "page.png").convert("RGB"))[100:, :480] / 255.0
            r, g, b = np.moveaxis(seen, -1, 0)
            return float(((r > 1.25 * g) & (r > 1.25 * b)).mean())

        try:
            tab.show(own, 800, 500)
            page.draw()
            until(
                tab,
                page,
                "document.body.innerText.includes('held') && document.querySelector('canvas') !== null",
            )
            before = red()
            start, end = (
                on_screen(tab, page, point) for point in ([0.0, 0.0, -0.5], [0.5, -0.2, 0.1])
            )
            mouse("mouseMoved", start, 0)
            mouse("mousePressed", start, 1)
            for part in np.linspace(0.25, 1.0, 4):
                mouse("mouseMoved", start + part * (end - start), 1)
            until(tab, page, "document.body.innerText.includes('cannot be held')")
            mouse("mouseReleased", end, 1)
            # under the mouse
            np.testing.assert_allclose(page.positions[0], [0.05, -0.02, 0.01], atol=0.006)
            assert red() > max(0.1, 3.0 * before)
            assert {request.removeprefix("blob:")[: len(own)] for request in tab.requests} == {own}
            assert [
                error for error in tab.errors if not any(known in error for known in OF_VISER)
            ] == []
        finally:
            tab.show("about:blank", 1280, 800)
            page.server.stop()
