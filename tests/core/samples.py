"""Random contacts, forces and wrenches for the tests of the core, from numpy and the oracles alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import _core_test as insides
import numpy as np
from oracles import geometry, newton

COUNTS = (3, 4, 5, 8, 9, 17, 50)
"""Numbers of contacts: full and partly filled registers of 2, 4 and 8 lanes."""


@dataclass(frozen=True)
class Sample:
    """Contacts as the core takes them, and their matrices by the oracles.

    Attributes:
        positions, normals: (N, 3).
        scale: (N, 3) cone coordinates = scale * force; 0: not transmitted.
        weights: (N, 2) omega and lambda.
    """

    positions: np.ndarray
    normals: np.ndarray
    scale: np.ndarray
    weights: np.ndarray

    @property
    def count(self) -> int:
        return len(self.positions)

    @cached_property
    def phi_weights(self) -> np.ndarray:
        """(N, 3) the weights of `oracles.phi`, without torsion."""
        return np.column_stack([self.weights, (self.scale[:, 1:] > 0.0).sum(axis=1) - 1.0])

    @cached_property
    def divisor(self) -> np.ndarray:
        """(N, 3) force = cone coordinates / divisor."""
        return np.where(self.scale > 0.0, self.scale, np.inf)

    @cached_property
    def frames(self) -> np.ndarray:
        return np.array([geometry.frame(n) for n in self.normals])

    @cached_property
    def cone_matrix(self) -> np.ndarray:
        """(6, 3N) G in cone coordinates, of wrenches as given."""
        return geometry.grasp_matrix(self.positions, self.frames) / self.divisor.reshape(-1)

    @cached_property
    def unit(self) -> np.ndarray:
        """(6, 6) to the unit frame."""
        return geometry.unit_frame(self.positions)[2]

    @cached_property
    def rows(self) -> np.ndarray:
        """(6, 3N) G in cone coordinates, unit frame."""
        return self.unit @ self.cone_matrix

    @cached_property
    def inverse(self) -> np.ndarray:
        """(3N, 6) G^+: the least change in force, as a change of cone coordinates."""
        transmitted = (self.scale > 0.0).reshape(-1)
        forces = self.unit @ geometry.grasp_matrix(self.positions, self.frames) * transmitted
        return self.scale.reshape(-1)[:, None] * geometry.least_norm_inverse(forces)

    @cached_property
    def placement(self) -> insides.Placement:
        return insides.place(self.positions, self.normals, self.scale, self.weights)

    @cached_property
    def rest(self) -> np.ndarray:
        """(3N,) the optimum of Phi without a wrench."""
        return newton.internal_force(self.rows, self.phi_weights)

    @cached_property
    def basis(self) -> np.ndarray:
        """(13, 3N) the offline optima."""
        return newton.twelve_basis(self.cone_matrix, self.phi_weights, self.rest)

    def minimum(self, wrench: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(argmin Phi, multipliers in the unit frame), found once."""
        key = wrench.tobytes()
        if key not in self._minima:
            self._minima[key] = newton.minimum(
                self.rest, self.rows, self.unit @ wrench, self.phi_weights
            )
        return self._minima[key]

    @cached_property
    def _minima(self) -> dict[bytes, tuple[np.ndarray, np.ndarray]]:
        return {}


def random_contacts(rng: np.random.Generator, count: int) -> Sample:
    """Contacts on an ellipsoid off the origin, with different friction and weights at each."""
    axes = rng.uniform(0.03, 0.06, 3)
    on = rng.standard_normal((count, 3))
    on /= np.linalg.norm(on, axis=1)[:, None]
    normals = -on / axes
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    scale = np.column_stack([rng.uniform(0.3, 1.0, count), rng.uniform(0.7, 1.4, (count, 2))])
    weights = np.column_stack(
        [rng.uniform(0.7, 1.6, count), 0.01 * 10.0 ** rng.uniform(-0.5, 0.5, count)]
    )
    return Sample(on * axes + [0.3, -0.2, 0.1], normals, scale, weights)


def with_frictionless(sample: Sample, which: slice) -> Sample:
    """The same contacts, some of them frictionless."""
    scale = sample.scale.copy()
    scale[which] = [1.0, 0.0, 0.0]
    return Sample(sample.positions, sample.normals, scale, sample.weights)


def thinned(sample: Sample, thin: float) -> Sample:
    """Contacts moved towards a line through their middle; `thin` is about the ratio of singular
    values of G."""
    middle = sample.positions.mean(axis=0)
    positions = (sample.positions - middle) * [1.0, thin, thin] + [0.01, 0.0, 0.0]
    return Sample(positions, sample.normals, sample.scale, sample.weights)


def has_closure(sample: Sample) -> bool:
    """True if the internal force of least Phi presses on all contacts alike, deep in their cones."""
    try:
        rest = sample.rest.reshape(-1, 3)
    except (ArithmeticError, np.linalg.LinAlgError):
        return False
    depth = rest[:, 0] - np.hypot(rest[:, 1], rest[:, 2])
    return bool(rest[:, 0].min() > 0.05 * rest[:, 0].max() and (depth > 0.02 * rest[:, 0]).all())


@cache
def sample(count: int, kind: str = "hard") -> Sample:
    """A grasp with force closure.

    kind: hard, frictionless (the last third; of three contacts none), thin (nearly on a line).
    """
    rng = np.random.default_rng([count, len(kind)])
    while True:
        found = random_contacts(rng, count)
        if kind == "frictionless" and count > 3:
            found = with_frictionless(found, slice(-(count // 3), None))
        if kind == "thin":
            found = thinned(found, 1e-3)
        if geometry.rank_ratio(found.rows) > 1e-6 and has_closure(found):
            return found


def reference_of(s: Sample) -> np.ndarray:
    """(3N, 3N - 6) object-frame directions of internal forces."""
    internal = np.linalg.svd(s.unit @ geometry.grasp_matrix(s.positions, s.frames))[2][6:].T
    return np.einsum("nab,nbk->nak", s.frames, internal.reshape(s.count, 3, -1)).reshape(
        internal.shape
    )


def moved(s: Sample, size: float, *seed: int) -> Sample:
    """Contacts that have moved by about `size`, in parts of 5 cm and 1 rad."""
    rng = np.random.default_rng([s.count, *(seed or (0,))])
    positions = s.positions + size * 0.05 * rng.standard_normal(s.positions.shape)
    normals = s.normals + size * rng.standard_normal(s.normals.shape)
    return Sample(positions, normals / np.linalg.norm(normals, axis=1)[:, None], s.scale, s.weights)


def wrenches(rng: np.random.Generator, number: int, size: float = 1.0) -> np.ndarray:
    """(number, 6) forces of about `size` [N], moments of 0.05 m times as much."""
    return size * rng.standard_normal((number, 6)) * [1.0, 1.0, 1.0, 0.05, 0.05, 0.05]
