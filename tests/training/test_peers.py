"""Peers against Clarabel at 1e-10, and their checks by hand."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError
from pathlib import Path

import numpy as np
import pytest

from grasp_env.errors import UnknownNameError
from grasp_env.grasp import Grasp, presets, wrench
from training import peers
from training.peers import catalogue, generated

GRASP = presets.paper_cuboid()
WRENCHES = wrench.sample_ball(np.random.default_rng(5), 20)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("generated")


def cost(grasp: Grasp) -> np.ndarray:
    return 1.0 / grasp.friction


def ready(name: str, folder: Path) -> peers.Peer:
    (peer,) = peers.available(folder, [name])
    if isinstance(peer, peers.MissingPeer):
        pytest.skip(peer.reason)
    return peer


@pytest.mark.parametrize("name", peers.NAMES)
def test_agrees_with_the_reference(name: str, folder: Path):
    pytest.importorskip("clarabel")
    solver = ready(name, folder).build(GRASP.cone_matrix, cost(GRASP))
    best = peers.reference(GRASP.cone_matrix, cost(GRASP))
    truth, found = (
        peers.achieved(GRASP.cone_matrix, cost(GRASP), WRENCHES, np.array([each.solve(w) for w in WRENCHES]))
        for each in (best, solver)
    )
    np.testing.assert_allclose(found.objective, truth.objective, rtol=1e-5)
    assert found.balance.max() < 1e-5
    assert found.violation.max() < 1e-6


@pytest.mark.parametrize("name", peers.NAMES)
def test_every_wrench_is_timed(name: str, folder: Path):
    solver = ready(name, folder).build(GRASP.cone_matrix, cost(GRASP))
    seconds = solver.times(WRENCHES[:4], repeats=2)
    assert seconds.shape == (4,)
    assert (seconds > 1e-7).all()
    assert (seconds < 1.0).all()


@pytest.mark.parametrize("name", peers.NAMES)
def test_a_failure_shows_and_leaves_no_trace(name: str, folder: Path):
    # four fingers on one side: they can push only one way
    pushing = Grasp.from_contacts(GRASP.positions, np.tile([0.0, 0.0, -1.0], (4, 1)), 0.4)
    solver = ready(name, folder).build(pushing.cone_matrix, cost(pushing))
    can, cannot = np.array([0.1, 0.0, 1.0, 0.0, 0.0, 0.0]), np.array([0.1, 0.0, -1.0, 0.0, 0.0, 0.0])
    before = solver.solve(can)
    assert before[::3] @ cost(pushing) == pytest.approx(1.0, rel=1e-5)
    failed = solver.solve(cannot)
    # qoco reports success on infeasible wrenches: the balance tells
    assert np.isnan(failed).all() or (name == "qoco" and np.abs(pushing.cone_matrix @ failed + cannot).max() > 0.5)
    np.testing.assert_allclose(solver.solve(can), before, atol=1e-6)


def test_two_grasps_share_generated_code(folder: Path):
    peer = ready("qocogen", folder)
    first, second = (
        peer.build(grasp.cone_matrix, cost(grasp)) for grasp in (GRASP, GRASP.with_friction([0.8, 0.7, 0.9, 0.6]))
    )
    assert not np.allclose(first.solve(WRENCHES[0]), second.solve(WRENCHES[0]), rtol=1e-2)
    assert len(list(folder.glob("qocogen_4_*.so"))) <= 2  # one per set of flags


def test_achieved_by_hand():
    force = np.zeros((2, 12))
    force[0, :3] = (1.0, 3.0, 4.0)
    force[1] = np.nan
    report = peers.achieved(GRASP.cone_matrix, cost(GRASP), np.zeros((2, 6)), force)
    assert report.objective[0] == pytest.approx(2.5)
    assert report.violation[0] == pytest.approx(4.0)
    assert report.balance[0] == pytest.approx(np.abs(GRASP.cone_matrix[:, :3] @ [1.0, 3.0, 4.0]).max())
    assert np.isnan([report.objective[1], report.balance[1], report.violation[1]]).all()


def test_missing_peers_say_why(monkeypatch: pytest.MonkeyPatch, folder: Path):
    def absent(package: str) -> str:
        raise PackageNotFoundError(package)

    with monkeypatch.context() as patch:
        patch.setattr(catalogue, "version", absent)
        for peer in peers.available(folder):
            assert isinstance(peer, peers.MissingPeer)
            assert "not installed" in peer.reason
    monkeypatch.setattr(generated, "compiler", lambda: None)
    assert generated.refusal(generated.PLAIN) == "no C compiler: install gcc or clang, or set CC"


def test_unknown_name(folder: Path):
    with pytest.raises(UnknownNameError, match="unknown peer 'mosek'"):
        peers.available(folder, ["mosek"])
