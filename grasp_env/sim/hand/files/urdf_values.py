"""Read the values of a URDF's elements; an error says where the element is."""

from __future__ import annotations

from xml.etree.ElementTree import Element

from grasp_env.errors import InvalidInputError, shown
from grasp_env.sim.hand.check import Vector3, numbers


def row(
    element: Element | None, key: str, count: int, default: str | None, where: str
) -> tuple[float, ...]:
    """Return an attribute of `count` numbers; `default` replaces a missing element or attribute."""
    text = default if element is None else element.get(key, default)
    if text is None:
        raise InvalidInputError(f"{where} lacks {key}=")
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        raise InvalidInputError(
            f"{where}: {key}={shown(text.split())} must be {count} numbers"
        ) from None
    return numbers(values, count, f"{where}: {key}")


def number(element: Element | None, key: str, default: str | None, where: str) -> float:
    """Return an attribute of one number; `default` replaces a missing element or attribute."""
    return row(element, key, 1, default, where)[0]


def placement(element: Element, where: str) -> tuple[Vector3, Vector3]:
    """Return position [m] and roll, pitch, yaw [rad] of an <origin> in an element, else zeros."""
    origin = element.find("origin")
    x, y, z = row(origin, "xyz", 3, "0 0 0", f"{where}, <origin>")
    roll, pitch, yaw = row(origin, "rpy", 3, "0 0 0", f"{where}, <origin>")
    return (x, y, z), (roll, pitch, yaw)


def color_of(material: Element, where: str) -> Vector3 | None:
    """Return red, green and blue of a <material>, 0 to 1; None if it has no <color>."""
    color = material.find("color")
    if color is None:
        return None
    red, green, blue, _ = row(color, "rgba", 4, None, f"{where}, <color>")
    return red, green, blue
