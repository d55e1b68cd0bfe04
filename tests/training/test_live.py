"""`grasp live` without its page: what is asked and answered, how events are taken together, where the server listens, what is recorded."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from live_client import EYE, LiveClient, live_client

from grasp_env.errors import InvalidInputError
from grasp_env.grasp import Grasp, presets, save_grasp
from training.cli import main
from training.commands.rules import rule
from training.live.bare import BarePage
from training.live.body import SHAPES, body_of, shaped
from training.live.newest import Newest
from training.live.page import close_server, open_server
from training.live.question import Answers, Mood, Question, screw
from training.live.session import Session, checked_record

ROOT = Path(__file__).parents[2]
LOAD = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])
GRASP = presets.paper_cuboid()
HELD = Question(GRASP.positions, GRASP.normals, 0.4, LOAD)
ONE_SIDE = Question(GRASP.positions[1:], GRASP.normals[1:], 0.4, LOAD)


@contextmanager
def bare_page(question: Question = HELD) -> Iterator[tuple[BarePage, int]]:
    """A page that is drawn at every event, and its port."""
    server = open_server(0, "test")
    page = BarePage(server, question, rule)
    page.draw()
    worker = Newest(page.draw)
    page.watch(worker.wake)
    try:
        yield page, server.get_port()
    finally:
        worker.close()
        close_server(server)
        assert worker.fault is None


def test_forces_balance_the_load_within_their_cones():
    answer = Answers()(HELD)
    assert (answer.mood, answer.status) == (Mood.GOOD, "held")
    moments = np.cross(HELD.positions, answer.forces).sum(axis=0)
    np.testing.assert_allclose(np.concatenate([answer.forces.sum(axis=0), moments]), -LOAD, atol=1e-9)
    assert answer.margins.min() > 0.0
    assert answer.bound <= answer.objective
    assert 0.0 < answer.microseconds < 1e5
    assert answer.twist is None


@pytest.mark.parametrize("method", ["reduced_flow", "full_flow", "newton", "conic", "linear"])
def test_every_method_answers(method):
    assert Answers(rule)(replace(HELD, method=method)).mood is Mood.GOOD


@pytest.mark.parametrize("start", ["single_value", "lagrange", "previous", "learned"])
def test_every_start_answers(start):
    ask = Answers(rule)
    first, again = ask(replace(HELD, start=start)), ask(replace(HELD, start=start))
    assert first.mood is again.mood is Mood.GOOD
    if start == "previous":  # what is timed again does not start from itself: the first load's answer is where it is
        assert again.iterations == 0


def test_the_twist_of_an_infeasible_load_separates_it():
    answer = Answers()(ONE_SIDE)
    assert (answer.mood, answer.status) == (Mood.BAD, "cannot be held")
    assert answer.twist is not None
    assert answer.twist @ LOAD > 0.0
    grasp = Grasp.from_contacts(ONE_SIDE.positions, ONE_SIDE.normals, 0.4)
    speeds = (grasp.matrix.T @ answer.twist).reshape(-1, 3)  # no force of a cone brakes it: the dual cone, to rounding
    assert (speeds[:, 0] >= 0.4 * np.hypot(speeds[:, 1], speeds[:, 2]) - 1e-6).all()
    assert not answer.forces.any()
    assert "turns the object" in answer.words
    assert "red screw" in answer.words


def test_the_friction_that_would_hold_is_said_and_holds():
    sphere = shaped("sphere", 0.1)
    places, normals = zip(*(sphere.nearest(np.array(p))[:2] for p in [(0.05, 0.1, 0.0), (-0.05, 0.1, 0.03), (0.0, 0.02, -0.1)]), strict=True)  # fmt: skip
    question = Question(np.array(places), np.array(normals), 0.1, LOAD)
    answer = Answers()(question)
    assert answer.mood is Mood.BAD
    said = float(answer.words.split("Friction ")[1].split()[0])
    assert Answers()(replace(question, friction=said + 0.01)).mood is Mood.GOOD
    assert Answers()(replace(question, friction=said - 0.03)).mood is Mood.BAD


def test_a_limit_that_no_force_keeps_is_told_with_the_gentlest():
    answer = Answers()(replace(HELD, max_normal=3.0))
    assert (answer.mood, answer.status) == (Mood.BAD, "beyond the limit")
    assert answer.normal_forces.max() > 3.0
    assert "3 N" in answer.words
    assert Answers()(replace(HELD, max_normal=20.0)).normal_forces.max() < 20.0


def test_errors_become_words():
    ask = Answers()
    assert "newton" in ask(replace(HELD, method="reduced_flow", max_normal=3.0)).words
    line = Question(np.array([[0.0, 0.0, -0.05], [0.0, 0.0, 0.05], [0.0, 0.0, 0.1]]), GRASP.normals[:3], 0.4, LOAD)
    assert ask(line).status == "no grasp"
    assert ask(HELD).status == "held"  # and the next question is answered
    out = ask(replace(HELD, normals=-HELD.normals))
    assert any("INTO the object" in text for text in out.advice)


def test_a_screw_is_its_twist():
    rng = np.random.default_rng(0)
    for _ in range(20):
        twist, centre = rng.normal(size=6), rng.normal(size=3)
        point, axis, turning, sliding = screw(twist, centre)
        np.testing.assert_allclose(turning * axis, twist[3:], atol=1e-12)
        np.testing.assert_allclose(sliding * axis - np.cross(turning * axis, point), twist[:3], atol=1e-9)
    point, axis, turning, sliding = screw(np.array([0.0, 2.0, 0.0, 0.0, 0.0, 0.0]), np.ones(3))
    assert (turning, sliding, axis.tolist()) == (0.0, 2.0, [0.0, 1.0, 0.0])


@pytest.mark.parametrize("shape", SHAPES)
def test_contacts_lie_on_the_surface_wherever_they_are_dragged(shape):
    body, rng = shaped(shape, 0.1), np.random.default_rng(1)
    for _ in range(50):
        eye = rng.normal(size=3)
        eye *= 0.4 / np.linalg.norm(eye)
        place, inward = body.under(eye, 0.06 * rng.normal(size=3))
        assert abs(body.nearest(place)[2]) < 1e-9
        np.testing.assert_allclose(np.linalg.norm(inward), 1.0, atol=1e-9)
        assert inward @ (body.centre - place) > 0.0  # into the object
    for count in range(3, 9):
        places, normals = body.placed(count)
        assert Answers()(Question(places, normals, 0.5, LOAD)).mood is Mood.GOOD


def test_presets_find_their_bodies_and_others_a_hull():
    assert {name: body_of(presets.preset(name)).name for name in presets.PRESETS} == {
        "paper_cuboid": "box", "tripod": "sphere", "five_finger_cuboid": "box",
    }  # fmt: skip
    rng = np.random.default_rng(2)
    positions = rng.normal(size=(5, 3))
    body = body_of(Grasp.from_contacts(positions, -positions / np.linalg.norm(positions, axis=1)[:, None], 0.5))
    assert body.name == "hull of the contacts"
    assert all(body.nearest(point)[2] < 1e-9 for point in positions)


def test_events_that_come_while_one_is_drawn_are_one():
    busy, go, drawn = threading.Event(), threading.Event(), []

    def work() -> None:
        drawn.append(len(drawn))
        busy.set()
        assert go.wait(10.0)

    newest = Newest(work)
    newest.wake()
    assert busy.wait(10.0)
    for _ in range(1000):
        newest.wake()
    go.set()
    newest.close()
    assert len(drawn) in (1, 2)  # the one under way, and one for all others where it had begun before the end


def test_a_fault_ends_the_worker_and_is_kept():
    newest = Newest(lambda: 1 / 0)
    newest.wake()
    assert not newest.wait(10.0)
    assert isinstance(newest.fault, ZeroDivisionError)


def test_only_this_machine_is_listened_to():
    server = open_server(0, "test")
    try:
        port, own = server.get_port(), f"/proc/{os.getpid()}/net"
        rows = [line.split() for name in ("tcp", "tcp6") for line in Path(own, name).read_text().splitlines()[1:]]
        listening = [row[1] for row in rows if row[3] == "0A" and int(row[1].rsplit(":", 1)[1], 16) == port]
        assert listening == [f"0100007F:{port:04X}"]  # 127.0.0.1, as the kernel writes it
        kinds = {kind.__name__ for kind in server._websock_server._incoming_handlers}
        assert not {kind for kind in kinds if "Share" in kind}  # no tunnel either
    finally:
        close_server(server)


def test_a_taken_port_is_said_and_the_next_one_taken(capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        server = open_server(port, "test")
        try:
            assert server.get_port() != port
            assert f"port {port} is taken" in capsys.readouterr().err
        finally:
            close_server(server)
    with pytest.raises(InvalidInputError, match="port must be"):
        open_server(70_000, "test")


def test_what_is_set_and_dragged_changes_what_is_seen():
    with bare_page() as (page, port), live_client(port) as client:
        client.until(lambda seen: "4.98" in seen.text)
        client.set("friction", 0.8)
        client.until(lambda seen: "4.98" not in seen.text and "held" in seen.text)
        assert page.question.friction == 0.8
        client.set("method", "conic")
        client.until(lambda seen: "<p style" in seen.text and "newton" not in seen.text)
        client.set("force, N", (0.0, 2.0, 0.0))
        client.until(lambda seen: bool(np.allclose(seen.nodes["/load/grip"]["position"][::2], 0.0)))
        np.testing.assert_array_equal(page.question.wrench[:3], [0.0, 2.0, 0.0])


def test_the_load_is_dragged_by_its_ball():
    with bare_page() as (page, port), live_client(port) as client:
        ball = np.array(client.nodes["/load/grip"]["position"])
        away = np.array([0.2, 0.1, -0.3])
        client.drag("/load/grip", "start", ball + 0.01, ball + 0.01)
        client.drag("/load/grip", "update", ball, ball + 0.01 + away)
        client.until(lambda seen: bool(np.allclose(seen.nodes["/load/grip"]["position"], ball + away, atol=1e-6)))
        scale = np.linalg.norm(ball) / np.linalg.norm(LOAD[:3])  # what it was fixed at
        np.testing.assert_allclose(page.question.wrench[:3], LOAD[:3] + away / scale, rtol=1e-5)
        np.testing.assert_array_equal(page.question.wrench[3:], LOAD[3:])


def _points(client: LiveClient) -> np.ndarray:
    return client.nodes["/contacts/points"]["batched_positions"].reshape(-1, 3)


def test_a_contact_is_dragged_over_the_object_until_nothing_holds():
    with bare_page() as (page, port), live_client(port) as client:
        thumb = _points(client)[0]
        np.testing.assert_allclose(thumb, [0.0, 0.0, -0.5], atol=1e-6)
        client.drag("/contacts/points", "start", thumb, thumb, 0)
        client.drag("/contacts/points", "update", thumb, (0.45, 0.1, 0.3), 0)
        client.until(lambda seen: "cannot be held" in seen.text)
        np.testing.assert_allclose(np.abs(page.question.positions[0]).max(), 0.05, atol=1e-9)  # on the box
        ray = np.array([0.45, 0.1, 0.3]) - EYE
        off = np.cross(10.0 * page.question.positions[0] - EYE, ray / np.linalg.norm(ray))
        assert np.linalg.norm(off) < 1e-3  # under the mouse
        assert client.nodes["/screw/axis"]["visible"]
        assert client.nodes["/object/body"]["color"] == [214, 48, 49]
        client.set("number", 6)
        client.until(lambda seen: len(_points(seen)) == 6 and "contact 6" in seen.text)
        assert not client.nodes["/screw/axis"]["visible"]


def test_a_recording_is_one_whole_file(tmp_path, capsys):
    server = open_server(0, "test")
    path = tmp_path / "live.html"
    Session(server, BarePage(server, HELD), "grasp live", path).run(0.5)
    address, written = capsys.readouterr().out.splitlines()
    assert address.startswith("http://127.0.0.1:")
    assert written == str(path)
    assert [file.name for file in tmp_path.iterdir()] == ["live.html"]
    text = path.read_text(encoding="utf-8")
    assert text.rstrip().endswith("</html>")
    assert "__VISER_EMBED_DATA__" in text
    assert "<title>grasp live</title>" in text
    assert path.stat().st_size < 3e6


def test_the_record_button_writes_a_new_file_each_time(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    server = open_server(0, "test")
    port = server.get_port()
    session = Session(server, BarePage(server, HELD), "grasp live")
    thread = threading.Thread(target=session.run, args=(60.0,))
    thread.start()
    try:
        with live_client(port) as client:
            client.until(lambda seen: "Record" in seen.gui)
            for number in (1, 2):
                client.gui.pop("Stop and save", None)
                client.set("Record", True)
                client.until(lambda seen: "Stop and save" in seen.gui)
                client.set("friction", 0.4 + 0.1 * number)
                client.set("Stop and save", True)
                client.gui.pop("Record", None)
                client.until(lambda seen: "Record" in seen.gui)  # told when it is written
                assert (tmp_path / f"grasp-live-{number}.html").exists()
    finally:
        session.stop()
        thread.join(20.0)
    assert not thread.is_alive()


@pytest.mark.parametrize("name", ["live.mp4", "missing/live.html"])
def test_a_recording_that_cannot_be_is_refused_before(tmp_path, name):
    with pytest.raises(InvalidInputError, match=r"html|does not exist"):
        checked_record(tmp_path / name)
    assert checked_record(None) is None


def _command(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "training", "live", "--port", "0", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)


def test_the_command_ends_after_its_time():
    with _command("--seconds", "0.5", "--preset", "tripod") as process:
        out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert out.splitlines()[0].startswith("http://127.0.0.1:")
    assert err == ""


def test_ctrl_c_ends_the_command_in_one_line(tmp_path):
    with _command("--record", str(tmp_path / "live.html")) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("http://127.0.0.1:")
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert err == "grasp: interrupted\n"
    assert (tmp_path / "live.html").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(("--seconds", "-1"), "seconds"), (("--record", "x.gif"), ".html"), (("--grasp", "missing.json"), "missing.json"), (("--hand", "nothing.urdf"), "nothing.urdf")],
)  # fmt: skip
def test_what_cannot_be_shown_is_an_error(arguments, said):
    with _command(*arguments) as process:
        out, err = process.communicate(timeout=120)
    assert process.returncode == 2
    assert out == ""
    assert said in err
    assert err.count("\n") == 1


def test_contacts_that_the_page_cannot_show_are_refused(tmp_path, capsys):
    grasp = presets.tripod()
    soft = Grasp.from_contacts(grasp.positions, grasp.normals, 0.5, contact_model="soft", torsional_friction=0.005)
    save_grasp(soft, tmp_path / "soft.json")
    assert main(["live", "--grasp", str(tmp_path / "soft.json"), "--port", "0", "--seconds", "1"]) == 2
    assert "hard contacts" in capsys.readouterr().err
