import numpy as np
import pytest
from force.clarabel_reference import Reference
from problems import GRASPS, closure_grasps, pyramid_margin, random_grasp

from grasp_env.errors import NotConvergedError
from grasp_env.force.limits import ForceLimits
from grasp_env.grasp import Grasp, presets
from grasp_env.quality import ForceClosure, force_closure


def random_grasps(number: int) -> list[Grasp]:
    rng = np.random.default_rng(11)
    return [random_grasp(rng, 3 + k % 5) for k in range(number)]


def assert_no_work_against(grasp: Grasp, twist: np.ndarray) -> None:
    """No force in the cones does negative work along the twist, and some do work."""
    assert Reference.of(grasp).separates(twist, np.zeros(6)) >= -1e-8
    assert np.abs(twist @ grasp.matrix).max() > 1e-8 * np.abs(twist).max()


def depth(grasp: Grasp, found: ForceClosure) -> float:
    """Depth in the cones of the witness, for mu * normal that sum to one less the depth."""
    assert found.force is not None
    least = grasp.cone_margin(found.force)
    return least / (float((grasp.friction * found.force[:, 0]).sum()) + least)


def test_verdicts_against_pyramids() -> None:
    closed = opened = 0
    for grasp in random_grasps(60):
        found = force_closure(grasp)
        inner, outer = (pyramid_margin(grasp, np.zeros(6), inner, limited=True)[0] for inner in (True, False))
        if inner > 1e-6:
            assert found.closed
            closed += 1
        elif not outer > 1e-6:
            assert not found
            opened += 1
        if found:
            assert found.twist is None
            assert grasp.residual(found.force, np.zeros(6)) <= 1e-14 * np.abs(found.force).sum()
            assert found.margin == pytest.approx(depth(grasp, found), rel=1e-5, abs=1e-8)
            # the pyramids inside and outside enclose the depth, for mu * normal that sum to one
            deep = found.margin / (1.0 - found.margin) * grasp.n_contacts
            assert inner * (1.0 - 1e-6) - 1e-7 <= deep <= outer * (1.0 + 1e-6) + 1e-7
        else:
            assert found.force is None
            assert found.margin == 0.0
            assert found.error <= 1e-8
            assert_no_work_against(grasp, found.twist)
    assert closed >= 20
    assert opened >= 10


def test_no_tangential_force_needed_is_the_largest_margin() -> None:
    soft = {"contact_model": "soft", "torsional_friction": 0.005}
    pinch = Grasp.from_contacts([[0, 0, -0.02], [0, 0, 0.02]], [[0, 0, 1], [0, 0, -1]], 0.5, **soft)
    assert force_closure(presets.tripod()).margin == pytest.approx(1 / 4, rel=1e-7)
    assert force_closure(pinch).margin == pytest.approx(1 / 3, rel=1e-7)
    for grasp in GRASPS.values():
        found = force_closure(grasp)
        assert found.witness is found.force
        assert (grasp.friction * found.witness[:, 0]).sum() == pytest.approx(1.0)


def test_soft_frictionless_and_elliptic_contacts() -> None:
    positions = [[0.005, 0, -0.02], [-0.005, 0, 0.02], [0, 0.03, 0], [0, -0.03, 0]]
    normals, models = [[0, 0, 1], [0, 0, -1], [0, -1, 0], [0, 1, 0]], ["soft"] * 2 + ["frictionless"] * 2
    grasp = Grasp.from_contacts(positions, normals, [[0.5, 0.3]] * 4, contact_model=models, torsional_friction=0.004)
    found = force_closure(grasp)
    assert found
    assert grasp.residual(found.force, np.zeros(6), found.torsion) <= 1e-14
    assert (np.abs(found.torsion) < 0.004 * found.force[:, 0])[:2].all()
    # one more soft contact that faces the other way, and nothing to press against
    up = [[0, 0, 1], [0, 0, 1]]
    alone = Grasp.from_contacts(positions[:2], up, 0.5, contact_model="soft", torsional_friction=0.004)
    without = force_closure(alone)
    assert not without
    assert_no_work_against(alone, without.twist)


@pytest.mark.parametrize("grasp", [*closure_grasps()[:4], *random_grasps(8)], ids=lambda grasp: f"N{grasp.n_contacts}")
def test_turning_all_normals_round_changes_nothing(grasp: Grasp) -> None:
    one, other = (
        force_closure(Grasp.from_contacts(grasp.positions, k * grasp.normals, grasp.friction)) for k in (1, -1)
    )
    assert one.closed == other.closed
    assert one.margin == pytest.approx(other.margin, rel=1e-6, abs=1e-9)
    assert one or "turning all normals round gives no force closure either" in str(other)


def test_one_outward_normal_is_named() -> None:
    good = presets.tripod()
    found = force_closure(Grasp.from_contacts(good.positions, good.normals * [[1.0], [-1.0], [1.0]], 0.5))
    assert not found
    assert "normals of contacts [1] point away" in found.help
    assert str(force_closure(good)).startswith("force closure")


def test_the_last_digits_of_friction_never_raise_the_wrong_answer() -> None:
    # too little friction on three fingers that do not face each other; bisect to where closure begins
    tilted = np.array([[-1.0, 0.2, 0.0], [0.5, -0.9, 0.0], [0.5, 0.5, 0.3]])
    tilted /= np.linalg.norm(tilted, axis=1)[:, None]
    low, high = 0.01, 2.0
    grasp = Grasp.from_contacts(presets.tripod().positions, tilted, 0.5)
    assert not force_closure(grasp.with_friction(low))
    assert force_closure(grasp.with_friction(high))
    for _ in range(45):
        middle = 0.5 * (low + high)
        try:
            found = force_closure(grasp.with_friction(middle))
        except NotConvergedError:
            break
        low, high = (low, middle) if found else (middle, high)
        there = grasp.with_friction(middle)
        inner, outer = (pyramid_margin(there, np.zeros(6), inner, limited=True)[0] for inner in (True, False))
        assert found or not inner > 1e-6
        assert not found or outer > 1e-9
    assert high - low < 1e-6


def test_limits() -> None:
    grasp = presets.paper_cuboid()
    limits = ForceLimits(min_normal=[0.0, 2.0, 2.0, 2.0], max_normal=7.0)
    found = force_closure(grasp, limits)
    assert found
    assert limits.violations(grasp, found.force, tolerance=0.0) == []
    assert grasp.residual(found.force, np.zeros(6)) <= 1e-13
    impossible = ForceLimits(min_normal=[0.0, 2.0, 2.0, 2.0], max_normal=5.0)
    without = force_closure(grasp, impossible)
    assert not without
    assert without.margin < 0.0
    assert "widen the limits" in without.help
    # what the cones forbid, limits do not mend
    palm = Grasp.from_contacts(grasp.positions, [[0, 0, 1]] * 4, 0.4)
    np.testing.assert_array_equal(force_closure(palm, limits).twist, force_closure(palm).twist)
