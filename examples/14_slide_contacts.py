"""
Slide contacts to minimise the force
====================================

Gradient descent moves fingertips over a screwdriver's handle to minimise the force for the worst of
twelve loads. To learn: ``policies.grasp_force`` is a torch function with gradients with respect to
positions and normals. Leading dimensions broadcast, here ``(grasps, 1, 4, 3)`` with ``(12, 6)``, so
all grasps move at once. Each ends in a local minimum, and the exact solver confirms the forces of
the best.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch

from grasp_env.force import optimize_forces
from grasp_env.grasp import Grasp
from policies import grasp_force

torch.set_num_threads(1)
FRICTION = 0.5
HALF = torch.tensor([0.018, 0.018, 0.05])  # half the sides of the handle, a rounded box [m]


def contacts(u):
    """Return points of the surface sum((p / HALF)^4) = 1 in given directions, and the inward unit
    normals there.
    """
    u = u / (u**4).sum(-1, keepdim=True) ** 0.25
    return HALF * u, torch.nn.functional.normalize(-(u**3) / HALF, dim=-1)


# the screw pushes back with 4 N and resists turning either way; 2 N pull at the upper end in one of
# six directions
pulls = 2 * torch.cat([torch.eye(3), -torch.eye(3)]).repeat(2, 1)
loads = torch.cat([pulls, torch.linalg.cross(torch.tensor([[0, 0, 0.03]]), pulls)], 1)
loads += torch.tensor([[0, 0, 4, 0, 0, 0.06], [0, 0, 4, 0, 0, -0.06]]).repeat_interleave(6, 0)

torch.manual_seed(0)
u = torch.randn(64, 4, 3, dtype=torch.float64)
u = u[
    grasp_force(*(a[:, None] for a in contacts(u)), FRICTION, loads).feasible.all(1)
].requires_grad_()
optimizer = torch.optim.Adam([u], lr=0.01)
path = []
worst = []
for _ in range(300):
    positions, normals = (a[:, None] for a in contacts(u))
    force = grasp_force(
        positions, normals, FRICTION, loads, barrier_weight=1e-3, infeasible="raise"
    ).force
    squeeze = (force * normals).sum((-1, -2))  # (grasps, 12): sums of normal forces [N]
    path.append(u.detach().clone())
    worst.append(squeeze.detach().amax(1))
    optimizer.zero_grad()
    # fingertips stay 20 mm apart
    gaps = torch.stack([torch.pdist(tips) for tips in positions[:, 0]])
    # a smooth maximum over the loads
    loss = squeeze.logsumexp(1) + 1000 * (0.02 - gaps).relu().sum(1)
    loss.sum().backward()  # each grasp has its own gradient
    optimizer.step()
worst = torch.stack(worst).numpy()
best = worst[-1].argmin()
before, after = np.median(worst[[0, -1]], axis=1)
print(
    f"{len(u)} of 64 random grasps hold all loads; the worst load takes {before:.1f} N, then {after:.1f} N (median)"
)

fig = plt.figure(figsize=(8, 4.5), layout="constrained")
left = fig.add_subplot(121, projection="3d")
right = fig.add_subplot(122)
a, b = torch.meshgrid(
    torch.linspace(0, 2 * torch.pi, 49), torch.linspace(0, torch.pi, 49), indexing="ij"
)
surface = contacts(torch.stack([a.cos() * b.sin(), a.sin() * b.sin(), b.cos()], -1))[0]
left.plot_surface(*1e3 * surface.movedim(-1, 0).numpy(), color="0.8", alpha=0.25)
positions, normals = (a.numpy() for a in contacts(torch.stack(path)[:, best]))
for finger in 1e3 * positions.swapaxes(0, 1):
    left.plot(*finger.T, color="0.3", linewidth=1)
for step, color, name in ((0, "tab:orange", "before"), (-1, "tab:blue", "after")):
    batch = optimize_forces(
        Grasp.from_contacts(positions[step], normals[step], FRICTION), loads.numpy(), method="conic"
    )
    exact = batch.force[:, :, 0].sum(axis=1).max()
    print(
        f"the grasp that ends best, {name}: {worst[step, best]:.2f} N; {exact:.2f} N by the exact solver"
    )
    np.testing.assert_allclose(worst[step, best], exact, rtol=0.03)
    back = 1e3 * (positions[step] - 0.014 * normals[step])
    left.quiver(*back.T, *14 * normals[step].T, color=color, linewidth=1.2)
    left.scatter(*1e3 * positions[step].T, color=color, s=30, depthshade=False, label=name)
assert (worst[-1] < worst[0]).all() and after < 0.5 * before and gaps.min() > 0.019
left.set_box_aspect(np.ptp([left.get_xlim(), left.get_ylim(), left.get_zlim()], axis=1), zoom=1.3)
left.view_init(elev=25, azim=-120)
left.set_axis_off()
left.legend(loc="upper left")
right.semilogy(worst, color="0.8", linewidth=0.8)
right.semilogy(worst[:, best], color="tab:blue", label="the grasp on the left")
right.set(xlabel="step", ylabel="least sum of normal forces, worst load [N]")
right.set_yticks([10, 20, 50, 100, 200], ["10", "20", "50", "100", "200"])
right.legend()
plt.show()
