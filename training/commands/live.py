"""`grasp live`: a grasp in the browser, to be pulled at."""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from grasp_env._extras import need
from grasp_env.errors import InvalidInputError, UnsupportedProblemError
from grasp_env.force import METHODS
from grasp_env.grasp import load_grasp, presets
from training.commands.options import Wrench, left_out, listed, one_of
from training.commands.rules import rule

if TYPE_CHECKING:
    import viser

    from training.live.session import Page


@dataclass(frozen=True)
class Live:
    """Show a grasp in the browser, to be pulled at.

    Drag the load and the contacts, or the object in a simulated hand.

    Only this machine can open the page.

    Attributes:
        preset: bare contacts of a named grasp.
        grasp: bare contacts of a grasp's JSON file instead.
        wrench: the first load on bare contacts: fx fy fz [N] mx my mz [N m].
        hand: a simulated hand instead: four_finger, three_finger, five_finger, four_finger_4dof, allegro, leap, or the path of a URDF.
        fingertips: of a URDF, links that the fingers touch with; none: every moving link that ends a branch.
        torque_limit: of a URDF, of all joints [N m]; 0: what the file says.
        shape: of the object in the hand.
        method: that solves.
        port: of the page on 127.0.0.1; a taken one: the next free one, which is said; 0: any.
        record: an .html file that records all that is seen, up to two minutes, and opens from disk.
        seconds: after which the page closes; 0: at ctrl-C.
    """

    preset: Annotated[str, one_of(presets.PRESETS)] = "paper_cuboid"
    grasp: Annotated[Path | None, left_out("the preset", "FILE")] = None
    wrench: Wrench = (1.0, 0.5, -0.6, -0.1, 0.2, 0.0)
    hand: Annotated[str | None, left_out("bare contacts", "NAME|FILE")] = None
    fingertips: tuple[str, ...] = ()
    torque_limit: float = 0.0
    shape: Annotated[str, listed("grasp_env.sim.objects.description", "SHAPES_WITHOUT_MESH")] = "cuboid"
    method: Annotated[str, one_of(METHODS)] = "newton"
    port: int = 8080
    record: Annotated[Path | None, left_out("nothing is recorded", "FILE")] = None
    seconds: float = 0.0

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        need(*("live",) if self.hand is None else ("live", "sim"))
        from training.live.page import close_server, open_server
        from training.live.session import Session, checked_record

        if not 0.0 <= self.seconds < 1e9:
            raise InvalidInputError(f"seconds must be 0 (until ctrl-C) or up to 1e9, got {self.seconds}")
        record = checked_record(self.record)
        server = open_server(self.port, "grasp live")
        try:
            page = self._bare(server) if self.hand is None else self._hand(server, self.hand)
        except BaseException:
            close_server(server)
            raise
        Session(server, page, "grasp live", record).run(self.seconds or None)

    def _bare(self, server: viser.ViserServer) -> Page:
        from training.live.bare import BarePage
        from training.live.question import Question

        grasp = presets.preset(self.preset) if self.grasp is None else load_grasp(self.grasp)
        if set(grasp.models.names) != {"hard"} or np.ptp(grasp.models.friction) > 0.0:
            raise UnsupportedProblemError(
                f"the page shows hard contacts with one round friction, got {', '.join(sorted(set(grasp.models.names)))} contacts with "
                f"friction {np.unique(grasp.models.friction).tolist()}: solve this grasp with grasp solve --grasp, or give a file without "
                "contact_model and with one number as friction"
            )
        friction = float(grasp.friction[0])
        question = Question(grasp.positions, grasp.normals, friction, np.array(self.wrench), method=self.method)
        return BarePage(server, question, rule)

    def _hand(self, server: viser.ViserServer, name: str) -> Page:
        from grasp_env.config import EnvConfig
        from grasp_env.sim.hand.description import HANDS, HandDescription
        from training.live.hand import HandPage

        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            if name in HANDS:
                hand: str | HandDescription = name
            else:
                hand = HandDescription.from_urdf(name, self.fingertips or None, torque_limit=self.torque_limit or None)
        for warning in told:
            sys.stderr.write(f"grasp: repaired: {warning.message}\n")
        return HandPage(server, EnvConfig(hand=hand, shape=self.shape, method=self.method), rule)
