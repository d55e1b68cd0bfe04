"""What a simulated grasp consists of, as one frozen record."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand import HandDescription, Vector3

_CUBOID_POINTS: tuple[Vector3, ...] = (
    (0.0, 0.0, -0.05), (0.0, 0.03, 0.05), (-0.03, -0.02, 0.05), (0.03, -0.02, 0.05),
)  # fmt: skip
_CUBOID_NORMALS: tuple[Vector3, ...] = (
    (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, 0.0, -1.0), (0.0, 0.0, -1.0),
)  # fmt: skip

_OVERLAP = 1e-5  # [m] by which Bullet lets bodies in contact overlap; starting there, nothing jumps


@dataclass(frozen=True)
class SceneConfig:
    """A hand around a cuboid; the object's nominal frame is the world frame.

    Attributes:
        hand: The hand; its fingers are in the order of the contacts.
        contact_points: Nominal contacts [m], (N, 3), object frame, on the cuboid's surface.
        contact_normals: Inward unit normals there, (N, 3), object frame.
        half_extents: Half of the cuboid's sides [m].
        object_mass: [kg].
        friction: Coefficient between tips and object.
        gravity: Acceleration [m/s^2], world frame; y points up, away from the object to the palm.
        physics_rate: Steps per simulated second [Hz].
        solver_iterations: Most sweeps of Bullet's contact solver in one step.
        clearance: Gap between tips and object at the start [m]; 0 lets them touch.
    """

    hand: HandDescription = field(default_factory=HandDescription.four_finger)
    contact_points: tuple[Vector3, ...] = _CUBOID_POINTS
    contact_normals: tuple[Vector3, ...] = _CUBOID_NORMALS
    half_extents: Vector3 = (0.05, 0.05, 0.05)
    object_mass: float = 0.2
    friction: float = 0.4
    gravity: Vector3 = (0.0, -9.81, 0.0)
    physics_rate: float = 500.0
    solver_iterations: int = 20
    clearance: float = 0.0

    def __post_init__(self) -> None:
        for name in ("object_mass", "friction", "physics_rate", "solver_iterations"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InvalidInputError(f"{name}={value} must be finite and above 0")
        if len(self.gravity) != 3 or not np.isfinite([*self.gravity, self.clearance]).all():
            raise InvalidInputError(
                f"gravity={self.gravity} must be three finite numbers, clearance={self.clearance} one"
            )
        if len(self.half_extents) != 3 or not min(self.half_extents) > 0:
            raise InvalidInputError(f"half_extents={self.half_extents} must be three lengths > 0")
        shape = (len(self.hand.fingers), 3)
        points, normals = np.array(self.contact_points), np.array(self.contact_normals)
        if points.shape != shape or normals.shape != shape:
            raise InvalidInputError(
                f"contact_points of shape {points.shape} and contact_normals of shape "
                f"{normals.shape} must both be {shape}, one row per finger of the hand"
            )
        if not np.allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9):
            raise InvalidInputError(f"contact_normals={normals.tolist()} must have length 1; normalise them")
        outside = np.abs(np.abs(points) / self.half_extents).max(axis=1) - 1.0
        if np.abs(outside).max() > 1e-6:
            raise InvalidInputError(
                f"contact_points={points.tolist()} must lie on the surface of the cuboid with "
                f"half_extents={self.half_extents}; move them onto a face"
            )

    @property
    def weight(self) -> np.ndarray:
        """Gravity's force on the object [N], (3,), world frame."""
        return self.object_mass * np.array(self.gravity)

    def nominal_tips(self) -> np.ndarray:
        """Centres of the tips at the start [m], (N, 3), world frame: resting on the object.

        They overlap it by 10 um as all contacts of Bullet do: started at distance zero the object
        falls and slips for a step, 0.2 mm at 500 Hz.
        """
        away = self.hand.tip_radius - _OVERLAP + self.clearance
        return np.array(self.contact_points) - away * np.array(self.contact_normals)
