"""What the hand holds: shape, size, mass, inertia and friction, as one frozen record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from grasp_env import core
from grasp_env._check import Array, as_array, choice
from grasp_env._files import as_path
from grasp_env.errors import InvalidInputError, UnknownNameError, shown
from grasp_env.sim.hand.check import numbers, positive
from grasp_env.sim.objects.mesh import Mesh, load_mesh

SMALLEST, LARGEST = 0.001, 1.0
"""[m] that an object measures along each axis."""

OBJECT_COLOR = (0.86, 0.80, 0.68)
"""Red, green and blue of objects in pictures."""

_SIZES = {
    "cuboid": ("x", "y", "z"),
    "cylinder": ("diameter", "height"),
    "sphere": ("diameter",),
    "capsule": ("diameter", "total length"),
    "mesh": ("scale",),
}
SHAPES = tuple(_SIZES)
SHAPES_WITHOUT_MESH = tuple(shape for shape in SHAPES if shape != "mesh")
_DEFAULTS = {
    "cuboid": (0.1, 0.1, 0.1),
    "cylinder": (0.1, 0.1),
    "sphere": (0.1,),
    "capsule": (0.07, 0.1),
    "mesh": (1.0,),
}
_MOST_MASS, _MOST_FRICTION = 1000.0, 10.0  # [kg], [1]; more is a mistake in the units


@dataclass(frozen=True)
class ObjectDescription:
    """A rigid, convex object. The body frame has its origin in the centre of mass.

    Attributes:
        shape: "cuboid", "cylinder", "sphere", "capsule" or "mesh"; the axis of cylinder and capsule is y.
        size: [m]. Cuboid: sides x, y, z. Cylinder: diameter, height. Sphere: diameter. Capsule: diameter, total length.
            Mesh: what its coordinates are multiplied by to give metres, 0.001 for a file in millimetres.
            () is 0.1 m each way (capsule: 0.07 m thick), and 1 for a mesh.
        mass: [kg].
        friction: Coefficient of Coulomb friction; it is multiplied by the fingertips'.
        torsional_friction: [m] Moment about a contact's normal that friction holds per newton of normal force, of a soft
            fingertip; also multiplied by the fingertips' friction. 0: hard contacts.
        inertia: Moments about the body's axes through the centre of mass [kg m^2], (3,); () or None is that of the
            solid of uniform density.
        mesh: Path of a closed convex mesh (.obj, .stl, .ply, .off) in shape "mesh". Its axes become the principal axes
            of inertia nearest to those of the file, its origin the centre of mass.

    Raises:
        UnknownNameError: No such shape.
        InvalidInputError: A size, mass, friction, inertia or file that no object here has; the message says why.

    Example:
        >>> can = ObjectDescription("cylinder", (0.066, 0.115), mass=0.35)
        >>> can.extent
        (0.066, 0.115, 0.066)
        >>> point, normal, distance = can.surface.nearest(np.array([0.0, 0.0, 0.05]))
        >>> point, round(distance, 3)
        (array([0.   , 0.   , 0.033]), 0.017)
    """

    shape: str = "cuboid"
    size: tuple[float, ...] = ()
    mass: float = 0.2
    friction: float = 0.4
    inertia: tuple[float, ...] | None = None
    mesh: str | None = None
    torsional_friction: float = 0.0

    def __post_init__(self) -> None:
        choice(self.shape, "shape", SHAPES)
        if (self.shape == "mesh") != (self.mesh is not None):
            raise InvalidInputError(
                f"shape={self.shape!r} with mesh={shown(self.mesh)}: shape 'mesh' needs the path of a mesh file, "
                "and other shapes take mesh=None"
            )
        given = np.atleast_1d(as_array(self.size, None, "size [m]"))
        size = numbers(given, None, "size [m]") if given.size else _DEFAULTS[self.shape]
        self._set(
            size=numbers(size, len(_SIZES[self.shape]), f"size of a {self.shape} ({', '.join(_SIZES[self.shape])})"),
            mass=_at_most(positive(self.mass, "mass [kg]"), _MOST_MASS, "mass [kg]"),
            friction=_at_most(positive(self.friction, "friction"), _MOST_FRICTION, "friction"),
            torsional_friction=_torsional(self.torsional_friction),
            mesh=None if self.mesh is None else str(as_path(self.mesh, InvalidInputError, "mesh")),
        )
        if min(self.size) <= 0.0:
            raise InvalidInputError(f"size={self.size} of a {self.shape} must be above 0")
        if self.shape == "capsule" and self.size[1] < self.size[0]:
            raise InvalidInputError(
                f"size={self.size} of a capsule: its total length must be at least its diameter; "
                "exchange them or use a cylinder"
            )
        if not (min(self.extent) >= SMALLEST and max(self.extent) <= LARGEST):
            hint = "; give the scale of the file in size=(0.001,) if it is in millimetres" if self.mesh else ""
            raise InvalidInputError(
                f"the {self.shape} measures {' x '.join(f'{side:.3g}' for side in self.extent)} m, allowed are "
                f"{SMALLEST:g} to {LARGEST:g} m each way; sizes are in metres{hint}"
            )
        if self.inertia is not None:
            given = as_array(self.inertia, None, "inertia [kg m^2]")
            self._set(inertia=_moments(given.tolist()) if given.size else None)

    @property
    def extent(self) -> tuple[float, float, float]:
        """Sides of the bounding box along the body's axes [m]."""
        if self._mesh is not None:
            x, y, z = np.ptp(self._mesh.vertices, axis=0).tolist()
            return x, y, z
        if self.shape == "cuboid":
            x, y, z = self.size
            return x, y, z
        return self.size[0], self.size[-1], self.size[0]

    @cached_property
    def surface(self) -> core.Surface:
        """The nearest points of it."""
        numbers = np.zeros(3)
        if self._mesh is not None:
            return core.Surface.make(self.shape, numbers, self._mesh.triangles, self._mesh.normals)
        numbers[: len(self.size)] = 0.5 * np.array(self.size)
        if self.shape == "capsule":
            numbers[1] -= numbers[0]
        return core.Surface.make(self.shape, numbers, np.zeros((0, 3, 3)), np.zeros((0, 3)))

    @cached_property
    def moments(self) -> tuple[float, float, float]:
        """Moments of inertia about the body's axes, which are principal axes [kg m^2]."""
        if self.inertia is not None:
            x, y, z = self.inertia
            return x, y, z
        if self._mesh is not None:
            x, y, z = (self.mass * self._mesh.gyration).tolist()
            return x, y, z
        x, y, z = _solid_gyration(self.shape, self.size)
        return self.mass * x, self.mass * y, self.mass * z

    @cached_property
    def inertia_matrix(self) -> Array:
        """About the centre of mass [kg m^2], (3, 3), body axes; of the uniform solid unless `inertia` is given."""
        return np.diag(self.moments)

    @cached_property
    def _mesh(self) -> Mesh | None:
        return None if self.mesh is None else load_mesh(self.mesh, self.size[0])

    @property
    def faces(self) -> tuple[Array, NDArray[np.int64]]:
        """Corners (V, 3) [m] and faces (F, 3) of a mesh, body frame, from outside counterclockwise.

        Raises:
            InvalidInputError: Another shape.
        """
        return self._of_mesh.vertices, self._of_mesh.faces

    @property
    def face_normals(self) -> Array:
        """Outward unit normals of a mesh's faces, (F, 3); raises as `faces`."""
        return self._of_mesh.normals

    @property
    def _of_mesh(self) -> Mesh:
        if self._mesh is None:
            raise InvalidInputError(f"a {self.shape} has no faces; only shape 'mesh' has")
        return self._mesh

    def __getstate__(self) -> dict[str, object]:
        """All but the surface, which cannot be pickled and is made anew."""
        return {name: value for name, value in self.__dict__.items() if name != "surface"}

    def _set(self, **values: object) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)


def random_object(
    rng: np.random.Generator,
    size: tuple[float, float] = (0.07, 0.12),
    mass: tuple[float, float] = (0.05, 0.5),
    friction: tuple[float, float] = (0.3, 0.8),
    shapes: Sequence[str] = SHAPES_WITHOUT_MESH,
) -> ObjectDescription:
    """An object drawn uniformly; a capsule's smaller number is its diameter.

    The same number of draws for every shape, so that what follows does not depend on it.

    Args:
        rng: Generator.
        size: Least and largest side, diameter, height or length [m].
        mass: [kg].
        friction: Coefficients.
        shapes: To draw from.

    Raises:
        InvalidInputError: A range that is none, no shape, or "mesh".
        UnknownNameError: An unknown shape.

    Example:
        >>> random_object(np.random.default_rng(0), shapes=["sphere"]).size
        (0.1018...,)
    """
    shapes = (shapes,) if isinstance(shapes, str) else tuple(shapes)
    if not shapes:
        raise InvalidInputError(f"shapes=() is empty; name some of {', '.join(SHAPES_WITHOUT_MESH)}")
    for shape in shapes:
        if shape not in SHAPES_WITHOUT_MESH:
            raise UnknownNameError("random shape", shape, SHAPES_WITHOUT_MESH)
    (low, high), masses, frictions = _range(size, "size"), _range(mass, "mass"), _range(friction, "friction")
    shape = shapes[int(rng.integers(len(shapes)))]
    sides = rng.uniform(low, high, 3).tolist()[: len(_SIZES[shape])]
    if shape == "capsule":
        sides.sort()
    return ObjectDescription(shape, tuple(sides), float(rng.uniform(*masses)), float(rng.uniform(*frictions)))


def _range(values: tuple[float, float], name: str) -> tuple[float, float]:
    low, high = as_array(values, (2,), name).tolist()
    if not 0.0 < low <= high:
        raise InvalidInputError(f"{name}={values} must be (least, largest) with 0 < least <= largest")
    return low, high


def _torsional(value: object) -> float:
    (number,) = numbers((value,), 1, "torsional_friction [m]")
    if not 0.0 <= number <= LARGEST:
        raise InvalidInputError(
            f"torsional_friction={number} m must be 0 or up to {LARGEST:g}: a few millimetres are usual"
        )
    return number


def _at_most(value: float, limit: float, name: str) -> float:
    if value > limit:
        raise InvalidInputError(f"{name}={value} must be at most {limit:g}; check its unit")
    return value


def _moments(values: Sequence[float]) -> tuple[float, ...]:
    """Of a body that can exist."""
    given = numbers(values, 3, "inertia (moments about x, y and z) [kg m^2]")
    if min(given) <= 0.0 or max(given) > (1.0 + 1e-9) * (sum(given) - max(given)):
        raise InvalidInputError(
            f"inertia={given} kg m^2 must be above 0, and none above the sum of the other two: give the moments about "
            "x, y and z through the centre of mass"
        )
    return given


def _solid_gyration(shape: str, size: tuple[float, ...]) -> tuple[float, float, float]:
    """Squared radii of gyration of a uniform solid about its axes [m^2]."""
    if shape == "cuboid":
        x, y, z = (side * side / 12.0 for side in size)
        return y + z, x + z, x + y
    radius, length = 0.5 * size[0], size[-1]
    square = radius * radius
    if shape == "sphere":
        return 0.4 * square, 0.4 * square, 0.4 * square
    if shape == "cylinder":
        across = 0.25 * square + length * length / 12.0
        return across, 0.5 * square, across
    straight = length - 2.0 * radius
    ends = 4.0 / 3.0 * radius / (straight + 4.0 / 3.0 * radius)  # their share of the volume
    rod = 1.0 - ends
    along = rod * 0.5 * square + ends * 0.4 * square
    # a half ball's centre of mass is 3/8 of its radius from its flat side
    across = rod * (0.25 * square + straight**2 / 12.0)
    across += ends * (0.4 * square + 0.25 * straight**2 + 0.375 * straight * radius)
    return across, along, across
