"""`grasp hand`: contents of a hand's file, and repairs to it."""

from __future__ import annotations

import math
import os
import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.extras import need
from training.program.commands.answers import make_table
from training.program.commands.options import left_out, pairs_of

if TYPE_CHECKING:
    from rich.table import Table

    from grasp_env.sim.hand.description import HandDescription


@dataclass(frozen=True)
class Hand:
    """Read a hand's file, and list what was repaired in it.

    Prints the joints, fingertips and links that `HandDescription.from_file` reads.

    Attributes:
        hand: a file (URDF, xacro, MJCF), or the name of a hand: allegro, leap, four_finger, ...
        fingertips: links that touch the object; none: every moving link that ends a branch.
        torque_limit: torque limit of all joints [N m], of sliding joints [N]; 0: the file's own limits.
        palm: palm link, if the file describes an arm or a whole robot.
        xacro_args: values of a xacro file's arguments, NAME=VALUE.
        draw: .png for a picture of the visual shapes beside the collision shapes, the fingertips
            red.
        size: height of the picture [pixels].
    """

    hand: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME|FILE")]
    fingertips: tuple[str, ...] = ()
    torque_limit: float = 0.0
    palm: Annotated[str, left_out("the link that carries all others", "LINK")] = ""
    xacro_args: Annotated[tuple[str, ...], left_out("the file's own", "NAME=VALUE")] = ()
    draw: Annotated[Path | None, left_out("no picture", "FILE")] = None
    size: int = 640

    def execute(self) -> None:
        """Run the command."""
        need("sim")
        from grasp_env.inputs.arguments import choice
        from grasp_env.sim.hand.description import HANDS, HandDescription
        from grasp_env.sim.picture.view import picture_size

        picture_size(self.size)
        with warnings.catch_warnings(record=True) as repairs:
            warnings.simplefilter("always")
            if self.hand in HANDS:
                if self.fingertips or self.torque_limit or self.palm or self.xacro_args:
                    raise InvalidInputError(
                        f"{self.hand} is no file: it has its own palm, fingertips and torque limits, and no arguments"
                    )
                hand = HANDS[self.hand]()
            else:
                if not os.path.lexists(self.hand) and not os.path.splitext(self.hand)[1]:
                    choice(
                        self.hand, "hand", HANDS, ", or give the path of a URDF, xacro or MJCF file"
                    )
                form = "an argument is given as NAME=VALUE, such as side=left"
                hand = HandDescription.from_file(
                    self.hand,
                    self.fingertips or None,
                    torque_limit=self.torque_limit or None,
                    palm=self.palm or None,
                    xacro_args=pairs_of(self.xacro_args, form),
                )
        console = Console()
        for table in (_joints(hand), _fingers(hand), _links(hand)):
            console.print(table)
        for warning in repairs:
            console.print(
                f"repaired: {warning.message}", style="yellow", highlight=False, soft_wrap=True
            )
        if self.draw is not None:
            from grasp_env.sim.picture.portrait import portrait, save_picture

            save_picture(portrait(hand, self.size), self.draw)
            console.print(str(self.draw), highlight=False, soft_wrap=True)


def _joints(hand: HandDescription) -> Table:
    columns = ("joint", "moves", "from", "to", "limit", "coupled to")
    table = make_table(f"{hand.name}: {hand.joint_count} joints", *columns)
    for link in hand.links:
        length, force = link.units
        ends = ("-", "-")
        if math.isfinite(link.lower):
            ends = (f"{link.lower:.3f} {length}", f"{link.upper:.3f} {length}")
        motor = (f"{link.torque_limit:g} {force}", "")
        if link.mimic is not None:  # another joint's motor moves it
            offset = f" {link.mimic.offset:+g}" if link.mimic.offset else ""
            motor = ("", f"{link.mimic.ratio:g} x {link.mimic.joint}{offset}")
        table.add_row(link.joint, link.name, *ends, *motor)
    return table


def _fingers(hand: HandDescription) -> Table:
    from grasp_env.sim.hand.kinematics import HandKinematics

    motors = HandKinematics(hand).carries
    table = make_table(
        f"{hand.finger_count} fingertips", "finger", "link", "centre, mm", "radius, mm", "motors"
    )
    for tip, moving in zip(hand.fingertips, motors, strict=True):
        center = " ".join(f"{1e3 * value:.1f}" for value in tip.center)
        table.add_row(tip.name, tip.link, center, f"{1e3 * tip.radius:.1f}", str(int(moving.sum())))
    return table


def _links(hand: HandDescription) -> Table:
    grams = 1e3 * sum(link.mass for link in hand.links)
    columns = ("link", "mass, g", "collision shapes", "hull vertices", "visual shapes")
    table = make_table(f"moving mass {grams:.0f} g", *columns)
    for body in (hand.palm, *hand.links):
        kinds = Counter(shape.kind for shape in body.collision)
        shapes = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
        hulls = (shape for shape in body.collision if shape.kind == "hull")
        vertices = " ".join(str(len(hull.corners)) for hull in hulls)
        mass = "" if body is hand.palm else f"{1e3 * body.mass:.2f}"  # type: ignore[union-attr]
        table.add_row(body.name, mass, shapes, vertices, str(len(body.visual)))
    return table
