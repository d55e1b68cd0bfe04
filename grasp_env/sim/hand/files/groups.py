"""The rigid groups of a file's links: what is fixed to the palm and to each moving link."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from grasp_env.inputs.arguments import Array
from grasp_env.sim.hand.files.elements import FileJoint, FileLink
from grasp_env.sim.hand.files.pieces import hulls_of_files
from grasp_env.sim.hand.frames import IDENTITY, Frame
from grasp_env.sim.hand.solids import outline
from grasp_env.sim.hand.tree import Geometry


class Place(NamedTuple):
    """The place of a file's link."""

    carrier: str | None  # the moving link to which it belongs; None for the palm
    frame: Frame  # in that link


class Groups:
    """The links of a hand with their shapes, each placed in the moving link that carries it.

    Attributes:
        root: Name of the palm's link.
        links: The links by name.
        moving: The joints that move, parents before children.
        places: Place of each link.
    """

    def __init__(
        self, root: str, links: Mapping[str, FileLink], joints: Sequence[FileJoint]
    ) -> None:
        self.root, self.links = root, links
        self.moving = [joint for joint in joints if not joint.fixed]
        self._joints = joints
        self.places = {root: Place(None, IDENTITY)}
        for joint in joints:
            carrier, frame = self.places[joint.parent]
            fixed = Place(carrier, frame @ Frame.of(joint.origin, joint.rotation))
            self.places[joint.child] = fixed if joint.fixed else Place(joint.child, IDENTITY)
        self._corners = hulls_of_files(
            shape.file
            for joint in self.moving
            for _, shape in self._outlines(self.of(joint.child))
            if shape.kind == "mesh"
        )

    def bodies(self) -> list[str]:
        """Return the names of the palm and of the moving links."""
        return [self.root, *(joint.child for joint in self.moving)]

    def of(self, name: str) -> list[str]:
        """Return the names of a link and of everything fixed to it."""
        group = [name]
        for joint in self._joints:
            if joint.fixed and joint.parent in group:
                group.append(joint.child)
        return group

    def touches(self, name: str) -> bool:
        """Return True if a link or anything fixed to it has a collision shape."""
        return any(self.links[other].collision for other in self.of(name))

    def only_drawn(self, name: str) -> bool:
        """Return True if a link and all that is fixed to it have visual shapes only."""
        return not self.touches(name) and any(self.links[other].visual for other in self.of(name))

    def shapes(
        self, name: str, carrier: str | None
    ) -> tuple[tuple[Geometry, ...], tuple[Geometry, ...]]:
        """Return collision and visual shapes of a link with everything fixed to it.

        Links without visual shapes show their collision shapes.
        """
        collision = list[Geometry]()
        visual = list[Geometry]()
        for other, place in self.places.items():
            if place.carrier != carrier:
                continue
            link = self.links[other]
            color = None if link.color == self.links[name].color else link.color
            collision += [shape.carried(place.frame) for shape in link.collision]
            for shape in link.visual or link.collision:
                visual.append(replace(shape.carried(place.frame), color=shape.color or color))
        return tuple(collision), tuple(visual)

    def points(self, group: Sequence[str]) -> list[Array]:
        """Return convex pieces (K, 3) [m] of the `_outlines` of links, carrier's frame."""
        pieces = list[Array]()
        for frame, shape in self._outlines(group):
            if shape.kind != "mesh":
                pieces.append(outline(shape.carried(frame)))
                continue
            if shape.file not in self._corners:
                self._corners |= hulls_of_files([shape.file])
            place = frame @ Frame.of(shape.origin, shape.rotation)
            corners = self._corners[shape.file] * shape.size
            pieces.append(corners @ place.rotation.T + place.origin)
        return pieces

    def _outlines(self, group: Sequence[str]) -> list[tuple[Frame, Geometry]]:
        """Return the links' collision shapes, or else visual ones, each with its link's frame."""
        links = [(self.places[name].frame, self.links[name]) for name in group]
        solids = [(frame, shape) for frame, link in links for shape in link.collision]
        return solids or [(frame, shape) for frame, link in links for shape in link.visual]

    def outward(self, link: str, points: Array) -> Array:
        """Return the vector (3,) from the palm's middle to a link's points (K, 3) [m], link frame.

        All joints are at 0.
        """
        frame, above = IDENTITY, link
        while above is not None:
            joint = next(joint for joint in self.moving if joint.child == above)
            above, outer = self.places[joint.parent]
            frame = outer @ Frame.of(joint.origin, joint.rotation) @ frame
        palm = [outline(shape) for shape in self.shapes(self.root, None)[0]]
        middle = np.vstack(palm).mean(axis=0) if palm else np.zeros(3)
        return frame.rotation.T @ (frame.rotation @ points.mean(axis=0) + frame.origin - middle)
