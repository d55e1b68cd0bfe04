"""The hand's side of `examples/ros2_node.py`, run by an interpreter that has rclpy: starts the
node, plays messages, records efforts.

It imports nothing of this project. A task is read as JSON from stdin, and the results are written
as JSON to stdout. Both processes communicate through shared memory only, without sockets, so no
other process can take part.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
import time
from itertools import chain
from typing import Any

ONLY_HERE = {"FASTDDS_BUILTIN_TRANSPORTS": "SHM", "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT"}
"""Environment in which Fast DDS opens no socket: LOCALHOST leaves UDP ports open on all interfaces.
"""
ANSWER = 0.05
"""Wait for the answer to the last message of a phase [s]."""
PATIENCE = 20.0
"""Longest wait for an answer of the node [s]."""


class Hand:
    """Node that publishes the messages of a hand, and records the received efforts."""

    def __init__(self) -> None:
        import rclpy
        from geometry_msgs.msg import WrenchStamped
        from lifecycle_msgs.srv import ChangeState
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from sensor_msgs.msg import JointState, PointCloud2, PointField

        rclpy.init()
        self.node, self.executor = rclpy.create_node("hand"), SingleThreadedExecutor()
        self.executor.add_node(self.node)
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.joints, self.contacts, self.wrench = JointState(), PointCloud2(), WrenchStamped()
        names = ("x", "y", "z", "normal_x", "normal_y", "normal_z")
        self.contacts.fields = [
            PointField(name=name, offset=4 * place, datatype=PointField.FLOAT32, count=1)
            for place, name in enumerate(names)
        ]
        self.contacts.point_step = 4 * len(names)
        # contacts go last
        topics = {"joint_states": self.joints, "wrench": self.wrench, "contacts": self.contacts}
        self.outputs = {
            topic: (self.node.create_publisher(type(message), topic, newest), message)
            for topic, message in topics.items()
        }
        self.node.create_subscription(JointState, "joint_commands", self.receive, newest)
        self.request = ChangeState.Request()
        self.service = self.node.create_client(ChangeState, "hand_controller/change_state")
        self.last: Any = None
        self.seen: list[int] = []

    def receive(self, message: Any) -> None:
        """Keep an effort, and the time stamp of the contacts that it answers [ns]."""
        self.last, stamp = message, message.header.stamp
        self.seen.append(stamp.sec * 10**9 + stamp.nanosec)

    def change(self, transition: str) -> bool:
        """Request a transition of the node's life cycle, and return True if it succeeded."""
        if not self.service.wait_for_service(timeout_sec=PATIENCE):
            raise SystemExit("the node offers no service hand_controller/change_state")
        self.request.transition.label = transition
        answer = self.service.call_async(self.request)
        self.executor.spin_until_future_complete(answer, timeout_sec=PATIENCE)
        if not answer.done():
            raise SystemExit(f"the node did not answer: {transition}")
        return answer.result().success

    def fill(self, phase: dict[str, Any]) -> None:
        """Make the messages of a phase."""
        self.joints.name, self.joints.position, self.joints.velocity = (
            phase["joints"][key] for key in ("name", "position", "velocity")
        )
        for part, values in (("force", phase["wrench"][:3]), ("torque", phase["wrench"][3:])):
            vector = getattr(self.wrench.wrench, part)
            vector.x, vector.y, vector.z = values
        self.contacts.header.frame_id, self.wrench.header.frame_id = phase.get(
            "frames", ("palm", "palm")
        )
        numbers = [*chain.from_iterable(phase["points"])]
        self.contacts.data = struct.pack(f"<{len(numbers)}f", *numbers)
        self.contacts.width = len(phase["points"])
        self.contacts.height = 1
        self.contacts.row_step = len(self.contacts.data)

    def play(self, phase: dict[str, Any]) -> dict[str, Any]:
        """Publish a phase's messages for its `seconds` at its `rate` [Hz], but for topics that are
        `silent`.

        `transitions` of the node come first; contacts are stamped `ahead` of time [s].
        """
        for transition in phase.get("transitions", ()):
            self.change(transition)
        self.fill(phase)
        self.seen, sent = [], list[int]()
        due = time.monotonic()
        end = due + phase["seconds"]
        while due < end:
            for topic, (publisher, message) in self.outputs.items():
                if topic not in phase.get("silent", ()):
                    now = time.time_ns()
                    stamp = now + int(phase.get("ahead", 0.0) * 1e9) * (topic == "contacts")
                    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
                    publisher.publish(message)
                    if topic == "contacts":
                        sent.append(now)
            due += 1.0 / phase["rate"]
            self.spin(due)
        self.spin(due + ANSWER)
        effort = (
            None if self.last is None else dict(zip(self.last.name, self.last.effort, strict=True))
        )
        seen = self.seen
        self.seen = []
        return {"effort": effort, "sent": sent, "seen": seen}

    def spin(self, until: float) -> None:
        """Receive until that time of the monotonic clock."""
        while (left := until - time.monotonic()) > 0.0:
            self.executor.spin_once(timeout_sec=left)


def main() -> None:
    """Play a task: the `command` of the node, and its phases."""
    task = json.load(sys.stdin)
    os.environ.update(ONLY_HERE)
    hand = Hand()
    found = dict[str, Any]()
    with subprocess.Popen(task["command"], stdout=sys.stderr) as process:
        try:
            found["configured"] = hand.change("configure")
            found["early"] = hand.change("activate")  # before any message
            if phases := task["phases"]:
                hand.play({**phases[0], "seconds": 0.5})
                found["activated"] = hand.change("activate")
                found["phases"] = [hand.play(phase) for phase in phases]
            hand.last = None
            process.send_signal(signal.SIGINT)
            found["code"] = process.wait(PATIENCE)
            hand.spin(time.monotonic() + 0.2)
            found["end"] = None if hand.last is None else list(hand.last.effort)
        finally:
            process.kill()
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
