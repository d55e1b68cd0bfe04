"""The record of a hand's grasp of an object: the place of the palm, contacts and postures."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env.errors import GraspError, GraspFileError, shown
from grasp_env.grasp.files import of_plain, read_plain, to_plain, write_plain
from grasp_env.grasp.grasp import Grasp
from grasp_env.inputs.arguments import Array, as_array
from grasp_env.sim.grasping.points import GraspPlan
from grasp_env.sim.hand.check import Vector3, numbers
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.plain import hand_of, hand_to_plain
from grasp_env.sim.objects.description import ObjectDescription

_ARRAYS = ("position", "rotation", "angles", "start")


@dataclass(frozen=True, eq=False)
class HandGrasp:
    """A hand's grasp of an object, whose body frame is the world frame; N fingers, M joints.

    `place_hand` makes it, an environment keeps it as `env.unwrapped.grasp`, and `save` writes it.

    Attributes:
        hand: The hand at its place, with its rest posture and the fingers that touch.
        position: Position of the palm's frame [m], (3,), world frame.
        rotation: Roll, pitch and yaw of the palm's frame [rad], (3,).
        points: Contacts [m], (N, 3), object frame, in the order of the fingers.
        normals: Inward unit normals at the contacts, (N, 3).
        angles: Joint angles at the contacts [rad], (M,).
        start: Joint angles before the fingers close [rad], (M,), with every tip 3 mm from the
            object.
        friction: Coefficient of friction between object and fingertips.
        torsional_friction: Torsional friction of soft contacts [m]; 0 for hard ones.
        force: Total normal force in the worst case [N], as in `GraspPlan`.
        clearance: Clearance of the links from the object [m].

    Example:
        >>> from grasp_env.sim import place_hand
        >>> ball = ObjectDescription("sphere", (0.06,), mass=0.15, friction=0.7)
        >>> grasp = place_hand(HandDescription.three_finger(), ball)
        >>> grasp.hand.finger_names, grasp.points.shape, grasp.start.shape
        (('thumb', 'left', 'right'), (3, 3), (9,))
        >>> grasp.contacts().friction
        array([0.7, 0.7, 0.7])
    """

    hand: HandDescription
    position: Vector3
    rotation: Vector3
    points: Array
    normals: Array
    angles: Array
    start: Array
    friction: float
    torsional_friction: float = 0.0
    force: float = np.inf
    clearance: float = 0.0

    @staticmethod
    def of_plan(
        hand: HandDescription,
        item: ObjectDescription,
        plan: GraspPlan,
        position: Vector3 = (0.0, 0.0, 0.0),
        rotation: Vector3 = (0.0, 0.0, 0.0),
    ) -> HandGrasp:
        """Return the record of a plan.

        Args:
            hand: The hand at its place.
            item: The object.
            plan: The contacts and postures.
            position: Place to which the palm's frame was moved [m], (3,).
            rotation: Roll, pitch and yaw by which it was turned [rad], (3,).
        """
        return HandGrasp(
            hand,
            position,
            rotation,
            **vars(plan),
            friction=item.friction * hand.tip_friction,
            torsional_friction=item.torsional_friction * hand.tip_friction,
        )

    def contacts(self) -> Grasp:
        """Return the contacts as the grasp that `optimize_force` takes, object frame."""
        if self.torsional_friction > 0.0:
            soft = {"contact_model": "soft", "torsional_friction": self.torsional_friction}
            return Grasp.from_contacts(self.points, self.normals, self.friction, **soft)
        return Grasp.from_contacts(self.points, self.normals, self.friction)

    def to_dict(self) -> dict[str, Any]:
        """Return the record as JSON values: a grasp file's, and the hand."""
        more = {
            "description": hand_to_plain(self.hand),
            **{name: np.asarray(getattr(self, name)).tolist() for name in _ARRAYS},
            "force": self.force if np.isfinite(self.force) else None,
            "clearance": self.clearance,
        }
        return {**to_plain(self.contacts()), "hand": more}

    def save(self, path: str | Path) -> Path:
        """Write the record as JSON and return the path.

        It is a grasp file with one more key: `load_grasp`, `grasp solve --grasp` and `grasp fit
        --grasp` read it, too.

        Args:
            path: Path of the file. Missing folders are made.

        Raises:
            GraspFileError: the file cannot be written.
        """
        return write_plain(self.to_dict(), path)

    @staticmethod
    def load(path: str | Path) -> HandGrasp:
        """Read a record that `save` wrote.

        Args:
            path: Path of the file.

        Raises:
            GraspFileError: the file is no such record; the message says why.

        Example:
            >>> import tempfile
            >>> from grasp_env.sim import place_hand
            >>> ball = ObjectDescription("sphere", (0.06,), mass=0.15, friction=0.7)
            >>> grasp = place_hand(HandDescription.three_finger(), ball)
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     HandGrasp.load(grasp.save(f"{folder}/grasp.json")) == grasp
            True
        """
        return hand_grasp_of(*read_plain(path))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, HandGrasp) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def _key(self) -> tuple[Any, ...]:
        values = (getattr(self, item.name) for item in fields(self))
        return tuple(
            value.tobytes() if isinstance(value, np.ndarray) else value for value in values
        )


def hand_grasp_of(values: Any, name: str) -> HandGrasp:
    """Return the record in a dict, as from `HandGrasp.to_dict`; `name` is its name in messages.

    Raises:
        GraspFileError: it is no such dict; the message says why.
    """
    contacts = of_plain(values, name)
    more = values.get("hand")
    if more is None:
        raise GraspFileError(
            f"{name} has contacts, but no hand: give a file that HandGrasp.save wrote"
        )
    if not isinstance(more, dict):
        raise GraspFileError(
            f"{name}: hand must be an object {{...}} that HandGrasp.save wrote, got {shown(more)}"
        )
    missing = [key for key in ("description", *_ARRAYS, "force", "clearance") if key not in more]
    if missing:
        raise GraspFileError(
            f"{name}, hand: the keys {missing} are missing; write it by HandGrasp.save"
        )
    try:
        return _from_plain(contacts, more)
    except GraspError as error:
        raise GraspFileError(f"{name}, hand: {error}") from error


def _from_plain(contacts: Grasp, values: dict[str, Any]) -> HandGrasp:
    hand = hand_of(values["description"], "description")
    x, y, z = numbers(values["position"], 3, "position [m]")
    roll, pitch, yaw = numbers(values["rotation"], 3, "rotation [rad]")
    angles, start = (
        as_array(values[name], (hand.joint_count,), f"{name} [rad]") for name in ("angles", "start")
    )
    as_array(contacts.positions, (hand.finger_count, 3), "positions, one for each finger")
    models = contacts.models
    force = np.inf if values["force"] is None else float(as_array(values["force"], (), "force"))
    return HandGrasp(
        hand,
        (x, y, z),
        (roll, pitch, yaw),
        contacts.positions,
        contacts.normals,
        angles,
        start,
        float(models.friction[0, 0]),
        float(models.torsional_friction[0]) if "soft" in models.names else 0.0,
        force,
        float(as_array(values["clearance"], (), "clearance")),
    )


def fingerprint(hand: HandDescription, item: ObjectDescription) -> bytes:
    """Return bytes that differ if a grasp of the object by the hand may differ."""
    values = hand_to_plain(hand.without_visuals())
    solid = item.faces[0].tobytes() + item.faces[1].tobytes() if item.mesh else b""
    numbers_of = (
        item.shape,
        item.size,
        item.mass,
        item.friction,
        item.torsional_friction,
    )
    return json.dumps([values, numbers_of]).encode() + solid
