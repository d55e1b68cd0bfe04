"""
Your own hand
=============

A hand with three fingers is read from a URDF, placed where it holds a ball, and simulated, as is
the ``allegro`` preset. To learn: ``HandDescription.from_urdf`` reads the hand, and ``gym.make``
finds the pose of the palm, the posture and the contacts.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np

from grasp_env.sim import HandDescription

LINK = """<link name="{name}">
  <inertial><origin xyz="0 0 {middle}"/><mass value="0.03"/>
    <inertia ixx="1e-5" iyy="1e-5" izz="3e-6" ixy="0" ixz="0" iyz="0"/></inertial>
  <visual><origin xyz="0 0 {middle}"/><geometry><cylinder radius="{radius}" length="{length}"/></geometry></visual>
  <collision><origin xyz="0 0 {middle}"/>
    <geometry><cylinder length="{length}" radius="{radius}"/></geometry></collision>
</link>"""
JOINT = """<joint name="{child}_joint" type="revolute"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="{xyz}" rpy="0 0 {turn}"/><axis xyz="{axis}"/>
  <limit lower="-1.2" upper="1.5" effort="1" velocity="5"/></joint>"""

parts = [LINK.format(name="palm", middle=0, radius=0.05, length=0.02)]
for k in range(3):  # fingers around the palm: one joint swings each sideways, two bend it
    turn = 2 * np.pi * k / 3
    above = "palm"
    xyz = f"{0.05 * np.cos(turn)} {0.05 * np.sin(turn)} 0.01"
    for bone, axis, length in (
        ("base", "1 0 0", 0.012),
        ("upper", "0 -1 0", 0.06),
        ("lower", "0 -1 0", 0.05),
    ):
        name = f"finger{k}_{bone}"
        parts.append(LINK.format(name=name, middle=length / 2, radius=0.008, length=length))
        parts.append(
            JOINT.format(
                child=name, parent=above, xyz=xyz, turn=turn if bone == "base" else 0, axis=axis
            )
        )
        above = name
        xyz = f"0 0 {length}"
with TemporaryDirectory() as folder:
    path = Path(folder, "three.urdf")
    path.write_text(f'<robot name="three">{"".join(parts)}</robot>')
    mine = HandDescription.from_urdf(path)

fig, axes = plt.subplots(1, 2, figsize=(8, 4.5), layout="constrained")
for ax, hand in zip(axes, (mine, HandDescription.allegro()), strict=True):
    ball = {"shape": "sphere", "size": (0.06,), "mass": 0.1, "friction": 0.8}
    env = gym.make(
        "grasp_env:FourFingerGrasp-v0",
        hand=hand,
        **ball,
        disturbance="random",
        render_mode="rgb_array",
    )
    observation, info = env.reset(seed=0)
    for _ in range(50):  # a second
        observation, reward, terminated, truncated, info = env.step(0 * env.action_space.sample())
    assert info["is_success"] and not info["saturated"]
    squeeze = info["commanded_force"][:, 0].sum()
    spare = info["torque_margin"]
    print(f"{hand.name}: {hand.joint_count} joints, fingers {', '.join(hand.finger_names)}")
    print(f"  holds with {squeeze:.1f} N, torques stay {spare:.2f} N m below their limits")
    ax.imshow(env.render())
    ax.set_title(hand.name)
    ax.axis("off")
    env.close()
plt.show()
