"""Properties of every grasp and wrench, by hypothesis; every strategy draws from fixed seeds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from force.generators import random_grasp, random_wrench
from scipy.spatial.transform import Rotation

from grasp_env.errors import GraspError
from grasp_env.force import ForceSolution, Status, optimize_force
from grasp_env.grasp import Grasp

hypothesis = pytest.importorskip("hypothesis")
given, strategies = hypothesis.given, hypothesis.strategies

hypothesis.settings.register_profile(
    "grasp", derandomize=True, deadline=None, max_examples=20, database=None
)
properties = hypothesis.settings(hypothesis.settings.get_profile("grasp"))

SEEDS = strategies.integers(0, 2**32 - 1)
KINDS = strategies.sampled_from(["hard", "elliptic", "soft", "mixed"])
CRITERIA = strategies.sampled_from(["sum", "max"])
CONIC = 3e-6
"""Two objectives of the same problem, each within 1e-6 of the optimum."""
Generator = np.random.Generator


def case(seed: int, kind: str = "hard", most: int = 8) -> tuple[Grasp, np.ndarray, Generator]:
    """A grasp of about 0.1 m and a wrench of about 1 N that it can balance; other draws are
    rejected."""
    rng = np.random.default_rng(seed)
    try:
        grasp = random_grasp(rng, kind, most=most)
        hypothesis.assume(1e-2 < grasp.length < 10.0)
        wrench = random_wrench(rng, grasp, 0.1, 10.0)
        optimize_force(grasp, wrench, method="conic")
    except GraspError:
        hypothesis.reject()
    return grasp, wrench, rng


def remade(grasp: Grasp, **changes: Any) -> Grasp:
    """The same contacts and frames, except for `changes`."""
    friction, gamma = rubbing(grasp)
    same = {
        "positions": grasp.positions,
        "normals": grasp.normals,
        "friction": friction,
        "contact_model": grasp.models.names,
        "torsional_friction": gamma,
        "tangents": grasp.frames[:, :, 1],
    }
    return Grasp.from_contacts(**(same | changes))


def rubbing(grasp: Grasp) -> tuple[np.ndarray, np.ndarray]:
    """Friction and torsional friction as arguments, which are not zero for any model."""
    friction = grasp.models.friction
    gamma = grasp.models.torsional_friction
    return np.where(friction > 0.0, friction, 0.5), np.where(gamma > 0.0, gamma, 1.0)


def least(grasp: Grasp, wrench: np.ndarray, **options: Any) -> ForceSolution:
    found = optimize_force(grasp, wrench, **{"method": "conic", **options})
    assert found.status is Status.OPTIMAL, found
    assert found.cone_margin >= 0.0
    return found


def cost(grasp: Grasp, wrench: np.ndarray, criterion: str, **options: Any) -> float:
    return least(grasp, wrench, criterion=criterion, **options).objective


# the same problem in other words: (contacts, wrench, order, side of the tangent t)

Same = tuple[Grasp, np.ndarray, Any, float]


def turned(grasp: Grasp, wrench: np.ndarray, rng: Generator, side: float = 1.0) -> Same:
    turn = (
        side * Rotation.random(random_state=np.random.RandomState(rng.integers(2**31))).as_matrix()
    )
    tangents = grasp.frames[:, :, 1] @ turn.T
    there = remade(
        grasp, positions=grasp.positions @ turn.T, normals=grasp.normals @ turn.T, tangents=tangents
    )
    return there, np.concatenate([turn @ wrench[:3], side * turn @ wrench[3:]]), slice(None), side


def mirrored(grasp: Grasp, wrench: np.ndarray, rng: Generator) -> Same:
    """A moment turns the other way, and so does the tangent t."""
    return turned(grasp, wrench, rng, -1.0)


def shifted(grasp: Grasp, wrench: np.ndarray, rng: Generator) -> Same:
    shift = rng.uniform(0.0, 3.0) * grasp.length * rng.standard_normal(3)
    load = np.concatenate([wrench[:3], wrench[3:] + np.cross(shift, wrench[:3])])
    return remade(grasp, positions=grasp.positions + shift), load, slice(None), 1.0


def permuted(grasp: Grasp, wrench: np.ndarray, rng: Generator) -> Same:
    order = rng.permutation(grasp.n_contacts)
    friction, gamma = rubbing(grasp)
    names = [grasp.models.names[k] for k in order]
    positions = grasp.positions[order]
    normals = grasp.normals[order]
    tangents = grasp.frames[order, :, 1]
    each = {"friction": friction[order], "torsional_friction": gamma[order], "contact_model": names}
    return Grasp.from_contacts(positions, normals, tangents=tangents, **each), wrench, order, 1.0


def in_another_unit(grasp: Grasp, wrench: np.ndarray, rng: Generator) -> Same:
    unit = 10.0 ** rng.uniform(-3.0, 3.0)
    other = remade(
        grasp, positions=unit * grasp.positions, torsional_friction=unit * rubbing(grasp)[1]
    )
    return other, wrench * [1, 1, 1, unit, unit, unit], slice(None), 1.0


@pytest.mark.parametrize("change", [turned, mirrored, shifted, permuted, in_another_unit])
@properties
@given(SEEDS, KINDS, strategies.sampled_from(["sum", "max", "newton"]))
def test_the_same_problem_has_the_same_answer(change, seed, kind, what):
    grasp, wrench, rng = case(seed, kind)
    other, load, order, side = change(grasp, wrench, rng)
    if what != "newton":
        assert cost(other, load, what) == pytest.approx(cost(grasp, wrench, what), rel=CONIC)
        return
    # the 12-basis needs force closure
    options = {"method": "newton", "tolerance": 1e-9, "initial": "phase_one"}
    one = least(grasp, wrench, **options)
    two = least(other, load, **options)
    assert two.objective == pytest.approx(one.objective, rel=3e-9)
    want = one.force[order] * [1.0, 1.0, side]
    np.testing.assert_allclose(two.force, want, rtol=0, atol=1e-3 * float(np.abs(want).max()))


# scale


@properties
@given(SEEDS, KINDS, CRITERIA, strategies.integers(-30, 30))
def test_powers_of_two_scale_every_bit(seed, kind, criterion, power):
    grasp, wrench, _ = case(seed, kind)
    one, other = (least(grasp, wrench * k, criterion=criterion) for k in (1.0, 2.0**power))
    np.testing.assert_array_equal(other.force, 2.0**power * one.force)
    np.testing.assert_array_equal(other.torsion, 2.0**power * one.torsion)
    np.testing.assert_array_equal(other.multipliers, one.multipliers)
    assert other.iterations == one.iterations
