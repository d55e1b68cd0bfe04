"""
Torque limits
=============

The load grows, and one finger has weak motors. To learn: forces are within the torque limits if
possible; otherwise ``elastic=True`` returns the force that exceeds them least, and the excess. In
C++: ``04_torque_limits.cpp``.
"""

import matplotlib.pyplot as plt
import numpy as np

from grasp_env.force import ForceLimits, ForceOptimizer, Status
from grasp_env.grasp import presets

grasp = presets.paper_cuboid()  # a thumb below, three fingers above
# velocities of the contact points by the joints, object frame [m]: three rows a contact, three
# joints a finger
jacobian = np.kron(np.eye(4), [[0.05, 0, 0], [0.01, -0.02, -0.03], [0.06, 0.05, 0.03]]).reshape(
    4, 3, 12
)
own_weight = np.tile([0.02, 0.01, 0.005], 4)  # joint torques of the links' weight [N m]
motors = np.repeat([0.8, 0.4, 0.4, 0.1], 3)  # torque limits [N m]
free = ForceOptimizer(
    grasp, limits=ForceLimits(jacobian=jacobian, torque_limit=np.inf, torque_bias=own_weight)
)
limited = ForceOptimizer(
    grasp, limits=ForceLimits(jacobian=jacobian, torque_limit=motors), elastic=True
)

loads = np.linspace(0, 15, 61)  # [N]
shares = np.empty((2, len(loads)))  # largest torque relative to its limit
excess = np.empty(len(loads))
for k, load in enumerate(loads):
    wrench = [0.7 * load, 0, 0.7 * load, 0, 0, 0]
    # in a loop, pass the current Jacobian and weight to each call
    kept = limited.solve(wrench, jacobian=jacobian, torque_bias=own_weight)
    shares[:, k] = [
        (abs(solution.torques) / motors).max() for solution in (free.solve(wrench), kept)
    ]
    excess[k] = kept.limit_excess
    if k % 10 == 0:
        print(
            f"{load:4.1f} N: {shares[0, k]:4.0%} of the limits; minding them {shares[1, k]:4.0%}, {kept.status.value}"
        )
    assert (kept.status is Status.LIMITS_EXCEEDED) == (excess[k] > 0)
    assert shares[1, k] < 1 + excess[k] + 1e-6

print(Status.LIMITS_EXCEEDED.help)
strong = loads[excess == 0].max()
naive = loads[shares[0] <= 1].max()
print(f"carried: {naive:.1f} N without minding the motors, {strong:.1f} N within their limits")
assert naive < strong < loads[-1]

fig, ax = plt.subplots(figsize=(8, 4.5), layout="constrained")
ax.plot(loads, shares[0], color="tab:orange", label="least Phi")
ax.plot(loads, shares[1], color="tab:blue", label="least Phi within the limits")
ax.axhline(1, color="0.4", linewidth=0.8)
ax.axvspan(strong, loads[-1], color="0.92", label="no force keeps them: status limits_exceeded")
ax.set(
    xlabel="load [N]", ylabel="largest joint torque / its limit", xlim=(loads[0], loads[-1]), ylim=0
)
ax.legend()
plt.show()
