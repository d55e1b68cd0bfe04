"""
When no force exists
====================

A block lies on three fingertips, and the hand tilts. To learn: a wrench that cannot be balanced
raises an error with a proof, a twist: the motion that the weight drives and that no force within
the friction cones resists.
"""

import matplotlib.pyplot as plt
import numpy as np

from grasp_env.errors import InfeasibleWrenchError
from grasp_env.force import optimize_force
from grasp_env.grasp import Grasp, gravity_wrench

points = np.array([[0.03, 0, 0], [-0.02, 0.025, 0], [-0.02, -0.025, 0]])  # under the block [m]
grasp = Grasp.from_contacts(points, [[0, 0, 1]] * 3, friction=0.4)


def tilted(degrees):
    """Return the weight of 0.5 kg, 20 mm above the fingertips, in the frame of the block."""
    angle = np.radians(degrees)
    down = 9.81 * np.array([np.sin(angle), 0, -np.cos(angle)])
    return gravity_wrench(0.5, com=[0, 0, 0.02], gravity=down)


arrows_at = {}
for degrees in range(0, 41, 5):
    try:
        solution = optimize_force(grasp, tilted(degrees))
        arrows_at[degrees] = grasp.to_object_frame(solution.force)
        print(f"{degrees:2d} deg: held, {solution.cone_margin:.3f} N from slipping")
    except InfeasibleWrenchError as error:
        # velocity [m/s] and angular velocity, up to scale
        twist = arrows_at[degrees] = error.solution.certificate
        slope = np.degrees(np.arctan2(twist[2], twist[0]))
        print(
            f"{degrees:2d} deg: no force; the proof slides along x, {slope:.0f} deg off the fingertips"
        )
        # the weight and every force within the cones drive this motion: nothing balances the weight
        velocities = (grasp.matrix.T @ twist).reshape(3, 3)  # of the contact points: normal, o, t
        assert (
            twist @ tilted(degrees) > 0
            and (velocities[:, 0] >= 0.4 * np.hypot(*velocities[:, 1:].T) - 1e-9).all()
        )
# atan(0.4) is 21.8
assert [degrees for degrees, arrows in arrows_at.items() if arrows.shape == (6,)] == [
    25,
    30,
    35,
    40,
]

corners = 1e3 * np.array([[-0.04, 0.04, 0.04, -0.04, -0.04], [0, 0, 0.04, 0.04, 0]])  # x and z [mm]
fig, axes = plt.subplots(1, 2, figsize=(8, 4.5), sharey=True, layout="constrained")
for ax, degrees, what in zip(
    axes, (20, 30), ("held, by these forces", "not held: the proof"), strict=True
):
    cos = np.cos(np.radians(degrees))
    sin = np.sin(np.radians(degrees))
    turn = np.array([[cos, sin], [-sin, cos]])  # from the block's x and z to the picture
    ax.fill(*(turn @ corners), color="0.85")
    arrows = arrows_at[degrees]
    if arrows.shape == (6,):
        starts = corners[:, :4]
        arrows = np.tile(arrows[[0, 2]] / np.linalg.norm(arrows), (4, 1)).T * 30
    else:
        starts = 1e3 * points[:, [0, 2]].T
        arrows = 10 * arrows[:, [0, 2]].T
    ax.quiver(
        *(turn @ starts), *(turn @ arrows), angles="xy", scale_units="xy", scale=1, color="tab:blue"
    )
    ax.quiver(*(turn @ [0, 20]), 0, -30, angles="xy", scale_units="xy", scale=1, color="tab:red")
    ax.set(
        title=f"{degrees} deg, {what}",
        xlabel="x [mm]",
        aspect="equal",
        xlim=(-50, 85),
        ylim=(-30, 70),
    )
axes[0].set_ylabel("z [mm]")
plt.show()
