"""
A controller for a torque-controlled hand
=========================================

The controller of the simulation is wired to an Allegro hand, here without hardware. A finger loses
its contact and finds it again; later the messages stop. To learn: the life cycle of
``HandController``, a calibration for the motors, the ages of messages, and what a status says. A
loop in C++ is ``grasp_env/core/examples/hand_controller.cpp``.
"""

import matplotlib.pyplot as plt
import numpy as np

from grasp_env.control import Calibration, HandController, HandControllerSettings
from grasp_env.sim import HandDescription, HandKinematics

RATE = 500.0  # [Hz]
hand = HandDescription.allegro()
kinematics = HandKinematics(hand)

# motors that take whole numbers from -240 to 240
limits = 0.5 * hand.torque_limits  # [N m]
units = np.tile([-240.0, 240.0], (hand.joint_count, 1))
calibration = Calibration(np.outer(limits, [-1.0, 1.0]), units)
controller = HandController()
controller.configure(hand, HandControllerSettings(friction=0.6, rate=RATE), calibration)

# A message, in the frame of the hand's base: on hardware, fill it from your sensors.
state = controller.new_state()
state.angles = np.array(hand.home)
state.gravity[2] = -9.81
tips = kinematics.tips(hand.home)
middle = 0.5 * (tips[:3].mean(axis=0) + tips[3])  # of an object between three fingers and the thumb
inward = (middle - tips) / np.linalg.norm(middle - tips, axis=1, keepdims=True)
state.touching[:] = 1.0
state.positions = tips + kinematics.tip_radii[:, None] * inward
state.normals = inward
weight = np.array([0.0, 0.0, -1.5])  # [N]
state.wrench = np.concatenate([weight, np.cross(middle, weight)])

controller.activate(state)  # torques rise from zero
ticks = 500
lost = range(100, 200)  # the ring finger does not touch
silent = range(300, 475)  # no message comes
times = np.arange(ticks) / RATE
normal_forces = np.empty((ticks, hand.finger_count))
durations = np.empty(ticks)
statuses = [controller.status]
for tick in range(ticks):
    state.touching[2] = tick not in lost
    if tick in silent:
        state.ages += 1.0 / RATE  # the last message gets older
    else:
        state.ages[:] = 0.001
    commands = controller.update(state, 1.0 / RATE)  # send these to the motors
    normal_forces[tick] = controller.force[:, 0]
    durations[tick] = controller.duration
    if controller.status != statuses[-1]:
        statuses.append(controller.status)
        print(
            f"{times[tick]:.3f} s: {controller.status}, largest command {abs(commands).max():.0f}"
        )
controller.deactivate()
print(f"an update takes {1e6 * np.median(durations):.0f} us; {controller.late} were late")
assert statuses == ["released", "holding", "coasting", "released", "holding"]
assert normal_forces[150, 2] < 0.1 < normal_forces[250, 2]  # the others hold meanwhile
assert not controller.update(state, 1.0 / RATE).any()  # deactivated: zero torque

fig, ax = plt.subplots(figsize=(8, 4.5), layout="constrained")
ax.plot(times, normal_forces, label=list(hand.finger_names))
for span, name in ((lost, "ring lost"), (silent, "no messages")):
    ax.axvspan(times[span[0]], times[span[-1]], color="0.9", label=name)
ax.set(xlabel="time [s]", ylabel="commanded normal force [N]")
ax.legend()
plt.show()
