"""
Train a network through the forces
==================================

A network chooses the contacts of four fingertips on objects of random size and friction, for random
tasks. It needs no labels: the loss is the force for the worst load. To learn:
``policies.GraspForceLayer`` as the last layer of a model, and ``infeasible="elastic"``, whose
multipliers give gradients for contacts that cannot hold a load. On held-out objects the network is
compared with the best single grasp and with descent on each object.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import nn

from policies import GraspForceLayer

torch.set_num_threads(1)
torch.manual_seed(0)
layer = GraspForceLayer(infeasible="elastic")
weights = 2 * torch.cat([torch.eye(3), -torch.eye(3)])  # 2 N in six directions


def draw(count):
    """Draw half sides [m] and friction of objects, and tasks: a push of 8 N and its point in half
    sides.
    """
    half = 0.02 + 0.03 * torch.rand(count, 1, 3)
    place = 1.4 * torch.rand(count, 1, 3) - 0.7
    push = 8 * nn.functional.normalize(torch.randn(count, 1, 3), dim=-1)
    return half, 0.3 + 0.5 * torch.rand(count, 1, 1), place, push


def squeeze(u, half, friction, place, push):
    """Return the sum of normal forces for each of six loads [N], and True if held; contacts u as in
    example 14.
    """
    u = u / (u**4).sum(-1, keepdim=True) ** 0.25
    positions = half * u
    normals = nn.functional.normalize(-(u**3) / half, dim=-1)
    loads = torch.cat([push + weights, torch.linalg.cross(half * place, push).expand(-1, 6, 3)], -1)
    result = layer(positions[:, None], normals[:, None], friction.expand(-1, 1, 4), loads)
    # penalty of the missing force
    price = torch.where(result.feasible, 0, result.multipliers[..., :3].norm(dim=-1))
    return (result.force * normals[:, None]).sum((-1, -2)) + price, result.feasible


def train(name, predict, parameters, steps, rate, objects=lambda: draw(64)):
    """Train by Adam without labels, on the forces that the predicted contacts need."""
    optimizer = torch.optim.Adam(parameters, rate)
    lost = 0
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        batch = objects()
        forces, held = squeeze(predict(*batch), *batch)
        lost += int((~held).sum())
        optimizer.zero_grad()
        # a smooth maximum over loads, a geometric mean over objects
        forces.logsumexp(1).log().mean().backward()
        optimizer.step()
        schedule.step()
    print(
        f"{name}: {steps} steps; {lost} of {steps * held.numel()} loads could not be held on the way"
    )


def network(half, friction, place, push):
    """Predict directions of the contacts (objects, 4, 3), relative to the best ones for all
    objects.
    """
    seen = torch.cat([50 * half - 1.75, 5 * friction - 2.75, 2 * place, push / 4], -1)
    return fixed.detach() + 0.3 * hidden(seen).reshape(-1, 4, 3)


fixed = torch.tensor(
    [[1.0, 1, 0.3], [-1, -1, 0.3], [1, -1, -0.3], [-1, 1, -0.3]], requires_grad=True
)
hidden = nn.Sequential(
    nn.Linear(10, 128), nn.SiLU(), nn.Linear(128, 128), nn.SiLU(), nn.Linear(128, 12)
)
train("one grasp for all", lambda *_: fixed.expand(64, 4, 3), [fixed], 200, 0.02)
train("network", network, hidden.parameters(), 600, 0.003)
held_out = draw(500)
with torch.no_grad():
    chosen = {"one grasp for all": fixed.expand(500, 4, 3), "network": network(*held_out)}
each = chosen["descent on each"] = chosen["network"].clone().requires_grad_()
train("descent on each", lambda *_: each, [each], 100, 0.02, lambda: held_out)

fig, (left, right) = plt.subplots(1, 2, figsize=(8, 4.5), layout="constrained")
worst = {}
for name, u in chosen.items():
    forces, held = squeeze(u.detach(), *held_out)
    assert held.all()
    worst[name] = forces.amax(1).numpy()
    median, most = np.percentile(worst[name], [50, 90])
    print(
        f"500 held-out objects, {name}: the worst load takes {median:.1f} N (median), {most:.1f} N (90 %)"
    )
    right.step(np.sort(worst[name]), np.linspace(0, 100, 500), where="post", label=name)
one, learned, own = worst.values()
print(f"the network needs less force than the one grasp on {(learned < one).mean():.0%} of them")
assert np.median(own) < np.median(learned) < 0.8 * np.median(one) and (learned < one).mean() > 0.95

points = left.scatter(one, learned, c=held_out[1].flatten(), s=8)
fig.colorbar(points, ax=left, label="friction")
left.axline((10, 10), slope=1, color="0.4", linewidth=0.8)
left.set(xlabel="worst load, one grasp for all [N]", ylabel="worst load, network [N]")
right.set(
    xlabel="sum of normal forces, worst load [N]", ylabel="held-out objects [%]", ylim=(0, 101)
)
right.legend()
plt.show()
