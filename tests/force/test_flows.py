"""The paper's flows: full and reduced are the same (Eqs. 9-26), both are methods, and every step
rule takes the steps it defines."""

from __future__ import annotations

from math import floor

import numpy as np
import pytest
from oracles import full_flow
from oracles import reduced_flow as flow
from oracles.descent import followed
from oracles.reduced_flow import flow_vector, landscape, picked_projector, reduced_projector
from problems import GRASPS, LIGHT

from grasp_env.core import LARGEST
from grasp_env.errors import GraspError, InfeasibleStartError, NotConvergedError
from grasp_env.force import (
    AdaptiveStep,
    BarzilaiBorweinStep,
    ForceOptimizer,
    Objective,
    OfflineBasis,
)
from grasp_env.force.initial import LinearCombination
from grasp_env.grasp import Grasp
from grasp_env.quality import force_closure

OBJECTIVE = Objective(1.0, 0.1)
CUBOID = GRASPS["cuboid, 4"]


def nearly_open(margin: float) -> Grasp:
    """Three contacts on a circle whose normals tilt until force closure has this margin."""
    angle = 2.0 * np.pi * np.arange(3) / 3.0
    out = np.array([np.cos(angle), np.sin(angle), 0.0 * angle]).T

    def made(tilt: float) -> Grasp:
        return Grasp.from_contacts(0.03 * out, -np.cos(tilt) * out + [0.0, 0.0, np.sin(tilt)], 0.5)

    low = 0.0
    high = float(np.arctan(0.5)) + 0.1
    while (middle := 0.5 * (low + high)) not in (low, high):
        try:
            closed = force_closure(made(middle)).margin > margin
        except NotConvergedError:
            closed = False
        low, high = (middle, high) if closed else (low, middle)
    return made(low)


@pytest.mark.parametrize("method", ["reduced_flow", "full_flow"])
@pytest.mark.parametrize("margin", [1e-7, 1e-8, 2e-9, 1.1e-9])
def test_next_to_losing_closure_a_flow_answers_or_refuses(margin, method):
    """Forces are finite, balanced to rounding, and at most 1e12 N, nine decades above the wrench;
    nothing is called infeasible."""
    grasp = nearly_open(margin)
    rng = np.random.default_rng(0)
    for initial in (None, "phase_one", "internal_force", "previous"):
        optimizer = ForceOptimizer(grasp, method=method, initial=initial, max_iterations=2000)
        for wrench in rng.standard_normal((4, 6)) * np.repeat([1.0, 0.03], 3):
            try:
                found = optimizer.solve(wrench)
            except GraspError as error:
                assert isinstance(error, (NotConvergedError, InfeasibleStartError))  # noqa: PT017
                continue
            most = float(np.abs(found.force).max())
            assert most <= LARGEST
            assert np.isfinite(found.multipliers).all()
            assert found.cone_margin >= 0.0
            assert (
                grasp.residual(found.force, wrench)
                <= 1e-9 * max(1.0, np.abs(wrench).max() / grasp.length) + 1e-13 * most
            )


def weights(grasp: Grasp) -> np.ndarray:
    return OBJECTIVE.weights(grasp.n_contacts)


def start(grasp: Grasp, squeeze: float = 5.0) -> np.ndarray:
    """Cone coordinates far from the optimum, for many steps: the start plus `squeeze` times the
    internal optimum."""
    force = (
        LinearCombination(OBJECTIVE)(grasp, LIGHT)
        + squeeze * OfflineBasis.of(grasp, OBJECTIVE).rest
    )
    return grasp.to_cone(force)


@pytest.mark.parametrize("name", GRASPS)
def test_full_and_reduced_iterates_are_equal(name):
    """By the dense projector, by the entries picked from it, and in closed form; balance and the
    structure of P stay."""
    grasp = GRASPS[name]
    # moments in units of the grasp: the projector does not depend on them, its rounding does
    land = landscape(grasp.unit_frame @ grasp.cone_matrix, weights(grasp))
    descent, iterates = followed(start(grasp), land, AdaptiveStep(0.004, grow=1.01), 120)
    assert descent.iterations == 120
    assert descent.values[-1] < 0.95 * descent.values[0]
    a = full_flow.constraints(grasp.cone_matrix)
    q = full_flow.projector(grasp.cone_matrix)
    for missed in (q @ q - q, q - q.T, a @ q):
        np.testing.assert_allclose(missed, 0.0, atol=1e-12)
    picked = picked_projector(grasp.cone_matrix)
    closed = reduced_projector(grasp.cone_matrix)
    np.testing.assert_allclose(picked, closed, rtol=0, atol=1e-11)
    whole = full_flow.start(start(grasp))
    reduced = start(grasp).reshape(-1)
    for alpha, expected in zip(descent.steps, iterates[1:], strict=True):
        whole = whole + alpha * q @ full_flow.drive(whole, weights(grasp))
        reduced = reduced + alpha * picked @ flow_vector(reduced, weights(grasp))
        # rounding of Q, contracted by the flow
        for other in (full_flow.cone_coordinates(whole), expected):
            assert np.abs(other - reduced).max() < 1e-10 * np.abs(reduced).max()
    kept = a @ whole
    assert np.abs(kept - np.append(np.zeros(6 * grasp.n_contacts), -LIGHT)).max() < 1e-11


def test_printed_indices_for_four_fingers():
    """Eqs.

    19 to 21 word for word; floor(a, b) there is the largest integer not greater than a / b.
    """
    m = [
        39 * floor((i - 1) / 3) + 2 ** (2 ** (i - 3 * floor((i - 1) / 3) - 1)) - 1
        for i in range(1, 13)
    ]
    n = [39 * floor((j - 1) / 3) + 12 * (j - 3 * floor((j - 1) / 3) - 1) + 1 for j in range(1, 13)]
    assert (flow.picked_rows(4) + 1).tolist() == m
    assert (flow.picked_columns(4) + 1).tolist() == [begin + k for begin in n for k in range(3)]
    assert picked_projector(CUBOID.cone_matrix).shape == (12, 36)


# step rules


def test_barzilai_borwein_steps_are_inverse_curvatures():
    land = landscape(CUBOID.cone_matrix, weights(CUBOID))
    for variant in ("long", "short", "alternate"):
        descent, iterates = followed(
            start(CUBOID, 2.0), land, BarzilaiBorweinStep(1e-3, variant=variant), 10
        )
        drives = [land.direction(x) for x in iterates]
        for k, alpha in enumerate(descent.steps[1:], 1):
            s = iterates[k] - iterates[k - 1]
            y = drives[k - 1] - drives[k]
            long = land.metric @ s**2 / (land.metric @ (s * y))
            short = land.metric @ (s * y) / (land.metric @ y**2)
            expected = {"long": long, "short": short, "alternate": short if k % 2 else long}[
                variant
            ]
            halvings = float(np.log2(expected / alpha))  # until Phi decreases
            assert halvings == pytest.approx(round(halvings), abs=1e-6)
            assert halvings > -1e-6
