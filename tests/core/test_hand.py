"""A hand without a simulator: control ticks that allocate nothing and stay finite, inverse kinematics. Also under the sanitizers."""

from __future__ import annotations

import _core_test as insides
import numpy as np
import pytest


@pytest.mark.parametrize("more", [0, 1])
@pytest.mark.parametrize("late", [False, True])
def test_a_control_tick_allocates_nothing(more: int, late: bool) -> None:
    """Optimised and carried, bounded, with fingers that lose their force, all other things to do, and late and noisy sensors."""
    made, total, repaired, changes, peak = insides.ticks(20_000, more, late)
    assert made == 0
    assert np.isfinite(total)
    assert peak == pytest.approx(3.0, rel=1e-9)  # springs take all that the motors have left, and no more
    assert changes > 100
    assert more or repaired > 100


def test_ticks_repeat_bit_by_bit() -> None:
    assert insides.ticks(500, 0, True) == insides.ticks(500, 0, True)


@pytest.mark.parametrize("more", [0, 2])
def test_tips_are_reached_from_nearby(more: int) -> None:
    assert insides.reached(300, more, 1) <= 1e-9


@pytest.mark.parametrize("shear", [0.5, 1.5, 3.0])
def test_forces_of_the_last_tick_are_followed_from_inside_their_cones(shear: float) -> None:
    """A force changes by at most 0.05 N a tick beyond what takes the last ones into their cones and balances them."""
    force, carried = (np.reshape(each, (4, 3)) for each in insides.landed(shear))
    assert np.abs(force - carried).max() == pytest.approx(0.05, rel=1e-9)
    assert (0.6 * force[:, 0] > np.hypot(force[:, 1], force[:, 2])).all()
