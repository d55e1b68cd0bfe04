"""`Grasp`: contacts on an object and the linear maps between their forces and its wrench."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from grasp_env.core import ContactReader, Contacts
from grasp_env.errors import InvalidInputError, shown
from grasp_env.grasp.checks import (
    DEFAULT_TANGENTS,
    check_place,
    check_torsion,
    checked_points,
    checked_pseudoinverse,
    checked_tangents,
    normalise_normals,
    rank_of,
)
from grasp_env.grasp.contact_model import ContactModels
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import AllFaults, Array, ContactForces, Wrench, as_array

_READER = ContactReader(
    least_friction=ranges.FRICTION.low,
    most_friction=ranges.FRICTION.high,
    least_length=ranges.LENGTH.low,
    most_length=ranges.LENGTH.high,
    distance=ranges.DISTANCE,
    most=ranges.CONTACTS,
)


class _Lazy:
    """An attribute of a grasp that is computed at its first use."""

    def __init__(self, make: Callable[[Grasp], Any] | None) -> None:
        self._make = make

    def __set_name__(self, _: type, name: str) -> None:
        self._name = name

    def __get__(self, grasp: Grasp | None, _: type) -> Any:
        if grasp is None:
            return self
        value = self._make(grasp) if self._make else getattr(grasp.contacts, self._name)
        vars(grasp)[self._name] = value
        return value


def _lazy(make: Callable[[Grasp], Any] | None = None) -> Any:
    """Declare a lazy attribute, computed by `make` (None: read from the compiled contacts)."""
    return _Lazy(make)


@dataclass(frozen=True, eq=False, init=False)
class Grasp:
    """Contacts with friction on a rigid object. Make one with `Grasp.from_contacts`.

    Balance is G f + w = 0 (paper, Eq. 2), where w is the external wrench ON the object and f the
    stacked contact forces (normal, o, t) of the fingers ON the object. Soft contacts add a torsion
    about the normal.

    Attributes:
        positions: (N, 3) contact points [m], object frame.
        normals: (N, 3) inward unit normals, object frame.
        friction: (N,) Coulomb coefficients; sqrt(mu_o mu_t) for elliptic cones, 0 for frictionless
            contacts.
        frames: (N, 3, 3) columns (n, o, t) in object coordinates.
        matrix: G, (6, 3N), columns (normal, o, t) per contact.
        length: root mean square distance of the contacts from `centre` [m].
        centre: (3,) mean of the contact points [m], object frame.
        cone_matrix: (6, 3N) G in cone coordinates; cone_matrix @ grasp.to_cone(f) = matrix @ f.
        models: contact models with all friction and the scaling of cone coordinates.
        torsion_matrix: (6, N) wrenches of unit torsions; zero columns unless soft.
        unit_frame: (6, 6) matrix; unit_frame @ wrench = (force, moment about `centre` divided by
            `length`) [N]. These components depend neither on the origin nor on the unit of length.
    """

    positions: Array = field(default=_lazy())
    normals: Array = field(default=_lazy())
    friction: Array = field(default=_lazy(lambda grasp: grasp.models.mean_friction))
    frames: Array = field(default=_lazy(), repr=False)
    matrix: Array = field(default=_lazy(), repr=False)
    length: float = field(default=_lazy(), repr=False)
    centre: Array = field(default=_lazy(), repr=False)
    cone_matrix: Array = field(default=_lazy(), repr=False)
    models: ContactModels = field(default=_lazy(lambda grasp: grasp._plain_models()), repr=False)
    torsion_matrix: Array = field(default=_lazy(), repr=False)
    unit_frame: Array = field(default=_lazy(), repr=False)

    def __init__(self, *_: object, **__: object) -> None:
        # only `_from_compiled` fills the arrays, since contradictory ones would give wrong forces
        raise InvalidInputError(
            "use Grasp.from_contacts(...) to make a Grasp, or grasp.with_friction(...) to change its friction"
        )

    @classmethod
    def from_contacts(
        cls,
        positions: ArrayLike,
        normals: ArrayLike,
        friction: ArrayLike,
        *,
        contact_model: str | Sequence[str] = "hard",
        torsional_friction: ArrayLike | None = None,
        tangents: ArrayLike | None = None,
    ) -> Grasp:
        """Make a grasp from contact geometry.

        Args:
            positions: (N, 3) contact points [m], object frame.
            normals: (N, 3) unit normals pointing INTO the object, object frame; lengths within 1 %
                of one are made exact.
            friction: coefficient(s): a scalar, (N,), or (N, 2) for elliptic cones (mu_o, mu_t).
                Ignored for frictionless contacts.
            contact_model: "hard", "soft" or "frictionless", one for all or N names; see
                `contact_model.py`.
            torsional_friction: gamma [m], the largest torsion over the normal force; a scalar or
                (N,); for soft contacts only. Tangential force lowers it, see
                `grasp_env.grasp.contact_model`. 0 makes a hard contact.
            tangents: (N, 3) directions; o is their normalised projection on the tangent plane.
                None: the rule of `contact_frames`.

        Raises:
            InvalidInputError: wrong shapes, values that are not finite, normals of another length,
                a tangent along its normal, soft contacts without torsional friction, no contact, or
                numbers, sizes and distances beyond `grasp_env/inputs/ranges.py`.
            UnknownNameError: unknown contact model.

        Example:
            >>> from grasp_env.grasp import presets
            >>> g = presets.paper_cuboid()
            >>> Grasp.from_contacts(g.positions, g.normals, 0.4).matrix.shape
            (6, 12)
            >>> pinch = Grasp.from_contacts(
            ...     [[0, 0, -0.02], [0, 0, 0.02]], [[0, 0, 1], [0, 0, -1]], 0.5, contact_model="soft", torsional_friction=0.005
            ... )
            >>> pinch.torsion_matrix[5]
            array([ 1., -1.])
        """
        if torsional_friction is None and type(contact_model) is str and contact_model == "hard":
            contacts = _READER.read(positions, normals, friction, tangents)
            if contacts is not None:
                return cls._from_compiled(
                    contacts, _friction=friction if type(friction) is float else np.array(friction)
                )
        with AllFaults() as check:
            points = check(checked_points, positions)
            count = None if points is None else len(points)
            inward = check(as_array, normals, (count, 3), "normals")
            settings = contact_model, friction, torsional_friction
            models: Any = None if count is None else check(ContactModels.checked, *settings, count)
        normalise_normals(inward)
        grasp = cls._from_arrays(points, inward, models, checked_tangents(tangents, inward))
        if torsional_friction is not None:
            check_torsion(models.torsional_friction, grasp.length)
        return grasp

    @classmethod
    def unchecked(
        cls, positions: Array, normals: Array, models: ContactModels, tangents: Array | None = None
    ) -> Grasp:
        """Make the same grasp as `from_contacts`, to the last bit, from trusted arguments.

        `positions`, `normals` and `tangents` are (N, 3). Not checked are the number of contacts,
        the models, tangents that are nearly along a normal, and torsional friction against the
        grasp's length.

        Raises:
            InvalidInputError: see `from_contacts`; arrays of another type than float64.
        """
        try:
            along = DEFAULT_TANGENTS if tangents is None else np.ascontiguousarray(tangents)
            return cls._from_arrays(
                np.ascontiguousarray(positions), np.ascontiguousarray(normals), models, along
            )
        except (AttributeError, TypeError) as error:
            raise InvalidInputError(
                f"positions, normals and tangents must be C-contiguous float64 arrays (N, 3) and models those of N contacts: {error}; "
                "Grasp.from_contacts takes anything"
            ) from None

    @classmethod
    def _from_arrays(
        cls, positions: Array, normals: Array, models: ContactModels, tangents: Array
    ) -> Grasp:
        contacts = Contacts.put(
            positions, normals, models.cone_scale, models.torsional_friction, tangents
        )
        grasp = cls._from_compiled(contacts, models=models)
        check_place(contacts.count, contacts.length, contacts.centre)
        if contacts.refused:  # the core has not placed them
            raise InvalidInputError(
                "positions must be finite and normals finite and of unit length"
            )
        if contacts.rank == 0:
            raise InvalidInputError("tangents must be finite and not along normals")
        return grasp

    @classmethod
    def _from_compiled(cls, contacts: Contacts, **known: Any) -> Grasp:
        grasp = object.__new__(cls)
        vars(grasp).update(known, _contacts=contacts)
        return grasp

    def _plain_models(self) -> ContactModels:
        return ContactModels.checked("hard", vars(self)["_friction"], None, self.n_contacts)

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("positions", "normals", "models")} | {
            "tangents": self.contacts.tangents
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(vars(self.unchecked(**state)))

    @cached_property
    def pseudoinverse(self) -> Array:
        """G^+, (3N, 6): least-norm forces for unit wrenches, with the torsions of soft contacts.

        Raises:
            RankDeficientGraspError: the rank is below 6.
        """
        models = self.models
        rough = "frictionless" not in models.names
        transmitted = self.matrix if rough else self.matrix * models.transmitted.reshape(-1)
        if models.torsional_friction.any():
            transmitted = np.concatenate([transmitted, self.torsion_matrix], axis=1)
        inverse = checked_pseudoinverse(transmitted, self.unit_frame, self.n_contacts)[
            : 3 * self.n_contacts
        ]
        inverse.setflags(write=False)
        return inverse

    @property
    def contacts(self) -> Contacts:
        """The compiled contacts, the input of every solver."""
        return vars(self)["_contacts"]

    @property
    def rank(self) -> int:
        """Rank of G with soft torsions; 6 if the contacts can balance wrenches of every direction.

        Hard contacts on one line have rank 5: no force of theirs turns the object about it.
        """
        return self.contacts.rank

    def within_reach(self, wrench: Wrench) -> Wrench:
        """Return a wrench (6,) [N, N m] without its part that no contact forces make.

        With `rank` 6 nothing is left out. What is left out is orthogonal to the rest in the
        components of `unit_frame`.

        Example:
            >>> pinch = Grasp.from_contacts([[0, 0.03, 0], [0, -0.03, 0]], [[0, -1, 0], [0, 1, 0]], 0.8)
            >>> pinch.rank, pinch.within_reach([0, 0, -1, 0, 0.01, 0.02])      # hard contacts do not resist the moment about y
            (5, array([ 0.  ,  0.  , -1.  ,  0.  ,  0.  ,  0.02]))
        """
        balanced = np.empty(6)
        self.contacts.within_reach(as_array(wrench, (6,), "wrench", ranges.SIZE), balanced)
        return balanced

    @property
    def largest_friction(self) -> float:
        """Largest friction coefficient of any contact in any direction."""
        # hard contacts make their `models` at the first use
        friction = vars(self).get("_friction")
        if type(friction) is float:
            return friction
        return float((self.models.friction if friction is None else friction).max())

    @property
    def hard(self) -> bool:
        """True if no contact transmits torsion; the flows need this."""
        return not self.contacts.soft

    def to_cone(self, force: ContactForces, torsion: ArrayLike | None = None) -> Array:
        """Return cone coordinates [N] of `force` (N, 3) [N] and `torsion` (N,) [N m].

        They are (u, o, t) of every contact, (3N,), VP of Eq. 18; with a torsion (u, o, t, v), (4N,).
        """
        rows = self._rows(force, "force") * self.models.cone_scale
        if torsion is not None:
            turning = as_array(torsion, (self.n_contacts,), "torsion", ranges.SIZE)
            rows = np.column_stack([rows, turning * self.models.torsion_scale])
        return rows.reshape(-1)

    def to_force(self, x: Array) -> ContactForces:
        """Return the forces (N, 3) (normal, o, t) [N] of flat cone coordinates `x` (3N,)."""
        return self._rows(x, "x") / self.models.cone_divisor

    def cone_margins(self, force: ContactForces, torsion: ArrayLike | None = None) -> Array:
        """Return the margins (N,) [N] of `force` (N, 3) [N] and `torsion` (N,) [N m] from the cones.

        They are u - sqrt(o^2 + t^2 + v^2) in cone coordinates; for round cones of hard contacts mu *
        normal - |tangential|.

        Example:
            >>> from grasp_env.grasp import presets
            >>> presets.tripod().cone_margins([[2, 0.1, 0], [2, 0, 0], [2, 0, 0]])   # mu = 0.5
            array([0.9, 1. , 1. ])
        """
        rows = self.to_cone(force, torsion).reshape(self.n_contacts, -1)
        return rows[:, 0] - np.sqrt((rows[:, 1:] ** 2).sum(axis=1))

    def cone_margin(self, force: ContactForces, torsion: ArrayLike | None = None) -> float:
        """Return the least of `cone_margins` of `force` [N] and `torsion` [N m]."""
        return float(self.cone_margins(force, torsion).min())

    @property
    def n_contacts(self) -> int:
        """Number of contacts N."""
        return self.contacts.count

    @cached_property
    def null_dimension(self) -> int:
        """Number of independent internal forces (N, 3), without torsions.

        It is the number of transmitted force components minus the rank of G on them: 3N - 6 for
        hard contacts, and 2 less for each frictionless one. Contacts on one line have rank 5 and so
        one internal force more: two soft ones have one, the squeeze.

        Example:
            >>> from grasp_env.grasp import presets
            >>> presets.tripod().null_dimension
            3
            >>> Grasp.from_contacts(
            ...     [[0, 0, -0.02], [0, 0, 0.02]], [[0, 0, 1], [0, 0, -1]], 0.5, contact_model="soft", torsional_friction=0.005
            ... ).null_dimension
            1
        """
        sent = self.models.transmitted
        count = int(sent.sum())
        if self.hard and self.contacts.clear:  # the rank is 6
            return count - 6
        return count - rank_of(
            np.linalg.svd(self.unit_frame @ (self.matrix * sent.reshape(-1)), compute_uv=False)
        )

    def with_friction(
        self, friction: ArrayLike, torsional_friction: ArrayLike | None = None
    ) -> Grasp:
        """Return the same contacts with other coefficients, as in `from_contacts`.

        `friction` replaces the tangential coefficients. `torsional_friction` replaces those of soft
        contacts; None keeps them.
        """
        kept = self.models.torsional_friction
        gamma = kept if torsional_friction is None else np.asarray(torsional_friction)
        return Grasp.from_contacts(
            self.positions,
            self.normals,
            friction,
            contact_model=self.models.names,
            torsional_friction=gamma if "soft" in self.models.names else None,
            tangents=self.frames[:, :, 1],
        )

    def wrench(self, force: ContactForces, torsion: Array | None = None) -> Wrench:
        """Return the wrench (6,) [N, N m] on the object of `force` (N, 3) and `torsion` (N,)."""
        forces = as_array(force, (self.n_contacts, 3), "force", ranges.SIZE)
        wrench = self.matrix @ forces.reshape(-1)
        return wrench if torsion is None else wrench + self._torsion_wrench(torsion)

    def residual(self, force: ContactForces, wrench: Wrench, torsion: Array | None = None) -> float:
        """Return the largest |component| of G f + w [N], in the components of `unit_frame`.

        `force` is (N, 3) [N], `wrench` (6,) [N, N m], `torsion` (N,) [N m] of soft contacts.
        """
        load = as_array(wrench, (6,), "wrench", ranges.SIZE)
        error = self.matrix @ self._rows(force, "force").reshape(-1) + load
        if torsion is not None:
            error += self._torsion_wrench(torsion)
        return float(np.abs(self.unit_frame @ error).max())

    def to_object_frame(self, force: ContactForces) -> Array:
        """Return object-frame vectors (N, 3) [N] of contact-frame forces `force` (N, 3)."""
        return np.einsum("nij,nj->ni", self.frames, self._rows(force, "force"))

    def to_contact_frame(self, vectors: Array) -> ContactForces:
        """Return contact-frame forces (N, 3) [N] from object-frame `vectors` (N, 3)."""
        return np.einsum("nji,nj->ni", self.frames, self._rows(vectors, "vectors"))

    def _torsion_wrench(self, torsion: ArrayLike) -> Wrench:
        return self.torsion_matrix @ as_array(torsion, (self.n_contacts,), "torsion", ranges.SIZE)

    def _rows(self, value: ArrayLike, name: str) -> Array:
        """Return checked rows (N, 3) from (N, 3) or flat (3N,)."""
        rows = as_array(value, None, name, ranges.SIZE)
        if rows.shape not in ((self.n_contacts, 3), (3 * self.n_contacts,)):
            raise InvalidInputError(
                f"{name} must have shape ({self.n_contacts}, 3), got {rows.shape}"
            )
        return rows.reshape(-1, 3)


def transmitted_matrix(grasp: Grasp, length: float = 1.0) -> Array:
    """Return G (6, 4N) of transmitted forces and of torsions over `length`; the rest is zero."""
    transmitted = grasp.matrix * grasp.models.transmitted.reshape(-1)
    return np.concatenate([transmitted, grasp.torsion_matrix * length], axis=1)


def as_grasp(value: object) -> Grasp:
    """Return `value`, checked to be a grasp."""
    if not isinstance(value, Grasp):
        raise InvalidInputError(
            f"a Grasp is needed (Grasp.from_contacts, grasp_env.grasp.presets), got {shown(value)}"
        )
    return value
