"""Write and read URDF files of simple hands."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from grasp_env.sim.hand.description import HandDescription

INERTIAL = '<inertial><mass value="0.1"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5"/></inertial>'


def solid(shape: str, xyz: str = "0 0 0", role: str = "collision") -> str:
    return f'<{role}><origin xyz="{xyz}"/><geometry>{shape}</geometry></{role}>'


def small(finger: str, palm: str = "", more: str = "") -> str:
    """Return a palm and a finger on the joint `bend` about y, with more elements inside and after
    them."""
    return (
        f'<robot name="small"><link name="palm">{palm}</link><joint name="bend" type="revolute"><parent link="palm"/>'
        '<child link="finger"/><axis xyz="0 2 0"/><limit lower="-1" upper="1" effort="2"/></joint>'
        f'<link name="finger">{INERTIAL}{finger}</link>{more}</robot>'
    )


SPACE = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
SMALL_HAND = small(solid('<sphere radius="0.01"/>'))


def xacro_hand(before: str = "", name: str = "own") -> str:
    """Return a xacro file of a hand that is called `name`, with xacro elements before its links."""
    text = SMALL_HAND.replace('<robot name="small">', f'<robot name="robot" {SPACE}>{before}')
    return text.replace("</robot>", f'<xacro:attribute name="name" value="{name}"/></robot>')


def link(
    name: str,
    size: float = 0.04,
    mass: float = 0.03,
    moment: float | None = None,
    place: str = "0 0 0",
) -> str:
    """Return a box of 2 cm by 2 cm, `size` [m] long along x, of `mass` [kg]; its inertia is the
    box's or `moment` [kg m^2] about each axis."""
    along = mass * 8e-4 / 12.0
    across = mass * (size**2 + 4e-4) / 12.0
    inertia = (along, across) if moment is None else (moment, moment)
    box = solid(f'<box size="{size} 0.02 0.02"/>', f"{0.5 * size} 0 0")
    return (
        f'<link name="{name}"><inertial><origin xyz="{place}"/><mass value="{mass}"/>'
        f'<inertia ixx="{inertia[0]}" iyy="{inertia[1]}" izz="{inertia[1]}"/></inertial>'
        f"{box}</link>"
    )


def joint(
    name: str,
    parent: str,
    child: str,
    place: str = "0.04 0 0",
    limits: tuple[float, float] = (-0.2, 1.6),
    effort: float | None = 1.0,
    kind: str = "revolute",
    mimic: str = "",
) -> str:
    """Return a joint about y at `place` [m] of its parent."""
    torque = "" if effort is None else f'effort="{effort}"'
    other = f'<mimic joint="{mimic}"/>' if mimic else ""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{place}"/>'
        f'<axis xyz="0 1 0"/><limit lower="{limits[0]}" upper="{limits[1]}" {torque}/>{other}</joint>'
    )


def finger(
    name: str,
    palm: str,
    place: str,
    size: float = 0.04,
    mass: float = 0.03,
    moment: float | None = None,
    **joints: Any,
) -> str:
    """Return a finger of two links, `name`1 and `name`2, with the joints `name`a and `name`b."""
    first = f"{name}1"
    second = f"{name}2"
    text = joint(f"{name}a", palm, first, place, **joints) + link(first, size, mass, moment)
    return text + joint(f"{name}b", first, second, **joints) + link(second, size, mass, moment)


def hand(palm: str = "palm", before: str = "", **options: Any) -> str:
    """Return a palm with the fingers `before`i, `before`m and `before`t; `options` go to `finger`."""
    return link(palm, 0.06, 0.2) + "".join(
        finger(f"{before}{name}", palm, place, **options)
        for name, place in (("i", "0.06 0.02 0"), ("m", "0.06 -0.02 0"), ("t", "0 0 0.03"))
    )


def robot(text: str) -> str:
    """Return a file of links and joints."""
    return f'<robot name="robot">{text}</robot>'


def read(
    folder: Path, text: str, fingertips: Any = None, name: str = "hand.urdf", **options: Any
) -> tuple[HandDescription, str]:
    """Read a file, or links and joints, by default without rotors; return the hand and its warning,
    "" for none."""
    (folder / name).write_text(
        robot(text) if text.startswith(("<link", "<joint")) else text, encoding="utf-8"
    )
    return read_file(folder / name, fingertips=fingertips, **{"rotor_inertia": 0.0, **options})


def read_file(path: Path, **options: Any) -> tuple[HandDescription, str]:
    """Return the hand of a file and its warning, "" for none."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        made = HandDescription.from_file(path, **options)
    assert len(told) <= 1
    return made, str(told[0].message) if told else ""
