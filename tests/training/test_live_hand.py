"""The simulated hand of `grasp live` without a browser: pulled, changed, lost, held again; what its page is told."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from live_client import live_client

from grasp_env.config import EnvConfig
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.urdf import hand_urdf
from grasp_env.sim.objects.description import ObjectDescription
from training.cli import main
from training.commands.rules import rule
from training.live.hand import HandPage
from training.live.newest import Newest
from training.live.page import close_server, open_server
from training.live.playground import STIFFNESS, Playground
from training.live.question import Mood
from training.live.shapes import item_mesh, looks

CENTRE = np.zeros(3)
NEWTON = EnvConfig(method="newton")


@pytest.fixture
def ground() -> Iterator[Playground]:
    made = Playground(NEWTON)
    yield made
    made.close()


def test_it_rests_until_it_is_pulled(ground):
    ground.advance(50)
    view = ground.view()
    assert (view.mood, view.status) == (Mood.GOOD, "held")
    assert view.drift < 1e-5
    assert not view.push.any()
    np.testing.assert_allclose(
        view.forces.sum(axis=0), [0.0, 0.2 * 9.81, 0.0], atol=1e-3
    )  # its weight, and a little pose feedback
    assert view.time == pytest.approx(0.2)


def test_the_spring_pulls_up_to_its_limit(ground):
    ground.pull(CENTRE, np.array([0.005, 0.0, 0.0]))
    np.testing.assert_allclose(ground.view().push, [STIFFNESS * 0.005, 0.0, 0.0], atol=0.01)  # it rests some um off
    ground.pull(CENTRE, np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(ground.view().push, [ground.most_push, 0.0, 0.0], atol=0.01)
    ground.advance(100)
    view = ground.view()
    assert view.mood is Mood.GOOD
    np.testing.assert_allclose(view.forces.sum(axis=0), [-5.0, 0.2 * 9.81, 0.0], atol=1e-3)  # held against
    ground.release()
    ground.advance(100)
    assert not ground.view().push.any()
    assert ground.view().drift < 1e-4


def test_a_pull_beside_the_centre_turns(ground):
    ground.pull(np.array([0.05, 0.0, 0.0]), np.array([0.05, 1.0, 0.0]))
    free = ground.view()
    np.testing.assert_allclose(free.grip, [0.05, 0.0, 0.0], atol=1e-4)
    ground.advance(100)
    arms = ground.view().points
    turned = np.cross(arms, ground.view().forces).sum(axis=0)
    np.testing.assert_allclose(turned[2], -0.05 * 5.0, atol=2e-3)


def test_too_much_is_lost_and_told_until_it_takes_hold_again(ground):
    ground.most_push = 300.0  # more than the motors have
    ground.pull(CENTRE, np.array([0.0, 1.0, 0.0]))
    for _ in range(40):
        ground.advance(25)
    view = ground.view()
    assert (view.mood, view.status) == (Mood.BAD, "lost")
    assert "Take hold again" in view.words
    ground.reset()
    ground.advance(25)
    view = ground.view()
    assert (view.mood, view.drift < 1e-4) == (Mood.GOOD, True)


def test_friction_and_mass_change_while_it_holds(ground):
    ground.advance(25)
    before = ground.view()
    for friction in (0.25, 0.15):
        ground.change_object(0.2, friction)
        ground.advance(50)
        view = ground.view()
        assert view.mood is Mood.GOOD
        assert view.normals[:, 0].sum() > 1.2 * before.normals[:, 0].sum()  # smoother: more squeeze
        before = view
    ground.change_object(0.4, 0.4)
    ground.advance(100)
    np.testing.assert_allclose(ground.view().forces.sum(axis=0), [0.0, 0.4 * 9.81, 0.0], atol=1e-4)
    ground.reset()
    item = ground.scene.config.object
    assert (item.mass, item.friction) == (0.2, 0.4)


def test_every_link_and_every_shape_has_looks():
    for hand in (HandDescription.four_finger(), HandDescription.allegro(), HandDescription.leap()):
        for body in (hand.palm, *hand.links):
            for corners, faces, _ in looks(body):
                assert len(corners) > int(faces.max())
        assert all(looks(link) for link in hand.links)
    for shape in ("cuboid", "cylinder", "sphere", "capsule"):
        item = ObjectDescription(shape)
        np.testing.assert_allclose(np.ptp(item_mesh(item).vertices, axis=0), item.extent, rtol=2e-3)


def test_the_page_is_pulled_changed_and_reset():
    server = open_server(0, "test")
    page = HandPage(server, NEWTON, rule)
    page.draw()
    worker = Newest(page.draw, page.every)
    page.watch(worker.wake)
    try:
        with live_client(server.get_port()) as client:
            grip = (0.5, 0.0, 0.0)
            client.drag("/object/body", "start", grip, grip)
            client.drag("/object/body", "update", grip, (3.0, 0.0, 0.0))
            client.until(lambda seen: "5.0 N" in seen.text and seen.nodes["/pull/arrow"]["visible"])
            client.drag("/object/body", "end", grip, grip)
            client.until(lambda seen: not seen.nodes["/pull/arrow"]["visible"])
            client.set("shape", "sphere")
            client.until(lambda seen: len(seen.nodes["/object/body"]["vertices"]) > 1000)
            client.text = ""
            client.until(lambda seen: "held" in seen.text)  # told by the drawing that has made all of it
            client.set("most pull, N", 40.0)
            client.drag("/object/body", "start", grip, grip)
            client.drag("/object/body", "update", grip, (0.0, 30.0, 0.0))
            client.until(lambda seen: ">lost<" in seen.text)
            assert client.nodes["/status"]["text"] == "lost"
            client.drag("/object/body", "end", grip, grip)
            client.set("Take hold again", True)
            client.until(lambda seen: ">held<" in seen.text)
    finally:
        worker.close()
        close_server(server)
    assert worker.fault is None


def test_the_command_shows_somebodys_urdf(tmp_path, capsys):
    path = tmp_path / "mine.urdf"
    path.write_text(hand_urdf(HandDescription.four_finger()), encoding="utf-8")
    record = tmp_path / "mine.html"
    assert main(["live", "--hand", str(path), "--port", "0", "--seconds", "0.5", "--record", str(record)]) == 0
    out, err = capsys.readouterr()
    assert out.splitlines()[0].startswith("http://127.0.0.1:")
    assert err == "" or err.startswith("grasp: repaired: ")
    assert record.stat().st_size > 5e5
