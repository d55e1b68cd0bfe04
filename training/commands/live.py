"""`grasp live`: a grasp in the browser, to be pulled at."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from grasp_env._extras import need
from grasp_env.grasp import load_grasp, presets
from training.commands.rules import rule


@dataclass(frozen=True)
class Live:
    """Show a grasp in the browser: drag the load and the contacts, move the sliders, watch the forces. Only this machine can open the page.

    Attributes:
        preset: the named grasp.
        grasp: a grasp's JSON file instead of a preset.
        wrench: the first load on the object: fx fy fz [N] mx my mz [N m].
        port: of the page on 127.0.0.1; a taken one: the next free one, which is said; 0: any.
        seconds: after which the page closes; 0: at Ctrl-C.
    """

    preset: str = "paper_cuboid"
    grasp: Path | None = None
    wrench: tuple[float, float, float, float, float, float] = (1.0, 0.5, -0.6, -0.1, 0.2, 0.0)
    port: int = 8080
    seconds: float = 0.0

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        need("live")
        from training.live.bare import BarePage
        from training.live.newest import Newest
        from training.live.page import address, close_server, open_server
        from training.live.question import Question

        grasp = presets.preset(self.preset) if self.grasp is None else load_grasp(self.grasp)
        question = Question(grasp.positions, grasp.normals, float(grasp.friction[0]), np.array(self.wrench))
        server = open_server(self.port, "grasp live")
        try:
            page = BarePage(server, question, rule)
            worker = Newest(page.draw)
            page.watch(worker.wake)
            worker.wake()
            sys.stdout.write(f"{address(server)}  (Ctrl-C ends it)\n")
            sys.stdout.flush()
            worker.wait(self.seconds or None)
            worker.close()
            if worker.fault is not None:
                raise worker.fault
        finally:
            close_server(server)
