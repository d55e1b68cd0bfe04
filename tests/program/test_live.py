"""`grasp live` without a browser: answers, mouse and controls, connections, recordings."""

from __future__ import annotations

import asyncio
import base64
import http.client
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
import viser
import zstandard
from numpy.testing import assert_allclose
from processes import start

from grasp_env.config import EnvConfig
from grasp_env.errors import SimulationError
from grasp_env.force.options import METHODS
from grasp_env.grasp import Grasp, presets
from grasp_env.sim.hand.description import HANDS, HandDescription
from grasp_env.sim.hand.urdf import hand_urdf
from grasp_env.sim.objects.description import ObjectDescription
from training.program.commands.rules import rule
from training.program.live import look
from training.program.live.answer import STARTS, answer
from training.program.live.contacts import SHAPES, BareContacts, body_of, cast_ray, place_contacts
from training.program.live.hand import STIFFNESS, SimulatedHand
from training.program.live.window import Window

ROOT = Path(__file__).parents[2]
GRASP = presets.paper_cuboid()
LOAD = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])
EYE = np.array([4.0, 2.5, 5.0])


@pytest.fixture
def bare():
    page = BareContacts(0, GRASP, LOAD, "newton", rule)
    page.draw()
    yield page
    page.server.stop()


@pytest.fixture
def hand():
    page = SimulatedHand(
        0, EnvConfig().override(hand=HANDS["four_finger"](), method="newton"), rule
    )
    page.draw()
    yield page
    page.server.stop()
    page.stage.scene.close()


def node(page: Window, name: str) -> Any:
    return page.scene.get_handle_by_name(name)


def panel(page: Window) -> str:
    return page._panel.content


def until(page: Window, seen: Callable[[], Any]) -> None:
    """Step until the events have arrived and are drawn."""
    for _ in range(200):
        if seen():
            return
        page.step(0.1)
    raise AssertionError(panel(page))


def drag(page: Window, name: str, *points: Any, ends: bool = False) -> None:
    """Drag a node from the first of some points to the others, scene units, seen from `EYE`."""
    phases = ["start", *["update"] * (len(points) - 1), *(["end"] if ends else [])]
    for phase, point in zip(phases, [*points, points[-1]], strict=False):
        camera = SimpleNamespace(camera=SimpleNamespace(position=EYE))
        event = SimpleNamespace(
            phase=phase, start_position=points[0], end_position=point, client=camera
        )
        for entry in node(page, name)._impl.drag_cb:
            asyncio.run(entry.callback(event))
    page.step(10.0)


@pytest.mark.parametrize(
    ("method", "start"), [(m, STARTS[0]) for m in METHODS] + [("newton", s) for s in STARTS]
)
def test_forces_balance_the_load_within_their_cones(method, start):
    found = answer(GRASP, LOAD, method, rule(start))
    again = answer(GRASP, LOAD, method, rule(start), previous=found.solution)
    assert (found.mood, found.status, again.status, found.twist) == ("good", "held", "held", None)
    forces = GRASP.to_object_frame(found.solution.force)
    margins = found.columns["margin, N"]
    balance = [*forces.sum(axis=0), *np.cross(GRASP.positions, forces).sum(axis=0)]
    assert_allclose(balance, -LOAD, atol=1e-9)
    assert_allclose(
        found.columns["normal, N"], np.einsum("ni,ni->n", forces, GRASP.normals), atol=1e-12
    )
    assert margins.min() > 0.0
    if start == "previous":  # the timed solve does not start from itself
        assert again.facts["iterations"] == "0 from previous"


def test_what_cannot_be_held_is_proved_and_mended():
    one_side = Grasp.from_contacts(GRASP.positions[1:], GRASP.normals[1:], 0.4)
    found = answer(one_side, LOAD)
    assert (found.mood, found.status, found.solution) == ("bad", "cannot be held", None)
    assert found.twist is not None
    assert found.twist @ LOAD > 0.0
    # in the dual cones: no force brakes it
    speeds = (one_side.matrix.T @ found.twist).reshape(-1, 3)
    assert (
        speeds[:, 0] >= 0.4 * np.hypot(speeds[:, 1], speeds[:, 2]) - 1e-6 * np.abs(speeds).max()
    ).all()
    assert "More friction alone does not help" in found.words
    sphere = look.object_mesh("sphere", (0.1,))
    eyes = np.array([[0.5, 1.0, 0.0], [-0.5, 1.0, 0.3], [0.0, 0.2, -1.0]])
    met = [cast_ray(sphere, eye, np.zeros(3)) for eye in eyes]
    smooth = Grasp.from_contacts(*map(np.array, zip(*met, strict=True)), 0.1)
    advised = float(answer(smooth, LOAD).words.split("Friction ")[1].split()[0])
    moods = [
        answer(smooth.with_friction(friction), LOAD).mood for friction in (advised, advised - 0.05)
    ]
    assert moods == ["good", "bad"]
    limited = answer(GRASP, LOAD, max_normal=3.0)
    assert (limited.mood, limited.status) == ("bad", "beyond the limit")
    assert limited.columns["normal, N"].max() > 3.0


def test_a_screw_is_drawn_about_its_axis():
    line, *ring = look.screw(
        np.array([0.0, 0.3, 0.1, 0.0, 0.0, 2.0]), np.array([0.0, 0.0, 7.0]), 1.0
    )
    # where the velocity is along the axis
    assert_allclose(line[:, :2], [[-0.15, 0.0]] * 2, atol=1e-12)
    assert line[1, 2] > 7.0 > line[0, 2]  # it slides upwards
    assert np.cross(ring[0][0] - line[0], ring[0][1] - line[0])[2] > 0.0  # and turns to the left
    line, *ring = look.screw(np.array([0.0, -2.0, 0.0, 0.0, 0.0, 0.0]), np.zeros(3), 1.0)
    assert_allclose(line, [[0.0, 0.85, 0.0], [0.0, -0.85, 0.0]])
    assert np.ptp(ring) == 0.0


@pytest.mark.parametrize("shape", SHAPES)
def test_contacts_lie_under_the_mouse(shape):
    rng = np.random.default_rng(1)
    mesh = look.object_mesh(shape, (0.1,) * 3)
    surface = ObjectDescription(shape).surface
    for _ in range(20):
        eye = rng.normal(size=3)
        mouse = 0.01 * rng.normal(size=3)
        met = cast_ray(mesh, eye, mouse)
        assert met is not None
        place, inward = met
        nearest, normal, _ = surface.nearest(place)
        assert_allclose([*place, inward @ normal], [*nearest, 1.0], atol=2e-3)
        assert inward @ (mouse - eye) > 0.0  # the side that the eye sees
        assert_allclose(np.cross(place - eye, mouse - eye), 0.0, atol=1e-12)
        assert cast_ray(mesh, eye, eye + np.cross(eye, inward)) is None  # beside the object
    for count in range(3, 9):
        assert answer(Grasp.from_contacts(*place_contacts(mesh, count), 0.5), LOAD).mood == "good"
    assert body_of(Grasp.from_contacts(*place_contacts(mesh, 8), 0.5))[0] == shape
    positions = np.random.default_rng(2).normal(size=(5, 3))
    name, hull = body_of(
        Grasp.from_contacts(positions, -positions / np.linalg.norm(positions, axis=1)[:, None], 0.5)
    )
    assert (name, hull.is_watertight) == ("hull of the contacts", True)


def test_the_controls_set_the_problem(bare):
    # needs more than 50 N: the end of the slider is no limit
    heavy = np.array([40.0, 0.0, 0.0, *LOAD[3:]])
    for control, value, changes in (
        (bare.friction, 0.8, {"grasp": GRASP.with_friction(0.8)}),
        (bare.force, tuple(heavy[:3]), {"wrench": heavy}),
        (bare.moment, (0.0, 0.0, 0.02), {"wrench": np.array([*LOAD[:3], 0.0, 0.0, 0.02])}),
        (bare.limit, 8.0, {"max_normal": 8.0}),
        (bare.method, "conic", {"method": "conic"}),
        (bare.start, "single_value", {"start": "single_value"}),
        (bare.weight, -4.0, {"barrier_weight": 1e-4}),
    ):
        before, control.value = control.value, value
        expected = answer(**{"grasp": GRASP, "wrench": LOAD, **changes})
        normals = expected.columns["normal, N"]
        until(bare, lambda told=f"{normals[2]:.2f}</td>": told in panel(bare))
        assert_allclose(bare.answer.columns["normal, N"], normals, atol=1e-9)
        assert bare.answer.status == "held"
        assert bare.answer.facts["iterations"] == expected.facts["iterations"]
        control.value = before


def test_forces_and_cones_are_drawn_to_scale(bare):
    tails, heads = np.swapaxes(node(bare, "/contacts/forces").points, 0, 1)
    assert_allclose(heads, 10.0 * GRASP.positions, atol=1e-6)  # they push from outside
    forces = GRASP.to_object_frame(bare.answer.solution.force)
    assert_allclose((heads - tails) / bare._force_scale, forces, atol=1e-5)
    for k, normal in enumerate(GRASP.normals):
        rim = node(bare, f"/contacts/{k}/cone").vertices[1:]
        outward = -rim @ normal
        sideways = np.linalg.norm(rim + np.outer(outward, normal), axis=1)
        assert_allclose(sideways, 0.4 * outward, atol=1e-6)
    bare.start.value = "none"
    until(bare, lambda: bare.answer.status == "not solved")
    assert "choose" in panel(bare)
    bare.again.value = True
    until(bare, lambda: bare.answer.status == "held")
    bare.normals = -GRASP.normals
    bare.draw()
    assert "INTO the object" in panel(bare)


def test_the_mouse_drags_load_and_contact(bare):
    for k, (control, load) in enumerate(((bare.force, LOAD[:3]), (bare.moment, LOAD[3:]))):
        head = np.array(node(bare, f"/load/{k}").position)
        away = np.array([0.2, 0.1, -0.3])
        drag(bare, f"/load/{k}", head + 0.01, head + 0.01 + away)
        assert_allclose(node(bare, f"/load/{k}").position, head + away, atol=1e-3)
        assert_allclose(node(bare, "/load").points[k, 1], head + away, atol=1e-3)
        scale = np.linalg.norm(head) / np.linalg.norm(load)
        assert_allclose(control.value, load + away / scale, atol=1e-4)
    to = np.array([0.45, 0.1, 0.3])
    drag(bare, "/contacts/0", 10.0 * GRASP.positions[0], to)
    assert bare.answer.status == "cannot be held"
    # under the mouse
    assert_allclose(np.cross(10.0 * bare.positions[0] - EYE, to - EYE), 0.0, atol=1e-9)
    # of the side that it is on now
    assert_allclose(bare.normals[0], [-1.0, 0.0, 0.0], atol=1e-9)
    assert "red screw" in panel(bare)
    assert tuple(node(bare, "/object/body").color) == look.BAD
    assert (node(bare, "/screw").visible, node(bare, "/contacts/forces").visible) == (True, False)
    bare.count.value, bare.shape.value = 6, "sphere"
    until(bare, lambda: "contact 6" in panel(bare) and bare.answer.status == "held")
    assert_allclose(np.linalg.norm(bare.positions, axis=1), 0.05, rtol=2e-3)
    bare.again.value = True  # pressed
    until(bare, lambda: bare.shape.value == "cuboid")
    assert (bare.force.value, bare.count.value, bare.answer.status) == ((1.0, 0.5, -0.6), 4, "held")


def test_only_the_page_itself_may_connect(bare):
    port = bare.server.get_port()
    upgrade = {"Upgrade": "websocket", "Connection": "Upgrade"}
    upgrade |= {"Sec-WebSocket-Key": "x" * 22 + "==", "Sec-WebSocket-Version": "13"}
    upgrade |= {"Sec-WebSocket-Protocol": f"viser-v{viser.__version__}"}
    for host, origin, page, websocket in (
        (f"127.0.0.1:{port}", f"http://127.0.0.1:{port}", 200, 101),
        (f"localhost:{port}", f"http://localhost:{port}", 200, 101),
        # opens the page; browsers send an origin with every websocket
        (f"127.0.0.1:{port}", None, 200, 403),
        (f"127.0.0.1:{port}", "http://example.org", 403, 403),  # another site
        (f"127.0.0.1:{port}", "http://localhost:1", 403, 403),  # another program on this machine
        (f"127.0.0.1:{port}", "null", 403, 403),  # a file, or a frame without rights
        (f"example.org:{port}", f"http://example.org:{port}", 403, 403),  # DNS rebinding
        (f"127.0.0.1.example.org:{port}", None, 403, 403),
    ):
        for more, expected in (({}, page), (upgrade, websocket)):
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
            connection.request(
                "GET", "/", headers={"Host": host, **({"Origin": origin} if origin else {}), **more}
            )
            answered = connection.getresponse()
            framed = "DENY" if expected == 200 else None
            assert (answered.status, answered.headers["X-Frame-Options"]) == (expected, framed), (
                host,
                origin,
            )
            connection.close()
    rows = [
        line.split()
        for name in ("tcp", "tcp6")
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]
    ]
    listening = [
        row[1] for row in rows if row[3] == "0A" and int(row[1].rsplit(":", 1)[1], 16) == port
    ]
    assert listening == [f"0100007F:{port:04X}"]  # 127.0.0.1 alone, as the kernel writes it


def recorded(path: Path) -> dict[str, Any]:
    """The film in a recording."""
    data = base64.b64decode(
        re.findall(r'__VISER_EMBED_DATA__="([^"]+)"', path.read_text(encoding="utf-8"))[-1]
    )
    whole = zstandard.ZstdDecompressor().decompress(data[8:], int.from_bytes(data[:8], "little"))
    return msgspec.msgpack.decode(whole[8 : 8 + int.from_bytes(whole[:8], "little")])


def test_recordings_are_saved_at_ctrl_c(tmp_path):
    assert all(all(look.link_meshes(make().links)) for make in HANDS.values())
    path = tmp_path / "mine.urdf"
    record = tmp_path / "live.html"
    path.write_text(hand_urdf(HandDescription.four_finger()), encoding="utf-8")
    command = [
        sys.executable,
        *f"-m training live --port 0 --hand {path} --record {record}".split(),
    ]
    with start(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("http://127.0.0.1:")
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert re.fullmatch(r"(grasp: repaired: .*\n)*grasp: interrupted\n", err)
    film = recorded(record)
    assert any(each["type"] == "SetPositionMessage" for _, each in film["messages"])


def test_it_ends_after_the_given_time(bare, capsys):
    began = time.monotonic()
    bare.run(seconds=0.2)
    assert 0.2 <= time.monotonic() - began < 20.0
    assert capsys.readouterr().out.startswith("http://127.0.0.1:")


def test_a_long_recording_ends_and_is_saved(bare, tmp_path, monkeypatch, capsys):
    bare._button, bare._note = SimpleNamespace(label=""), SimpleNamespace(content="")
    bare._record(tmp_path / "long.html")
    bare._draw()
    assert bare._button.label == "Stop and save"
    monkeypatch.setattr("training.program.live.window.MAX_RECORDED", -1.0)
    bare._draw()
    assert bare._button.label == "Record"
    assert capsys.readouterr().out == f"{tmp_path / 'long.html'}\n"
    assert recorded(tmp_path / "long.html")["messages"]


def test_a_recording_that_cannot_be_saved(bare, tmp_path):
    bare._button, bare._note = SimpleNamespace(label=""), SimpleNamespace(content="")
    bare._record(tmp_path / "gone" / "live.html")
    bare._press()
    assert bare._button.label == "Record"
    assert bare._note.content.startswith(
        "not saved: live.html: No such file or directory; choose another folder"
    )


def pushes(hand: SimulatedHand) -> np.ndarray:
    """Commanded forces (N, 3) on the object [N], world frame."""
    return np.einsum(
        "nij,nj->ni", hand.stage.scene.look().rotation @ hand.loop.frames, hand.loop.force
    )


def test_controls_change_hand_and_object(hand, monkeypatch):
    margin, stage = hand.loop.effort.margin, hand.stage
    hand.mass.value = 0.4
    hand.draw()
    hand.advance(100)
    assert_allclose(pushes(hand).sum(axis=0), [0.0, 0.4 * 9.81, 0.0], atol=1e-3)

    def refuse(*_: Any) -> Any:
        raise SimulationError("the hand cannot hold this")

    with monkeypatch.context() as patch:
        patch.setattr("training.program.live.hand.Stage", refuse)
        hand.shape.value = "sphere"
        hand.draw()
    assert hand.stage is stage
    assert "the hand cannot hold this" in panel(hand)
    hand.shape.value = "cylinder"
    hand.draw()
    assert (hand.status()[1], hand.stage.scene.config.object.shape) == ("held", "cylinder")
    hand.motors.value = 10
    hand.draw()
    hand.advance(25)
    assert 0.0 < hand.loop.effort.margin < 0.11 * margin


def test_the_mouse_pulls_the_object(hand):
    drag(hand, "/object/body", (0.5, 0.0, 0.0), (0.5, 0.1, 0.0))
    # in metres: it is drawn ten times as large
    assert_allclose(hand.grip, [0.05, 0.0, 0.0], atol=1e-4)
    assert_allclose(hand.pull(), [0.0, 0.01 * STIFFNESS, 0.0], atol=0.05)
    drag(hand, "/object/body", (0.5, 0.0, 0.0), (0.5, 10.0, 0.0))
    hand.advance(100)
    assert_allclose(hand.pull(), [0.0, 5.0, 0.0], atol=0.01)  # and no more
    assert_allclose(pushes(hand).sum(axis=0), [0.0, 0.2 * 9.81 - 5.0, 0.0], atol=2e-3)
    moments = np.cross(hand.stage.scene.look().touch, pushes(hand)).sum(axis=0)
    assert_allclose(moments, [0.0, 0.0, -0.05 * 5.0], atol=3e-3)
    hand.draw()
    assert all(text in panel(hand) for text in ("held", "5.0 N"))
    drag(hand, "/object/body", (0.5, 0.0, 0.0), ends=True)
    assert not node(hand, "/pull").visible
    hand.max_pull.value, hand.friction.value = 40.0, 0.1
    drag(hand, "/object/body", (0.0, 0.5, 0.0), (0.0, 30.0, 0.0))
    until(hand, lambda: hand.status()[1] == "lost")
    assert tuple(node(hand, "/object/body").color) == look.BAD
    assert node(hand, "/status").text == "lost"
    hand.again.value = True
    until(hand, lambda: hand.status()[1] == "held")
    assert (hand.mouse, hand.friction.value, hand.outcome.drift < 1e-3) == (None, 0.4, True)
    # the simulation diverges
    hand.stage.scene.advance([0.0] * len(hand.loop.torques), [np.nan] * 6)
    hand.step(0.0)
    assert "simulation diverged" in panel(hand)
    assert hand.status()[1] == "held"
