"""`grasp live` in a headless Chromium: what it loads, shows and complains about, and what a mouse does to it."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viser
from browser import Browser, browser, find_browser
from live_tab import bare, dragged, on_screen, opened, until
from PIL import Image

from grasp_env.config import EnvConfig
from training.commands.rules import rule
from training.live.hand import HandPage
from training.live.page import address, close_server, open_server
from training.live.parts import Recorder

EXECUTABLE = find_browser()
pytestmark = pytest.mark.skipif(
    EXECUTABLE is None, reason="no Chromium here: install Debian's (apt-get install chromium) or run .ci/run"
)
SIZE = 1280, 800
OF_VISER = ("THREE.Clock", "preventDefault inside passive")
"""Warnings of the libraries in viser's page, about themselves."""


@pytest.fixture(scope="module")
def tab() -> Iterator[Browser]:
    assert EXECUTABLE is not None
    with browser(EXECUTABLE, local=True) as made:
        yield made


@contextmanager
def shown(tab: Browser, make: Any) -> Iterator[tuple[viser.ViserServer, Any]]:
    """A page in the tab; at the end nothing was asked of anyone else, and nothing complained of."""
    tab.requests.clear()
    tab.errors.clear()
    with opened(tab, make, SIZE) as (server, page, worker):
        yield server, page
        assert {request.split("/")[2] for request in tab.requests if request.startswith("http")} == {address(server).split("/")[2]}  # fmt: skip
        assert all(request.startswith(("http://127.0.0.1:", "blob:http://127.0.0.1:")) for request in tab.requests)
        assert [error for error in tab.errors if not any(known in error for known in OF_VISER)] == []
    assert worker.fault is None


def pixels(tab: Browser, out: Path) -> np.ndarray:
    """What the window shows, (H, W, 3), of its middle left, where the scene is."""
    tab.picture(out, whole=False)
    with Image.open(io.BytesIO(out.read_bytes())) as picture:
        return np.asarray(picture.convert("RGB"))[160:, :900].astype(int)


def share(picture: np.ndarray, red: bool) -> float:
    """Part of the picture that is red, or that is anything but nearly white."""
    r, g, b = np.moveaxis(picture, -1, 0)
    return float(((r > 1.25 * g) & (r > 1.25 * b)).mean() if red else (picture.min(axis=2) < 225).mean())


def test_a_mouse_drags_the_load_and_a_contact_until_nothing_holds(tab, tmp_path):
    with shown(tab, bare) as (server, page):
        before = pixels(tab, tmp_path / "held.png")
        assert share(before, red=False) > 0.05
        first = page.question
        ball = 0.95 * first.wrench[:3] / np.linalg.norm(first.wrench[:3])
        start = on_screen(tab, server, ball)
        with dragged(tab, start, (start[0] - 150.0, start[1] - 120.0)):
            until(tab, "!document.body.innerText.includes('4.98')")  # the thumb's force was that
        wrench = page.question.wrench
        assert wrench[1] > first.wrench[1] + 0.2  # upwards, as the mouse went
        np.testing.assert_array_equal(wrench[3:], first.wrench[3:])
        with dragged(tab, on_screen(tab, server, [0.0, 0.0, -0.5]), on_screen(tab, server, [0.5, -0.2, 0.1])):
            until(tab, "document.body.innerText.includes('cannot be held')")
        np.testing.assert_allclose(page.question.positions[0], [0.05, -0.02, 0.01], atol=0.006)  # where it was let go
        until(tab, "document.body.innerText.includes('red screw')")
        assert share(pixels(tab, tmp_path / "lost.png"), red=True) > max(0.1, 3.0 * share(before, red=True))


def test_a_slider_that_is_moved_changes_the_numbers(tab):
    with shown(tab, bare) as (_, page):
        total = "document.body.innerText.match(/total normal force\\s*([\\d.]+)/)[1]"
        before = tab.value(total)
        tab.value(
            "[...document.querySelectorAll('[role=slider]')].find(each => each.getAttribute('aria-valuenow') === '0.4').focus()"
        )
        for kind in ("keyDown", "keyUp"):
            tab.call("Input.dispatchKeyEvent", type=kind, key="End", code="End", windowsVirtualKeyCode=35)
        until(tab, f"{total} !== '{before}'")
        assert page.question.friction == 1.5
        assert float(tab.value(total)) < float(before)  # rougher: less squeeze


def test_the_hand_is_pulled_with_the_mouse(tab, tmp_path):
    with shown(tab, lambda server: HandPage(server, EnvConfig(method="newton"), rule)) as (server, _):
        assert share(pixels(tab, tmp_path / "hand.png"), red=False) > 0.1
        start = on_screen(tab, server, [0.5, -0.3, 0.3])
        with dragged(tab, start, (start[0] + 180.0, start[1] - 90.0)):
            until(tab, "document.body.innerText.includes('5.0 N')")
        until(tab, "document.body.innerText.includes('0.0 N')")


def test_a_recording_opens_from_disk(tab, tmp_path):
    server = open_server(0, "grasp live")
    try:
        page = bare(server)
        page.draw()
        recorder = Recorder(server, tmp_path / "live.html", "grasp live")
        for _ in range(3):
            recorder.frame()
            page.draw()
        recorder.save()
    finally:
        close_server(server)
    tab.requests.clear()
    tab.errors.clear()
    tab.show(tmp_path / "live.html", *SIZE)
    until(tab, "document.querySelector('canvas') !== null && document.body.innerText.includes('grasp live')")
    end = time.monotonic() + 60.0
    while share(pixels(tab, tmp_path / "live.png"), red=False) < 0.05:
        assert time.monotonic() < end, "nothing is drawn"
    assert [request for request in tab.requests if not request.startswith(("file:///", "blob:"))] == []
    assert [error for error in tab.errors if not any(known in error for known in OF_VISER)] == []
