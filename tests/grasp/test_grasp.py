"""Grasps against the plain formulas of the oracles: frames, G, its inverse and rank, contact
models, conversions."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from oracles import geometry
from problems import random_grasp

from grasp_env.errors import InvalidInputError, RankDeficientGraspError
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.contact import contact_frames

POSITIONS = presets.tripod().positions
NORMALS = presets.tripod().normals
ALONG = np.ascontiguousarray(NORMALS[:, [1, 2, 0]] + NORMALS[:, [2, 0, 1]])
ARRAYS = (
    "positions",
    "normals",
    "friction",
    "frames",
    "matrix",
    "cone_matrix",
    "torsion_matrix",
    "centre",
    "unit_frame",
)
SOFT = {"contact_model": "soft", "torsional_friction": 0.005}
PINCH = ([[0, 0, -0.02], [0, 0, 0.02]], [[0, 0, 1], [0, 0, -1]], 0.5)


def same(grasp: Grasp, other: Grasp) -> None:
    """Equal to the bit."""
    for name in (*ARRAYS, "pseudoinverse"):
        np.testing.assert_array_equal(getattr(grasp, name), getattr(other, name), err_msg=name)
    for name in ("friction", "torsional_friction", "cone_scale", "cone_divisor"):
        np.testing.assert_array_equal(
            getattr(grasp.models, name), getattr(other.models, name), err_msg=name
        )
    assert (grasp.models.names, grasp.length) == (other.models.names, other.length)


def test_frames_follow_the_rule_of_the_tangents():
    normals = geometry.directions()
    plain = np.array([geometry.frame(n) for n in normals])
    # near |n_x| = 0.9 the projection divides by 0.44 at least
    np.testing.assert_allclose(contact_frames(normals), plain, atol=3e-15)
    positions, along = np.random.default_rng(1).uniform(-0.1, 0.1, (2, *normals.shape))
    given = Grasp.from_contacts(positions, normals, 0.5, tangents=along)
    np.testing.assert_allclose(given.with_friction(0.3).frames, given.frames, atol=1e-15)


@pytest.mark.parametrize("tangents", [False, True])
@pytest.mark.parametrize("count", [3, 4, 5, 7, 50])
def test_arrays_are_the_plain_formulas(count, tangents):
    rng = np.random.default_rng(count)
    base = random_grasp(rng, count)
    mu = rng.uniform(0.2, 1.0, (count, 2))
    along = rng.standard_normal((count, 3)) if tangents else None
    models = ["soft", "frictionless", *(count - 2) * ["hard"]]
    twisting: dict[str, Any] = (
        {"contact_model": models, "torsional_friction": 0.01} if count > 3 else {}
    )
    grasp = Grasp.from_contacts(base.positions, base.normals, mu, tangents=along, **twisting)
    frames = np.array(
        [geometry.frame(n, None if along is None else along[k]) for k, n in enumerate(base.normals)]
    )
    centre, length, unit = geometry.unit_frame(base.positions)
    matrix = geometry.grasp_matrix(base.positions, frames)
    mean = np.sqrt(mu.prod(axis=1))
    scale = np.column_stack([mean, mean / mu[:, 0], mean / mu[:, 1]])
    torsion = np.zeros((6, count))
    divisor = scale.copy()
    friction = mean.copy()
    if twisting:
        scale[1] = (1, 0, 0)
        divisor[1] = (1, np.inf, np.inf)
        friction[1] = 0.0
        torsion[3:, 0] = base.normals[0]
    wanted = {
        "positions": base.positions,
        "normals": base.normals,
        "frames": frames,
        "matrix": matrix,
        "centre": centre,
        "length": length,
        "unit_frame": unit,
        "friction": friction,
        "cone_matrix": matrix / divisor.reshape(-1),
        "torsion_matrix": torsion,
    }
    for name, value in wanted.items():
        np.testing.assert_allclose(
            getattr(grasp, name), value, rtol=1e-12, atol=1e-13, err_msg=name
        )
    np.testing.assert_allclose(grasp.models.cone_scale, scale, rtol=1e-15)
    np.testing.assert_allclose(grasp.models.cone_divisor, divisor, rtol=1e-15)
    # condition numbers reach 1e3 on random grasps
    carried = matrix * (scale > 0.0).reshape(-1)
    plain = np.linalg.pinv(np.concatenate([carried, torsion], axis=1))[: 3 * count]
    near = 1e-11 * np.abs(plain).max()
    np.testing.assert_allclose(grasp.pseudoinverse, plain, rtol=0, atol=near)
    # forces there and back; G f by hand; margins
    force = rng.standard_normal((count, 3))
    twist = rng.standard_normal(count)
    carried = force * (scale > 0.0)
    np.testing.assert_allclose(grasp.to_force(grasp.to_cone(force)), carried, rtol=1e-15)
    vectors = grasp.to_object_frame(force)
    np.testing.assert_allclose(
        vectors, [frame @ f for frame, f in zip(frames, force, strict=True)], atol=1e-13
    )
    np.testing.assert_allclose(grasp.to_contact_frame(vectors), force, atol=1e-13)
    wrench = (
        np.concatenate([vectors.sum(axis=0), np.cross(base.positions, vectors).sum(axis=0)])
        + torsion @ twist
    )
    np.testing.assert_allclose(grasp.wrench(force, twist), wrench, atol=1e-12)
    load = rng.standard_normal(6)
    assert grasp.residual(force, load, twist) == pytest.approx(
        np.abs(unit @ (wrench + load)).max(), rel=1e-11
    )
    x = (scale * force).reshape(-1, 3)
    np.testing.assert_allclose(
        grasp.cone_margins(force), x[:, 0] - np.hypot(x[:, 1], x[:, 2]), atol=1e-14
    )
    assert grasp.cone_margin(force) == grasp.cone_margins(force).min()
    # with torsions: v = mu / gamma torsion of the soft one, and of no other
    turned = np.zeros(count)
    if count > 3:
        turned[0] = mu[0, 0] ** 0.5 * mu[0, 1] ** 0.5 / 0.01 * twist[0]
    four = np.column_stack([x, turned])
    np.testing.assert_allclose(grasp.to_cone(force, twist), four.reshape(-1), rtol=1e-14)
    np.testing.assert_allclose(
        grasp.cone_margins(force, twist),
        x[:, 0] - np.sqrt(x[:, 1] ** 2 + x[:, 2] ** 2 + turned**2),
        rtol=1e-14,
        atol=1e-14,
    )
    assert grasp.cone_margin(force, twist) == grasp.cone_margins(force, twist).min()
    parts = {"soft": 3, "frictionless": 0, "hard": 2}
    np.testing.assert_array_equal(
        grasp.models.tangential, [parts[name] for name in grasp.models.names]
    )


def test_rank_is_that_of_the_singular_values():
    """A clear rank is decided without them, since they cost ten times the rest of a grasp."""
    rng = np.random.default_rng(0)
    clear = 0
    lost = 0
    for thin in 10.0 ** np.arange(-12.0, 0.0, 0.25):
        base = random_grasp(rng, 3 + clear % 4)
        # nearly on a line, off the origin
        positions = base.positions * [1.0, thin, thin] + [0.1, -0.2, 0.3]
        frames = np.array([geometry.frame(n) for n in base.normals])
        ratio = geometry.rank_ratio(
            geometry.unit_frame(positions)[2] @ geometry.grasp_matrix(positions, frames)
        )
        grasp = Grasp.from_contacts(positions, base.normals, base.friction)
        if grasp.rank < 6:
            assert ratio < 1.1e-8
            lost += 1
            with pytest.raises(RankDeficientGraspError, match=rf"rank\(G\) = {grasp.rank} < 6"):
                grasp.pseudoinverse  # noqa: B018
            continue
        assert ratio > 0.9e-8
        found = grasp.contacts.clear
        clear += found
        assert (not found or ratio > 1e-6) and (found or ratio < 1e-2)  # noqa: PT018
    assert min(clear, lost) > 4
    # two soft contacts, never two hard ones
    assert Grasp.from_contacts(*PINCH, **SOFT).null_dimension == 1


MODELS: dict[str, dict[str, Any]] = {
    "hard": {"friction": [0.3, 0.4, 0.5]},
    "elliptic": {"friction": [[0.3, 0.4], [0.5, 0.2], [0.4, 0.4]]},
    "mixed": {
        "friction": 0.5,
        "contact_model": ["hard", "soft", "hard"],
        "torsional_friction": 0.01,
    },
}


@pytest.mark.parametrize("tangents", [None, ALONG], ids=["default", "given"])
@pytest.mark.parametrize("models", MODELS)
def test_unchecked_pickled_and_copied_grasps_are_the_same_to_the_bit(models, tangents):
    grasp = Grasp.from_contacts(POSITIONS + 0.01, NORMALS, tangents=tangents, **MODELS[models])
    positions = grasp.positions.copy()
    unchecked = Grasp.unchecked(positions, grasp.normals.copy(), grasp.models, tangents)
    positions[0] = 9.0
    for again in (unchecked, pickle.loads(pickle.dumps(grasp)), copy.deepcopy(grasp)):
        same(again, grasp)
        assert not again.matrix.flags.writeable
    with pytest.raises(InvalidInputError, match=r"of their centre .* got 0 m"):
        Grasp.unchecked(np.zeros((3, 3)), grasp.normals, grasp.models)


FORMS = {
    "lists": np.ndarray.tolist,
    "columns": np.asfortranarray,
    "swapped": lambda a: a.astype(">f8"),
    "strided": lambda a: np.repeat(a, 2, axis=0)[::2],
    "object": lambda a: a.astype(object),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    "friction", [0.4, [0.4, 0.5, 0.6], [[0.4, 0.5], [0.6, 0.6], [0.5, 0.4]]], ids=str
)
def test_numbers_in_any_form_make_the_same_grasp(form, friction):
    """The compiled reader takes plain arrays; anything else goes through Python."""
    # normals to rounding of unit length
    given = [POSITIONS + 0.01, NORMALS * (1.0 + 5e-7), np.array(friction)]
    grasp = Grasp.from_contacts(*given, tangents=ALONG)
    np.testing.assert_allclose(np.linalg.norm(grasp.normals, axis=1), 1.0, atol=3e-16)
    turned = [FORMS[form](a) if a.ndim else float(a) for a in given]
    same(grasp, Grasp.from_contacts(*turned, tangents=FORMS[form](ALONG)))
    same(grasp, Grasp.from_contacts(*given, contact_model=["hard"] * 3, tangents=ALONG))


def test_a_grasp_is_an_immutable_copy():
    positions = POSITIONS.copy()
    friction = np.full(3, 0.5)
    grasp = Grasp.from_contacts(positions, NORMALS, friction)
    positions[0] = friction[0] = 9.0
    same(grasp, presets.tripod())
    for name in ARRAYS:
        with pytest.raises(ValueError, match="read-only"):
            getattr(grasp, name)[0] = 1.0
    shown = grasp.matrix
    del grasp
    np.testing.assert_array_equal(shown, presets.tripod().matrix)
