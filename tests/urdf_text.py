"""URDF files of simple hands and of what carries them, as text, and read."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from grasp_env.sim.hand.description import HandDescription


def link(name: str, size: float = 0.04, mass: float = 0.03, moment: float | None = None, place: str = "0 0 0") -> str:
    """A link: a box of 2 cm by 2 cm, `size` [m] long along x, of `mass` [kg]; its inertia is the box's or `moment` [kg m^2] about each axis."""
    along, across = mass * 8e-4 / 12.0, mass * (size**2 + 4e-4) / 12.0
    inertia = (along, across) if moment is None else (moment, moment)
    return (
        f'<link name="{name}"><inertial><origin xyz="{place}"/><mass value="{mass}"/>'
        f'<inertia ixx="{inertia[0]}" iyy="{inertia[1]}" izz="{inertia[1]}"/></inertial>'
        f'<collision><origin xyz="{0.5 * size} 0 0"/><geometry><box size="{size} 0.02 0.02"/></geometry></collision></link>'
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
    """A joint about y at `place` [m] of its parent."""
    torque = "" if effort is None else f'effort="{effort}"'
    other = f'<mimic joint="{mimic}"/>' if mimic else ""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{place}"/>'
        f'<axis xyz="0 1 0"/><limit lower="{limits[0]}" upper="{limits[1]}" {torque}/>{other}</joint>'
    )


def finger(name: str, palm: str, place: str, **options: object) -> str:
    """A finger of two links, `name`1 and `name`2, whose joints are `name`a and `name`b."""
    joints = {key: value for key, value in options.items() if key in ("limits", "effort", "kind")}
    links = {key: value for key, value in options.items() if key not in joints}
    return (
        joint(f"{name}a", palm, f"{name}1", place, **joints)  # pyright: ignore[reportArgumentType]
        + link(f"{name}1", **links)  # pyright: ignore[reportArgumentType]
        + joint(f"{name}b", f"{name}1", f"{name}2", **joints)  # pyright: ignore[reportArgumentType]
        + link(f"{name}2", **links)  # pyright: ignore[reportArgumentType]
    )


def hand(palm: str = "palm", before: str = "", **options: object) -> str:
    """A palm with the fingers `before`i, `before`m and `before`t; `options` go to `finger`."""
    return link(palm, 0.06, 0.2) + "".join(
        finger(f"{before}{name}", palm, place, **options)
        for name, place in (("i", "0.06 0.02 0"), ("m", "0.06 -0.02 0"), ("t", "0 0 0.03"))
    )


def robot(text: str) -> str:
    """A file of links and joints."""
    return f'<robot name="robot">{text}</robot>'


def read(folder: Path, text: str, **options: Any) -> tuple[HandDescription, str]:
    """The hand of links and joints in a file, and its warning, "" for none."""
    path = folder / "hand.urdf"
    path.write_text(robot(text), encoding="utf-8")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        made = HandDescription.from_urdf(path, rotor_inertia=0.0, **options)
    assert len(told) <= 1
    return made, str(told[0].message) if told else ""
