"""contact_estimator.hpp allocates nothing where it runs, and refuses wrong settings."""

from __future__ import annotations

from building import succeed

from grasp_env.sim import HandDescription, HandKinematics


def test_updates_allocate_nothing(programs, tmp_path):
    """Also with joints that move at up to 30 rad/s, for normals and for a surface."""
    file = HandKinematics(HandDescription.allegro()).export(tmp_path / "allegro.hand")
    assert succeed(programs / "contact_estimator", file).splitlines() == [
        "allocations: 0, finite: 1, nothing known: 1",
        "another hand: 0",
        "touch must be finite and above release, and release at least 0 N",
    ]
