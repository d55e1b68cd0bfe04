"""A browser's side of `grasp live` without a browser: what is sent when something is set or dragged, and what comes back."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import numpy as np
import viser
import zstandard
from websockets.sync.client import ClientConnection, connect

EYE = (4.0, 2.5, 5.0)
"""Where its camera stands, scene units."""


class LiveClient:
    """Keeps the last state of panel and scene: `gui` by label, `text` of the panel's head, `nodes` by name and property."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.gui: dict[str, str] = {}
        self.text = ""
        self.nodes: dict[str, dict[str, Any]] = {}
        self._text_id, self._caught_up = "", False
        self.send("ViewerCameraMessage", wxyz=(1.0, 0.0, 0.0, 0.0), position=EYE, fov=0.6, near=0.01, far=100.0, image_height=800, image_width=1200,
                  look_at=(0.0, 0.0, 0.0), up_direction=(0.0, 1.0, 0.0))  # fmt: skip

    def send(self, kind: str, **fields: Any) -> float:
        """Sends a message; when [s]."""
        now = time.perf_counter()
        self._socket.send(msgspec.msgpack.encode({"type": kind, **fields}))
        return now

    def set(self, label: str, value: Any) -> float:
        """Somebody sets what has this label."""
        return self.send("GuiUpdateMessage", uuid=self.gui[label], updates={"value": value})

    def drag(self, name: str, phase: str, start: Any, end: Any, instance: int | None = None) -> float:
        """Somebody drags a node, in scene units."""
        points = {"start_position": tuple(map(float, start)), "end_position": tuple(map(float, end))}
        return self.send("SceneNodeDragMessage", phase=phase, name=name, instance_index=instance, start_screen_pos=(0.5, 0.5), end_screen_pos=(0.5, 0.5),
                         button="left", modifier=None, owner="", **points)  # fmt: skip

    def until(self, seen: Callable[[LiveClient], bool], seconds: float = 20.0) -> float:
        """Reads until `seen`; when its message came [s]."""
        end = time.monotonic() + seconds
        while not seen(self):
            self._read(max(0.0, end - time.monotonic()))
        return time.perf_counter()

    def _read(self, seconds: float) -> None:
        data = self._socket.recv(timeout=seconds)
        assert isinstance(data, bytes)
        packed = int.from_bytes(data[8:16], "little")
        whole = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + packed], int.from_bytes(data[:8], "little")))  # fmt: skip
        start, arrays = 16 + packed, []
        for length in whole["binaryBufferLengths"]:
            start += -start % 8
            arrays.append(data[start : start + length])
            start += length
        for message in whole["messages"]:
            self._note(message, arrays)

    def _note(self, message: dict[str, Any], arrays: list[bytes]) -> None:
        kind = message["type"]
        if kind == "ReplayDoneMessage":
            self._caught_up = True
        elif kind == "GuiUpdateMessage":
            if "label" in message["updates"]:
                self.gui[message["updates"]["label"]] = message["uuid"]
            if message["uuid"] == self._text_id:
                self.text = message["updates"].get("content", self.text)
        elif kind.startswith("Gui") and "props" in message:
            self.gui[message["props"].get("label", "")] = message["uuid"]
            if kind == "GuiHtmlMessage":
                self._text_id, self.text = message["uuid"], message["props"]["content"]
        elif "name" in message:
            node = self.nodes.setdefault(message["name"], {})
            values = message.get("updates") or message.get("props") or {k: v for k, v in message.items() if k not in ("type", "name")}  # fmt: skip
            for key, value in values.items():
                binary = isinstance(value, dict) and "__binary_index" in value
                node[key] = np.frombuffer(arrays[value["__binary_index"]], value["dtype"]) if binary else value


@contextmanager
def live_client(port: int) -> Iterator[LiveClient]:
    """A client that has seen all that was there."""
    protocol: Any = f"viser-v{viser.__version__}"
    with connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None, open_timeout=20) as socket:
        client = LiveClient(socket)
        client.until(lambda seen: seen._caught_up)
        yield client
