"""Problems for the tests: soft contacts and limits as the core takes them, and the same as dense
rows for the oracles."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache, cached_property

import _core_test as insides
import numpy as np
from oracles import limits as oracle
from samples import Sample, sample

from grasp_env.core import _core
from grasp_env.force.solution import STARTS

REFUSED = _core.codes()["refused"]
FIELDS = _core.record_fields()
START = {name: number for number, name in enumerate(STARTS)}
METHODS = {"newton": 0, "reduced flow": 1, "full flow": 2, "sum": 3, "largest": 3}
FACETS = 64


def at(row: np.ndarray, name: str) -> float:
    """A number of a record's summary."""
    return float(row[FIELDS[name]])


def nu_of(row: np.ndarray) -> np.ndarray:
    """(6,) the multipliers of a record."""
    return row[FIELDS["multipliers"] :][:6]


@dataclass(frozen=True)
class Case:
    """Contacts, some of which may be soft, within limits.

    Attributes:
        gamma: (N,) torsional friction [m], 0: not soft.
        limits: arrays by the names of `ForceLimits`; the Jacobian (N, 6, J) along the axes of the
            positions.
    """

    contacts: Sample
    gamma: np.ndarray
    limits: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def count(self) -> int:
        return self.contacts.count

    @property
    def soft(self) -> np.ndarray:
        return self.gamma > 0.0

    @cached_property
    def placement(self) -> insides.Placement:
        s = self.contacts
        return insides.place(s.positions, s.normals, s.scale, s.weights, torsion=self.gamma)

    @property
    def wide(self) -> int:
        """Numbers of a contact in z: (u, o, t), or (u, o, t, v) if some contacts are soft."""
        return 4 if self.soft.any() else 3

    @cached_property
    def phi_weights(self) -> np.ndarray:
        """(N, 3) the weights of `oracles.phi`."""
        return self.contacts.phi_weights + np.outer(self.soft, [0.0, 0.0, 1.0])

    @cached_property
    def torsion_divisor(self) -> np.ndarray:
        """(N,) torsion = v / divisor."""
        return np.where(
            self.soft, self.contacts.scale[:, 0] / np.where(self.soft, self.gamma, 1.0), np.inf
        )

    # --- rows, of the cone coordinates (u, o, t, v) of all contacts: (..., N, 4)

    @cached_property
    def jacobian(self) -> np.ndarray:
        """(N, 4, J) along (normal, o, t) and about the normal."""
        s = self.contacts
        given = self.limits.get("jacobian", np.zeros((self.count, 6, 0)))
        along = np.einsum("nik,nij->nkj", s.frames, given[:, :3])
        return np.concatenate(
            [along, np.einsum("ni,nij->nj", s.normals, given[:, 3:])[:, None]], axis=1
        )

    @cached_property
    def given_rows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows on cone coordinates, right sides, and what each limit is [N, N m]."""
        rows = []
        bound = []
        limited = []
        each = np.eye(self.count)[:, :, None] * [1.0, 0.0, 0.0, 0.0]
        for name, sign in (("min_normal", -1.0), ("max_normal", 1.0)):
            for i, value in enumerate(self.limits.get(name, ())):
                if 0.0 < value < np.inf:
                    rows.append(sign * each[i])
                    bound.append(sign * value)
                    limited.append(value)
        for j, value in enumerate(self.limits.get("torque_limit", ())):
            for sign in (1.0, -1.0) if value < np.inf else ():
                rows.append(sign * self.jacobian[:, :, j])
                bound.append(value - sign * self.limits["torque_bias"][j])
                limited.append(value)
        divisor = np.column_stack([self.contacts.divisor, self.torsion_divisor])
        return (
            np.array(rows).reshape(-1, self.count, 4) / divisor,
            np.array(bound),
            np.array(limited),
        )

    @cached_property
    def sizes(self) -> np.ndarray:
        """(M,) the length of each row, by which Phi divides it; 1 of one that no force changes."""
        length = np.sqrt((self.given_rows[0] ** 2).sum(axis=(1, 2)))
        return np.where(length > 0.0, length, 1.0)

    @cached_property
    def balance(self) -> np.ndarray:
        """(6, N, 4) in the unit frame."""
        s = self.contacts
        turn = np.zeros((6, self.count))
        turn[3:] = s.normals.T
        return np.dstack([s.rows.reshape(6, -1, 3), s.unit @ turn / self.torsion_divisor])

    def flat(self, rows: np.ndarray) -> np.ndarray:
        """(M, w N) of rows (M, N, 4)."""
        return rows[:, :, : self.wide].reshape(len(rows), self.wide * self.count)

    @cached_property
    def matrix(self) -> np.ndarray:
        return self.flat(self.balance)

    @cached_property
    def own(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The limits as rows of z of length one, their right sides and shares."""
        rows, bound, limited = self.given_rows
        return self.flat(rows / self.sizes[:, None, None]), bound / self.sizes, limited / self.sizes

    @cached_property
    def row_weights(self) -> np.ndarray:
        """(M,) the mean lambda of the contacts that a limit touches, of all where it touches none."""
        touched = (self.given_rows[0] != 0.0).any(axis=2)
        touched[~touched.any(axis=1)] = True
        return touched @ self.contacts.weights[:, 1] / touched.sum(axis=1)

    @cached_property
    def terms(self) -> oracle.Terms:
        """Phi and all limits."""
        rows, bound, _ = self.own
        return oracle.Terms(self.phi_weights, rows, bound, self.row_weights)

    # --- solutions

    def start(self, load: np.ndarray) -> np.ndarray:
        """Optimum of hard contacts without limits."""
        z = np.zeros((self.count, self.wide))
        z[:, :3] = self.contacts.minimum(load)[0].reshape(-1, 3)
        return z.reshape(-1)

    def minimum(self, load: np.ndarray) -> np.ndarray | None:
        """argmin Phi, or None if the limits cannot be kept."""
        if not len(self.terms.rows) and not self.soft.any():
            return self.start(load)
        return oracle.minimum(self.start(load), self.matrix, self.contacts.unit @ load, self.terms)

    def value(self, z: np.ndarray) -> float:
        return float(oracle.value(z, self.terms))

    def z(self, row: np.ndarray, at: str = "force") -> np.ndarray:
        """The variables of a record."""
        force, torsion = self.forces(row, at)
        v = np.where(self.soft, torsion * self.contacts.scale[:, 0], 0.0)
        v /= np.where(self.soft, self.gamma, 1.0)
        rows = np.column_stack([force.reshape(-1, 3) * self.contacts.scale, v])
        return rows[:, : self.wide].reshape(-1)

    def margins(self, z: np.ndarray) -> np.ndarray:
        """(N,) distances from the cones' surfaces along u."""
        x = z.reshape(self.count, -1)
        return x[:, 0] - np.hypot.reduce(x[:, 1:], axis=1)

    def forces(self, row: np.ndarray, at: str = "force") -> tuple[np.ndarray, np.ndarray]:
        """Forces (3N,) and torsions (N,) of a record."""
        first = FIELDS["force"] + (3 * self.count if at == "initial" else 0)
        return row[first : first + 3 * self.count], row[FIELDS["force"] + 6 * self.count :][
            : self.count
        ]

    def torques(self, row: np.ndarray) -> np.ndarray:
        """(J,) from the force and the torsion of a record."""
        force, torsion = self.forces(row)
        all_four = np.column_stack([force.reshape(-1, 3), torsion])
        return np.einsum("naj,na->j", self.jacobian, all_four) + self.limits.get(
            "torque_bias", np.zeros(0)
        )

    def torques_and_multipliers(self, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint torques (J,) and multipliers of the limits (M,) in a record."""
        rest = row[FIELDS["force"] + 17 * self.count :]
        return np.split(rest, [self.jacobian.shape[2]])[0], np.split(
            rest, [self.jacobian.shape[2]]
        )[1]

    def excess(self, z: np.ndarray) -> float:
        """Largest excess of a limit, as a part of it."""
        rows, bound, share = self.own
        return float(((rows @ z - bound) / share).max(initial=0.0))

    def pyramids(self, *, inside: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """A (z, r) <= b around cones, then all rows. inside: pyramids in the cones, 0.12 % narrower.

        Of a soft contact r >= |(o, t)| and u >= |(r, v)|, a pyramid each.
        """
        which = np.flatnonzero(self.soft)
        size = self.wide * self.count
        columns = np.arange(size).reshape(self.count, self.wide)
        length = columns[:, 0].copy()  # what is at least |(o, t)|
        length[which] = size + np.arange(len(which))
        triples = [(length[i], columns[i, 1], columns[i, 2]) for i in range(self.count)]
        triples += [(columns[i, 0], length[i], columns[i, 3]) for i in which]
        angles = 2.0 * np.pi * np.arange(FACETS) / FACETS
        width = np.cos(np.pi / FACETS) if inside else 1.0
        facets = np.column_stack([-width * np.ones(FACETS), np.cos(angles), np.sin(angles)])
        cones = np.zeros((len(triples), FACETS, size + len(which)))
        for cone, triple in zip(cones, triples, strict=True):
            cone[:, triple] = facets
        rows = np.pad(self.terms.rows, [(0, 0), (0, len(which))])
        return (
            np.vstack([cones.reshape(-1, size + len(which)), rows]),
            np.append(np.zeros(len(triples) * FACETS), self.terms.bound),
        )

    def solver(self, method: str = "newton", **options: object) -> insides.AnyOptimizer:
        """Solver with options of `AnyOptimizer.make`."""
        options = {
            "tolerance": 1e-9,
            "method": METHODS[method],
            "criterion": int(method == "largest"),
        } | options
        return insides.AnyOptimizer.make(self.placement, **options, **self.limits)


def softened(s: Sample, kind: str) -> np.ndarray:
    """(N,) torsional friction of two thirds of the contacts, or of all (`all soft`, `slippery
    soft`)."""
    rng = np.random.default_rng([3, s.count])
    gamma = rng.uniform(0.002, 0.02, s.count)
    if kind not in ("all soft", "slippery soft"):
        gamma[rng.permutation(s.count)[: s.count // 3]] = 0.0
    return gamma


def own_limits(
    s: Sample, seed: int, tight: float, *, full: bool = False, free: int = 0
) -> dict[str, np.ndarray]:
    """Zero to five joints a contact, none of which moves another, and limits of some normal forces;
    one joint moves nothing.

    full: three or four joints each and no limits of normal forces, so that joints bound every
    force. free: contacts that nothing bounds.
    """
    rng = np.random.default_rng([seed, s.count])
    owner = [
        i
        for i in range(free, s.count)
        for _ in range(int(rng.choice([3, 4] if full else [0, 1, 2, 3, 3, 3, 4, 5])))
    ]
    joints = len(owner) + 1
    jacobian = np.zeros((s.count, 6, joints))
    limit = tight * rng.uniform(0.5, 2.0, joints)
    for j, i in enumerate(owner):
        a = rng.standard_normal(3)
        jacobian[i, :3, j] = s.frames[i] @ (a / np.linalg.norm(a) * s.scale[i])
    out = {
        "jacobian": jacobian,
        "torque_limit": limit,
        "torque_bias": 0.2 * limit * rng.uniform(-1.0, 1.0, joints),
    }
    if not full:
        chosen = rng.random((2, s.count)) < 0.3
        out |= {
            "min_normal": np.where(chosen[0], 0.05, 0.0),
            "max_normal": np.where(chosen[1], 3.0 * tight, np.inf),
        }
    return out


def shared_limits(s: Sample, seed: int, tight: float) -> dict[str, np.ndarray]:
    """Three joints that move and turn all contacts, one without a limit, one of the first contact,
    and largest normal forces."""
    rng = np.random.default_rng([seed, s.count, 1])
    jacobian = 0.3 * rng.standard_normal((s.count, 6, 5)) * ([[1.0]] * 3 + [[10.0]] * 3)
    jacobian[1:, :, 4] = 0.0
    limit = tight * np.append(rng.uniform(1.0, 3.0, 3), [np.inf, 1.0])
    bias = 0.2 * tight * rng.uniform(-1.0, 1.0, 5)
    return {
        "jacobian": jacobian,
        "torque_limit": limit,
        "torque_bias": bias,
        "max_normal": np.full(s.count, 5.0 * tight),
    }


@cache
def case(count: int, kind: str, seed: int = 0, tight: float = 6.0) -> Case:
    """Problem of a kind: hard, frictionless, thin, some soft, all soft, slippery soft (a third with
    torsion alone), own limits, shared limits, or soft limits (some soft, shared limits)."""
    kinds = {"frictionless": "frictionless", "thin": "thin", "slippery soft": "frictionless"}
    s = sample(count, kinds.get(kind, "hard"))
    gamma = softened(s, kind) if "soft" in kind else np.zeros(count)
    if kind == "own limits":
        return Case(s, gamma, own_limits(s, seed, tight))
    return Case(s, gamma, shared_limits(s, seed, tight) if "limits" in kind else {})
