"""The problems of the benchmark, and the files that hold them.

Balance a wrench w with the forces of N contacts, f = (normal, o, t[, torsion]) of each in its own
frame:

    G f + w = 0,   sqrt((o / friction)^2 + (t / friction)^2 + (torsion / torsional_friction)^2) <=
    inner,   B f <= b

inner is normal, and with a margin friction_margin * (normal - preload). Friction and torsion of a
soft contact share one cone (Howe and Cutkosky 1996). A torsional friction of 0 is a hard contact,
which transmits no torsion.

Objectives: `sum` is the sum of the normal forces [N]. `phi` is the paper's, sum_i 3 u + lambda (1 /
u + 2 u / (u^2 - o^2 - t^2)) with u = friction * inner and lambda = `BARRIER_WEIGHT`; it is defined
for contacts without torsion and limits.

A track is a file NAME.npz with NAME.json beside it. It consists of sessions, which are sequences of
problems of one structure.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.files import digest, parsed, read_json, replacing, unpacked

Array = NDArray[np.float64]

SCHEMA = 2
"""Version of the files and of what their arrays mean. In 1, friction and torsion had bounds apart."""
MEANINGS = {"torsional_friction": ", in one cone with friction"}
"""Meanings of arrays that are part of their hash: the same numbers were other problems in schema 1."""
BARRIER_WEIGHT = 0.01
"""lambda of `phi` [N^2]."""
OBJECTIVES = ("sum", "phi")
MODES = ("cold", "persistent", "warm")
"""cold: `setup` is timed with every solve. persistent: `setup` is called once a session, untimed.
warm: the same, and `start` is the last force."""
SETS = Path(__file__).with_name("sets")
FIELDS = {
    "positions": "(M, N, 3) m, contact points",
    "frames": "(M, N, 3, 3) columns (n, o, t) of the contact frames, n the inward normal",
    "friction": "(M, N) Coulomb coefficients",
    "wrench": "(M, 6) N and N m about the origin, external wrench on the object",
    "touching": "(M, N) which contacts touch; the force of the others is zero",
    "torsional_friction": "(M, N) m, (hypot(o, t) / friction)^2 + (torsion / torsional_friction)^2 <= normal^2; 0, or without it: no torsion",
    "min_normal": "(M, N) N",
    "max_normal": "(M, N) N, inf: no limit",
    "jacobian": "(M, N, 6, J) joint speeds -> velocity of the contact point and angular velocity of the fingertip",
    "torque_limit": "(M, J) N m, abs(J^T f + torque_bias) <= torque_limit",
    "torque_bias": "(M, J) N m",
}
"""The arrays of a session in the object's frame, for M problems of N contacts and J joints; arrays
that do not change have a first dimension of 1."""
MARGIN_FIELDS = {
    "friction_margin": "(M,) share of both frictions that forces may use",
    "preload": "(M, N) N, in the cones friction_margin * (normal - preload) stands for normal",
}
"""Further arrays of a session whose forces keep a margin."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Problem that a solver receives, with read-only arrays.

    Attributes:
        positions, frames, friction, wrench, touching, torsional_friction, min_normal, max_normal,
            jacobian, torque_limit, torque_bias, friction_margin, preload: as in `FIELDS` and
            `MARGIN_FIELDS` without M; None where a track has none.
        normals: (N, 3) inward unit normals, the first columns of the frames.
        matrix: G (6, N k), k numbers per contact, moments about the origin; the columns of contacts
            that do not touch are zero.
        limit_matrix: B (L, N k): least normal forces > 0, largest normal forces, then each limited
            joint's upper and lower torque; L may be 0. Rows are zero at contacts that do not touch.
        limit_bound: b (L,) [N, N m].
        limit_size: (L,) the limit that a row stands for [N, N m].
        moved: something besides the wrench differs from the first problem of the session.
    """

    positions: Array
    frames: Array
    friction: Array
    wrench: Array
    touching: NDArray[np.bool_] | None = None
    torsional_friction: Array | None = None
    min_normal: Array | None = None
    max_normal: Array | None = None
    jacobian: Array | None = None
    torque_limit: Array | None = None
    torque_bias: Array | None = None
    friction_margin: Array | None = None
    preload: Array | None = None
    moved: bool = False
    normals: Array = field(init=False, repr=False)
    matrix: Array = field(init=False, repr=False)
    limit_matrix: Array = field(init=False, repr=False)
    limit_bound: Array = field(init=False, repr=False)
    limit_size: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._keep(vars(self))
        rows, bound, size = self._limits()
        self._keep({"normals": self.frames[:, :, 0], "matrix": self._matrix()})
        self._keep({"limit_matrix": rows, "limit_bound": bound, "limit_size": size})

    def _keep(self, arrays: dict[str, Any]) -> None:
        """Set fields to contiguous read-only arrays."""
        for name, array in arrays.items():
            if isinstance(array, np.ndarray):
                copy = np.array(array, order="C")
                copy.setflags(write=False)
                object.__setattr__(self, name, copy)

    def differs(self, earlier: Problem) -> bool:
        """Return True if more than the wrench may differ from an earlier problem of the session."""
        return self is not earlier and (self.moved or earlier.moved)

    @property
    def n_contacts(self) -> int:
        """N."""
        return len(self.positions)

    @property
    def width(self) -> int:
        """k: 4 with torsion, else 3."""
        return 3 if self.torsional_friction is None else 4

    @property
    def lever(self) -> Array:
        """(N,) torsional_friction / friction [m]: in the cone torsion / lever is a tangential force."""
        gamma = self.torsional_friction
        return np.zeros(self.n_contacts) if gamma is None else gamma / self.friction

    @property
    def active(self) -> NDArray[np.bool_]:
        """(N,) True for contacts that touch."""
        return np.ones(self.n_contacts, dtype=bool) if self.touching is None else self.touching

    @property
    def has_margin(self) -> bool:
        """True if the problem has a friction margin or preloads."""
        return self.friction_margin is not None or self.preload is not None

    @property
    def share(self) -> Any:
        """Share of both frictions that forces may use."""
        return 1.0 if self.friction_margin is None else self.friction_margin

    @property
    def shift(self) -> Array:
        """(N,) preloads s of the contacts that touch [N]."""
        return np.zeros(self.n_contacts) if self.preload is None else self.preload * self.active

    def shifted(self) -> Problem:
        """Return the problem of f - s n without a margin, or itself if it has none.

        Rows of limits and multipliers are the same; the optimum of `sum` is less by that of s.
        """
        if not self.has_margin:
            return self
        s = self.shift
        push = np.pad(s[:, None], ((0, 0), (0, self.width - 1))).reshape(-1)
        changes: dict[str, Any] = {"friction_margin": None, "preload": None}
        changes["friction"] = self.share * self.friction
        changes["wrench"] = self.wrench + self.matrix @ push
        if self.torsional_friction is not None:
            changes["torsional_friction"] = self.share * self.torsional_friction
        if self.min_normal is not None:
            changes["min_normal"] = np.maximum(self.min_normal - s, 0.0)
        if self.max_normal is not None:
            changes["max_normal"] = self.max_normal - s
        if self.jacobian is not None:
            bias = 0.0 if self.torque_bias is None else self.torque_bias
            pushed = np.einsum("naj,na,n->j", self.jacobian[:, :3], self.normals, s)
            changes["torque_bias"] = bias + pushed
        shifted = replace(self, **changes)
        # its own rows would lack least normal forces that the preload guarantees
        shifted._keep({"limit_matrix": self.limit_matrix, "limit_size": self.limit_size})
        shifted._keep({"limit_bound": self.limit_bound - self.limit_matrix @ push})
        return shifted

    def _matrix(self) -> Array:
        moments = np.cross(self.positions[:, :, None], self.frames, axisa=1, axisb=1, axisc=1)
        columns = np.concatenate([self.frames, moments], axis=1)  # (N, 6, 3)
        if self.width == 4:
            turning = np.concatenate([np.zeros_like(self.positions), self.frames[:, :, 0]], axis=1)
            columns = np.concatenate([columns, turning[:, :, None]], axis=2)
        if self.touching is not None:
            columns = columns * self.touching[:, None, None]
        return columns.transpose(1, 0, 2).reshape(6, -1)

    def _limits(self) -> tuple[Array, Array, Array]:
        n, k = self.n_contacts, self.width
        touching = self.active
        rows = []
        bound = []
        size = []
        for sign, limits in ((-1.0, self.min_normal), (1.0, self.max_normal)):
            for i, limit in enumerate(() if limits is None else limits):
                if 0.0 < limit < np.inf:
                    row = np.zeros((n, k))
                    row[i, 0] = sign * touching[i]
                    rows.append(row)
                    bound.append(sign * limit if touching[i] or sign > 0.0 else 0.0)
                    size.append(limit)
        if self.jacobian is not None and self.torque_limit is not None:
            bias = (
                np.zeros_like(self.torque_limit) if self.torque_bias is None else self.torque_bias
            )
            levers = np.einsum("nab,naj->nbj", self.frames, self.jacobian[:, :3])
            if k == 4:
                about = np.einsum("na,naj->nj", self.frames[:, :, 0], self.jacobian[:, 3:])
                levers = np.concatenate([levers, about[:, None]], axis=1)
            levers = levers * touching[:, None, None]
            for j, limit in enumerate(self.torque_limit):
                for sign in (1.0, -1.0) if limit < np.inf else ():
                    rows.append(sign * levers[:, :, j])
                    bound.append(limit - sign * bias[j])
                    size.append(limit)
        matrix = np.array(rows).reshape(-1, n * k)
        return matrix, np.array(bound, dtype=float), np.array(size, dtype=float)


@dataclass(frozen=True, eq=False)
class Reference:
    """Certified optima of the problems of a session, for one objective.

    Attributes:
        value: (M,) the optimum; inf where no force exists.
        lower, upper: (M,) dual and primal bound.
        force: (M, N k) an optimal force; nan where none exists.
        multipliers: (M, 6 + L) of balance and limits; the witness where no force exists.
        rest: (M, N k + 6 + L) rounding errors of force and multipliers if they have many digits
            (zero if doubles sufficed), else None.
        other: (M,) the optimum by another solver, in the published files: Clarabel's, or in track
            `hard` one in the six multipliers.
    """

    value: Array
    lower: Array
    upper: Array
    force: Array
    multipliers: Array
    rest: Array | None = None
    other: Array | None = None


@dataclass(frozen=True, eq=False)
class Session:
    """A sequence of problems of one structure.

    Attributes:
        name: within the track.
        arrays: as in `FIELDS` and `MARGIN_FIELDS`.
        references: by objective.
    """

    name: str
    arrays: dict[str, NDArray[Any]]
    references: dict[str, Reference]

    @cached_property
    def problems(self) -> list[Problem]:
        """The problems; those of equal contacts and limits differ in the wrench."""
        return self.copies()

    def copies(self) -> list[Problem]:
        """Return new copies of the problems."""
        count = len(self.arrays["wrench"])
        stacked = {
            name: np.broadcast_to(array, (count, *array.shape[1:]))
            for name, array in self.arrays.items()
        }
        problems = []
        for m in range(count):
            moved = any(
                name != "wrench" and not np.array_equal(array[m], array[0])
                for name, array in stacked.items()
            )
            arrays = {name: np.array(array[m]) for name, array in stacked.items()}
            problems.append(Problem(**arrays, moved=moved))
        return problems


@dataclass(frozen=True, eq=False)
class Track:
    """A file of problems.

    Attributes:
        name: of the file.
        sessions: in their order.
        about: contents of the JSON file: schema, seed, command, objectives, hashes.
    """

    name: str
    sessions: list[Session]
    about: dict[str, Any]

    @property
    def size(self) -> int:
        """Number of problems."""
        return sum(len(session.problems) for session in self.sessions)

    def digest(self) -> str:
        """Return the SHA-256 of the problems: name, meaning, type, shape and bytes of every array."""
        blobs = []
        for session in self.sessions:
            for name in sorted(session.arrays):
                array = np.ascontiguousarray(session.arrays[name])
                named = f"{session.name}/{name}{MEANINGS.get(name, '')}"
                header = f"{named} {array.dtype.str} {array.shape}\n"
                blobs += [header.encode(), array.tobytes()]
        return digest(*blobs)


def names(folder: Path = SETS) -> list[str]:
    """Return the tracks of a folder in their order."""
    descriptions = {
        path.stem: _description(path)
        for path in folder.glob("*.json")
        if path.with_suffix(".npz").exists()
    }
    if not descriptions:
        raise ValueError(
            f"{folder} holds no track: NAME.npz with NAME.json beside it; make them with `python -m benchmarks.force generate`"
        )
    return sorted(descriptions, key=lambda name: descriptions[name].get("place", 0))


def load(name: str, folder: Path = SETS) -> Track:
    """Read a track from its files.

    Raises:
        ValueError: there are none, or they are of another version or do not fit their SHA-256.
    """
    path = folder / f"{name}.npz"
    if not path.is_file():
        raise ValueError(f"no track {name!r} in {folder}: it holds {', '.join(names(folder))}")
    about = _description(path.with_suffix(".json"))

    def read(blob: bytes) -> Track:
        if lacking := {"schema", "modes", "objectives", "sessions", "sha256"} - set(about):
            raise ValueError(f"{name}.json lacks {', '.join(sorted(lacking))}")
        if about["schema"] != SCHEMA:
            raise ValueError(
                f"file has schema {about['schema']!r}; this version reads schema {SCHEMA}"
            )
        for what, known in (("modes", MODES), ("objectives", OBJECTIVES)):
            if not set(about[what]) <= set(known):
                raise ValueError(f"its {what} are {about[what]}, known are {', '.join(known)}")
        sessions: dict[str, tuple[dict[str, Any], dict[str, dict[str, Array]]]] = {
            label: ({}, {}) for label in about["sessions"]
        }
        for key, array in unpacked(blob).items():
            session, *names = key.split("/")
            arrays, references = sessions[session]
            if len(names) == 1:
                arrays[names[0]] = array
            else:
                references.setdefault(names[0], {})[names[1]] = array
        track = Track(name, [], about)
        for label, (arrays, references) in sessions.items():
            optima = {objective: Reference(**fields) for objective, fields in references.items()}
            track.sessions.append(Session(label, arrays, optima))
        if track.digest() != about["sha256"]:
            digests = f"their SHA-256 is {track.digest()}, expected {about['sha256']}"
            raise ValueError(f"it does not hold the problems of {name}.json: {digests}")
        return track

    again = "; make it again with `python -m benchmarks.force generate`"
    return parsed(path, read, InvalidInputError, str(path), "a track of this version", again)


def save(track: Track, folder: Path = SETS) -> None:
    """Write the files of a track, each atomically."""
    folder.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {}
    for session in track.sessions:
        arrays |= {f"{session.name}/{name}": array for name, array in session.arrays.items()}
        for objective, reference in session.references.items():
            fields = {name: array for name, array in vars(reference).items() if array is not None}
            arrays |= {
                f"{session.name}/{objective}/{name}": array for name, array in fields.items()
            }
    about = {"schema": SCHEMA, **track.about, "sha256": track.digest()}
    margins = any(MARGIN_FIELDS.keys() & session.arrays.keys() for session in track.sessions)
    fields = FIELDS | MARGIN_FIELDS if margins else FIELDS
    about |= {"sessions": [session.name for session in track.sessions], "arrays": fields}
    path = folder / f"{track.name}.npz"
    with replacing(path) as temporary:
        np.savez_compressed(temporary, **arrays)
    with replacing(path.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")


def _description(path: Path) -> dict[str, Any]:
    """Read the JSON of a track."""
    return read_json(path, InvalidInputError, "the description of a track")
