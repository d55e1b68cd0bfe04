"""Batches of problems for differentiable layers: optima of the front, exact gradients, independent
problems, no NaN."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from grasp_env.core import _core
from grasp_env.grasp import presets

NAMES = (
    "positions",
    "normals",
    "friction",
    "tangents",
    "torsion",
    "wrench",
    "jacobian",
    "torque_limit",
    "torque_bias",
    "min_normal",
    "max_normal",
    "force_weight",
    "barrier_weight",
)
KINDS = (
    "hard",
    "elliptic",
    "soft",
    "slippery soft",
    "own",
    "shared",
    "normal",
    "soft shared normal",
    "own tight",
    "soft own tight",
    "adrift",
    "adrift own soft",
)
"""slippery: one contact has no friction, except about its normal; own, shared: torque limits of one
finger or of several; tight: no force keeps them; adrift: contacts that cannot balance the wrench."""
OPTIMAL = 0
REFUSED = _core.codes()["refused"]
Batch = dict[str, np.ndarray | None]


@cache
def batch(kind: str, size: int = 19) -> Batch:
    """Problems near the paper's grasp, each with its own contacts."""
    rng = np.random.default_rng([size, *kind.encode()])
    near = presets.paper_cuboid()
    made: Batch = dict.fromkeys(NAMES)
    made["positions"] = near.positions + rng.normal(size=(size, 4, 3)) * 5e-3
    made["normals"] = near.normals + rng.normal(size=(size, 4, 3)) * 0.05
    made["friction"] = np.repeat(rng.uniform(0.3, 0.7, (size, 4, 1)), 2, -1)
    made["wrench"] = rng.normal(size=(size, 6)) * [1, 1, 1, 0.03, 0.03, 0.03]
    made["force_weight"], made["barrier_weight"] = np.full((size, 4), 1.3), np.full((size, 4), 0.01)
    if "elliptic" in kind:
        made["friction"], made["tangents"] = (
            rng.uniform(0.3, 0.7, (size, 4, 2)),
            rng.normal(size=(size, 4, 3)),
        )
    if "slippery" in kind:
        made["friction"][:, 3] = 0.0
    if "soft" in kind:
        made["torsion"] = rng.uniform(0.002, 0.01, (size, 4))
    if "own" in kind or "shared" in kind:
        jacobian = np.zeros((size, 4, 6 if "soft" in kind else 3, 12))
        for i in range(4):
            jacobian[:, i, :, 3 * i : 3 * i + 3] = (
                rng.normal(size=(*jacobian.shape[:1], jacobian.shape[2], 3)) * 0.05
            )
        if "shared" in kind:
            jacobian += rng.normal(size=jacobian.shape) * 0.01
        made["jacobian"], made["torque_bias"] = jacobian, rng.normal(size=(size, 12)) * 0.01
        made["torque_limit"] = np.full((size, 12), 0.03 if "tight" in kind else 1.5)
    if "normal" in kind:
        made["min_normal"], made["max_normal"] = np.full((size, 4), 0.2), np.full((size, 4), 6.0)
    if "adrift" in kind:  # all of them push up, and so does the load
        made["normals"] = (
            np.tile([0.1, 0.0, 1.0], (size, 4, 1)) + rng.normal(size=(size, 4, 3)) * 0.05
        )
        made["wrench"][:, 2] = 1.0 + np.abs(made["wrench"][:, 2])
    return made


def rows(given: Batch, chosen: slice | list[int]) -> Batch:
    return mapped(given, lambda array: np.ascontiguousarray(array[chosen]))


def mapped(given: Batch, f: Callable[[np.ndarray], np.ndarray]) -> Batch:
    return {name: None if array is None else f(array) for name, array in given.items()}


def solved(
    given: Batch, start: np.ndarray | None = None, tolerance: float = 1e-10, limit: int = 300
) -> tuple[np.ndarray, ...]:
    """State, force, torsion, multipliers, facts."""
    problems = read(given, start)
    count = problems.contacts
    shapes = ((count, 3), (count,), (6,), (_core.LAYER_FACTS,), (_core.layer_state_size(count),))
    *answers, state = (np.full((*problems.lead, *shape), np.nan) for shape in shapes)
    problems.solve((0, problems.size), (tolerance, limit), (*answers, state))
    return (state, *answers)


def read(given: Batch, *start: np.ndarray | None) -> _core.ForceProblems:
    problems = _core.ForceProblems.of((*(given[name] for name in NAMES), *start), 1000, 1000)
    assert problems is not None
    return problems


def differentiated(
    given: Batch, state: np.ndarray, by: tuple[np.ndarray, ...], elastic: bool = True
) -> Batch:
    gradients = mapped(given, lambda array: np.full(array.shape, np.nan))
    read(given).differentiate((0, len(state)), state, tuple(by), elastic, tuple(gradients.values()))
    return gradients


def loss(kind: str, answer: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Derivatives by force, torsion and multipliers of a random linear loss of each problem."""
    rng = np.random.default_rng([7, len(kind)])
    return tuple(
        rng.normal(size=array.shape) * per
        for array, per in zip(answer[1:4], (1.0, 100.0, 1.0), strict=True)
    )


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_central_differences_of_the_answers(kind):
    given = rows(batch(kind), slice(0, 8))
    rng = np.random.default_rng(3)
    answer = solved(given)
    assert (answer[4][:, 0] == OPTIMAL).all() == (
        kind.split()[0] != "adrift" and "tight" not in kind
    )
    by = loss(kind, answer)
    made = differentiated(given, answer[0], by)
    size = sum(np.abs(b * a).sum() for b, a in zip(by, answer[1:4], strict=True))

    def value(moved: Batch) -> np.ndarray:
        again = solved(moved)
        return sum((b * a).reshape(len(a), -1).sum(1) for b, a in zip(by, again[1:4], strict=True))

    for name, array in given.items():
        if array is None:
            continue
        found = made[name]
        step = 1e-5 * np.abs(array).max()
        assert found is not None
        assert np.isfinite(found).all()
        # a zero of a Jacobian stays zero: else its row would touch another contact
        direction = rng.normal(size=array.shape) * (array != 0.0)
        ahead, back, twice, far = (
            value(given | {name: array + k * step * direction}) for k in (1.0, -1.0, 2.0, -2.0)
        )
        expected = (8.0 * (ahead - back) - (twice - far)) / (12.0 * step)
        flat = (found * direction).reshape(len(found), -1)
        # differences lose the last digits of the answers over the step; elastic forces beside very
        # stiff limits have fewer
        rounding = 1e-12 if "tight" in kind else 1e-13
        np.testing.assert_allclose(
            flat.sum(1),
            expected,
            rtol=2e-6,
            atol=rounding * size / step + 1e-6 * np.abs(flat).sum(1).max(),
        )


@pytest.mark.parametrize("kind", ["hard", "soft shared normal", "soft own tight", "adrift"])
def test_an_answer_and_its_gradient_depend_on_no_neighbour(kind):
    given = batch(kind)
    other = batch(kind, 3)
    mixed = {
        name: None if array is None else np.concatenate([array, other[name]])  # type: ignore[list-item]
        for name, array in given.items()
    }
    bad = np.array(mixed["positions"])
    wrench = np.array(mixed["wrench"])
    bad[5], wrench[11] = np.nan, 1e11
    mixed |= {"positions": bad, "wrench": wrench}
    answer = solved(mixed)
    by = loss(kind, answer)
    gradients = differentiated(mixed, answer[0], by)
    assert all(
        np.isfinite(array).all()
        for array in (*answer[:4], *(g for g in gradients.values() if g is not None))
    )
    assert answer[4][5, 0] == REFUSED
    assert not answer[1][5].any()
    for k in range(len(wrench)):
        one = rows(mixed, [k])
        alone = solved(one)
        for a, b in zip(answer, alone, strict=True):
            assert (a[k : k + 1] == b).all()
        found = differentiated(one, alone[0], tuple(array[k : k + 1] for array in by))
        assert all(
            (gradients[name][k] == array[0]).all()
            for name, array in found.items()
            if array is not None
        )


def test_problems_are_read_in_any_layout():
    given = batch("hard", 20)
    plain = solved(given)
    double = mapped(given, lambda array: array.astype(np.float32).astype(np.float64))
    shared = given | {
        name: None if given[name] is None else given[name][0] for name in NAMES if name != "wrench"
    }
    shared |= {"friction": shared["friction"][:, 0], "force_weight": 1.3, "barrier_weight": 0.01}
    spread = mapped(given, lambda array: np.stack([array[0]] * 20)) | {"wrench": given["wrench"]}
    turned = given | {
        name: np.asfortranarray(given[name]) for name in ("positions", "friction", "wrench")
    }
    turned["normals"] = np.repeat(given["normals"], 2, axis=0)[::2]
    folded = mapped(given, lambda array: array.reshape(4, 5, *array.shape[1:]))
    crossed = shared | {"wrench": given["wrench"].reshape(4, 5, 6), "normals": given["normals"][:5]}
    every = spread | {"normals": np.tile(given["normals"][:5], (4, 1, 1))}
    single = mapped(given, lambda array: array.astype(np.float32))
    assert (read(given).lead, read(folded).lead, read(crossed).lead) == ((20,), (4, 5), (4, 5))
    assert (read(given).float32, read(single).float32) == (False, True)
    for one, wanted in (
        (shared, solved(spread)),
        (turned, plain),
        (single, solved(double)),
        (folded, plain),
        (crossed, solved(every)),
    ):
        for a, b in zip(solved(one), wanted, strict=True):
            assert (a.reshape(b.shape) == b).all()


@pytest.mark.parametrize(
    "wrong",
    [
        {"wrench": np.ones((19, 5))},
        {"wrench": None},
        {"wrench": np.ones((18, 6))},
        {"friction": np.ones((19, 4, 2), dtype=np.float16)},
        {"friction": 10**400},
        {"positions": "x"},
        {"positions": np.ones(3)},
        {"jacobian": np.ones((19, 4, 3, 2))},
        {"torque_bias": np.ones((19, 2))},
        {"jacobian": np.ones((19, 4, 5, 2)), "torque_limit": 1.0},
    ],
    ids=lambda wrong: "-".join(wrong),
)
def test_wrong_problems_are_not_read(wrong):
    given = batch("hard") | wrong
    assert _core.ForceProblems.of(tuple(given[name] for name in NAMES), 1000, 1000) is None
    own = tuple(batch("own")[name] for name in NAMES)  # of 4 contacts and 12 joints
    for contacts, joints in ((4, 12), (3, 12), (4, 11)):
        assert (_core.ForceProblems.of(own, contacts, joints) is None) == (contacts * joints < 48)


def test_arrays_to_write_are_checked():
    problems = read(batch("hard", 2))
    count = 4
    shapes = (
        (2, count, 3),
        (2, count),
        (2, 6),
        (2, _core.LAYER_FACTS),
        (2, _core.layer_state_size(count)),
    )
    arrays = [np.zeros(shape) for shape in shapes]
    for k, right in enumerate(arrays):
        read_only = right.copy()
        read_only.flags.writeable = False
        for bad in (
            right[:1],
            right.astype(np.float32),
            np.broadcast_to(right[:1], shapes[k]),
            None,
            read_only,
        ):
            with pytest.raises(TypeError, match="expected C-contiguous"):
                problems.solve((0, 2), (1e-10, 300), (*arrays[:k], bad, *arrays[k + 1 :]))
    for start, stop in ((-1, 1), (0, 3), (2, 1)):
        with pytest.raises(ValueError, match="no part of the problems"):
            problems.solve((start, stop), (1e-10, 300), tuple(arrays))
