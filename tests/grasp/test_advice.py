from __future__ import annotations

import warnings

import numpy as np
import pytest
from problems import GRASPS, random_grasp

from grasp_env.errors import GraspWarning
from grasp_env.force import ForceOptimizer, optimize_force
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.advice import advise
from grasp_env.grasp.transforms import transformed
from grasp_env.quality import force_closure


def _only(grasp: Grasp) -> str:
    said = advise(grasp)
    assert len(said) == 1, said
    return said[0]


@pytest.mark.parametrize("name", GRASPS)
def test_good_grasps_need_no_advice(name: str) -> None:
    assert advise(GRASPS[name]) == []


def test_random_grasps_need_no_advice_about_normals() -> None:
    rng = np.random.default_rng(0)
    for k in range(40):
        grasp = random_grasp(rng, 4 + k % 4)
        assert not [text for text in advise(grasp) if "normal" in text]


def test_some_normals_are_only_blamed_where_turning_them_round_helps() -> None:
    rng = np.random.default_rng(1)
    said = 0
    for k in range(60):
        grasp = random_grasp(rng, 3 + k % 4)
        away = rng.random(grasp.n_contacts) < 0.4
        turned = Grasp.from_contacts(
            grasp.positions, np.where(away[:, None], -1.0, 1.0) * grasp.normals, grasp.friction
        )
        blamed = any("with these normals turned round they could" in text for text in advise(turned))
        assert not (blamed and force_closure(turned))
        said += blamed
    assert said > 5


def test_all_normals_outwards() -> None:
    for grasp in GRASPS.values():
        outwards = Grasp.from_contacts(grasp.positions, -grasp.normals, grasp.friction)
        assert _only(outwards).startswith(f"all {grasp.n_contacts} normals point away from the centre")


def test_one_normal_outwards() -> None:
    grasp = presets.paper_cuboid()
    normals = grasp.normals.copy()
    normals[0] *= -1.0  # the thumb: nothing pushes against the fingers any more
    assert "the normals of contacts [0] point away" in _only(Grasp.from_contacts(grasp.positions, normals, 0.4))


def test_millimetres() -> None:
    grasp = presets.paper_cuboid()
    text = _only(Grasp.from_contacts(1000.0 * grasp.positions, grasp.normals, 0.4))
    assert text.startswith(f"the contacts lie {1000 * grasp.length:.3g} m from their centre")
    assert "divide millimetres by 1000" in text


def test_friction() -> None:
    assert "friction is 21.8 at contact 1" in _only(presets.tripod([0.5, 21.8, 0.5]))
    assert "friction is 3 at contact 2" in _only(presets.tripod([[0.5, 0.5], [1.0, 2.0], [3.0, 0.5]]))
    assert advise(presets.tripod(2.0)) == []
    plain = presets.tripod()
    soft = Grasp.from_contacts(plain.positions, plain.normals, 0.5, contact_model="soft", torsional_friction=5.0)
    assert any(text.startswith("torsional_friction is 5 m at contact 0") for text in advise(soft))


def test_nearly_coincident_contacts() -> None:
    plain = presets.five_finger_cuboid()
    positions = plain.positions.copy()
    positions[3] = positions[1] + [1e-4, 0.0, 0.0]
    text = _only(Grasp.from_contacts(positions, plain.normals, 0.4))
    assert text.startswith("contacts 1 and 3 are 0.1 mm apart")


def test_nearly_singular() -> None:
    positions = np.array([[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0], [0.0, 2e-5, 0.0]])  # almost on one line
    grasp = Grasp.from_contacts(positions, [[1, 0, 0], [-1, 0, 0], [0, -1, 0]], 0.5)
    singular = [text for text in advise(grasp) if "nearly singular" in text]
    whole = grasp.matrix / np.array([1, 1, 1, *[grasp.length] * 3])[:, None]
    assert len(singular) == 1
    # printed to two digits; moments about the centre of the contacts instead of the origin
    assert float(singular[0].split("condition number ")[1].split(":")[0]) == pytest.approx(
        np.linalg.cond(whole), rel=0.3
    )


def test_a_far_origin() -> None:
    far = transformed(presets.tripod(), np.eye(3), [2.0, 0.0, 0.0])
    assert "the object frame's origin is 2 m away" in _only(far)
    assert advise(transformed(presets.tripod(), np.eye(3), [0.2, 0.0, 0.0])) == []


def test_who_solves_without_asking_is_warned_at_his_own_line() -> None:
    good = presets.tripod()
    wrong = {
        "normals must point INTO the object": Grasp.from_contacts(good.positions, -good.normals, 0.5),
        "divide millimetres by 1000": Grasp.from_contacts(1000.0 * good.positions, good.normals, 0.5),
    }
    for text, grasp in wrong.items():
        for solve in (lambda grasp: optimize_force(grasp, np.zeros(6)), ForceOptimizer):
            with pytest.warns(GraspWarning, match=text) as told:
                solve(grasp)
            assert [warning.filename for warning in told] == [__file__]


@pytest.mark.parametrize("name", GRASPS)
def test_good_grasps_are_solved_in_silence(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ForceOptimizer(GRASPS[name], method="newton")


def test_a_control_loop_is_not_warned_again() -> None:
    grasp = presets.tripod()
    optimizer = ForceOptimizer(grasp, method="newton")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        optimizer.solve(np.zeros(6), normals=-grasp.normals)
