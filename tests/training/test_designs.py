"""Every design keeps balance and cones; the closed form inverts the gradient; the comparison of designs in small."""

from __future__ import annotations

import json

import numpy as np
import torch

from policies.newton_layers import phi
from training.any_dataset import make_pool
from training.cli import main
from training.cones import least_forces
from training.designs import Multipliers, Plain, Unrolled


def test_designs_side_by_side(tmp_path, capsys):
    small = ["--steps", "2", "--samples", "300", "--grasps", "12", "--held-out", "80", "--batch-size", "32"]
    assert main(["fit", "designs", *small, "--out", str(tmp_path / "designs")]) == 0
    told = capsys.readouterr().out
    report = json.loads((tmp_path / "designs" / "designs.json").read_text())
    assert list(report["designs"]) == ["plain", "unrolled", "multipliers", "newton_layers"]
    for design in report["designs"].values():
        assert design["what"] in told
        assert np.isfinite(design["gaps"]).all()
    assert (tmp_path / "designs" / "designs.md").read_text().strip() in told.strip()


def test_every_design_keeps_balance_and_cones():
    pool = make_pool(np.random.default_rng(1), 10, 60, (4,))
    problems, start = pool.problems(torch.arange(len(pool))), pool.starts["basis"]
    for build in (Plain, Unrolled, Multipliers):
        torch.manual_seed(0)
        for force in build()(problems, start):
            missing = torch.einsum("brnk,bnk->br", problems.rows, force - start)
            assert missing.abs().max() < 1e-9 * start.abs().max()
            assert torch.isfinite(phi(problems, force)).all()


def test_least_forces_invert_the_gradient():
    pool = make_pool(np.random.default_rng(2), 10, 60)
    problems, x = pool.problems(torch.arange(len(pool))), pool.starts["basis"]
    x = x.clone().requires_grad_()
    gradient = torch.autograd.grad(phi(problems, x).sum(), x)[0]
    free = torch.zeros_like(gradient)
    free[..., 0] = 3.0
    again = least_forces(free - gradient, problems.mask)
    torch.testing.assert_close(again, x.detach(), rtol=1e-6, atol=1e-6)
