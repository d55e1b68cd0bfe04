"""`grasp live`: an interactive grasp in the browser."""

from __future__ import annotations

import math
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from grasp_env.errors import InvalidInputError, UnsupportedProblemError
from grasp_env.force.options import METHODS
from grasp_env.grasp import load_grasp, presets
from grasp_env.inputs.extras import need
from training.program.commands.options import Wrench, left_out, listed, one_of
from training.program.commands.rules import rule

if TYPE_CHECKING:
    from training.program.live.window import Window


@dataclass(frozen=True)
class Live:
    """Open a grasp in the browser and pull on the object.

    Drag the load and the contacts, or the object in a simulated hand.

    Only this machine can open the page.

    Attributes:
        preset: show the bare contacts of a named grasp.
        grasp: show the bare contacts of a grasp's JSON file instead.
        wrench: initial load on bare contacts: fx fy fz [N] mx my mz [N m].
        hand: show a simulated hand instead: four_finger, three_finger, five_finger,
            four_finger_4dof, allegro, leap, or a file (URDF, xacro, MJCF).
        fingertips: for a file: links that touch the object; none: every moving link that ends a
            branch.
        torque_limit: for a file: torque limit of all joints [N m]; 0: the file's own limits.
        shape: shape of the object in the hand.
        method: optimisation method.
        port: port of the page on 127.0.0.1, 1024 to 65000; if it is taken, the next free one is
            used and printed; 0: any free port.
        record: .html file to record into, at most two minutes; it opens from disk.
        seconds: time after which the page closes; 0: at ctrl-C.
    """

    preset: Annotated[str, one_of(presets.PRESETS)] = "paper_cuboid"
    grasp: Annotated[Path | None, left_out("the preset", "FILE")] = None
    wrench: Wrench = (1.0, 0.5, -0.6, -0.1, 0.2, 0.0)
    hand: Annotated[str | None, left_out("bare contacts", "NAME|FILE")] = None
    fingertips: tuple[str, ...] = ()
    torque_limit: float = 0.0
    shape: Annotated[str, listed("grasp_env.sim.objects.description", "SHAPES_WITHOUT_MESH")] = (
        "cuboid"
    )
    method: Annotated[str, one_of(METHODS)] = "newton"
    port: int = 8080
    record: Annotated[Path | None, left_out("nothing is recorded", "FILE")] = None
    seconds: float = 0.0

    def execute(self) -> None:
        """Run the command."""
        need(*("live",) if self.hand is None else ("live", "sim"))
        if not 0.0 <= self.seconds < 1e9:
            raise InvalidInputError(
                f"seconds must be 0 (until ctrl-C) or up to 1e9, got {self.seconds}"
            )
        path = self.record
        if path is not None and not (path.suffix == ".html" and path.absolute().parent.is_dir()):
            raise InvalidInputError(
                f"record must be an .html file in a folder that exists, got {path}"
            )
        window = self._bare() if self.hand is None else self._hand(self.hand)
        window.run(self.seconds or math.inf, path)

    def _bare(self) -> Window:
        from training.program.live.contacts import BareContacts

        grasp = presets.preset(self.preset) if self.grasp is None else load_grasp(self.grasp)
        if set(grasp.models.names) != {"hard"} or np.ptp(grasp.models.friction) > 0.0:
            raise UnsupportedProblemError(
                f"the page shows hard contacts with one round friction, got {', '.join(sorted(set(grasp.models.names)))} contacts with "
                f"friction {np.unique(grasp.models.friction).tolist()}: solve this grasp with grasp solve --grasp, or give a file without "
                "contact_model and with one number as friction"
            )
        return BareContacts(self.port, grasp, np.array(self.wrench), self.method, rule)

    def _hand(self, name: str) -> Window:
        from grasp_env.config import EnvConfig
        from grasp_env.sim.hand.description import HANDS, HandDescription
        from training.program.live.hand import SimulatedHand

        with warnings.catch_warnings(record=True) as repairs:
            warnings.simplefilter("always")
            tips = self.fingertips or None
            limit = self.torque_limit or None
            if name in HANDS:
                hand = HANDS[name]()
            else:
                hand = HandDescription.from_file(name, tips, torque_limit=limit)
        sys.stderr.writelines(f"grasp: repaired: {warning.message}\n" for warning in repairs)
        config = EnvConfig().override(hand=hand, shape=self.shape, method=self.method)
        return SimulatedHand(self.port, config, rule)
