"""
The hand controller as a ROS 2 node
===================================

A managed (lifecycle) node around ``HandController`` publishes efforts. To learn: messages, ages
from time stamps, a clean shutdown. ``python ros2_node.py --ros-args -p hand:=allegro -p
friction:=0.6 -r joint_states:=/hand/joint_states``
"""

import signal
import threading
from dataclasses import asdict

import numpy as np
import rclpy
from geometry_msgs.msg import WrenchStamped
from numpy.lib.recfunctions import structured_to_unstructured

# before Kilted: rclpy.executors.SingleThreadedExecutor, which is slower
from rclpy.experimental import EventsExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from sensor_msgs.msg import JointState, PointCloud2, PointField

from grasp_env.control import HandController, HandControllerSettings
from grasp_env.sim import HANDS, HandDescription

INPUTS = {"joint_states": JointState, "contacts": PointCloud2, "wrench": WrenchStamped}
# those whose default is None are not parameters: a wrench of any age is used
SETTINGS = {
    name: value for name, value in asdict(HandControllerSettings()).items() if value is not None
}
# gravity [m/s^2], base frame
PARAMETERS = {"hand": "four_finger", "gravity": [0.0, 0.0, -9.81], **SETTINGS}
# matches publishers of both reliabilities
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
POINT = ("x", "y", "z", "normal_x", "normal_y", "normal_z")  # float32, as in PCL's PointNormal


class HandNode(LifecycleNode):
    """`configure` reads parameters, `activate` needs a message on every topic, `deactivate`
    commands zero torque.
    """

    def __init__(self):
        super().__init__("hand_controller")
        self.controller, self.newest, self.timer = None, dict.fromkeys(INPUTS), None
        for topic, kind in INPUTS.items():
            self.create_subscription(
                kind,
                topic,
                lambda message, topic=topic: self.newest.update({topic: message}),
                NEWEST,
            )
        self.publisher = self.create_lifecycle_publisher(JointState, "joint_commands", 1)
        self.declare_parameters("", [*PARAMETERS.items()])

    def on_configure(self, state):
        """Make the controller."""
        values = {name: self.get_parameter(name).value for name in PARAMETERS}
        hand, gravity = values.pop("hand"), values.pop("gravity")
        try:
            self.hand = HANDS[hand]() if hand in HANDS else HandDescription.from_urdf(hand)
            # the calibration is left out: efforts are in N m
            self.controller = HandController()
            self.controller.configure(self.hand, HandControllerSettings(**values))
            self.reading = self.controller.new_state()
            self.reading.gravity = np.array(gravity, dtype=float)
        except (TypeError, ValueError, OSError) as error:
            self.get_logger().error(f"cannot configure: {error}")
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def on_activate(self, state):
        """Start the loop at the current state of the hand."""
        self.last = self.get_clock().now()
        try:
            self.read()
            self.controller.activate(self.reading)
        except ValueError as error:
            self.get_logger().error(f"cannot activate: {error}")
            return TransitionCallbackReturn.FAILURE
        self.timer = self.create_timer(1.0 / self.controller.settings.rate, self.tick)
        return super().on_activate(state)

    def on_deactivate(self, state):
        """Stop the loop with a last command of zero torque."""
        if self.timer is not None:
            self.destroy_timer(self.timer)
            self.timer = None
            self.controller.deactivate()
            self.publish()
        return super().on_deactivate(state)

    on_shutdown = on_deactivate  # from every state

    def tick(self):
        """Update the controller; while messages do not fit, the ages of the last state grow."""
        before = self.last
        status = self.controller.status
        self.last = self.get_clock().now()
        period = (self.last - before).nanoseconds * 1e-9
        try:
            self.read()
        except ValueError as error:
            self.reading.ages += period
            self.get_logger().warning(str(error), throttle_duration_sec=1.0)
        self.controller.update(self.reading, period)
        if self.controller.status != status:
            self.get_logger().info(f"{self.controller.status}, was {status}")
        self.publish()

    def publish(self):
        """Publish efforts with the time stamp of their contacts."""
        header = self.newest["contacts"].header
        efforts = self.controller.torques.tolist()
        self.publisher.publish(
            JointState(header=header, name=self.hand.joint_names, effort=efforts)
        )

    def read(self):
        """Fill the state from the newest messages, or raise ValueError and leave it as it is."""
        if missing := [topic for topic, message in self.newest.items() if message is None]:
            raise ValueError(f"nothing came yet on {', '.join(missing)}")
        joints, contacts, wrench = self.newest.values()
        if contacts.header.frame_id != wrench.header.frame_id:
            raise ValueError(
                "contacts and wrench must both be in the frame of the hand's base; their frame_id differ"
            )
        known = dict(
            zip(joints.name, zip(joints.position, joints.velocity, strict=False), strict=False)
        )
        angles, rates = np.array(
            pick(self.hand.joint_names, known, "joint_states with position and velocity")
        ).T.copy()
        load = np.array(
            [
                getattr(part, axis)
                for part in (wrench.wrench.force, wrench.wrench.torque)
                for axis in "xyz"
            ]
        )
        touching, positions, normals = read_points(contacts, self.hand.finger_count)
        ages = [
            1e-9 * abs((self.last - Time.from_msg(part.header.stamp)).nanoseconds)
            for part in (joints, contacts)
        ]
        reading = self.reading
        reading.angles, reading.rates = angles, rates
        reading.touching, reading.positions, reading.normals = touching, positions, normals
        reading.wrench, reading.ages = load, np.array([*ages, 0.0])


def read_points(cloud, count):
    """Return touching fingertips (count,) as 1 or 0, points (count, 3) [m] and unit normals; NaN
    means no contact.
    """
    places = {
        field.name: field.offset for field in cloud.fields if field.datatype == PointField.FLOAT32
    }
    offsets = pick(POINT, places, "float32 fields of contacts")
    number = ">f4" if cloud.is_bigendian else "<f4"
    layout = np.dtype(
        {"names": POINT, "formats": [number] * 6, "offsets": offsets, "itemsize": cloud.point_step}
    )
    points = structured_to_unstructured(np.frombuffer(cloud.data, layout)).astype(np.float64)
    if len(points) != count:
        raise ValueError(f"contacts have {len(points)} points, {count} fingertips need one each")
    touching = np.isfinite(points).all(axis=1)
    points[~touching] = 0.0
    lengths = np.linalg.norm(points[:, 3:], axis=1, keepdims=True)
    if (lengths[touching] < 0.5).any():
        raise ValueError("contacts have normals of no length; a contact that is none needs nan")
    return touching * 1.0, points[:, :3].copy(), points[:, 3:] / lengths.clip(0.5)


def pick(names, known, what):
    """Return the values of these names."""
    if missing := [name for name in names if name not in known]:
        raise ValueError(f"{what} lack {', '.join(missing)}")
    return [known[name] for name in names]


def main():
    """Spin until ctrl-C or SIGTERM; an active controller then commands zero torque before the end."""
    # rclpy's would close the connection first
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    node = HandNode()
    executor = EventsExecutor()
    executor.add_node(node)
    while not ended.is_set():
        executor.spin_once(timeout_sec=0.1)
    node.on_shutdown(None)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
