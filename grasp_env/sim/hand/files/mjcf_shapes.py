"""Convert the geometries of a MuJoCo model to shapes of links."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from grasp_env.inputs.arguments import Array
from grasp_env.sim.hand.check import Vector3
from grasp_env.sim.hand.files.meshes import why_not_drawn
from grasp_env.sim.hand.files.mjcf_model import frame_of, mesh_file
from grasp_env.sim.hand.files.pieces import cached_pieces
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.solids import few_corners, hull_shape, outline
from grasp_env.sim.hand.tree import Geometry
from grasp_env.sim.mujoco_api import mujoco


class MjcfShapes:
    """The geometries of a model; `undrawn` has the reason for each mesh that cannot be drawn."""

    def __init__(self, model: Any, path: Path) -> None:
        self._model, self._path = model, path
        self.undrawn: dict[str, str] = {}

    def of_body(
        self, body: int, shift: Frame, without: set[int]
    ) -> tuple[list[Geometry], list[Geometry], Vector3 | None]:
        """Return collision shapes, visual shapes and color of a body at `shift` in its link's frame.

        The geometries `without` get no collision shapes.
        """
        model = self._model
        geoms = [geom for geom in range(model.ngeom) if int(model.geom_bodyid[geom]) == body]
        touching = [
            geom for geom in geoms if model.geom_contype[geom] or model.geom_conaffinity[geom]
        ]
        drawn = [geom for geom in geoms if geom not in touching] or touching
        collision = [
            shape for geom in touching if geom not in without for shape in self.solids(geom, shift)
        ]
        visual = [shape for geom in drawn for shape in self.looks(geom, shift)]
        return collision, visual, _color(model, drawn[0]) if drawn else None

    def _place(self, geom: int, shift: Frame) -> Frame:
        return shift @ frame_of(self._model.geom_pos[geom], self._model.geom_quat[geom])

    def solids(self, geom: int, shift: Frame) -> list[Geometry]:
        """Return a geometry's collision shapes: convex pieces of a mesh, none of other surfaces."""
        model = self._model
        kind = int(model.geom_type[geom])
        origin, rotation = self._place(geom, shift).numbers()
        color = _color(model, geom)
        kinds = mujoco.mjtGeom
        a, b, c = model.geom_size[geom].tolist()
        primitives = {
            int(kinds.mjGEOM_SPHERE): ("sphere", (a,)),
            int(kinds.mjGEOM_CAPSULE): ("capsule", (a, 2.0 * b)),
            int(kinds.mjGEOM_CYLINDER): ("cylinder", (a, 2.0 * b)),
            int(kinds.mjGEOM_BOX): ("box", (2.0 * a, 2.0 * b, 2.0 * c)),
        }
        if kind in primitives:
            name, size = primitives[kind]
            return [Geometry(name, size, origin, rotation, color)]
        pieces = list[Array]()
        if kind == int(kinds.mjGEOM_ELLIPSOID):
            pieces = [few_corners(outline(Geometry("sphere", (1.0,))) * (a, b, c))]
        elif kind == int(kinds.mjGEOM_MESH):
            mesh = model.mesh(int(model.geom_dataid[geom]))
            corners = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]]
            faces = model.mesh_face[mesh.faceadr[0] :][: mesh.facenum[0]]
            pieces = cached_pieces(corners, faces, f"{self._path.name}: {mesh.name or mesh.id}")
        return [hull_shape(piece, origin, rotation, color) for piece in pieces]

    def looks(self, geom: int, shift: Frame) -> list[Geometry]:
        """Return a geometry's visual shapes: a mesh's file if it can be drawn, else the pieces."""
        model = self._model
        if int(model.geom_type[geom]) != int(mujoco.mjtGeom.mjGEOM_MESH):
            return self.solids(geom, shift)
        mesh = int(model.geom_dataid[geom])
        file = mesh_file(model, mesh, self._path)
        scale = model.mesh_scale[mesh].tolist()
        if file is None:
            return self.solids(geom, shift)
        if why := why_not_drawn(file, scale):
            self.undrawn[file.name] = why
            return self.solids(geom, shift)
        # MuJoCo moved the mesh to its centre and principal axes
        back = frame_of(model.mesh_pos[mesh], model.mesh_quat[mesh]).inverse()
        origin, rotation = (self._place(geom, shift) @ back).numbers()
        return [
            Geometry("mesh", tuple(scale), origin, rotation, _color(model, geom), file=str(file))
        ]


def _color(model: Any, geom: int) -> Vector3:
    material = int(model.geom_matid[geom])
    x, y, z, _ = (model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]).tolist()
    return x, y, z
