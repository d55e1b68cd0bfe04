"""Limits on a grasp's forces besides friction: least and largest normal forces, and joint torques.

The limit on joint torques is that of Han, Trinkle, Li 2000 and Lippiello, Siciliano, Villani 2013.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from grasp_env import core
from grasp_env.errors import InvalidInputError, shown
from grasp_env.force.torques import checked_jacobian
from grasp_env.grasp.grasp import Grasp, as_grasp
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import AllFaults, Array, as_array, instance, number, whole


class LimitArrays(NamedTuple):
    """Limits of N contacts and J joints as arrays of full shape, inf where unlimited.

    Normal forces are (N,) [N], torques (J,) [N m]. The Jacobian is (N, 6, J), with zero angular
    rows if only (N, 3, J) was given; J = 0 without torque limits.
    """

    min_normal: Array
    max_normal: Array
    jacobian: Array
    torque_limit: Array
    torque_bias: Array


class LimitRows(NamedTuple):
    """Limits as A f <= b, with f = (normal, o, t, torsion) stacked contact by contact.

    Attributes:
        matrix: A, (M, 4N).
        bound: b, (M,) [N] for normal forces, [N m] for torques.
        labels: M descriptions.
    """

    matrix: Array
    bound: Array
    labels: tuple[str, ...]


class LimitSlack(NamedTuple):
    """Smallest slack [N, N m] of each kind of limit; negative if violated, inf without limits."""

    min_normal: float
    max_normal: float
    torque: float


@dataclass(frozen=True, eq=False)
class ForceLimits:
    """Limits on normal forces and joint torques.

    Attributes:
        min_normal: least normal force [N], 0 to 1e6; one for all contacts or (N,).
        max_normal: largest normal force [N], above `min_normal`, 1e-12 to 1e12; one or (N,); inf:
            no limit.
        jacobian: (N, 3, J), (3N, J) or (N, 6, J), as in `joint_torques`, in the frame of the
            contacts' positions.
        torque_limit: largest absolute joint torque [N m], 1e-12 to 1e12; one for all joints or
            (J,); inf: no limit. It needs `jacobian`, and `jacobian` needs it.
        torque_bias: (J,) tau_0 [N m], torques that the motors supply in addition to J^T f, for
            example to hold up the links; None: zero. The limit is on abs(J^T f + tau_0).

    Raises:
        InvalidInputError: a limit out of range, min_normal >= max_normal, shapes that do not match,
            or only one of jacobian and torque_limit.

    Example:
        >>> from grasp_env.grasp import presets
        >>> limits = ForceLimits(max_normal=[5, 3, 3])
        >>> limits.slack(presets.tripod(), [[4, 0, 0], [2, 0, 0], [2, 0, 0]])
        LimitSlack(min_normal=2.0, max_normal=1.0, torque=inf)
        >>> limits.violations(presets.tripod(), [[4, 0, 0], [2, 0, 0], [3.5, 0, 0]])
        ['contact 2: normal <= 3 N is exceeded by 0.5']
    """

    min_normal: ArrayLike = 0.0
    max_normal: ArrayLike = np.inf
    jacobian: ArrayLike | None = None
    torque_limit: ArrayLike | None = None
    torque_bias: ArrayLike | None = None

    def __post_init__(self) -> None:
        with AllFaults() as check:
            least = check(
                _bound, self.min_normal, "min_normal", "contact", ranges.LEAST_NORMAL_FORCE
            )
            most = check(_bound, self.max_normal, "max_normal", "contact", ranges.NORMAL_FORCE)
        _check_order(np.atleast_1d(least), np.atleast_1d(most))
        arrays = {"min_normal": least, "max_normal": most}
        if (self.jacobian is None) != (self.torque_limit is None):
            raise InvalidInputError(
                "torque limits need jacobian and torque_limit together, got only "
                f"{'torque_limit' if self.jacobian is None else 'jacobian'}"
            )
        if self.jacobian is not None and self.torque_limit is not None:
            jac = checked_jacobian(self.jacobian)
            joints = jac.shape[2]
            limit = _bound(self.torque_limit, "torque_limit", "joint", ranges.TORQUE)
            if limit.ndim and len(limit) != joints:
                raise InvalidInputError(
                    f"torque_limit has {len(limit)} entries, the jacobian {joints} joints: give one or {joints}"
                )
            bias = np.zeros(joints) if self.torque_bias is None else self.torque_bias
            arrays["jacobian"] = jac
            arrays["torque_limit"] = np.broadcast_to(limit, (joints,)).copy()
            arrays["torque_bias"] = as_array(bias, (joints,), "torque_bias", ranges.BIAS)
        elif self.torque_bias is not None:
            raise InvalidInputError(
                "torque_bias without torque limits has no effect: give jacobian and torque_limit too"
            )
        for name, array in arrays.items():
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def checked(self, n_contacts: int) -> LimitArrays:
        """Return the limits of `n_contacts` contacts as arrays of full shape.

        Raises:
            InvalidInputError: limits or a Jacobian for another number of contacts.
        """
        n_contacts = whole(n_contacts, "n_contacts", 1, ranges.CONTACTS)

        def per_contact(name: str) -> Array:
            value = np.asarray(getattr(self, name))
            if value.ndim and len(value) != n_contacts:
                raise InvalidInputError(
                    f"{name} has {len(value)} entries, the grasp {n_contacts} contacts: give one or {n_contacts}"
                )
            return np.broadcast_to(value, (n_contacts,)).copy()

        normals = per_contact("min_normal"), per_contact("max_normal")
        if self.jacobian is None:
            return LimitArrays(*normals, np.zeros((n_contacts, 6, 0)), np.zeros(0), np.zeros(0))
        rows = checked_jacobian(self.jacobian, n_contacts)
        jac = np.zeros((n_contacts, 6, rows.shape[2]))
        jac[:, : rows.shape[1]] = rows
        return LimitArrays(*normals, jac, np.array(self.torque_limit), np.array(self.torque_bias))

    @property
    def joints(self) -> int:
        """Number of joints J of the torque limits; 0 without them."""
        return 0 if self.jacobian is None else np.asarray(self.jacobian).shape[2]

    def labels(self, n_contacts: int) -> tuple[str, ...]:
        """Return (M,) descriptions of the finite limits of `n_contacts` contacts, as in `rows`."""
        least, most, _, limit, _ = self.checked(n_contacts)
        out = [
            f"contact {k}: normal >= {least[k]:g} N"
            for k in np.flatnonzero((least > 0.0) & np.isfinite(least))
        ]
        out += [f"contact {k}: normal <= {most[k]:g} N" for k in np.flatnonzero(np.isfinite(most))]
        for j in np.flatnonzero(np.isfinite(limit)):
            out += [f"joint {j}: torque {word}{limit[j]:g} N m" for word in ("<= ", ">= -")]
        return tuple(out)

    def slack(self, grasp: Grasp, force: ArrayLike, torsion: ArrayLike | None = None) -> LimitSlack:
        """Return the distances of `force` (N, 3) [N] and `torsion` (N,) on `grasp` from limits."""
        least, most, jac, limit, bias = self.checked(as_grasp(grasp).n_contacts)
        forces = _with_torsion(grasp, force, torsion)
        torque = np.einsum("nij,ni->j", _in_contact_frames(grasp, jac), forces) + bias
        return LimitSlack(
            float((forces[:, 0] - least).min(initial=np.inf)),
            float((most - forces[:, 0]).min(initial=np.inf)),
            float((limit - np.abs(torque)).min(initial=np.inf)),
        )

    def rows(self, grasp: Grasp) -> LimitRows:
        """Return all finite limits on `grasp` as A f <= b in force, not cone coordinates.

        The order is: least normal forces above 0 (the cone implies 0), largest normal forces, then
        the upper and the lower torque limit of each joint. Columns of components that a contact
        does not transmit are zero.

        Raises:
            InvalidInputError: limits for another number of contacts.
        """
        count = as_grasp(grasp).n_contacts
        least, most, jac, limit, bias = self.checked(count)
        labels = self.labels(count)
        capacity = 2 * (count + len(limit))
        matrix = np.empty((capacity, count, 4))
        bound = np.empty(capacity)
        limits = least, most, _in_contact_frames(grasp, jac), limit, bias
        used = core.limit_rows(limits, matrix, bound, np.empty(capacity))
        assert used == len(labels)
        transmitted = np.ones((count, 4))
        transmitted[:, :3] = grasp.models.transmitted
        transmitted[:, 3] = grasp.models.torsional_friction > 0.0
        rows = (matrix[:used] * transmitted).reshape(used, 4 * count)
        return LimitRows(rows, bound[:used].copy(), labels)

    def violations(
        self,
        grasp: Grasp,
        force: ArrayLike,
        torsion: ArrayLike | None = None,
        tolerance: float = 1e-9,
    ) -> list[str]:
        """Return a message for each limit that is exceeded by more than `tolerance` [N, N m].

        `grasp`, `force` and `torsion` are those of `slack`.
        """
        matrix, bound, labels = self.rows(grasp)
        tolerance = number(tolerance, "tolerance", ranges.NOT_NEGATIVE)
        forces = _with_torsion(grasp, force, torsion)
        excess = matrix @ forces.reshape(-1) - bound
        return [
            f"{labels[k]} is exceeded by {excess[k]:.3g}"
            for k in np.flatnonzero(excess > tolerance)
        ]


def as_limits(value: object) -> ForceLimits | None:
    """Return `value`, checked to be a `ForceLimits` or None."""
    return instance(value, ForceLimits, "limits", or_none=True)


def core_limits(limits: ForceLimits | None, n_contacts: int) -> tuple[Any, ...] | None:
    """Return the limits for the core, in the order of `LimitArrays`; None: no limit."""
    if limits is None:
        return None
    arrays: Any = vars(limits)
    least, most, jacobian, torque, bias = map(arrays.__getitem__, LimitArrays._fields)
    if least.ndim == 0:
        least = np.full(n_contacts, least) if least else None
    if most.ndim == 0:
        most = np.full(n_contacts, most) if most < np.inf else None
    for array in (least, most, jacobian):
        if array is not None and len(array) != n_contacts:
            limits.checked(n_contacts)  # raises, with the reason
    return least, most, jacobian, torque, bias


def _in_contact_frames(grasp: Grasp, jacobian: Array) -> Array:
    """Return (N, 4, J) from (N, 6, J): velocity along (normal, o, t), rate about the normal."""
    turned = np.einsum("nik,nij->nkj", grasp.frames, jacobian[:, :3])
    about = np.einsum("ni,nij->nj", grasp.normals, jacobian[:, 3:])
    return np.concatenate([turned, about[:, None]], axis=1)


def _with_torsion(grasp: Grasp, force: ArrayLike, torsion: ArrayLike | None) -> Array:
    """Return (N, 4): normal, o, t, torsion."""
    forces = as_array(force, (grasp.n_contacts, 3), "force", ranges.SIZE)
    torsions = np.zeros(len(forces)) if torsion is None else torsion
    torsions = as_array(torsions, (len(forces),), "torsion", ranges.SIZE)
    return np.column_stack([forces, torsions])


def _bound(value: ArrayLike, name: str, of: str, within: ranges.Range) -> Array:
    """Return a checked limit, one or a vector; inf means no limit, but not for `min_normal`."""
    unlimited = within.low > 0.0
    try:
        array = as_array(value, None, name, finite=False)
    except InvalidInputError as error:
        raise InvalidInputError(f"{name} must be a number or one per {of}: {error}") from None
    fits = (array >= within.low) & (array <= within.high) | (unlimited & (array == np.inf))
    if array.ndim > 1 or array.size == 0 or not fits.all():
        raise InvalidInputError(
            f"{name} must lie within {within}{', or be inf for no limit' * unlimited}, one for all or one per {of}, got {shown(array)}"
        )
    return array


def _check_order(least: Array, most: Array) -> None:
    try:
        least, most = np.broadcast_arrays(least, most)
    except ValueError:
        raise InvalidInputError(
            f"min_normal has {len(least)} entries and max_normal {len(most)}: give one or N of each"
        ) from None
    crossing = np.flatnonzero(least >= most)
    if crossing.size:
        k = crossing[0]
        raise InvalidInputError(
            f"max_normal must be > min_normal at every contact; at contact {k} they are {most[k]:g} and {least[k]:g}"
        )
