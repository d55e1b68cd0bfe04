"""Read the shapes and colors of a URDF's links."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias
from xml.etree.ElementTree import Element

from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs.arguments import AllFaults
from grasp_env.sim.hand.check import Vector3
from grasp_env.sim.hand.files.elements import FileLink, listed
from grasp_env.sim.hand.files.meshes import PARENTS, find_mesh, unit_of, why_not_drawn
from grasp_env.sim.hand.files.pieces import LARGEST, PLAUSIBLE, MeshUse, extents_of, solids_of
from grasp_env.sim.hand.files.urdf_values import color_of, placement, row
from grasp_env.sim.hand.tree import Geometry

# attributes of a shape, with the number of their values
_SIZES = {
    "sphere": {"radius": 1},
    "capsule": {"radius": 1, "length": 1},
    "cylinder": {"radius": 1, "length": 1},
    "box": {"size": 3},
}

_MILLIMETRE = 1e-3  # [m]

_Shapes: TypeAlias = tuple[list[Geometry | MeshUse], list[Geometry | MeshUse]]
"""Shapes of a link that touch, and those that are drawn."""


class UrdfShapes:
    """The shapes of a file's links.

    `undrawn` has the reason for each visual mesh that is left out, `notes` what was assumed.
    """

    def __init__(self, path: str | os.PathLike[str], robot: Element) -> None:
        self._path = Path(os.fsdecode(path))
        self._materials = list(robot.iter("material"))
        self._palette: dict[str, Vector3] = {}
        self._missing: dict[str, list[str]] = {}
        self._shapes: dict[str, _Shapes] = {}
        self.undrawn: dict[str, str] = {}
        self.notes: list[str] = []

    def read_palette(self) -> None:
        """Read the colors of materials, by which links name them."""
        self._palette = {
            material.get("name", ""): color
            for material in self._materials
            if (color := color_of(material, f"material {material.get('name', '')!r}")) is not None
        }

    def add(self, element: Element, name: str) -> Vector3 | None:
        """Read the shapes of a <link> and return its color. Meshes are read by `with_shapes`."""
        looks = [
            (shape, self._color_of_visual(shape, f"link {name!r}, <visual>"))
            for shape in element.findall("visual")
        ]
        link_color = next((color for _, color in looks if color), None)
        with AllFaults() as check:
            collision = [check(self._placed, shape, name) for shape in element.findall("collision")]
            visual = [
                check(self._placed, shape, name, None if color == link_color else color)
                for shape, color in looks
            ]
        self._shapes[name] = list(filter(None, collision)), list(filter(None, visual))
        return link_color

    def _color_of_visual(self, element: Element, where: str) -> Vector3 | None:
        material = element.find("material")
        if material is None:
            return None
        return color_of(material, where) or self._palette.get(material.get("name", ""))

    def check_meshes(self) -> None:
        """Raise an error that lists the missing meshes."""
        if self._missing:
            meshes = [
                f"{shown(name)} ({', '.join(dict.fromkeys(links))})"
                for name, links in self._missing.items()
            ]
            raise InvalidInputError(
                f"these meshes (of links) are neither beside the URDF nor in the {PARENTS} folders above it: {listed(meshes, 40)}. "
                "Download the whole package and keep its folder structure"
            )

    def with_shapes(self, links: Mapping[str, FileLink]) -> dict[str, FileLink]:
        """Return the links with their shapes: convex pieces of collision meshes, visual meshes.

        If all collision meshes are far too large, they are taken as millimetres.
        """
        shapes = {name: self._shapes[name] for name in links}
        solids = self._drawn_solids(shapes)
        if solids is None:
            try:
                solids = self._solids(shapes)
            except InvalidInputError:
                scaled = self._in_metres(shapes)
                if scaled is None:
                    raise
                shapes, solids = scaled, self._solids(scaled)
        shaped = dict[str, FileLink]()
        for name, link in links.items():
            visual = [
                look if isinstance(look, Geometry) else self._visual_mesh(look)
                for look in shapes[name][1]
            ]
            shaped[name] = replace(
                link, collision=tuple(solids[name]), visual=tuple(filter(None, visual))
            )
        return shaped

    def _drawn_solids(self, shapes: Mapping[str, _Shapes]) -> dict[str, list[Geometry]] | None:
        """Return what is drawn as collision shapes if no link has any, which is noted; else None.

        They are None, too, if they cannot be read.
        """
        if any(pair[0] for pair in shapes.values()):
            return None
        try:
            solids = self._solids({name: (pair[1], []) for name, pair in shapes.items()})
        except InvalidInputError:
            return None
        if any(solids.values()):
            self.notes.append(
                "no link has a collision shape, so what is drawn touches instead; give <collision> in the file"
            )
        return solids

    def _solids(self, shapes: Mapping[str, _Shapes]) -> dict[str, list[Geometry]]:
        """Return the convex collision shapes of each link."""
        return solids_of({name: pair[0] for name, pair in shapes.items()}, self._path.name)

    def _in_metres(self, shapes: Mapping[str, _Shapes]) -> dict[str, _Shapes] | None:
        """Return shapes with meshes of millimetres scaled to metres, which is noted.

        They are None unless all collision meshes are larger than `LARGEST`, and at most `PLAUSIBLE`
        if they are in millimetres. Visual meshes may have another scale, so each is judged.
        """
        meshes = [
            [
                shape
                for pair in shapes.values()
                for shape in pair[role]
                if isinstance(shape, MeshUse)
            ]
            for role in (0, 1)
        ]
        extents = [extents_of(uses) for uses in meshes]
        if not all(LARGEST < extent <= PLAUSIBLE / _MILLIMETRE for extent in extents[0]):
            return None
        large = {
            use
            for uses, sizes in zip(meshes, extents, strict=True)
            for use, extent in zip(uses, sizes, strict=True)
            if extent > PLAUSIBLE
        }
        rows = dict.fromkeys(
            f"{use.name!r} ({extent:.3g} m)"
            for use, extent in zip(meshes[0], extents[0], strict=True)
        )
        self.notes.append(
            f"collision meshes are larger than {LARGEST:g} m, so they are taken as millimetres and scaled by {_MILLIMETRE:g}: "
            f"{listed(list(rows))}; check it, and write scale= of each <mesh>"
        )

        def fitting(shape: Geometry | MeshUse) -> Geometry | MeshUse:
            if isinstance(shape, Geometry) or shape not in large:
                return shape
            x, y, z = (_MILLIMETRE * factor for factor in shape.scale)
            return replace(shape, scale=(x, y, z))

        return {
            name: ([*map(fitting, pair[0])], [*map(fitting, pair[1])])
            for name, pair in shapes.items()
        }

    def _placed(
        self, element: Element, link: str, color: Vector3 | None = None
    ) -> Geometry | MeshUse | None:
        """Return the shape of a <collision> or <visual>; None for a missing mesh, recorded."""
        where = f"link {link!r}, <{element.tag}>"
        shape = _shape(element, where)
        if shape.tag != "mesh":
            return _primitive(element, shape, where, color)
        origin, rotation = placement(element, where)
        name, scale = _mesh(shape, where)
        path, unit = None, 1.0
        try:
            path = find_mesh(name, self._path)
            unit = 1.0 if path is None else unit_of(path)
        except InvalidInputError as error:
            if element.tag == "collision":
                raise InvalidInputError(f"{where}: {error}") from None
            self.undrawn[name] = "are missing" if path is None else "have an invalid unit"
            return None
        if path is not None:
            x, y, z = (unit * factor for factor in scale)
            return MeshUse(name, path, (x, y, z), origin, rotation, color)
        if element.tag == "collision":
            self._missing.setdefault(name, []).append(link)
        else:
            self.undrawn[name] = "are missing"
        return None

    def _visual_mesh(self, use: MeshUse) -> Geometry | None:
        """Return a visual mesh; None if it cannot be drawn, which is recorded."""
        if why := why_not_drawn(use.path, use.scale):
            self.undrawn[use.name] = why
            return None
        return Geometry("mesh", use.scale, use.origin, use.rotation, use.color, file=str(use.path))


def _shape(element: Element, where: str) -> Element:
    """Return the element inside the <geometry> of a <visual> or <collision>."""
    geometry = element.find("geometry")
    shape = None if geometry is None else next(iter(geometry), None)
    if shape is None:
        raise InvalidInputError(
            f"{where} has no shape in its <geometry>; write a sphere, capsule, box, cylinder or mesh"
        )
    return shape


def _mesh(shape: Element, where: str) -> tuple[str, Vector3]:
    name = shape.get("filename", "").strip()
    if not name:
        raise InvalidInputError(f"{where}, <mesh> lacks filename=")
    x, y, z = row(shape, "scale", 3, "1 1 1", f"{where}, <mesh>")
    if 0.0 in (x, y, z):
        raise InvalidInputError(f"{where}, <mesh>: scale={(x, y, z)} must not be 0")
    return name, (x, y, z)


def _primitive(element: Element, shape: Element, where: str, color: Vector3 | None) -> Geometry:
    if shape.tag not in _SIZES:
        raise InvalidInputError(
            f"{where}: the shape <{shape.tag[:40]}> is not one of sphere, capsule, box, cylinder and mesh"
        )
    inside = f"{where}, <{shape.tag}>"
    size = [
        value
        for key, count in _SIZES[shape.tag].items()
        for value in row(shape, key, count, None, inside)
    ]
    try:
        origin, rotation = placement(element, where)
        return Geometry(shape.tag, tuple(size), origin, rotation, color)
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from None
