"""From an event at the page to the redraw that is sent for it: `python tests/live_latency.py [EVENTS]`, through the websocket."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np
from live_client import EYE, LiveClient, live_client

PACE = 0.05
"""[s] between two events: viser's page sends no more often while something is dragged."""


def report(name: str, seconds: list[float]) -> None:
    p50, p95, p99 = np.percentile(1e3 * np.array(seconds), (50, 95, 99))
    sys.stdout.write(f"{name}: {len(seconds)} events, p50 {p50:.1f} ms, p95 {p95:.1f} ms, p99 {p99:.1f} ms, most {1e3 * max(seconds):.1f} ms\n")  # fmt: skip
    sys.stdout.flush()


def load_dragged(client: LiveClient, events: int) -> list[float]:
    """The ball at the load's arrow is dragged around; its new place is the answer."""
    start = np.array(client.nodes["/load/grip"]["position"])
    client.drag("/load/grip", "start", start, start)
    times = []
    for k in range(events):
        angle = 2.0 * np.pi * k / 60.0
        end = start + 0.3 * np.array([np.sin(angle), np.cos(angle), 0.5 * np.sin(2.0 * angle)]) + 1e-5 * k
        begin = client.drag("/load/grip", "update", start, end)
        times.append(client.until(lambda seen, end=end: bool(np.allclose(seen.nodes["/load/grip"]["position"], end, atol=2e-6))) - begin)  # fmt: skip
        time.sleep(max(0.0, PACE - times[-1]))
    client.drag("/load/grip", "end", start, start)
    return times


def contact_dragged(client: LiveClient, events: int) -> list[float]:
    """A contact is dragged over its face; its place under the mouse is the answer."""
    times = []
    first = client.nodes["/contacts/points"]["batched_positions"].reshape(-1, 3)[1].copy()
    client.drag("/contacts/points", "start", first, first, 1)
    for k in range(events):
        angle = 2.0 * np.pi * k / 60.0
        end = first + 0.1 * np.array([np.sin(angle), np.cos(angle), 0.0]) + 1e-5 * k
        begin = client.drag("/contacts/points", "update", end, end, 1)

        def under(seen: LiveClient, end: np.ndarray = end) -> bool:
            ray = (end - EYE) / np.linalg.norm(end - EYE)
            place = seen.nodes["/contacts/points"]["batched_positions"].reshape(-1, 3)[1]
            return bool(np.linalg.norm(np.cross(place - EYE, ray)) < 1e-3)  # events are 10 mm of the page apart

        times.append(client.until(under) - begin)
        time.sleep(max(0.0, PACE - times[-1]))
    client.drag("/contacts/points", "end", first, first, 1)
    return times


def object_pulled(client: LiveClient, events: int) -> list[float]:
    """The object in the hand is pulled hither and thither; the first redraw with the new pull is the answer."""
    times = []
    grip = np.array([0.0, 0.5, 0.0])
    client.drag("/object/body", "start", grip, grip)
    for k in range(events):
        # the pull is limited to 5 N, 12.5 mm of the spring: by its direction the answer is known from what came before
        away = np.array([np.cos(2.0 * k), np.sin(2.0 * k), 0.0])
        begin = client.drag("/object/body", "update", grip, grip + away)

        def pulled(seen: LiveClient, away: np.ndarray = away) -> bool:
            points = seen.nodes.get("/pull/arrow", {}).get("points", np.zeros(6)).reshape(2, 3)
            along = points[1] - points[0]
            return bool(along @ away > 0.99 * np.linalg.norm(along) > 0.0)

        times.append(client.until(pulled) - begin)
        time.sleep(max(0.0, PACE - times[-1]))
    client.drag("/object/body", "end", grip, grip)
    return times


def measure(name: str, arguments: list[str], events: int, prepare: int = 0) -> None:
    command = [sys.executable, "-m", "training", "live", "--port", "0", "--seconds", "300", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            port = int(process.stdout.readline().split()[0].rsplit(":", 1)[1])
            with live_client(port) as client:
                if prepare:
                    client.set("number", prepare)
                    client.until(lambda seen: len(seen.nodes.get("/contacts/points", {}).get("batched_positions", ())) == 3 * prepare)  # fmt: skip
                if arguments:
                    client.set("most pull, N", 1.0)  # any hand holds against that
                    report(f"{name}, the object pulled", object_pulled(client, events))
                    return
                report(f"{name}, the load dragged", load_dragged(client, events))
                report(f"{name}, a contact dragged", contact_dragged(client, events))
        finally:
            process.terminate()


if __name__ == "__main__":
    many = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    for count in (4, 8):
        measure(f"bare contacts, N = {count}", [], many, count)
    for hand in ("four_finger", "allegro"):
        measure(f"hand {hand}", ["--hand", hand], many)
