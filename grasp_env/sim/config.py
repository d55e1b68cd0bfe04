"""Configuration of a simulated grasp."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import as_array, instance, whole
from grasp_env.sim.engine import EngineSettings, engine_of
from grasp_env.sim.hand.description import HandDescription, Vector3
from grasp_env.sim.objects.description import ObjectDescription

_CUBOID_POINTS: tuple[Vector3, ...] = (
    (0.0, 0.0, -0.05),
    (0.0, 0.03, 0.05),
    (-0.03, -0.02, 0.05),
    (0.03, -0.02, 0.05),
)
START_CLEARANCE = 0.003  # distance between tips and object before the fingers close [m]
ON_SURFACE = 1e-4  # largest distance of a contact point from the surface [m]


@dataclass(frozen=True)
class SceneConfig:
    """A hand around an object; the object's nominal frame is the world frame.

    Attributes:
        hand: The hand, with its fingers in the order of the contacts.
        object: The object that it holds.
        contact_points: Nominal contacts on the object's surface [m], (N, 3), object frame.
        gravity: Acceleration [m/s^2], world frame; y points up, away from the object to the palm.
        engine: Settings of the physics engine; see `engine_of` for the default.
        substeps: Steps of the engine in one step of the scene, with the same torques. Contact
            forces are their mean.
        clearance: Gap between tips and object at the start [m]; at 0 they touch.
        start_angles: Joint angles at the start [rad], (M,); () to put the tips at `nominal_tips`.

    Example:
        >>> SceneConfig(gravity=(0.0, 0.0, 0.0)).contact_normals[0]
        array([0., 0., 1.])
    """

    hand: HandDescription = field(default_factory=HandDescription.four_finger)
    object: ObjectDescription = field(default_factory=ObjectDescription)
    contact_points: tuple[Vector3, ...] = _CUBOID_POINTS
    gravity: Vector3 = (0.0, -9.81, 0.0)
    engine: EngineSettings = field(default_factory=engine_of)
    substeps: int = 1
    clearance: float = 0.0
    start_angles: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        instance(self.engine, EngineSettings, "engine")
        whole(self.substeps, "substeps", 1)
        object.__setattr__(self, "gravity", tuple(as_array(self.gravity, (3,), "gravity").tolist()))
        as_array(self.clearance, (), "clearance")
        if len(self.start_angles):
            name = "start_angles, one for each joint of the hand"
            angles = as_array(self.start_angles, (self.hand.joint_count,), name)
            object.__setattr__(self, "start_angles", tuple(angles.tolist()))
        name = "contact_points, one row per finger of the hand"
        points = as_array(self.contact_points, (self.hand.finger_count, 3), name)
        object.__setattr__(self, "contact_points", tuple(map(tuple, points.tolist())))
        gaps = np.array([self.object.surface.nearest(point)[2] for point in points])
        worst = int(np.abs(gaps).argmax())
        if np.abs(gaps[worst]) > ON_SURFACE:
            raise InvalidInputError(
                f"contact_points[{worst}]={points[worst].tolist()} must lie on the surface of the object "
                f"({self.object.shape}, size {self.object.size}), it is {gaps[worst] * 1e3:.2f} mm away: move it there"
            )

    @property
    def contact_normals(self) -> np.ndarray:
        """Inward unit normals at the contact points, (N, 3), object frame."""
        return np.array(
            [self.object.surface.nearest(point)[1] for point in np.array(self.contact_points)]
        )

    def nominal_tips(self) -> np.ndarray:
        """Return the centres of the tips at the start [m], (N, 3), world frame.

        Without clearance the tips overlap the object by `engine.overlap`. From distance zero the
        object would fall and slip for a step, by 0.2 mm at 500 Hz.
        """
        radii = np.array([tip.radius for tip in self.hand.fingertips])
        distances = radii + (self.clearance or -self.engine.overlap)
        return np.array(self.contact_points) - distances[:, None] * self.contact_normals
