"""Named grasps."""

from __future__ import annotations

from grasp_env.grasp.grasp import Grasp
from grasp_env.inputs.arguments import Array, choice

_Contacts = tuple[list[list[float]], list[list[float]], float]
"""Positions, normals, friction."""


def _cuboid(*fingers: tuple[float, float]) -> _Contacts:
    """Return a thumb on one z face of a 0.1 m cuboid, and fingers at (x, y) on the other."""
    positions = [[0.0, 0.0, -0.05], *([x, y, 0.05] for x, y in fingers)]
    return positions, [[0.0, 0.0, 1.0], *([0.0, 0.0, -1.0] for _ in fingers)], 0.4


_CONTACTS: dict[str, _Contacts] = {
    "paper_cuboid": _cuboid((0.0, 0.03), (-0.03, -0.02), (0.03, -0.02)),
    "tripod": (
        [[0.04, 0.0, 0.0], [-0.02, 0.034641016151377546, 0.0], [-0.02, -0.034641016151377546, 0.0]],
        [[-1.0, 0.0, 0.0], [0.5, -0.8660254037844386, 0.0], [0.5, 0.8660254037844386, 0.0]],
        0.5,
    ),
    "five_finger_cuboid": _cuboid((-0.03, 0.03), (0.03, 0.03), (-0.03, -0.03), (0.03, -0.03)),
}
PRESETS = tuple(_CONTACTS)
"""Names of the presets."""


def preset(name: str, friction: float | Array | None = None) -> Grasp:
    """Return the named grasp of `PRESETS`; `friction`, scalar, (N,) or (N, 2), replaces its own.

    Raises:
        UnknownNameError: no preset has that name.

    Example:
        >>> preset("tripod", friction=0.8).friction
        array([0.8, 0.8, 0.8])
    """
    positions, normals, default = _CONTACTS[choice(name, "preset", PRESETS)]
    return Grasp.from_contacts(positions, normals, default if friction is None else friction)


def paper_cuboid(friction: float | Array | None = None) -> Grasp:
    """Return the paper's grasp: thumb at -z, three fingers at +z of a 0.1 m cuboid, mu = 0.4.

    The paper does not give the places of the fingers; `friction` is as in `preset`.

    Example:
        >>> paper_cuboid().positions[0]
        array([ 0.  ,  0.  , -0.05])
    """
    return preset("paper_cuboid", friction)


def tripod(friction: float | Array | None = None) -> Grasp:
    """Return three fingers around a disc of 40 mm radius, mu = 0.5; `friction` as in `preset`."""
    return preset("tripod", friction)


def five_finger_cuboid(friction: float | Array | None = None) -> Grasp:
    """Return a thumb against four fingers on the cuboid, mu = 0.4; `friction` as in `preset`."""
    return preset("five_finger_cuboid", friction)
