"""Read a MuJoCo model file (MJCF), which MuJoCo compiles, as links and joints like a URDF's."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand.files.couplings import STRAIGHT, Motor, find_motors, joints_of
from grasp_env.sim.hand.files.elements import FileJoint, FileLink, names_of
from grasp_env.sim.hand.files.mjcf_model import frame_of, load_model, model_name, name_of
from grasp_env.sim.hand.files.mjcf_shapes import MjcfShapes
from grasp_env.sim.hand.frames import IDENTITY, Frame
from grasp_env.sim.hand.inertia import inertia_numbers
from grasp_env.sim.hand.tips import SMALLEST
from grasp_env.sim.hand.tree import Geometry, Mimic
from grasp_env.sim.mujoco_api import mujoco
from grasp_env.sim.progress import progress_bar

_LEAST_SPAN = 0.1  # smallest plausible median range of the hinges [rad]
_MAX_BODIES = 500
_LIGHT = 1e-3  # mass of the link between two joints of one body [kg], which is massless in MuJoCo
_LIGHT_INERTIA = 1e-7  # inertia of that link about each axis [kg m^2]


class MjcfReader:
    """A reader of one file; `urdf.UrdfReader` describes the attributes.

    A body without joints is fixed to its parent. A body with several joints becomes several links.
    Joints without a motor are frozen. Free bodies without a motor, such as objects of a scene, are
    left out. Sites and geometries that are named as fingertips become fixed links.
    """

    def __init__(self, path: str | os.PathLike[str], tips: Sequence[str] = ()) -> None:
        self.path = Path(os.fsdecode(path))
        self.model, degrees, unknown = load_model(self.path)
        model = self.model
        self.name = model_name(model, self.path)
        self._shapes = MjcfShapes(model, self.path)
        self.undrawn = self._shapes.undrawn
        self.notes: list[str] = []
        if unknown:
            self.notes.append(
                f"attributes that MuJoCo {mujoco.__version__} does not know are left out: {', '.join(unknown)}"
            )
        if model.nbody - 1 > _MAX_BODIES:
            raise InvalidInputError(
                f"there are {model.nbody - 1} bodies, allowed are up to {_MAX_BODIES}; take the hand out"
            )
        if model.njnt == 0:
            raise InvalidInputError(
                "the file has no joint; a part that other files include is not read by itself: give the file that includes it"
            )
        if degrees:
            self._repair_degrees()
        self.motors = find_motors(model)
        self._note_motors()
        moving = {joint for motor in self.motors for joint in (motor.joint, *motor.followers)}
        self._bodies, self._root = self._tree(moving)
        self._names = {body: name_of(model, "body", body) for body in self._bodies}
        self._joints = {
            body: [joint for joint in joints_of(model, body) if joint in moving]
            for body in self._bodies
        }
        self._tips = self._named_tips(tips)
        self._links, self._file_joints = self._read()
        self.names = [link.name for link in self._links]
        self.ends = [(joint.name, joint.parent, joint.child) for joint in self._file_joints]
        self.origins = {joint.name: joint.origin for joint in self._file_joints}
        self.mimics = {joint.name: joint.mimic.joint for joint in self._file_joints if joint.mimic}
        self.fixed = {joint.name for joint in self._file_joints if joint.fixed}

    def elements(self, names: Collection[str]) -> tuple[dict[str, FileLink], list[FileJoint]]:
        """See `urdf.UrdfReader`."""
        links = {link.name: link for link in self._links if link.name in names}
        joints = self._file_joints
        return links, [joint for joint in joints if joint.parent in links and joint.child in links]

    def with_shapes(self, links: dict[str, FileLink]) -> dict[str, FileLink]:
        """See `urdf.UrdfReader`."""
        bodies = {name: body for body, name in self._names.items()}
        tip_geoms = {geom for _, geom in self._tips.values() if geom is not None}
        shaped = dict[str, FileLink]()
        for name, link in progress_bar(
            list(links.items()), f"{self.path.name}: convex pieces of meshes"
        ):
            shaped[name] = link
            if name in self._tips:
                _, geom = self._tips[name]
                if geom is None:
                    radius = max(float(self.model.site(name).size[0]), SMALLEST)
                    solids = [Geometry("sphere", (radius,))]
                else:
                    solids = self._shapes.solids(geom, IDENTITY)
                shaped[name] = replace(link, collision=tuple(solids))
            elif name in bodies:
                body = bodies[name]
                collision, visual, color = self._shapes.of_body(
                    body, self._shifts[body], without=tip_geoms
                )
                shaped[name] = replace(
                    link, collision=tuple(collision), visual=tuple(visual), color=color
                )
        return shaped

    def _repair_degrees(self) -> None:
        """Take hinge angles, which MuJoCo read as degrees, as radians if ranges are too small."""
        model = self.model
        hinges = np.flatnonzero(
            (model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)) & (model.jnt_limited != 0)
        )
        spans = np.ptp(model.jnt_range[hinges], axis=1)
        if len(hinges) == 0 or np.median(spans) > _LEAST_SPAN:
            return
        model.jnt_range[hinges] *= 180.0 / math.pi
        addresses = model.jnt_qposadr[hinges]
        model.qpos0[addresses] *= 180.0 / math.pi
        self.notes.append(
            f"without angle='radian' in <compiler> ranges are degrees, but their median would then be {np.median(spans):.2g} rad: "
            "radians are assumed"
        )

    def _note_motors(self) -> None:
        model = self.model
        if not self.motors:
            raise InvalidInputError(
                "no actuator moves a hinge or slide joint; add <position joint=.../> for each motor of the hand"
            )
        idle = {*range(model.nu)} - {motor.actuator for motor in self.motors}
        if idle:
            names = names_of([name_of(model, "actuator", number) for number in sorted(idle)])
            self.notes.append(f"actuators that move no joint of their own are left out: {names}")
        lines = list[str]()
        for motor in self.motors:
            driver = name_of(model, "joint", motor.joint)
            error = ""
            if motor.bend > STRAIGHT:
                error = f" (misses by up to {motor.bend:.0%} of its travel)"
            for joint, (ratio, offset) in motor.followers.items():
                shift = f" {offset:+g}" if offset else ""
                name = name_of(model, "joint", joint)
                lines.append(f"{name} = {ratio:g} * {driver}{shift}{error}")
        if lines:
            self.notes.append(
                f"joints that share a motor are coupled as MuJoCo moves them: {', '.join(lines)}"
            )

    def _tree(self, moving: set[int]) -> tuple[list[int], int]:
        """Return the bodies of the hand, parents first, and the root body."""
        model = self.model
        parent = model.body_parentid.tolist()

        def above(body: int) -> list[int]:
            chain = [body]
            while chain[-1] != 0:
                chain.append(parent[chain[-1]])
            return chain

        carriers = {int(model.jnt_bodyid[joint]) for joint in moving}
        tops = {above(body)[-2] for body in carriers}
        (root,) = tops if len(tops) == 1 and not carriers & tops else (0,)
        ball = int(mujoco.mjtJoint.mjJNT_BALL)
        free = int(mujoco.mjtJoint.mjJNT_FREE)
        still = list[str]()
        left = list[str]()
        bodies = list[int]()
        for body in range(model.nbody):
            if body != root and parent[body] not in bodies:
                continue
            passive = [joint for joint in joints_of(model, body) if joint not in moving]
            kinds = {int(model.jnt_type[joint]) for joint in passive}
            carries = any(body in above(carrier) for carrier in carriers)
            if ball in kinds and carries:
                raise InvalidInputError(
                    f"the ball joint {name_of(model, 'joint', passive[0])!r} has no motor and carries joints that motors move: such parallel "
                    "mechanisms are not supported; replace each by equivalent hinges"
                )
            if body != root and not carries and kinds & {ball, free}:
                left.append(name_of(model, "body", body))
                continue
            still += [name_of(model, "joint", joint) for joint in passive]
            bodies.append(body)
        if left:
            self.notes.append(
                f"bodies that move freely, and rods on ball joints, are left out: {names_of(left)}"
            )
        if still:
            self.notes.append(
                f"joints without a motor hold still in the file's posture: {names_of(still)}"
            )
        return bodies, root

    def _named_tips(self, tips: Sequence[str]) -> dict[str, tuple[int, int | None]]:
        """Return body and geometry of each tip that is one, or body and None of one that is a site."""
        model = self.model
        named = dict[str, tuple[int, int | None]]()
        for name in tips:
            if name in self._names.values():
                continue
            site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
            geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
            if site >= 0 and (body := int(model.site_bodyid[site])) in self._bodies:
                named[name] = body, None
            if geom >= 0 and (body := int(model.geom_bodyid[geom])) in self._bodies:
                named[name] = body, geom
        return named

    def _read(self) -> tuple[list[FileLink], list[FileJoint]]:
        model = self.model
        links = list[FileLink]()
        joints = list[FileJoint]()
        # pose of each body's frame in its link's frame, which lies on the axis of the joint
        shifts = {self._root: IDENTITY}
        ends = {self._root: self._names[self._root]}
        followers = {
            joint: (motor.joint, *line)
            for motor in self.motors
            for joint, line in motor.followers.items()
        }
        efforts = {motor.joint: self._effort(motor) for motor in self.motors}
        for body in self._bodies:
            if body == self._root:
                links.append(self._link(body, IDENTITY))
                continue
            above = int(model.body_parentid[body])
            parent = ends[above]
            place = shifts[above] @ frame_of(model.body_pos[body], model.body_quat[body])
            name = self._names[body]
            body_joints = self._joints[body]
            for joint in body_joints:
                joint_name = name_of(model, "joint", joint)
                child = name if joint == body_joints[-1] else f"{name}/{joint_name}"
                axis = np.array(model.jnt_axis[joint])
                anchor = np.array(model.jnt_pos[joint])
                first = float(model.qpos0[model.jnt_qposadr[joint]])
                sliding = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
                zero = Frame(np.eye(3), anchor) @ Frame.of_joint(axis, -first, sliding)
                x, y, z = (axis / np.linalg.norm(axis)).tolist()
                lower, upper = -math.inf, math.inf
                if model.jnt_limited[joint]:
                    lower, upper = model.jnt_range[joint].tolist()
                mimic = None
                if joint in followers:
                    driver, ratio, offset = followers[joint]
                    mimic = Mimic(name_of(model, "joint", driver), ratio, offset)
                joints.append(
                    FileJoint(
                        joint_name,
                        parent,
                        child,
                        False,
                        *(place @ zero).numbers(),
                        (x, y, z),
                        lower,
                        upper,
                        efforts.get(joint),
                        sliding,
                        mimic,
                        float(model.dof_armature[model.jnt_dofadr[joint]]),
                    )
                )
                parent = child
                place = Frame(np.eye(3), -anchor)
                if child != name:
                    inertia = inertia_numbers(_LIGHT_INERTIA * np.eye(3))
                    links.append(FileLink(child, _LIGHT, IDENTITY, inertia))
            if not body_joints:
                joints.append(FileJoint(f"{name}/fixed", parent, name, True, *place.numbers()))
                place = IDENTITY
            shifts[body], ends[body] = place, name
            links.append(self._link(body, place))
        for name, (body, geom) in self._tips.items():
            place = shifts[body]
            if geom is None:
                place @= frame_of(model.site(name).pos, model.site(name).quat)
            links.append(FileLink(name))
            joints.append(FileJoint(f"{name}/fixed", ends[body], name, True, *place.numbers()))
        self._shifts = shifts
        return links, joints

    def _effort(self, motor: Motor) -> float | None:
        """Return the largest torque of a motor at its joint; None if the file has none."""
        model = self.model
        actuator = motor.actuator
        efforts = list[float]()
        if actuator >= 0 and model.actuator_forcelimited[actuator]:
            efforts.append(float(np.abs(model.actuator_forcerange[actuator]).max()) * motor.arm)
        elif (
            actuator >= 0
            and model.actuator_ctrllimited[actuator]
            and not model.actuator_biasprm[actuator].any()
        ):
            control = float(np.abs(model.actuator_ctrlrange[actuator]).max())
            efforts.append(abs(float(model.actuator_gainprm[actuator, 0])) * control * motor.arm)
        if model.jnt_actfrclimited[motor.joint]:
            efforts.append(float(np.abs(model.jnt_actfrcrange[motor.joint]).max()))
        return min(efforts, default=None)

    def _link(self, body: int, shift: Frame) -> FileLink:
        """Return a body as a link without shapes, in the frame of its joint."""
        model = self.model
        inertial = shift @ frame_of(model.body_ipos[body], model.body_iquat[body])
        inertia = inertia_numbers(np.diag(model.body_inertia[body]))
        return FileLink(self._names[body], float(model.body_mass[body]), inertial, inertia)
