"""A hand without a simulator: control ticks that allocate nothing and stay finite, inverse kinematics. Also under the sanitizers."""

from __future__ import annotations

import _core_test as insides
import numpy as np
import pytest

# joints besides, late sensors, soft contacts, a shared joint, torque limit [N m], flow
CASES = {
    "flow": (0, False, False, False, 3.0, True),
    "newton, redundant, late": (1, True, False, False, 3.0, False),
    "within limits, late": (0, True, False, False, 0.15, True),
    "no force within limits": (0, False, False, False, 0.05, False),
    "soft": (0, False, True, False, 3.0, False),
    "soft within limits": (1, False, True, False, 0.15, False),
    "a shared joint": (0, False, False, True, 3.0, True),
    "a shared joint within limits": (0, True, False, True, 0.2, False),
}


@pytest.mark.parametrize("case", CASES)
def test_a_control_tick_allocates_nothing(case: str) -> None:
    """Optimized, adjusted, bounded, with fingers that come and go, and all other things to do."""
    made, total, _, changes, peak = insides.ticks(3000, *CASES[case])
    limit = CASES[case][4]
    assert made == 0
    assert np.isfinite(total)
    assert peak == pytest.approx(limit, rel=1e-9)  # springs take all that the motors have left, and no more
    assert changes > 20


def test_ticks_repeat_bit_by_bit() -> None:
    for case in CASES.values():
        assert insides.ticks(300, *case) == insides.ticks(300, *case)


@pytest.mark.parametrize("more", [0, 2])
def test_tips_are_reached_from_nearby(more: int) -> None:
    assert insides.reached(300, more, 1) <= 1e-9
