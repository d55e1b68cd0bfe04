"""A hand from a MuJoCo model file (MJCF) as the same links and joints as those of a URDF; MuJoCo's own compiler reads the file."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco as compiled
import numpy as np

from grasp_env._check import Array
from grasp_env._files import shown_path
from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand.check import Vector3, inertia_numbers
from grasp_env.sim.hand.files.couplings import Motor, find_motors
from grasp_env.sim.hand.files.elements import FileJoint, FileLink, names_of
from grasp_env.sim.hand.files.meshes import why_not_drawn
from grasp_env.sim.hand.files.pieces import kept_pieces
from grasp_env.sim.hand.frames import Frame, axis_rotation
from grasp_env.sim.hand.solids import few_corners, outline
from grasp_env.sim.hand.tips import SMALLEST
from grasp_env.sim.hand.tree import Geometry, Mimic
from grasp_env.sim.objects.apart import apart
from grasp_env.sim.progress import counted

mujoco: Any = compiled  # it has no types

_SECONDS = 30.0
"""Longest time in which MuJoCo may compile a file."""
_MOST_MEMORY = 8 << 30
"""[bytes] that compiling may take."""
_PARENTS = 5
"""Folders above the file in which its meshes may be."""
_MOST_BODIES = 500
"""Largest number of bodies in a file."""
_LIGHT = 1e-3
"""[kg] of the link between two joints of one body, which MuJoCo lets weigh nothing."""
_LIGHT_INERTIA = 1e-7
"""[kg m^2] of that link about each axis."""
_IDENTITY = Frame(np.eye(3), np.zeros(3))


def compile_mjcf(path: Any) -> dict[str, Any]:
    """Compile a file in a process of its own, which `apart` makes.

    Args:
        path: Of the file, an array of one text.

    Returns:
        The "model" as MuJoCo writes it, uint8; or the "error" as text.
    """
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_MOST_MEMORY, _MOST_MEMORY))
    except (ImportError, ValueError, OSError):  # not on Windows
        pass
    file = Path(str(path))
    first = ""
    for folder in list(file.parents)[: _PARENTS + 1]:
        try:
            model = _compiled(file, folder)
        except (ValueError, RuntimeError, MemoryError) as error:
            first = first or str(error) or type(error).__name__
            continue
        buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        return {"model": buffer}
    return {"error": np.array(first)}


def _compiled(file: Path, folder: Path) -> Any:
    """The model of a file whose meshes are named from a folder on."""
    os.chdir(folder)
    if folder == file.parent and file.suffix == ".xml":
        return mujoco.MjModel.from_xml_path(str(file))
    spec = mujoco.MjSpec.from_string(file.read_text())
    spec.modelfiledir = str(folder)
    return spec.compile()


class MjcfReader:
    """Reads one file; see `urdf.UrdfReader` for the attributes.

    Bodies without joints are fixed to those that carry them. What has several joints becomes several links. Bodies whose joints no
    motor moves hold still. Free bodies that no motor moves, as objects of a scene, are left out.

    Args:
        path: Of the file.
        tips: Names of bodies, sites or geometries that are wanted as links: sites and geometries become fixed links of their own.

    Attributes:
        said: What was assumed or left out, a sentence each.

    Raises:
        InvalidInputError: No such file, or MuJoCo refuses it; or a hand cannot have what is in it.
    """

    def __init__(self, path: str | os.PathLike[str], tips: Sequence[str] = ()) -> None:
        self.path = Path(os.fsdecode(path))
        self.model = model = _load(self.path)
        self.name: str = _text(model, 0) or "hand"
        self.unseen: dict[str, str] = {}
        self.said: list[str] = []
        if model.nbody - 1 > _MOST_BODIES:
            raise InvalidInputError(
                f"there are {model.nbody - 1} bodies, allowed are up to {_MOST_BODIES}; take the hand out"
            )
        if model.njnt == 0:
            raise InvalidInputError(
                "no joint is in the file; a part that other files include is not read by itself: give the file that includes it"
            )
        self.motors = find_motors(model)
        self._note_motors()
        moving = {motor.joint for motor in self.motors} | {other for motor in self.motors for other in motor.followers}
        self._bodies, self._root = self._tree(moving)
        self._names = {body: model.body(body).name or f"body{body}" for body in self._bodies}
        self._joints = {body: [joint for joint in self._joints_of(body) if joint in moving] for body in self._bodies}
        self._tips = self._named_tips(tips)
        self._links, self._ends = self._read()
        self.names = [link.name for link in self._links]
        self.ends = [(joint.name, joint.parent, joint.child) for joint in self._ends]
        self.mimics = {joint.name: joint.mimic.joint for joint in self._ends if joint.mimic is not None}
        self.fixed = {joint.name for joint in self._ends if joint.fixed}

    def elements(self, wanted: Collection[str]) -> tuple[dict[str, FileLink], list[FileJoint]]:
        """See `urdf.UrdfReader`."""
        links = {link.name: link for link in self._links if link.name in wanted}
        return links, [joint for joint in self._ends if not {joint.parent, joint.child} - set(wanted)]

    def shaped(self, links: dict[str, FileLink]) -> dict[str, FileLink]:
        """See `urdf.UrdfReader`."""
        bodies = {name: body for body, name in self._names.items()}
        shaped = dict[str, FileLink]()
        for name, link in counted(list(links.items()), f"{self.path.name}: convex pieces of meshes"):
            if name in self._tips:
                _, geom = self._tips[name]
                solids = (
                    self._solid(geom, _IDENTITY) if geom is not None else [Geometry("sphere", (self._radius(name),))]
                )
                shaped[name] = replace(link, collision=tuple(solids))
            elif name in bodies:
                shaped[name] = self._with_shapes(link, bodies[name])
            else:
                shaped[name] = link
        return shaped

    def _note_motors(self) -> None:
        model = self.model
        if not self.motors:
            raise InvalidInputError(
                "no actuator moves a hinge or slide joint; add <position joint=.../> for each motor of the hand"
            )
        acting = {motor.actuator for motor in self.motors}
        idle = [_name(model, "actuator", number) for number in range(model.nu) if number not in acting]
        if idle:
            self.said.append(f"actuators that move no joint of their own are left out: {names_of(idle)}")
        lines = list[str]()
        for motor in self.motors:
            for other, (ratio, offset) in motor.followers.items():
                shift = f" {offset:+g}" if offset else ""
                bend = f" (misses by up to {motor.bend:.2f} rad)" if motor.curved else ""
                lines.append(
                    f"{_name(model, 'joint', other)} = {ratio:g} * {_name(model, 'joint', motor.joint)}{shift}{bend}"
                )
        if lines:
            self.said.append(f"joints that share a motor are coupled as MuJoCo moves them: {', '.join(lines)}")

    def _joints_of(self, body: int) -> list[int]:
        first, count = int(self.model.body_jntadr[body]), int(self.model.body_jntnum[body])
        return list(range(first, first + count))

    def _tree(self, moving: set[int]) -> tuple[list[int], int]:
        """The bodies of the hand, parents first, and the one that carries all others."""
        model = self.model
        parent = [int(number) for number in model.body_parentid]

        def above(body: int) -> list[int]:
            chain = [body]
            while chain[-1] != 0:
                chain.append(parent[chain[-1]])
            return chain

        carriers = {int(model.jnt_bodyid[joint]) for joint in moving}
        tops = {above(body)[-2] for body in carriers}
        (root,) = tops if len(tops) == 1 and not carriers & tops else (0,)
        inside = [body for body in range(model.nbody) if root in above(body)]
        ball, free = int(mujoco.mjtJoint.mjJNT_BALL), int(mujoco.mjtJoint.mjJNT_FREE)
        still, left = list[str](), list[str]()
        bodies = list[int]()
        for body in inside:
            if body != root and parent[body] not in bodies:
                continue
            passive = [joint for joint in self._joints_of(body) if joint not in moving]
            kinds = {int(model.jnt_type[joint]) for joint in passive}
            carries = carriers & {other for other in inside if body in above(other)}
            if ball in kinds and carries:
                raise InvalidInputError(
                    f"the ball joint {_name(model, 'joint', passive[0])!r} has no motor and carries joints that motors move: such parallel "
                    "mechanisms are not read; describe each finger by the hinges that they make of it"
                )
            if body != root and not carries and kinds & {ball, free}:
                left.append(model.body(body).name or f"body{body}")
                continue
            still += [_name(model, "joint", joint) for joint in passive]
            bodies.append(body)
        if left:
            self.said.append(f"bodies that move freely, and rods on ball joints, are left out: {names_of(left)}")
        if still:
            self.said.append(f"joints without a motor hold still where the file has them: {names_of(still)}")
        return bodies, root

    def _named_tips(self, tips: Sequence[str]) -> dict[str, tuple[int, int | None]]:
        """Of each tip that is a site or geometry: its body, and its geometry's number."""
        found = dict[str, tuple[int, int | None]]()
        for name in tips:
            if name in self._names.values():
                continue
            for site in range(self.model.nsite):
                if self.model.site(site).name == name and int(self.model.site_bodyid[site]) in self._bodies:
                    found[name] = int(self.model.site_bodyid[site]), None
            for geom in range(self.model.ngeom):
                if self.model.geom(geom).name == name and int(self.model.geom_bodyid[geom]) in self._bodies:
                    found[name] = int(self.model.geom_bodyid[geom]), geom
        return found

    def _read(self) -> tuple[list[FileLink], list[FileJoint]]:
        model = self.model
        links, joints = list[FileLink](), list[FileJoint]()
        # the frame of a link lies on the axis of its joint: where the body's frame is in it
        shifts = {self._root: _IDENTITY}
        ends = {self._root: self._names[self._root]}
        followers = {other: (motor, line) for motor in self.motors for other, line in motor.followers.items()}
        efforts = {motor.joint: self._effort(motor) for motor in self.motors}
        for body in self._bodies:
            if body == self._root:
                links.append(self._link(body, _IDENTITY))
                continue
            above = int(model.body_parentid[body])
            parent, place = ends[above], shifts[above] @ _frame(model.body_pos[body], model.body_quat[body])
            name, moved = self._names[body], self._joints[body]
            for number, joint in enumerate(moved):
                child = name if number == len(moved) - 1 else f"{name}/{_name(model, 'joint', joint)}"
                axis, anchor = np.array(model.jnt_axis[joint]), np.array(model.jnt_pos[joint])
                first = float(model.qpos0[model.jnt_qposadr[joint]])
                sliding = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
                zero = (
                    Frame(np.eye(3), anchor - first * axis) if sliding else Frame(axis_rotation(axis, -first), anchor)
                )
                origin, rotation = (place @ zero).numbers()
                lower, upper = self._range(joint)
                mimic = None
                if joint in followers:
                    motor, (ratio, offset) = followers[joint]
                    mimic = Mimic(_name(model, "joint", motor.joint), ratio, offset)
                joints.append(
                    FileJoint(
                        _name(model, "joint", joint),
                        parent,
                        child,
                        False,
                        origin,
                        rotation,
                        _vector(axis / np.linalg.norm(axis)),
                        lower,
                        upper,
                        efforts.get(joint),
                        sliding,
                        mimic,
                        float(model.dof_armature[model.jnt_dofadr[joint]]),
                    )
                )
                parent, place = child, Frame(np.eye(3), -anchor)
                if child != name:
                    links.append(FileLink(child, _LIGHT, _IDENTITY, inertia_numbers(_LIGHT_INERTIA * np.eye(3))))
            if not moved:
                origin, rotation = place.numbers()
                joints.append(FileJoint(f"{name}/fixed", parent, name, True, origin, rotation))
                place = _IDENTITY
            shifts[body], ends[body] = place, name
            links.append(self._link(body, place))
        for name, (body, geom) in self._tips.items():
            frame = shifts[body] if geom is not None else shifts[body] @ self._site(name)
            links.append(FileLink(name))
            joints.append(FileJoint(f"{name}/fixed", ends[body], name, True, *frame.numbers()))
        self._shifts = shifts
        return links, joints

    def _site(self, name: str) -> Frame:
        site = self.model.site(name)
        return _frame(site.pos, site.quat)

    def _radius(self, name: str) -> float:
        """Of the sphere that a site becomes [m]."""
        return max(float(self.model.site(name).size[0]), SMALLEST)

    def _range(self, joint: int) -> tuple[float, float]:
        if not self.model.jnt_limited[joint]:
            return -math.inf, math.inf
        low, high = self.model.jnt_range[joint].tolist()
        return low, high

    def _effort(self, motor: Motor) -> float | None:
        """Largest torque of a motor at its joint; None where the file names none."""
        model = self.model
        found = list[float]()
        if motor.actuator >= 0:
            if model.actuator_forcelimited[motor.actuator]:
                found.append(float(np.abs(model.actuator_forcerange[motor.actuator]).max()) * motor.arm)
            elif model.actuator_ctrllimited[motor.actuator] and not model.actuator_biasprm[motor.actuator].any():
                most = float(np.abs(model.actuator_ctrlrange[motor.actuator]).max())
                found.append(abs(float(model.actuator_gainprm[motor.actuator, 0])) * most * motor.arm)
        if model.jnt_actfrclimited[motor.joint]:
            found.append(float(np.abs(model.jnt_actfrcrange[motor.joint]).max()))
        return min(found, default=None)

    def _link(self, body: int, shift: Frame) -> FileLink:
        """A body as a link without shapes, in the frame of its joint."""
        model = self.model
        inertial = shift @ _frame(model.body_ipos[body], model.body_iquat[body])
        inertia = inertia_numbers(np.diag(model.body_inertia[body]))
        return FileLink(self._names[body], float(model.body_mass[body]), inertial, inertia)

    def _with_shapes(self, link: FileLink, body: int) -> FileLink:
        model, shift = self.model, self._shifts[body]
        mine = [geom for geom in range(model.ngeom) if int(model.geom_bodyid[geom]) == body]
        own = {geom for _, geom in self._tips.values() if geom is not None}
        touching = [geom for geom in mine if model.geom_contype[geom] or model.geom_conaffinity[geom]]
        looks = [geom for geom in mine if geom not in touching] or touching
        collision = [shape for geom in touching if geom not in own for shape in self._solid(geom, shift)]
        visual = [shape for geom in looks for shape in self._look(geom, shift)]
        color = _color(model, looks[0]) if looks else None
        return replace(link, collision=tuple(collision), visual=tuple(visual), color=color)

    def _place(self, geom: int, shift: Frame) -> Frame:
        return shift @ _frame(self.model.geom_pos[geom], self.model.geom_quat[geom])

    def _solid(self, geom: int, shift: Frame) -> list[Geometry]:
        """Shapes that touch: of a mesh its convex pieces, where MuJoCo has its hull; none of a plane or height field."""
        model, kind = self.model, int(self.model.geom_type[geom])
        origin, rotation = self._place(geom, shift).numbers()
        color = _color(model, geom)
        kinds = mujoco.mjtGeom
        a, b, c = model.geom_size[geom].tolist()
        if kind == int(kinds.mjGEOM_SPHERE):
            return [Geometry("sphere", (a,), origin, rotation, color)]
        if kind in (int(kinds.mjGEOM_CAPSULE), int(kinds.mjGEOM_CYLINDER)):
            name = "capsule" if kind == int(kinds.mjGEOM_CAPSULE) else "cylinder"
            return [Geometry(name, (a, 2.0 * b), origin, rotation, color)]
        if kind == int(kinds.mjGEOM_BOX):
            return [Geometry("box", (2.0 * a, 2.0 * b, 2.0 * c), origin, rotation, color)]
        if kind == int(kinds.mjGEOM_ELLIPSOID):
            return [_hull(few_corners(outline(Geometry("sphere", (1.0,))) * (a, b, c)), origin, rotation, color)]
        if kind == int(kinds.mjGEOM_MESH):
            return [_hull(piece, origin, rotation, color) for piece in self._pieces(int(model.geom_dataid[geom]))]
        return []

    def _pieces(self, mesh: int) -> list[Array]:
        model = self.model
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        begin, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        name = f"{self.path.name}: {model.mesh(mesh).name or mesh}"
        return kept_pieces(model.mesh_vert[first : first + count], model.mesh_face[begin : begin + faces], name)

    def _look(self, geom: int, shift: Frame) -> list[Geometry]:
        """A shape that is drawn: of a mesh its file where that can be drawn, else its hull."""
        model = self.model
        if int(model.geom_type[geom]) != int(mujoco.mjtGeom.mjGEOM_MESH):
            return self._solid(geom, shift)
        mesh = int(model.geom_dataid[geom])
        file = _file(model, int(model.mesh_pathadr[mesh]), self.path)
        scale = model.mesh_scale[mesh].tolist()
        if file is None:
            return self._solid(geom, shift)
        if why := why_not_drawn(file) or ("are mirrored by a scale below 0" if min(scale) < 0.0 else ""):
            self.unseen[file.name] = why
            return self._solid(geom, shift)
        # MuJoCo moved the mesh into its own axes
        moved = _frame(model.mesh_pos[mesh], model.mesh_quat[mesh])
        back = Frame(moved.rotation.T, -moved.rotation.T @ moved.origin)
        origin, rotation = (self._place(geom, shift) @ back).numbers()
        return [Geometry("mesh", tuple(scale), origin, rotation, _color(model, geom), file=str(file))]


def _load(path: Path) -> Any:
    """The compiled model of a file."""
    where = f"cannot read the MuJoCo model {shown_path(path)}"
    try:
        made = apart(
            f"{__name__}:compile_mjcf", f"compiling {path.name}", _SECONDS, path=np.array(str(path.absolute()))
        )
    except (TimeoutError, ChildProcessError) as error:
        raise InvalidInputError(f"{where}: MuJoCo's compiler failed: {str(error).splitlines()[-1]}") from None
    if "error" in made:
        raise InvalidInputError(f"{where}: {' '.join(str(made['error']).split())}")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "model.mjb")
        file.write_bytes(made["model"].tobytes())
        return mujoco.MjModel.from_binary_path(str(file))


def _text(model: Any, address: int) -> str:
    return bytes(model.names[address:]).split(b"\0", 1)[0].decode(errors="replace")


def _name(model: Any, kind: str, number: int) -> str:
    return getattr(model, kind)(number).name or f"{kind}{number}"


def _file(model: Any, address: int, path: Path) -> Path | None:
    """The file at an address of the model's paths; None: there is none."""
    if address < 0:
        return None
    text = bytes(model.paths[address:]).split(b"\0", 1)[0].decode(errors="replace")
    file = Path(text) if Path(text).is_absolute() else path.absolute().parent / text
    return file if text and file.is_file() else None


def _frame(position: Array, quaternion: Array) -> Frame:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, dtype=float))
    return Frame(matrix.reshape(3, 3), np.array(position, dtype=float))


def _vector(row: Array) -> Vector3:
    x, y, z = row.tolist()
    return x, y, z


def _hull(corners: Array, origin: Vector3, rotation: Vector3, color: Vector3) -> Geometry:
    return Geometry("hull", (), origin, rotation, color, tuple((x, y, z) for x, y, z in corners.tolist()))


def _color(model: Any, geom: int) -> Vector3:
    material = int(model.geom_matid[geom])
    x, y, z, _ = (model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]).tolist()
    return x, y, z
