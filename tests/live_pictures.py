"""The pictures of `grasp live` in the documentation: `python tests/live_pictures.py docs/pictures`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from browser import Browser, browser, find_browser
from live_tab import dragged, on_screen, until
from PIL import Image

from grasp_env.config import EnvConfig
from grasp_env.grasp import presets
from training.commands.rules import rule
from training.live.bare import BarePage
from training.live.hand import HandPage
from training.live.newest import Newest
from training.live.page import address, close_server, open_server
from training.live.question import Question

SIZE = 1200, 760


def contacts(server: Any) -> BarePage:
    grasp = presets.paper_cuboid()
    return BarePage(
        server, Question(grasp.positions, grasp.normals, 0.4, np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])), rule
    )


def picture(tab: Browser, out: Path, make: Any, start: Any, end: Any, words: str) -> None:
    """What is seen while something is dragged from one point of the scene to another, once the panel says some words."""
    server = open_server(0, "grasp live")
    page = make(server)
    page.draw()
    worker = Newest(page.draw, page.every)
    page.watch(worker.wake)
    try:
        tab.show(address(server), *SIZE)
        until(tab, "document.querySelector('canvas') !== null && document.body.innerText.includes('held')")
        until(
            tab,
            "(document.querySelectorAll('.mantine-Notification-closeButton').forEach(each => each.click()), document.querySelector('.mantine-Notification-root') === null)",
        )
        with dragged(tab, on_screen(tab, server, start), on_screen(tab, server, end)):
            until(tab, f"document.body.innerText.includes('{words}')")
            tab.picture(out, whole=False)
    finally:
        worker.close()
        close_server(server)
        tab.show("about:blank", *SIZE)
    with Image.open(out) as shot:
        small = shot.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE)
    small.save(out, optimize=True)


if __name__ == "__main__":
    executable, folder = find_browser(), Path(sys.argv[1])
    assert executable is not None, "no Chromium here"
    folder.mkdir(parents=True, exist_ok=True)
    with browser(executable, local=True) as chromium:
        ball = 0.95 * np.array([1.0, 0.5, -0.6]) / np.linalg.norm([1.0, 0.5, -0.6])
        picture(chromium, folder / "live_contacts.png", contacts, ball, ball + np.array([-0.15, 0.35, 0.1]), "held")
        picture(
            chromium, folder / "live_infeasible.png", contacts, [0.0, 0.0, -0.5], [0.5, -0.2, 0.1], "cannot be held"
        )
        picture(
            chromium,
            folder / "live_hand.png",
            lambda server: HandPage(server, EnvConfig(method="newton"), rule),
            [0.5, -0.2, 0.2],
            [1.4, 0.2, 0.0],
            "5.0 N",
        )
