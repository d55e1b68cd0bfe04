"""Control ticks of a hand without a simulator allocate nothing, stay finite and repeat.

Also run under the sanitizers.
"""

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
def test_control_ticks_allocate_nothing_and_repeat_bit_by_bit(case):
    """Forces that are optimised, adjusted and bounded, fingers that come and go, and all other ways
    to hold."""
    found = insides.ticks(900, *CASES[case])
    allocated, total, _, changes, peak = found
    assert allocated == 0
    assert np.isfinite(total)
    # springs take all that the motors have left, and no more
    assert peak == pytest.approx(CASES[case][4], rel=1e-9)
    assert changes > 5
    assert insides.ticks(900, *CASES[case]) == found
