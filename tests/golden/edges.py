"""Sizes of wrenches and weights, solves that end early or in a proof, limits."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from golden.case import BASIS, FLOWS, Case, loads, named, solve
from golden.grasps import FLOOR, GRASPS, LIGHT, NONE, PAPER, wrenches

from grasp_env.force import ForceLimits
from grasp_env.grasp import Grasp

WANTED = np.array([PAPER, NONE, LIGHT, *wrenches(1, 3)])


def _sizes() -> list[Case]:
    """Wrenches from nothing to too large, weights of every size and unequal ones."""
    factors = (0.0, 1e-300, 1e-30, 1e-9, 1e-3, 1e3, 1e6, 1e9)
    wanted = np.array([factor * PAPER for factor in factors])
    out: list[Case] = []
    for name, method in product(("cuboid", "3 uneven", "millimetres"), ("reduced_flow", "newton", "conic")):
        # huge wrenches take the flow thousands of steps, or it stalls where rounding says so
        some = loads(name, wanted[:6] if method == "reduced_flow" else wanted)
        options = {"method": method, "max_iterations": 2000}
        out.append(Case(f"{method}, {name}, sizes", lambda g=GRASPS[name], w=some, o=options: solve(g, w, **o)))
    for method in ("newton", "conic"):
        out.append(Case(f"{method}, soft, sizes", lambda m=method: solve(GRASPS["soft"], wanted[:6], method=m)))
    weights: dict[str, dict[str, Any]] = {
        "unequal": {"force_weight": (1.0, 2.0, 0.5, 3.0), "barrier_weight": (0.01, 0.1, 0.002, 1.0)},
        "unequal, omega": {"force_weight": np.array([0.2, 5.0, 1.0, 1.0])},
        **{f"barrier {value:g}": {"barrier_weight": value} for value in (1e-11, 1e-6, 1e-5, 1.0, 1e4)},
        **{f"force {value:g}": {"force_weight": value} for value in (1e-3, 1e3)},
    }
    some = np.array([PAPER, NONE, LIGHT])
    for (label, options), method in product(weights.items(), ("newton", "reduced_flow")):
        for name in ("cuboid", "4 uneven"):
            every = {**options, "method": method, "max_iterations": 3000}
            out.append(Case(f"{method}, {label}, {name}", lambda g=GRASPS[name], o=every: solve(g, some, **o), start=BASIS))  # fmt: skip
            if method == "newton":
                every = {**every, "tolerance": 1e-12}
                out.append(Case(f"newton, {label}, {name}, tight", lambda g=GRASPS[name], o=every: solve(g, some, **o), tight=True))  # fmt: skip
    return out


def _ends() -> list[Case]:
    """Solves that end otherwise: known optimum, trace, too few iterations, a tolerance out of reach, no balance."""
    out: list[Case] = []
    best = {"cuboid": 12.253093871456, "5 uneven": None}["cuboid"]
    for method in (*FLOWS, "newton"):
        out.append(Case(f"{method}, known optimum", lambda m=method: solve(
            GRASPS["cuboid"], PAPER[None], {"optimum": best}, method=m, tolerance=1e-6), start=BASIS))  # fmt: skip
        out.append(Case(f"{method}, trace", lambda m=method: solve(
            GRASPS["cuboid"], np.array([PAPER, NONE]), {"trace": True}, method=m, tolerance=1e-8), start=BASIS))  # fmt: skip
        for most in (0, 1, 3):
            out.append(Case(f"{method}, {most} iterations", lambda m=method, k=most: solve(
                GRASPS["cuboid"], WANTED, {"trace": True}, method=m, max_iterations=k, tolerance=1e-9), start=BASIS))  # fmt: skip
    for criterion, most in product(("sum", "max"), (0, 2)):
        out.append(Case(f"conic {criterion}, {most} iterations", lambda c=criterion, k=most: solve(
            GRASPS["cuboid"], WANTED, method="conic", criterion=c, max_iterations=k)))  # fmt: skip
    lift = np.array([[0, 0, 2.0, 0, 0, 0], [0, 0, 0, 0, 0, 0.5], [0, 0, -2.0, 0, 0, 0], [1.0, 0, -1.0, 0, 0, 0], [0, 0, -3.0, 0.01, 0.02, 0.001], [0, 0, 0.0, 0, 0, 0]])  # fmt: skip
    for method, criterion in (
        ("reduced_flow", "sum"),
        ("newton", "sum"),
        ("conic", "sum"),
        ("conic", "max"),
    ):
        for initial in (None, "phase_one") if method in ("reduced_flow", "newton") else (None,):
            options = {"method": method, "criterion": criterion, "initial": initial}
            out.append(Case(f"{method} {criterion} on a floor, {initial}", lambda o=options: solve(FLOOR, lift, **o)))
    return out


def limits_of(grasp: Grasp, torque: float) -> ForceLimits:
    """Three joints per finger with levers of up to 0.1 m, their limit `torque` [N m], and some weight of the hand."""
    count = grasp.n_contacts
    rng = np.random.default_rng(count)
    jacobian = np.zeros((count, 3, 3 * count))
    for k in range(count):
        jacobian[k, :, 3 * k : 3 * k + 3] = rng.uniform(-0.1, 0.1, (3, 3))
    jacobian = grasp.frames @ jacobian  # drawn, and recorded, in contact frames
    return ForceLimits(jacobian=jacobian, torque_limit=torque, torque_bias=0.02 * rng.standard_normal(3 * count))


def _limits() -> list[Case]:
    """Normal forces and joint torques: loose, binding, impossible."""
    out: list[Case] = []
    wanted = np.array([PAPER, NONE, LIGHT, *wrenches(3, 2, 1.0)])
    for name in ("cuboid", "4 uneven", "5 uneven", "8 random", "soft", "elliptic"):
        count = GRASPS[name].n_contacts
        kinds = {
            "max_normal 5": ForceLimits(max_normal=5.0),
            "max_normal 1": ForceLimits(max_normal=1.0),
            "min_normal": ForceLimits(min_normal=0.3),
            "normal, each": ForceLimits(min_normal=np.linspace(0.0, 0.5, count), max_normal=np.linspace(5.0, 8.0, count)),
            "torque 0.5": limits_of(GRASPS[name], 0.5),
            "torque 0.3": limits_of(GRASPS[name], 0.3),
            "torque 0.05": limits_of(GRASPS[name], 0.05),
        }  # fmt: skip
        for (label, limits), (method, criterion) in product(kinds.items(), (("newton", "sum"), ("conic", "sum"), ("conic", "max"))):  # fmt: skip
            options = {"method": method, "criterion": criterion, "limits": limits}
            text = f"{method} {criterion}, {label}, {name}"
            out.append(Case(text, lambda g=GRASPS[name], o=options: solve(g, wanted, **o)))
            if method == "newton":
                every = {**options, "tolerance": 1e-10}
                out.append(Case(f"{text}, tight", lambda g=GRASPS[name], o=every: solve(g, wanted, **o), tight=True))
    return out


def cases() -> dict[str, Case]:
    """All of them."""
    return named(_sizes(), _ends(), _limits())
