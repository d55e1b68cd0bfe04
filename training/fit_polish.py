"""The fixed grasp as samples for learned layers: where its network's force lies once it is repaired, and true gaps of Phi."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from grasp_env._check import Array
from grasp_env.errors import InfeasibleStartError
from grasp_env.force import Objective
from grasp_env.grasp import Grasp, null_space_basis
from grasp_env.grasp.wrench import sample_ball, sample_magnitudes
from policies.features import Features
from policies.network import Network
from policies.newton_layers import NewtonLayers, newton_step, phi
from training.any_dataset import OBJECTIVE_LEARNED, UNIT, Pool, label
from training.cones import inside
from training.random_grasps import closed

FRICTIONS = 24
SHARES = (1.0, 0.9, 0.75, 0.5, 0.25)
"""Parts of the way from the 12-basis to a prediction outside the cones that are tried."""
GOOD = 1e-4
NAMES, QUANTILES = ("median", "p90", "p95", "p99", "p99.5"), (0.5, 0.9, 0.95, 0.99, 0.995)


class FixedGrasp(NamedTuple):
    """What a model of one grasp is about.

    Attributes:
        grasp: its friction is the one of the standard ball.
        reference: see `null_space_basis`.
        features: of the network.
        objective: Phi to learn.
    """

    grasp: Grasp
    reference: Array
    features: Features
    objective: Objective

    @property
    def unit(self) -> float:
        """[N] sqrt(lambda / omega)."""
        return float(np.sqrt(self.objective.weights(1)[0, 1] / self.objective.weights(1)[0, 0]))


class FixedPool:
    """Wrenches and frictions of one grasp, labelled.

    Args:
        model: the grasp and what its network reads.
        frictions: (F,) coefficients.
        index: (M,) which of them a wrench goes with.
        wrenches: (M, 6) [N, N m].

    Attributes:
        pool: the samples; their basis start is the 12-basis of the grasp with its friction.
    """

    def __init__(self, model: FixedGrasp, frictions: Array, index: np.ndarray, wrenches: Array) -> None:
        grasp, unit = model.grasp, model.unit
        made: list[tuple[Grasp, Array]] = []
        for mu in frictions:
            each = grasp.with_friction(float(mu))
            basis = closed(each, OBJECTIVE_LEARNED)
            if basis is None:
                raise InfeasibleStartError(f"the grasp has no force closure with friction {mu:.3g}: raise friction_low")
            made.append((each, basis))
        # in units of sqrt(lambda / omega) every Phi is the same
        self.pool: Pool = label(made, index, wrenches @ grasp.unit_frame.T * (UNIT / unit))
        raw = self.pool.wrench.numpy() @ np.linalg.inv(grasp.unit_frame).T * (unit / UNIT)
        kept = self.pool.grasp.numpy()
        inputs, size = model.features(raw, frictions[kept])
        self._inputs = torch.from_numpy(inputs.astype(np.float32))
        self._scale = torch.from_numpy(np.array([each.models.cone_scale for each, _ in made])[kept] / unit)
        self._particular = torch.from_numpy((-raw @ grasp.pseudoinverse.T).reshape(-1, grasp.n_contacts, 3))
        self._size = torch.from_numpy(size)[:, None]
        self._null_space = torch.from_numpy(null_space_basis(grasp, model.reference))

    @classmethod
    def ball(cls, model: FixedGrasp, rng: np.random.Generator, count: int) -> FixedPool:
        """The standard ball at the grasp's own friction."""
        return cls(model, model.grasp.friction[:1], np.zeros(count, int), sample_ball(rng, count))

    @classmethod
    def ranges(
        cls,
        model: FixedGrasp,
        rng: np.random.Generator,
        count: int,
        magnitudes: tuple[float, float],
        friction: tuple[float, float],
    ) -> FixedPool:
        """The range of training, on a few frictions."""
        frictions = np.sort(np.concatenate([friction, rng.uniform(*friction, FRICTIONS - 2)]))
        wrenches = sample_magnitudes(rng, count, *magnitudes)
        return cls(model, frictions, rng.integers(0, FRICTIONS, count), wrenches)

    @torch.no_grad()
    def starts(self, network: Network) -> tuple[Tensor, Tensor]:
        """(M, 5, 3) the network's forces, and the same repaired as the kernels do: units of `UNIT`, cone coordinates."""
        internal = network(self._inputs).double() * self._size @ self._null_space.T
        made = (self._particular + internal.reshape(self._particular.shape)) * self._scale
        raw = torch.zeros_like(self.pool.starts["basis"])
        raw[:, : made.shape[1]] = made
        problems, safe = self.pool.problems(torch.arange(len(self.pool))), self.pool.starts["basis"]
        edge = inside(safe, raw, problems.mask)
        best, least = safe, phi(problems, safe)
        for target, share in ((raw, 1.0), *((edge, share) for share in SHARES)):
            force = safe + share * (target - safe)
            value = phi(problems, force)
            best = torch.where((value < least)[:, None, None], force, best)
            least = torch.minimum(value, least)
        return raw, best

    def gap(self, force: Tensor) -> Tensor:
        """(M,) relative gap of Phi; inf outside the cones."""
        return phi(self.pool.problems(torch.arange(len(self.pool))), force) / self.pool.least - 1.0

    @torch.no_grad()
    def scores(self, network: Network, polish: NewtonLayers | None, steps: int = 2) -> dict[str, Any]:
        """Summaries of the gap: raw, repaired, after each learned layer and after as many plain Newton steps."""
        raw, start = self.starts(network)
        problems, x = self.pool.problems(torch.arange(len(self.pool))), start
        told: dict[str, Any] = {
            "raw": _summary(self.gap(raw)) | {"outside the cones": float(torch.isinf(self.gap(raw)).double().mean())},
            "repaired": _summary(self.gap(start)),
        }
        layers = polish(problems, start) if polish is not None else []
        for count, force in enumerate(layers, start=1):
            told[f"{count} learned layers"] = _summary(self.gap(force))
        for count in range(1, max(steps, len(layers)) + 1):
            x = newton_step(problems, x)
            told[f"{count} Newton steps"] = _summary(self.gap(x))
        return told


def _summary(gap: Tensor) -> dict[str, Any]:
    found = np.quantile(gap.numpy(), QUANTILES, method="higher")
    told: dict[str, Any] = {
        name: float(f"{max(value, 0.0):.3g}") if np.isfinite(value) else None
        for name, value in zip(NAMES, found, strict=True)
    }
    return told | {f"share below {GOOD:g}": float((gap <= GOOD).double().mean())}
