"""`grasp fit designs`: the designs of a start for any grasp, trained on the same data for the same time, side by side."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env._extras import need

with need("train"):
    import torch
    from torch import nn

from policies.newton_layers import NewtonLayers
from training.any_dataset import Pool, make_pool
from training.designs import Multipliers, Plain, Unrolled
from training.fit_any import HELD_OUT_SEED, PERCENTILES, StartsTask, layer_gaps
from training.fit_loop import Plan, optimise
from training.runs import Run, provenance, understood
from training.settings import AnyFitConfig
from training.soap import Soap

CONTACTS = 4
DESIGNS: dict[str, tuple[str, Callable[[AnyFitConfig], nn.Module]]] = {
    "plain": ("plain network on (x_p, Pi) to internal forces", lambda config: Plain(CONTACTS, 256)),
    "unrolled": ("unrolled layers, Euclidean projection", lambda config: Unrolled(config.layers, config.width)),
    "multipliers": (
        "6 multipliers as Pi c, closed-form forces, projection in the Hessian",
        lambda config: Multipliers(64),
    ),
    "newton_layers": ("learned Newton layers (chosen)", lambda config: NewtonLayers(config.layers, config.width)),
}


def compare(config: AnyFitConfig, out: Path, progress: bool = False) -> dict[str, Any]:
    """Trains every design and writes designs.json and designs.md; a design that is already there is not trained again.

    Args:
        config: of data and training; four contacts only, since the plain network knows one number.
        out: folder.
        progress: tell the progress on stderr.

    Raises:
        InvalidInputError: the folder cannot be written, or was begun with other settings.
    """
    config = config.resolved()
    if config.quick:
        config = replace(config, seconds=min(config.seconds, 6.0))
    torch.set_num_threads(1)
    run = Run.create(out.parent, out.name)
    made = provenance()
    kept: dict[str, Any] = {}
    if (out / "designs.json").is_file():
        with understood(out, "choose another --out"):
            kept = run.read_json("designs.json")
            kept = dict(kept["designs"]) if kept["config"] == asdict(config) else {}
    train = make_pool(np.random.default_rng([config.seed, 0]), config.grasps, config.samples, (CONTACTS,))
    held_out = make_pool(np.random.default_rng([HELD_OUT_SEED, 1]), config.held_out // 4, config.held_out, (CONTACTS,))
    steps = layer_gaps(None, held_out, "basis", 8)
    report: dict[str, Any] = {
        "kind": "designs",
        "quick": config.quick,
        "config": asdict(config),
        "percentiles": PERCENTILES,
        "held_out": f"{len(held_out)} wrenches on {config.held_out // 4} random grasps of {CONTACTS} contacts",
        "machine": made["machine"],
        "versions": made["versions"],
        "basis": _start(held_out),
        "plain Newton steps": steps,
        "designs": kept,
    }
    for name, (words, build) in DESIGNS.items():
        if name not in kept:
            torch.manual_seed(config.seed)
            module = build(config)
            task = StartsTask(module, config, train, held_out, from_basis=1.0)
            told = f"fit designs: {name}" if progress else ""
            plan = Plan(config.seconds, config.steps, config.learning_rate, Soap, config.seed, words=told, cpu=True)
            now = optimise(task, plan)
            kept[name] = {
                "what": words,
                "gaps": layer_gaps(module, held_out, "basis"),
                "parameters": sum(p.numel() for p in module.parameters()),
                "microseconds": _microseconds(module, held_out),
                "steps": now.step,
                "seconds": round(now.seconds, 1),
                "cpu_seconds": round(now.cpu_seconds, 1),
                "curve": [[float(f"{value:.3g}") for value in row] for row in now.curve],
            }
        run.write_json("designs.json", report)
        run.write_text("designs.md", table(report))
    return report


def table(report: dict[str, Any]) -> str:
    """The report as markdown."""
    lines = [
        f"# Designs of a start for any grasp{' (quick: rough numbers)' if report['quick'] else ''}",
        "",
        f"Gap of Phi on {report['held_out']}, from the 12-basis; the same data, loss and time for each. Microseconds are torch's in "
        "batches of 1000, per start: they compare the designs with each other, the compiled layers are much faster.",
        "",
        "| design | layers | median | p90 | p99 | parameters | us | steps | CPU s |",
        "|---|---|---|---|---|---|---|---|---|",
        f"| start: 12-basis | 0 | {_gaps(report['basis'])} | | | | |",
    ]
    for design in report["designs"].values():
        lines.append(
            f"| {design['what']} | {len(design['gaps'])} | {_gaps(design['gaps'][-1])} | {design['parameters']} | "
            f"{design['microseconds']:.0f} | {design['steps']} | {design['cpu_seconds']:.0f} |"
        )
    for count in (1, 2, 4, 8):
        lines.append(
            f"| control: plain Newton steps | {count} | {_gaps(report['plain Newton steps'][count - 1])} | | | | |"
        )
    return "\n".join(lines) + "\n"


def _gaps(row: list[float]) -> str:
    return " | ".join(f"{value:.1e}" for value in row)


@torch.no_grad()
def _start(pool: Pool) -> list[float]:
    class Nothing(nn.Module):
        def forward(self, problems: object, start: torch.Tensor) -> list[torch.Tensor]:
            return [start]

    return layer_gaps(Nothing(), pool, "basis")[0]


@torch.no_grad()
def _microseconds(module: nn.Module, pool: Pool, repeats: int = 3) -> float:
    """Least time of a batch of 1000 per start, processor time of one core."""
    samples = torch.arange(min(1000, len(pool)))
    problems, start = pool.problems(samples), pool.starts["basis"][samples]
    spent = []
    for _ in range(repeats):
        begun = time.process_time()
        module(problems, start)
        spent.append(time.process_time() - begun)
    return 1e6 * min(spent) / len(samples)
