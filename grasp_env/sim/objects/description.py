"""Description of the object: shape, size, mass, inertia and friction."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grasp_env import core
from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs.arguments import Array, as_array, warn
from grasp_env.inputs.files import as_path
from grasp_env.inputs.ranges import Range
from grasp_env.settings import POSITIVE, Kind, Settings, one_of, placed, real, setting
from grasp_env.sim.hand.check import numbers
from grasp_env.sim.mesh_shape import scale_advice
from grasp_env.sim.objects.mesh import Mesh, load_mesh

SMALLEST, LARGEST = 0.001, 1.0  # smallest and largest extent of an object along each axis [m]
GRASPABLE = 0.4  # largest extent of an object for which a scale is suggested [m]
OBJECT_COLOR = (0.86, 0.80, 0.68)  # in pictures: red, green and blue in [0, 1]
SIZES = {
    "cuboid": ("x", "y", "z"),
    "cylinder": ("diameter", "height"),
    "sphere": ("diameter",),
    "capsule": ("diameter", "total length"),
    "mesh": ("scale",),
}
"""Dimensions in the size of each shape."""
SHAPES = tuple(SIZES)
SHAPES_WITHOUT_MESH = tuple(shape for shape in SHAPES if shape != "mesh")
_DEFAULTS = {
    "cuboid": (0.1,) * 3,
    "cylinder": (0.1,) * 2,
    "sphere": (0.1,),
    "capsule": (0.07, 0.1),
    "mesh": (1.0,),
}
_DEFAULT_MASS = 0.2  # [kg]
_MAX_MASS, _MAX_FRICTION = 1000.0, 10.0  # [kg], [1]; more is a mistake of units


def _numbers(value: Any, name: str) -> tuple[float, ...]:
    array = np.atleast_1d(as_array(() if value is None else value, None, name))
    return numbers(array, None, name) if array.size else ()


def _moments(value: Any, name: str) -> tuple[float, ...] | None:
    """Return principal moments of inertia that a rigid body can have; None for an empty value."""
    if not _numbers(value, name):
        return None
    moments = numbers(value, 3, name)
    if min(moments) <= 0.0 or max(moments) > (1.0 + 1e-9) * (sum(moments) - max(moments)):
        raise InvalidInputError(
            f"{name}={moments} must be above 0, and none above the sum of the other two: give the moments about x, y and z through the "
            "centre of mass"
        )
    return moments


@dataclass(frozen=True)
class ObjectDescription(Settings):
    """A rigid object. The origin of its body frame is the centre of mass.

    Raises:
        UnknownNameError: No such shape.
        InvalidInputError: A size, mass, friction, inertia or file is not allowed.

    Example:
        >>> can = ObjectDescription("cylinder", (0.066, 0.115), mass=0.35)
        >>> can.extent
        (0.066, 0.115, 0.066)
        >>> point, normal, distance = can.surface.nearest(np.array([0.0, 0.0, 0.05]))
        >>> point, round(distance, 3)
        (array([0.   , 0.   , 0.033]), 0.017)
    """

    shape: str = setting(
        "cuboid", one_of(SHAPES), "Shape; the axis of cylinder and capsule is y.", random=True
    )
    size: tuple[float, ...] = setting(
        (),
        Kind(_numbers, "0.001 to 1 each way"),
        "Cuboid: sides x, y, z. Cylinder: diameter, height. Sphere: diameter. Capsule: diameter, total length. Mesh: factor from its "
        "coordinates to metres, 0.001 for a file in millimetres. (): 0.1 m along each axis (capsule: 0.07 m thick), 1 for a mesh.",
        unit="m",
        random=True,
    )
    mass: float = setting(
        _DEFAULT_MASS, real(Range(1e-9, _MAX_MASS)), "Mass.", unit="kg", random=True
    )
    friction: float = setting(
        0.4,
        real(Range(1e-9, _MAX_FRICTION)),
        "Coefficient of Coulomb friction; it is multiplied by the fingertips'.",
        random=True,
    )
    inertia: tuple[float, ...] | None = setting(
        None,
        Kind(_moments, "3 numbers"),
        "Moments of inertia about the body axes through the centre of mass.",
        unit="kg m^2",
        none="those of the solid of uniform density",
    )
    mesh: str | None = setting(
        None,
        Kind(lambda value, name: str(as_path(value, InvalidInputError, name)), "path"),
        'Path of a mesh (.obj, .stl, .ply, .off, .glb, .dae) of up to 200,000 faces in shape "mesh", convex or not; its axes become the '
        "principal axes of inertia nearest to those of the file, its origin the centre of mass.",
        none="the other shapes have none",
    )
    torsional_friction: float = setting(
        0.0,
        real(Range(0.0, LARGEST)),
        "Largest friction moment about a contact's normal over the normal force; it is multiplied by the fingertips' friction. Soft fingertips "
        "have a few millimetres, and two of them can hold an object. All methods then solve for forces by Newton within all limits.",
        unit="m",
    )

    @classmethod
    def from_mesh(
        cls,
        path: str | os.PathLike[str],
        scale: float = 1.0,
        *,
        density: float | None = None,
        **settings: Any,
    ) -> ObjectDescription:
        """Make an object from a mesh file, convex or not.

        Contact points, normals, mass and inertia are those of the mesh. It is also cut into convex
        pieces, which takes seconds and at most two minutes. They serve for distances to links and
        for collisions, unless Bullet's `mesh_contacts` is "faces". The user's cache folder keeps
        them; `grasp object list` and `grasp object clear` show and empty it. A mesh that is not
        closed is repaired if possible, with a warning that lists the changes.

        Args:
            path: Path of an .obj, .stl, .ply, .off, .glb or .dae of up to 200,000 faces.
            scale: Factor from its coordinates to metres, 0.001 for a file in millimetres.
            density: Density [kg/m^3]; None to use `mass`, or 0.2 kg with a warning.
            settings: Other fields, such as `friction`.

        Raises:
            InvalidInputError: It is not a mesh, cannot be closed, or is too large or too small; the
                message says what to do.

        Example:
            >>> import tempfile, trimesh
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     path = trimesh.creation.box((60, 40, 20)).export(f"{folder}/box.stl") and f"{folder}/box.stl"
            ...     box = ObjectDescription.from_mesh(path, scale=0.001, density=1000.0)
            >>> round(box.mass, 6), [round(side, 6) for side in box.extent]
            (0.048, [0.06, 0.04, 0.02])
        """
        factor = real(POSITIVE).take(scale, "scale")
        file = str(as_path(path, InvalidInputError, "path"))
        settings = {"shape": "mesh", "mesh": file, "size": (factor,), **settings}
        if density is not None:
            if "mass" in settings:
                raise InvalidInputError(
                    "give mass or density, not both: each follows from the other"
                )
            volume = load_mesh(settings["mesh"], factor, tell=False).volume
            settings["mass"] = real(POSITIVE).take(density, "density") * volume
        elif "mass" not in settings:
            warn(
                f"mesh={file!r}: neither mass nor density is given, {_DEFAULT_MASS:g} kg is assumed; give mass= [kg] or density= [kg/m^3]"
            )
        return cls(**settings)

    def agree(self) -> None:
        """Check that shape, size and mesh agree."""
        if (self.shape == "mesh") != (self.mesh is not None):
            raise InvalidInputError(
                f"{placed('shape')}={self.shape!r} with mesh={shown(self.mesh)}: shape 'mesh' needs the path of a mesh file, "
                "and other shapes take mesh=None"
            )
        name = f"{placed('size')} of a {self.shape} ({', '.join(SIZES[self.shape])})"
        size = numbers(self.size or _DEFAULTS[self.shape], len(SIZES[self.shape]), name)
        object.__setattr__(self, "size", size)
        if min(self.size) <= 0.0:
            raise InvalidInputError(f"{name} must be above 0, got {self.size}")
        if self.shape == "capsule" and self.size[1] < self.size[0]:
            raise InvalidInputError(
                f"{placed('size')}={self.size} of a capsule: its total length must be at least its diameter; "
                "exchange them or use a cylinder"
            )
        hint = "sizes are in metres"
        if self.mesh is not None:
            name = "scale= of `from_mesh` and size= are its factor to metres"
            fitting = scale_advice(max(self.extent) / self.size[0], GRASPABLE)
            hint = f"{name}: {fitting}" if fitting else f"{name}, choose another"
        check_extent(self.extent, self.shape, hint)

    def replaced(self, changes: Mapping[str, Any], path: str = "") -> ObjectDescription:
        """Return a copy with some settings replaced.

        Another shape gets its default size and no mesh, unless `changes` contains them.

        Args:
            changes: Settings by name.
            path: Path of the object's settings, for messages.
        """
        if changes.get("shape") not in (None, self.shape):
            changes = {"size": (), "mesh": None, **changes}
        return super().replaced(changes, path)

    @property
    def extent(self) -> tuple[float, float, float]:
        """Sides of the bounding box along the body axes [m]."""
        if self._mesh is not None:
            return self._mesh.extent
        if self.shape == "cuboid":
            x, y, z = self.size
            return x, y, z
        return self.size[0], self.size[-1], self.size[0]

    @cached_property
    def surface(self) -> core.Surface:
        """Surface of the object, which finds nearest points."""
        if self._mesh is not None:
            return core.Surface.mesh(
                self._mesh.vertices, self._mesh.faces.astype(float), list(self._mesh.pieces)
            )
        half = np.zeros(3)
        half[: len(self.size)] = 0.5 * np.array(self.size)
        if self.shape == "capsule":
            half[1] -= half[0]
        return core.Surface.make(self.shape, half)

    @cached_property
    def moments(self) -> tuple[float, float, float]:
        """Moments of inertia about the body axes, which are principal axes [kg m^2]."""
        if self.inertia is not None:
            x, y, z = self.inertia
        elif self._mesh is not None:
            x, y, z = (self.mass * self._mesh.gyration).tolist()
        else:
            x, y, z = (self.mass * radius for radius in _solid_gyration(self.shape, self.size))
        return x, y, z

    @cached_property
    def inertia_matrix(self) -> Array:
        """Inertia about the centre of mass [kg m^2], (3, 3), body axes."""
        return np.diag(self.moments)

    @cached_property
    def _mesh(self) -> Mesh | None:
        return None if self.mesh is None else load_mesh(self.mesh, self.size[0])

    @property
    def faces(self) -> tuple[Array, NDArray[np.int64]]:
        """Corners (V, 3) [m] and faces (F, 3) of a mesh, body frame, counterclockwise from outside.

        Raises:
            InvalidInputError: The shape is not a mesh.
        """
        return self._required_mesh.vertices, self._required_mesh.faces

    @property
    def pieces(self) -> tuple[Array, ...]:
        """Corners (K, 3) [m] of convex pieces that cover a mesh, body frame; raises as `faces`."""
        return self._required_mesh.pieces

    @property
    def has_coarse_pieces(self) -> bool:
        """True if the pieces of a mesh stand out too far for collisions."""
        return self._mesh is not None and self._mesh.coarse

    @property
    def _required_mesh(self) -> Mesh:
        if self._mesh is None:
            raise InvalidInputError(f"a {self.shape} has no faces; only shape 'mesh' has")
        return self._mesh

    def __getstate__(self) -> dict[str, object]:
        """Return the state without surface and mesh, which a copy makes anew."""
        return {
            name: value for name, value in self.__dict__.items() if name not in ("surface", "_mesh")
        }


def sides_text(extent: Sequence[float]) -> str:
    """Return sides [m] as "0.1 x 0.2 x 0.3 m"."""
    return f"{' x '.join(f'{side:.3g}' for side in extent)} m"


def check_extent(extent: Sequence[float], shape: str, hint: str) -> None:
    """Raise unless sides [m] are allowed; the hint says what to change."""
    if not (min(extent) >= SMALLEST and max(extent) <= LARGEST):
        raise InvalidInputError(
            f"the {shape} measures {sides_text(extent)}, allowed are {SMALLEST:g} to {LARGEST:g} m each way; "
            f"{hint}"
        )


def _solid_gyration(shape: str, size: tuple[float, ...]) -> tuple[float, float, float]:
    """Return the squared radii of gyration of a uniform solid about its axes [m^2]."""
    if shape == "cuboid":
        x, y, z = (side * side / 12.0 for side in size)
        return y + z, x + z, x + y
    radius = 0.5 * size[0]
    length = size[-1]
    square = radius * radius
    if shape == "sphere":
        return 0.4 * square, 0.4 * square, 0.4 * square
    if shape == "cylinder":
        across = 0.25 * square + length * length / 12.0
        return across, 0.5 * square, across
    straight = length - 2.0 * radius
    ends = 4.0 / 3.0 * radius / (straight + 4.0 / 3.0 * radius)  # share of the volume
    rod = 1.0 - ends
    along = rod * 0.5 * square + ends * 0.4 * square
    # a half ball's centre of mass is 3/8 of its radius from its flat side
    across = rod * (0.25 * square + straight**2 / 12.0)
    across += ends * (0.4 * square + 0.25 * straight**2 + 0.375 * straight * radius)
    return across, along, across
