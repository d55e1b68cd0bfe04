"""Pictures of a hand or a mesh alone, beside its collision shapes, and of a hand at an object."""

from __future__ import annotations

import io
import math
import tempfile
from collections.abc import Collection
from colorsys import hsv_to_rgb
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from grasp_env.inputs.arguments import Array
from grasp_env.inputs.files import replacing
from grasp_env.sim.engine import class_of, engine_of
from grasp_env.sim.hand.description import Fingertip, Geometry, HandDescription, Link, Palm, Vector3
from grasp_env.sim.hand.frames import roll_pitch_yaw
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.hand.solids import outline
from grasp_env.sim.mesh_files import obj_text
from grasp_env.sim.objects.description import OBJECT_COLOR, ObjectDescription
from grasp_env.sim.objects.mesh import Mesh
from grasp_env.sim.picture.view import View

_TIP = (0.90, 0.25, 0.15)
_TOUCHING = (0.20, 0.65, 0.25)
_SOLID = (0.62, 0.70, 0.80)
_PALM = (0.45, 0.50, 0.58)
_FINE = 2  # rendered pixels per delivered pixel along each side
_MARGIN = 0.04  # share of the picture left free around the hand or mesh
_MESH_SIZE = (
    0.2  # size to which meshes are scaled, as the camera cannot come near to small ones [m]
)
_ORIGIN = (0.0, 0.0, 0.0)


def portrait(hand: HandDescription, size: int = 640, angles: Array | None = None) -> np.ndarray:
    """Return a picture (size, 2 size, 3) uint8 of a hand's visual and its collision shapes.

    Fingertips are red among the collision shapes. If possible the palm is below the fingertips,
    which close towards the camera. The joints are at `angles` (M,) [rad], or at `home`.
    """
    posture = np.array(hand.home) if angles is None else angles
    upright = hand.moved(_ORIGIN, roll_pitch_yaw(_upright(hand, posture)))
    view = _view(_outlines(upright, posture), size)
    return np.hstack([_shot(look, posture, view) for look in (upright, _solid(upright))])


def mesh_portrait(mesh: Mesh, size: int = 640) -> np.ndarray:
    """Return a picture (size, 2 size, 3) uint8 of a mesh, y up, and of its pieces in colours."""
    scale = _MESH_SIZE / max(mesh.extent)
    pieces = list[Geometry]()
    for index, piece in enumerate(mesh.pieces):
        corners = tuple(map(tuple, (scale * piece).tolist()))
        pieces.append(Geometry("hull", (), color=_color(index), corners=corners))
    points = scale * np.vstack([mesh.vertices, *mesh.pieces])
    view = _view(points, size)
    with tempfile.TemporaryDirectory() as folder:
        whole = _mesh_shape(scale * mesh.vertices, mesh.faces, folder)
        return np.hstack(
            [_shot(_lookalike(shapes), np.zeros(1), view) for shapes in ((whole,), tuple(pieces))]
        )


def grasp_portrait(
    hand: HandDescription, item: ObjectDescription, touching: Collection[str], size: int = 640
) -> np.ndarray:
    """Return a picture (size, 2 size, 3) uint8 of a hand at an object, from the front and behind.

    Collision shapes are drawn. The tips of the fingers named in `touching` are green, other tips
    red. The object's body frame is the world frame, with y up; the joints are at `home`.
    """
    angles = np.array(hand.home)
    solid = _solid(hand, touching)
    points = np.vstack([_outlines(hand, angles), outline(Geometry("box", item.extent))])
    with tempfile.TemporaryDirectory() as folder:
        palm = replace(solid.palm, visual=(*solid.palm.visual, _shape_of(item, folder)))
        both = replace(solid, palm=palm)
        return np.hstack([_shot(both, angles, _view(points, size, back)) for back in (False, True)])


def save_picture(pixels: np.ndarray, path: Path) -> None:
    """Write pixels (height, width, 3) as a .png file."""
    image = io.BytesIO()  # writing to a file, the encoder would not tell why it failed
    Image.fromarray(pixels).save(image, format="PNG")
    with replacing(path) as temporary:
        temporary.write_bytes(image.getbuffer())


def _outlines(hand: HandDescription, angles: Array) -> Array:
    """Return points (K, 3) [m] around the collision shapes, tips and joints of a hand."""
    kinematics = HandKinematics(hand)
    rotations, origins = kinematics.links(angles)
    points = [outline(shape) for shape in hand.palm.collision]
    for link, rotation, origin in zip(hand.links, rotations, origins, strict=True):
        points += [outline(shape) @ rotation.T + origin for shape in link.collision]
    return np.vstack([*points, kinematics.tips(angles), origins])


def _shape_of(item: ObjectDescription, folder: str) -> Geometry:
    """Return an object as a shape to draw; the file of a mesh is written to the folder."""
    width, height, _ = item.extent
    if item.shape == "mesh":
        return _mesh_shape(*item.faces, folder)
    if item.shape == "cuboid":
        return Geometry("box", item.extent, color=OBJECT_COLOR)
    if item.shape == "sphere":
        return Geometry("sphere", (0.5 * width,), color=OBJECT_COLOR)
    length = height - (width if item.shape == "capsule" else 0.0)
    along_y = (0.5 * math.pi, 0.0, 0.0)
    return Geometry(item.shape, (0.5 * width, length), rotation=along_y, color=OBJECT_COLOR)


def _mesh_shape(corners: Array, faces: np.ndarray, folder: str) -> Geometry:
    file = Path(folder, "mesh.obj")
    file.write_text(obj_text([(corners, faces)]), encoding="ascii")
    return Geometry("mesh", (1.0, 1.0, 1.0), color=OBJECT_COLOR, file=str(file))


def _view(points: Array, size: int, behind: bool = False) -> View:
    side = -1.0 if behind else 1.0
    view = View((0.45 * side, 0.35, side), _ORIGIN, 20.0, size, size)
    return view.fitted(points, _MARGIN, _MARGIN)


def _color(index: int) -> Vector3:
    """Return a colour; hues are a golden section apart, so that consecutive ones differ."""
    saturation, value = ((0.55, 0.9), (0.35, 0.95), (0.7, 0.75))[index % 3]
    return hsv_to_rgb(0.08 + 0.618034 * index, saturation, value)


def _lookalike(shapes: tuple[Geometry, ...]) -> HandDescription:
    """Make a hand with only these visual shapes, as painters draw hands."""
    body = 1.0, _ORIGIN, (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)  # mass, centre, inertia
    link = Link("unseen", "palm", _ORIGIN, _ORIGIN, (0.0, 0.0, 1.0), -1.0, 1.0, 1.0, *body)
    tip = Fingertip("tip", "unseen", _ORIGIN, 1.0)
    return HandDescription("mesh", Palm(visual=shapes), (link,), (tip,))


def _shot(hand: HandDescription, angles: Array, view: View) -> np.ndarray:
    with closing(class_of(engine_of(), "painter").of_hand(hand, angles)) as painter:
        return np.array(painter.shoot(view, _FINE, shadows=True)[0].reduce(_FINE))


def _solid(hand: HandDescription, touching: Collection[str] = ()) -> HandDescription:
    """Return the hand with its collision shapes as its visual shapes."""
    tips = {
        ("sphere", tip.link, tip.center): _TOUCHING if tip.name in touching else _TIP
        for tip in hand.fingertips
    }

    def colored(body: Link | Palm, color: Vector3) -> tuple[Geometry, ...]:
        return tuple(
            replace(shape, color=tips.get((shape.kind, body.name, shape.origin), color))
            for shape in body.collision
        )

    links = tuple(replace(link, visual=colored(link, _SOLID)) for link in hand.links)
    return replace(hand, palm=replace(hand.palm, visual=colored(hand.palm, _PALM)), links=links)


def _upright(hand: HandDescription, angles: Array) -> Array:
    """Return a rotation (3, 3) with the tips above the palm, along y, that close towards z."""
    kinematics = HandKinematics(hand)
    tips = kinematics.tips(angles)
    points = [outline(shape) for shape in hand.palm.collision]
    palm = np.vstack(points).mean(axis=0) if points else 0.0
    up = _first([tips.mean(axis=0) - palm, np.eye(3)[1]], np.zeros(3))
    # fingers close towards the farther limit of each joint
    far = np.where(
        np.abs(kinematics.upper) > np.abs(kinematics.lower), kinematics.upper, kinematics.lower
    )
    closing = kinematics.tips(np.where(np.isfinite(far), 0.8 * angles + 0.2 * far, angles)) - tips
    ahead = _first([closing.mean(axis=0), *np.eye(3)], up)
    return np.array([np.cross(up, ahead), up, ahead])


def _first(vectors: list[Array], normal: Array) -> Array:
    """Return the unit direction across the normal of the first vector that is not along it."""
    across = (vector - (vector @ normal) * normal for vector in vectors)
    return next(
        vector / np.linalg.norm(vector) for vector in across if np.linalg.norm(vector) > 1e-6
    )
