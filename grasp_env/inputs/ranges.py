"""Smallest and largest numbers of a problem: calls raise `InvalidInputError` beyond them.

The ranges were measured on hard, soft and elliptic grasps with all methods. They end a decade or
more before answers lose their digits. Wrenches go up to `core.LARGEST`.
"""

from __future__ import annotations

from typing import NamedTuple


class Range(NamedTuple):
    """Closed interval from `low` to `high`, in `unit`."""

    low: float
    high: float
    unit: str = ""

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g}{self.unit and ' '}{self.unit}"


POSITIVE = Range(1e-300, 1e300)
"""Positive numbers of any size."""
FINITE = Range(-1e300, 1e300)
NOT_NEGATIVE = Range(0.0, 1e300)

FRICTION = Range(1e-4, 1e4)
"""Coulomb coefficients: below 1e-6 and above 1e5 balance loses its digits."""
TORSIONAL_FRICTION = Range(1e-15, 1e6, "m")
"""Torsional friction gamma; or 0, of a hard contact."""
TORSIONAL_LEVER = 1e4
"""Largest gamma in lengths of the grasp: from 1e6 on torsion outweighs every other moment."""
FRICTION_MARGIN = Range(0.01, 1.0)
"""Shares of friction that forces may use."""
LENGTH = Range(1e-9, 1e6, "m")
"""Lengths of grasps, and others that turn moments into forces."""
DISTANCE = 1e5
"""Largest distance of a grasp from the origin, in its lengths: moments lose as many digits."""
SIZE = Range(-1e50, 1e50)
"""Numbers that are only multiplied: products of six of them do not overflow."""
DIRECTION = Range(1e-100, 1e12)
"""Largest components of directions whose multiples are loads."""
SIDE_BY_SIDE = 100_000_000
"""Most contacts that `Objective` takes at once, which are those of many grasps."""
MASS = Range(1e-9, 1e9, "kg")
CONTACTS = 1000
"""Most contacts of a grasp."""

FORCE_WEIGHT = Range(1e-4, 1e4)
"""Weight omega; forces are in units of sqrt(lambda / omega), 100 kN at the most."""
BARRIER_WEIGHT = Range(1e-16, 1e6, "N^2")
"""Weight lambda: 0.01 for newtons is 1e-14 for micronewtons."""
TOLERANCE = Range(1e-300, 1.0)
"""Relative gaps."""
ITERATIONS = 10_000_000
"""Most steps of a solve; a trace keeps one number for each."""

STEP = Range(1e-15, 1e12, "N")
"""First trial steps of the flows."""
SHRINK = Range(1e-3, 0.999)
"""Factors of a line search, which ends after log(1e16) / -log(shrink) trials: 37,000 at 0.999."""

NORMAL_FORCE = Range(1e-12, 1e12, "N")
"""Limits on normal forces that are neither 0 nor infinite."""
LEAST_NORMAL_FORCE = Range(0.0, 1e6, "N")
TORQUE = Range(1e-12, 1e12, "N m")
"""Finite limits on torques."""
BIAS = Range(-1e12, 1e12, "N m")
LEVER = Range(-1e6, 1e6, "m")
"""Entries of a Jacobian."""
JOINTS = 1000

BALL = Range(1e-9, 1e9, "N or N m")
"""Radii of a `WrenchBall`."""
STARTS = 10_000
POINTS = 5000
"""Most points of the hull of `worst_case`, which has far more facets."""

NUMBERS = 100_000_000
"""Most numbers that a call makes of a count: 0.8 GB."""
SEED = 2**63 - 1
WORKERS = 1024
