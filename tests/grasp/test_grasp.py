from __future__ import annotations

import copy
import pickle
from dataclasses import asdict, replace

import numpy as np
import pytest
from oracles import geometry
from problems import GRASPS, random_grasp

from grasp_env import ranges
from grasp_env.errors import GraspError, InvalidInputError, RankDeficientGraspError, UnknownNameError
from grasp_env.grasp import Grasp, presets

POSITIONS = presets.tripod().positions
NORMALS = presets.tripod().normals


@pytest.mark.parametrize("name", GRASPS)
def test_pseudoinverse_is_the_least_norm_answer(name: str) -> None:
    grasp = GRASPS[name]
    # condition number of G about 40 on these grasps: 1e-13 leaves a factor of ten over rounding
    np.testing.assert_allclose(grasp.pseudoinverse, np.linalg.pinv(grasp.matrix), rtol=0, atol=1e-13 * 40)
    np.testing.assert_allclose(grasp.matrix @ grasp.pseudoinverse, np.eye(6), atol=1e-13)


def test_pseudoinverse_does_not_depend_on_where_moments_are_scaled() -> None:
    rng = np.random.default_rng(3)
    for count in range(3, 8):
        grasp = random_grasp(rng, count)
        error = grasp.matrix @ grasp.pseudoinverse - np.eye(6)
        assert np.abs(error).max() < 1e-11  # condition numbers reach 1e3 on random grasps
        # least norm: the answer has no part in the null space
        null = np.linalg.svd(grasp.matrix)[2][6:]
        assert np.abs(null @ grasp.pseudoinverse).max() < 1e-9 * np.abs(grasp.pseudoinverse).max()


def test_a_grasp_is_immutable() -> None:
    grasp = presets.tripod()
    for array in (grasp.positions, grasp.normals, grasp.friction, grasp.frames, grasp.matrix, grasp.cone_matrix):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    with pytest.raises(AttributeError):
        grasp.length = 1.0  # type: ignore[misc]


def test_the_callers_arrays_are_neither_kept_nor_frozen() -> None:
    positions, normals, friction = POSITIONS.copy(), NORMALS.copy(), np.full(3, 0.5)
    grasp = Grasp.from_contacts(positions, normals, friction)
    positions[0], normals[0], friction[0] = 9.0, 9.0, 9.0
    np.testing.assert_array_equal(grasp.positions, POSITIONS)
    np.testing.assert_array_equal(grasp.friction, np.full(3, 0.5))


def test_presets_by_name_and_their_friction() -> None:
    for name in presets.PRESETS:
        assert presets.preset(name, 0.7).friction.tolist() == [0.7] * presets.preset(name).n_contacts
    np.testing.assert_array_equal(presets.paper_cuboid().positions[0], [0.0, 0.0, -0.05])
    np.testing.assert_array_equal(presets.paper_cuboid().normals[:, 2], [1.0, -1.0, -1.0, -1.0])
    assert (presets.paper_cuboid().friction == 0.4).all()
    grasp = presets.tripod()
    np.testing.assert_array_equal(grasp.with_friction([0.1, 0.2, 0.3]).friction, [0.1, 0.2, 0.3])


def test_residual_is_the_largest_component_with_moments_over_length() -> None:
    grasp = presets.paper_cuboid()
    nothing = np.zeros((4, 3))
    assert grasp.residual(nothing, np.array([0.0, -3.0, 0.0, 0.0, 0.0, 0.0])) == 3.0
    moment = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2.0])
    assert grasp.residual(nothing, moment) == pytest.approx(2.0 / grasp.length, rel=1e-15)
    assert moment[5] == 2.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("which", ["positions", "normals", "friction"])
def test_values_that_are_not_finite(which: str, bad: float) -> None:
    given = {"positions": POSITIONS.copy(), "normals": NORMALS.copy(), "friction": np.full(3, 0.5)}
    given[which].reshape(-1)[1] = bad
    with pytest.raises(InvalidInputError, match=rf"{which} must be finite, got .*{bad}") as caught:
        Grasp.from_contacts(**given)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize(
    ("which", "value", "message"),
    [
        ("positions", np.zeros((3, 2)), r"positions must have shape \(N, 3\), got \(3, 2\)"),
        ("positions", [], r"positions must have shape \(N, 3\), got \(0,\)"),
        ("positions", "here", "positions must be numbers"),
        ("positions", [[0.0, 0.0, 0.0], [1.0]], "positions must be numbers"),
        ("positions", None, r"positions must have shape"),
        ("normals", NORMALS[:2], r"normals must have shape \(3, 3\), got \(2, 3\)"),
        ("normals", NORMALS * [[1.0], [0.0], [1.0]], r"normal 1 is .* with length 0: divide"),
        ("normals", NORMALS * 1.01, r"normal \d is .* with length 1.01: divide"),
        ("friction", np.full(2, 0.5), r"friction must have shape \(3,\), got \(2,\)"),
        ("friction", np.full((3, 1), 0.5), r"friction must have shape \(3, 2\), got \(3, 1\)"),
        ("friction", 0.0, r"friction must be > 0 at every contact that is not frictionless, got 0\.0"),
        (
            "friction",
            [0.5, -0.1, 0.5],
            r"friction must be > 0 at every contact that is not frictionless, got \[0\.5, -0\.1, 0\.5\]",
        ),
        ("friction", "rough", "friction must be numbers"),
    ],
)
def test_wrong_geometry(which: str, value: object, message: str) -> None:
    given: dict = {"positions": POSITIONS, "normals": NORMALS, "friction": 0.5}
    given[which] = value
    with pytest.raises(InvalidInputError, match=message) as caught:
        Grasp.from_contacts(**given)
    assert isinstance(caught.value, ValueError)


_LINE = np.array([[0.0, 0.0, 0.0], [0.01, 0.02, 0.03], [0.02, 0.04, 0.06], [-0.03, -0.06, -0.09]])


@pytest.mark.parametrize(
    ("positions", "count"),
    [
        (np.empty((0, 3)), 0),
        (POSITIONS[:1], 1),
        (POSITIONS[:2], 2),
        (_LINE, 4),
        (_LINE + 0.2, 4),
        (np.zeros((4, 3)), 4),
        (np.full((3, 3), 0.1), 3),
    ],
    ids=["none", "one", "two", "line", "line, off the origin", "one point", "one point, off the origin"],
)
def test_rank_deficient_contacts(positions: np.ndarray, count: int) -> None:
    normals = np.tile([0.6, 0.0, 0.8], (count, 1))
    with pytest.raises(RankDeficientGraspError, match=rf"rank\(G\) = [0-5] < 6 with {count} contacts") as caught:
        Grasp.from_contacts(positions, normals, 0.5)
    assert isinstance(caught.value, GraspError)


MODELS = {
    "hard": {"friction": [0.3, 0.4, 0.5]},
    "elliptic": {"friction": [[0.3, 0.4], [0.5, 0.2], [0.4, 0.4]]},
    "soft": {"friction": 0.5, "contact_model": "soft", "torsional_friction": 0.01},
    "mixed": {"friction": 0.5, "contact_model": ["hard", "soft", "hard"], "torsional_friction": 0.01},
}


@pytest.mark.parametrize("tangents", [None, NORMALS[:, [1, 2, 0]] + NORMALS[:, [2, 0, 1]]], ids=["default", "given"])
@pytest.mark.parametrize("models", MODELS)
def test_unchecked_contacts_make_the_same_grasp(models: str, tangents: np.ndarray | None) -> None:
    checked = Grasp.from_contacts(POSITIONS + 0.01, NORMALS, tangents=tangents, **MODELS[models])
    positions, normals = checked.positions.copy(), checked.normals.copy()
    for _ in range(2):  # the second reads what the models remember
        grasp = Grasp.unchecked(positions, normals, checked.models, tangents)
        assert grasp.pseudoinverse.shape == (9, 6)
        for name in (*Grasp.__dataclass_fields__, "pseudoinverse"):
            if name != "models":
                np.testing.assert_array_equal(getattr(grasp, name), getattr(checked, name))
        for array in (grasp.positions, grasp.matrix, grasp.torsion_matrix, grasp.unit_frame, grasp.pseudoinverse):
            assert not array.flags.writeable
    positions[0] = 9.0
    assert (grasp.positions == checked.positions).all()
    with pytest.raises(RankDeficientGraspError, match=r"rank\(G\) = [0-5] < 6 with 3 contacts"):
        Grasp.unchecked(np.zeros((3, 3)), normals, checked.models)


def test_a_doubtful_rank_is_left_to_the_singular_values() -> None:
    """They cost ten times the rest of a grasp, and are remembered where they were asked."""
    rng = np.random.default_rng(0)
    clear, refused = 0, 0
    for thin in 10.0 ** np.arange(-12.0, 0.0, 0.125):
        base = random_grasp(rng, 3 + clear % 4)
        # nearly on a line, off the origin: no moment about it
        positions = base.positions * [1.0, thin, thin] + [0.1, -0.2, 0.3]
        frames = np.array([geometry.frame(n) for n in base.normals])
        rows = geometry.unit_frame(positions)[2] @ geometry.grasp_matrix(positions, frames)
        ratio = geometry.rank_ratio(rows)
        try:
            grasp = Grasp.from_contacts(positions, base.normals, base.friction)
        except RankDeficientGraspError:
            assert ratio < 1.1e-8
            refused += 1
            continue
        assert ratio > 0.9e-8
        found = "pseudoinverse" not in vars(grasp)
        clear += found
        assert not found or ratio > 1e-6
        assert found or ratio < 1e-2
    assert clear > 8
    assert refused > 8


@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf])
@pytest.mark.parametrize("which", ["positions", "normals", "tangents"])
def test_unchecked_contacts_that_are_none(which: str, bad: float) -> None:
    given: dict = {"positions": POSITIONS, "normals": NORMALS, "models": presets.tripod().models}
    with pytest.raises(GraspError, match=r"finite|rank|centre"):
        Grasp.unchecked(**(given | {which: np.full((3, 3), bad)}))


LOOKS = (
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


def compared(grasp: Grasp, other: Grasp) -> None:
    """The same to the bit."""
    for name in (*LOOKS, "pseudoinverse"):
        np.testing.assert_array_equal(getattr(grasp, name), getattr(other, name), err_msg=name)
    for name in ("friction", "torsional_friction", "cone_scale", "cone_divisor"):
        np.testing.assert_array_equal(getattr(grasp.models, name), getattr(other.models, name), err_msg=name)
    assert grasp.models.names == other.models.names
    assert grasp.length == other.length


@pytest.mark.parametrize("name", LOOKS)
def test_what_a_grasp_shows_is_made_when_it_is_asked_for(name: str) -> None:
    grasp = Grasp.from_contacts(POSITIONS.copy(), NORMALS.copy(), 0.5)
    assert not {*LOOKS, "models", "pseudoinverse", "length"} & set(vars(grasp))
    shown = getattr(grasp, name)
    assert not shown.flags.writeable
    assert getattr(grasp, name) is shown
    kept = shown.copy()
    del grasp  # and it keeps what it reads
    np.testing.assert_array_equal(shown, kept)


@pytest.mark.parametrize("tangents", [False, True])
@pytest.mark.parametrize("count", [3, 4, 7, 50])
def test_what_a_grasp_shows_is_the_plain_formula(count: int, tangents: bool) -> None:
    rng = np.random.default_rng(count)
    base, mu = random_grasp(rng, count), rng.uniform(0.2, 1.0, (count, 2))
    along = rng.standard_normal((count, 3)) if tangents else None
    grasp = Grasp.from_contacts(base.positions, base.normals, mu, tangents=along)
    frames = np.array([geometry.frame(n, None if along is None else along[k]) for k, n in enumerate(base.normals)])
    centre, length, unit = geometry.unit_frame(base.positions)
    matrix, mean = geometry.grasp_matrix(base.positions, frames), np.sqrt(mu.prod(axis=1))
    scale = np.column_stack([mean, mean / mu[:, 0], mean / mu[:, 1]])
    wanted = {
        "positions": base.positions, "normals": base.normals, "frames": frames, "matrix": matrix, "centre": centre,
        "length": length, "unit_frame": unit, "friction": mean, "cone_matrix": matrix / scale.reshape(-1),
        "torsion_matrix": np.zeros((6, count)),
    }  # fmt: skip
    for name, value in wanted.items():
        np.testing.assert_allclose(getattr(grasp, name), value, rtol=1e-12, atol=1e-13, err_msg=name)
    np.testing.assert_array_equal(grasp.models.friction, mu)
    np.testing.assert_allclose(grasp.models.cone_scale, scale, rtol=1e-15)
    soft = Grasp.from_contacts(
        base.positions, base.normals, mu, contact_model=["soft", *(count - 1) * ["hard"]], torsional_friction=0.01
    )
    np.testing.assert_array_equal(soft.torsion_matrix[3:, 0], soft.normals[0])
    assert not soft.torsion_matrix[:3].any()
    assert not soft.torsion_matrix[:, 1:].any()


FRICTION = [0.4, np.float64(0.4), [0.4, 0.5, 0.6], [[0.4, 0.5], [0.6, 0.6], [0.5, 0.4]]]
OTHERWISE = {
    "lists": np.ndarray.tolist,
    "tuples": lambda a: tuple(map(tuple, a)) if a.ndim > 1 else tuple(a),
    "columns": np.asfortranarray,
    "swapped": lambda a: a.astype(">f8"),
    "strided": lambda a: np.repeat(a, 2, axis=0)[::2],
    "object": lambda a: a.astype(object),
}


@pytest.mark.parametrize("way", OTHERWISE)
@pytest.mark.parametrize("friction", FRICTION, ids=["number", "numpy's", "each", "elliptic"])
@pytest.mark.parametrize("tangents", [False, True])
def test_contacts_that_python_converts_are_the_same_to_the_bit(way: str, friction: object, tangents: bool) -> None:
    along = np.ascontiguousarray(NORMALS[:, [1, 2, 0]] + NORMALS[:, [2, 0, 1]])
    given = [POSITIONS + 0.01, NORMALS * (1.0 + 5e-7), friction if isinstance(friction, float) else np.array(friction)]
    grasp = Grasp.from_contacts(*given, tangents=along if tangents else None)
    assert "models" not in vars(grasp)  # read in one call
    turned = [a if isinstance(a, float) else OTHERWISE[way](a) for a in given]
    other = Grasp.from_contacts(*turned, tangents=OTHERWISE[way](along) if tangents else None)
    assert "models" in vars(other)
    compared(grasp, other)
    compared(grasp, Grasp.from_contacts(*given, contact_model=["hard"] * 3, tangents=along if tangents else None))


def test_numbers_of_other_types_are_converted() -> None:
    wanted = Grasp.from_contacts(2.0 * np.eye(3), -np.eye(3), 1.0)
    for kind in (np.float32, np.int64, np.float16):
        compared(Grasp.from_contacts(2 * np.eye(3, dtype=kind), -np.eye(3, dtype=kind), 1), wanted)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"friction": ranges.FRICTION.low * 0.999}, "friction must lie within"),
        ({"friction": np.array([0.5, 0.5, 1.001e4])}, "friction must lie within"),
        ({"friction": np.array([[0.5, 0.5], [0.5, 2e4], [0.5, 0.5]])}, "friction must lie within"),
        ({"friction": np.array([[0.5, 0.5], [0.5, -0.1], [0.5, 0.5]])}, "friction must be > 0"),
        ({"positions": POSITIONS * 1e-8}, "positions must lie within"),
        ({"positions": POSITIONS * 1e9}, "positions must lie within"),
        ({"positions": np.full((3, 3), 1e308) * [[1], [-1], [1]]}, "positions must lie within"),
        ({"positions": POSITIONS + 1e5}, "positions must have their centre within"),
        ({"positions": np.ma.array(POSITIONS, mask=np.eye(3) > 0.0)}, "masked entries"),
        ({"tangents": NORMALS + 1e-7 * NORMALS[:, [1, 2, 0]]}, r"tangent 0 is .*, along its normal"),
        ({"tangents": np.zeros((3, 3))}, r"tangent 0 is .*, along its normal"),
        ({"tangents": np.full((3, 3), np.nan)}, "tangents must be finite"),
        ({"tangents": np.ones((2, 3))}, "tangents must have shape"),
    ],
)
def test_arrays_that_hold_what_is_wrong(change: dict, message: str) -> None:
    given: dict = {"positions": POSITIONS, "normals": NORMALS, "friction": 0.5, **change}
    with pytest.raises(InvalidInputError, match=message):
        Grasp.from_contacts(**given)


def test_as_many_contacts_as_are_allowed() -> None:
    every = np.random.default_rng(0).standard_normal((ranges.CONTACTS + 1, 3))
    normals = -every / np.linalg.norm(every, axis=1)[:, None]
    assert Grasp.from_contacts(every[1:], normals[1:], 0.5).n_contacts == ranges.CONTACTS
    with pytest.raises(InvalidInputError, match="at most 1000 contacts, got 1001"):
        Grasp.from_contacts(every, normals, 0.5)


@pytest.mark.parametrize("name", [*GRASPS, "elliptic"])
def test_a_grasp_survives_pickling_and_copying_to_the_bit(name: str) -> None:
    grasp = presets.tripod(FRICTION[3]) if name == "elliptic" else GRASPS[name]
    for again in (pickle.loads(pickle.dumps(grasp)), copy.copy(grasp), copy.deepcopy(grasp)):
        compared(again, grasp)
        assert again != grasp
        assert not again.matrix.flags.writeable


def test_a_grasp_looks_like_its_contacts() -> None:
    grasp = presets.tripod()
    assert (
        repr(grasp) == f"Grasp(positions={grasp.positions!r}, normals={grasp.normals!r}, friction={grasp.friction!r})"
    )
    assert set(LOOKS) < set(asdict(grasp))
    assert {grasp: 1}[grasp] == 1
    for make in (lambda: replace(grasp, friction=0.3), Grasp):
        with pytest.raises(
            InvalidInputError, match=r"made by Grasp\.from_contacts, with other friction by with_friction"
        ):
            make()


def test_normals_within_rounding_of_unit_length_are_normalised() -> None:
    grasp = Grasp.from_contacts(POSITIONS, NORMALS * (1.0 + 5e-7), 0.5)
    np.testing.assert_allclose(np.linalg.norm(grasp.normals, axis=1), 1.0, atol=3e-16)


def test_unknown_preset_names_the_choices() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown preset 'cube'.*'paper_cuboid'") as caught:
        presets.preset("cube")
    assert isinstance(caught.value, KeyError)
    assert isinstance(caught.value, ValueError)
    assert caught.value.allowed == presets.PRESETS


@pytest.mark.parametrize("force", [np.zeros(9), np.zeros((4, 3)), np.full((3, 3), np.nan)])
def test_wrench_of_a_wrong_force(force: np.ndarray) -> None:
    with pytest.raises(InvalidInputError, match="force must"):
        presets.tripod().wrench(force)
