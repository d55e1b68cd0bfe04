"""Arguments of a call in the forms in which sensors and messages deliver them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from grasp_env.errors import GraspError, InvalidInputError
from grasp_env.force import ForceLimits, ForceOptimizer, Status
from grasp_env.grasp import Grasp, presets

CUBOID = presets.paper_cuboid()
WRENCH = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])
JACOBIAN = 0.05 * np.random.default_rng(0).standard_normal((4, 3, 12))
THREE = np.array([True, True, True, False])


def test_numbers_of_a_contact_that_does_not_touch_are_not_read():
    """Arrays, which the core reads in place, and lists; nan and infinities, and for a start in
    Python as well."""
    optimizer = ForceOptimizer(CUBOID, limits=ForceLimits(jacobian=JACOBIAN, torque_limit=5.0))
    whole: dict[str, Any] = {
        "positions": CUBOID.positions,
        "normals": CUBOID.normals,
        "friction": np.full(4, 0.4),
        "jacobian": JACOBIAN,
    }
    expected = optimizer.solve(WRENCH, **whole, contacts=THREE)
    for odd in (np.nan, np.inf, 1e300):
        broken = {
            name: np.where(THREE.reshape(-1, *[1] * (a.ndim - 1)), a, odd)
            for name, a in whole.items()
        }
        for given in (broken, {name: a.tolist() for name, a in broken.items()}):
            for options in ({}, {"initial": lambda grasp, wrench: expected.force[:3]}):
                found = optimizer.solve(WRENCH, **given, contacts=THREE, **options)
                assert found.status is Status.OPTIMAL
                np.testing.assert_allclose(found.force, expected.force, rtol=1e-3, atol=1e-3)
        for name in whole:
            with pytest.raises(InvalidInputError, match=name):
                optimizer.solve(WRENCH, **{**whole, name: broken[name]}, contacts=[True] * 4)


@pytest.mark.parametrize(
    "mask",
    [[1, 1, 1, 0], [1.0, 1, 1, 0], THREE.astype(np.uint8), THREE.astype(float), THREE.tolist()],
    ids=str,
)
def test_a_mask_of_ones_and_zeros_is_a_mask(mask):
    optimizer = ForceOptimizer(CUBOID)
    np.testing.assert_array_equal(
        optimizer.solve(WRENCH, contacts=mask).force, optimizer.solve(WRENCH, contacts=THREE).force
    )


@pytest.mark.parametrize(
    "mask",
    [[1, 1, 1, 2], [1, 1, 1, np.nan], ["1"] * 4, [1, 1, 1], [[1, 1, 1, 1]], [[1], [1, 1]], 1],
    ids=str,
)
def test_other_masks_are_refused(mask):
    with pytest.raises(InvalidInputError, match=r"contacts must be \(4,\) of true and false"):
        ForceOptimizer(CUBOID).solve(WRENCH, contacts=mask)


def unaligned(a: np.ndarray) -> np.ndarray:
    """The same numbers, one byte after an address that a processor likes."""
    made = np.frombuffer(b"x" + a.tobytes(), dtype=float, offset=1).reshape(a.shape)
    assert not made.flags.aligned
    return made


def test_arrays_at_odd_addresses_are_copied():
    optimizer = ForceOptimizer(
        CUBOID, limits=ForceLimits(jacobian=unaligned(JACOBIAN), torque_limit=5.0)
    )
    given = {
        "positions": CUBOID.positions,
        "normals": CUBOID.normals,
        "jacobian": JACOBIAN,
        "friction": np.full(4, 0.4),
    }
    odd = {name: unaligned(a) for name, a in given.items()}
    expected = optimizer.solve(WRENCH, **given)
    np.testing.assert_array_equal(optimizer.solve(unaligned(WRENCH), **odd).force, expected.force)
    grasp = Grasp.from_contacts(odd["positions"], odd["normals"], odd["friction"])
    np.testing.assert_array_equal(
        grasp.matrix, Grasp.from_contacts(CUBOID.positions, CUBOID.normals, 0.4).matrix
    )
    even = ForceOptimizer(CUBOID, limits=ForceLimits(jacobian=JACOBIAN, torque_limit=5.0))
    optimizer.update(**odd)
    even.update(**given)
    np.testing.assert_array_equal(optimizer.solve(WRENCH).force, even.solve(WRENCH).force)


@pytest.mark.parametrize(
    "name",
    ["method", "criterion", "force_weight", "tolerance", "max_iterations", "step_rule", "elastic"],
)
def test_options_that_cannot_be_hashed_are_named(name):
    for odd in (memoryview(bytearray(8)), {}, [[]]):
        with pytest.raises(GraspError, match=name):
            ForceOptimizer(CUBOID, **{name: odd})
