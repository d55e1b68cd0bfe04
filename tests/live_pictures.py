"""The pictures of `grasp live` in the documentation: `python tests/live_pictures.py docs/pictures`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from browser import Browser, browser, find_browser
from live_tab import bare, dragged, on_screen, opened, until
from PIL import Image

from grasp_env.config import EnvConfig
from training.commands.rules import rule
from training.live.hand import HandPage

SIZE = 1200, 760


def picture(tab: Browser, out: Path, make: Any, start: Any, end: Any, words: str) -> None:
    """What is seen while something is dragged from one point of the scene to another, once the panel says some words."""
    with opened(tab, make, SIZE) as (server, *_):
        until(
            tab,
            "(document.querySelectorAll('.mantine-Notification-closeButton').forEach(each => each.click()), document.querySelector('.mantine-Notification-root') === null)",
        )
        with dragged(tab, on_screen(tab, server, start), on_screen(tab, server, end)):
            until(tab, f"document.body.innerText.includes('{words}')")
            tab.picture(out, whole=False)
    with Image.open(out) as shot:
        small = shot.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE)
    small.save(out, optimize=True)


if __name__ == "__main__":
    executable, folder = find_browser(), Path(sys.argv[1])
    assert executable is not None, "no Chromium here"
    folder.mkdir(parents=True, exist_ok=True)
    with browser(executable, local=True) as chromium:
        ball = 0.95 * np.array([1.0, 0.5, -0.6]) / np.linalg.norm([1.0, 0.5, -0.6])
        picture(chromium, folder / "live_contacts.png", bare, ball, ball + np.array([-0.15, 0.35, 0.1]), "held")
        picture(chromium, folder / "live_infeasible.png", bare, [0.0, 0.0, -0.5], [0.5, -0.2, 0.1], "cannot be held")
        picture(
            chromium,
            folder / "live_hand.png",
            lambda server: HandPage(server, EnvConfig(method="newton"), rule),
            [0.5, -0.2, 0.2],
            [1.4, 0.2, 0.0],
            "5.0 N",
        )
