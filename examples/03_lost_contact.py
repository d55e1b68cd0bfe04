"""
A contact is lost and regained
==============================

One of four fingers leaves the object for 0.2 s. To learn: ``contacts`` marks the fingers that touch
in a call; the others have zero force, and the solver warm-starts from its last solution. In C++:
``03_lost_contact.cpp``.
"""

import matplotlib.pyplot as plt
import numpy as np

from grasp_env.errors import InfeasibleWrenchError
from grasp_env.force import ForceOptimizer
from grasp_env.grasp import presets

# a thumb below, three fingers above
optimizer = ForceOptimizer(presets.paper_cuboid(), initial="previous")
events = {
    399: "four hold",
    400: "one is lost",
    401: "three hold",
    600: "it is back",
    601: "four hold",
}
forces = np.empty((1000, 4))
iterations = np.empty(1000)
for tick in range(1000):
    touching = np.array([True, True, True, not 400 <= tick < 600])
    turn = 2 * np.pi * 1e-3 * tick
    wrench = np.array([3 * np.sin(turn), 2 * np.cos(turn), 2, 0, 0, 0.02])  # [N, N m]
    solution = optimizer.solve(wrench, contacts=touching).raise_for_status()
    forces[tick], iterations[tick] = solution.force[:, 0], solution.iterations
    if tick in events:
        normal = solution.force[:, 0].round(3)
        print(
            f"{tick} ms, {events[tick]:11} {solution.iterations} iterations, normal forces {normal} N"
        )
assert forces[500, 3] == 0 and iterations[401] <= iterations[400]

two = [True, True, False, False]
normal = optimizer.solve([0, 0, 2, 0, 0, 0], contacts=two).force[:2, 0].round(3)
print(f"two hold, normal forces {normal} N")
try:  # but not against a moment about the line through them
    optimizer.solve([0, 0, 2, 0, 0, 0.02], contacts=two)
except InfeasibleWrenchError as error:
    print(f"two cannot hold {error.solution.wrench[5]} N m")
    print(error)

fig, ax = plt.subplots(figsize=(8, 4.5), layout="constrained")
ax.plot(forces, label=["thumb", "finger 1", "finger 2", "finger 3"])
ax.axvspan(400, 600, color="0.92", label="finger 3 is off")
ax.set(xlabel="time [ms]", ylabel="normal force [N]", xlim=(0, 1000), ylim=(0, 7))
ax.legend(ncols=5, loc="upper center")
plt.show()
