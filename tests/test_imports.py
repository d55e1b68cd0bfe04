"""One direction: benchmarks -> training -> policies -> grasp_env; the solver needs neither
simulator, gymnasium nor torch."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from docs.rooms import DOORS, PICTURE, ROOT, files, imports, module_arrows, picture

SOLVER = {"numpy", "scipy", "grasp_env"}
"""All that `grasp_env.grasp`, `grasp_env.force` and `grasp_env.quality` may import besides the
standard library."""


def _roots(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imports(path)}


ABOVE = {
    "grasp_env": {"policies", "training", "benchmarks", "torch", "stable_baselines3", "matplotlib"},
    "policies": {"training", "benchmarks"},
    "training": {"benchmarks"},
}


@pytest.mark.parametrize("package", ABOVE)
def test_packages_never_import_upwards(package):
    guilty = {str(path.relative_to(ROOT)): _roots(path) & ABOVE[package] for path in files(package)}
    assert {path: roots for path, roots in guilty.items() if roots} == {}


@pytest.mark.parametrize("package", ["core", "grasp", "force", "quality"])
def test_the_solver_imports_numpy_and_scipy_only(package):
    for path in files("grasp_env", package):
        assert _roots(path) <= SOLVER | set(sys.stdlib_module_names), path


ROOMS: dict[str, dict[str, set[str]]] = {
    "grasp_env": {
        "errors": set(),
        "core": set(),
        "inputs": {"errors", "core"},
        "grasp": {"errors", "core", "inputs"},
        "force": {"errors", "core", "inputs", "grasp"},
        "quality": {"errors", "core", "inputs", "grasp", "force"},
        "settings": {"errors", "inputs"},
        "sim": {"errors", "core", "inputs", "settings", "grasp"},
        "task": {"errors", "inputs", "settings", "grasp"},
        "config": {"errors", "inputs", "settings", "force", "sim", "task"},
        "_spec": {"config"},
        "control": {
            "errors",
            "core",
            "inputs",
            "settings",
            "grasp",
            "force",
            "sim",
            "task",
            "config",
        },
        "env": {
            "_spec",
            "errors",
            "core",
            "inputs",
            "grasp",
            "force",
            "sim",
            "task",
            "config",
            "control",
        },
    },
    "training": {
        "data": set(),
        "evaluation": {"data"},
        "fit": {"data", "evaluation"},
        "rl": {"data", "evaluation"},
        "program": {"data", "evaluation", "fit", "rl"},
    },
}
"""Rooms of a package, the lowest first, and the rooms that each may import."""


@pytest.mark.parametrize("package", ROOMS)
def test_rooms_look_one_way(package):
    rooms = ROOMS[package]
    order = list(rooms)
    for room, below in rooms.items():
        assert {order.index(other) < order.index(room) for other in below} <= {True}, room
    found = {room: set[str]() for room in rooms}
    for name, targets in module_arrows(package).items():
        room = name.split(".")[1] if name.count(".") else ""
        if room in DOORS:
            continue
        assert room in rooms, f"{name} lies in no room"
        found[room] |= {target.split(".")[1] for target in targets if target.count(".")} - {room}
    assert {
        room: others - rooms[room] for room, others in found.items() if others - rooms[room]
    } == {}
    assert found == rooms, "an arrow that nothing needs any more"


@pytest.mark.parametrize("package", ["grasp_env", "policies", "training", "benchmarks"])
def test_no_modules_import_each_other_in_a_circle(package):
    left = module_arrows(package)
    while free := [name for name, targets in left.items() if not targets & set(left)]:
        for name in free:
            del left[name]
    assert left == {}


def test_pybullet_is_imported_in_one_file():
    users = {
        str(path.relative_to(ROOT))
        for part in ("grasp_env", "policies", "training", "benchmarks")
        for path in files(part)
        if _roots(path) & {"pybullet", "pybullet_data", "pybullet_utils"}
    }
    assert users == {str(Path("grasp_env", "sim", "client.py"))}


def _run(script: str) -> None:
    """Run a script in a fresh interpreter; warnings are errors."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        cwd=ROOT,
        timeout=120,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "imports",
    ["grasp_env, gymnasium", "gymnasium, grasp_env", "gymnasium.envs.registration, grasp_env"],
)
def test_the_environment_is_registered_whatever_is_imported_first(imports):
    _run(f"""
import sys, {imports}, gymnasium
assert gymnasium.spec("FourFingerGrasp-v0").entry_point == "grasp_env.env:FourFingerGrasp"
assert not [finder for finder in sys.meta_path if type(finder).__module__ == "grasp_env"]
""")


def test_hard_contacts_and_learned_starts_need_numpy_only():
    """A control loop waits for nothing else before its first force: other packages cannot be
    imported here."""
    _run("""
import sys
for name in ("scipy", "torch", "gymnasium", "pybullet", "matplotlib"):
    sys.modules[name] = None
import numpy as np
import grasp_env.force as force
from grasp_env.grasp import presets
from policies import LearnedInitialForce
grasp, wrench = presets.paper_cuboid(), np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])
for method in ("reduced_flow", "full_flow", "newton", "conic"):
    optimizer = force.ForceOptimizer(grasp, method=method)
    for k in range(2):
        assert optimizer.solve(wrench).status is force.Status.OPTIMAL
    assert optimizer.solve(0.1 * wrench, positions=grasp.positions + 1e-3).status is force.Status.OPTIMAL
    assert optimizer.solve(0.1 * wrench, contacts=[True, True, True, False]).status is force.Status.OPTIMAL
    assert force.optimize_forces(grasp, np.tile(wrench, (3, 1)), method=method).optimal.all()
rule = LearnedInitialForce.pretrained(remembers=True)
rule(grasp, wrench), rule.raw(grasp, wrench), rule.covers(grasp, wrench)
for initial in ("previous", "linear_combination", "single_value", "lagrange", rule):
    assert force.optimize_force(grasp, wrench, initial=initial).status is force.Status.OPTIMAL
force.Repair()(grasp, wrench, np.ones((4, 3)))
assert "training" not in sys.modules
""")


def test_an_episode_starts_without_torch_and_other_heavy_packages():
    _run("""
import sys
import gymnasium
env = gymnasium.make("grasp_env:FourFingerGrasp-v0")
env.reset(seed=0)
env.step(env.action_space.sample())
env.close()
assert not {name.split(".")[0] for name in sys.modules} & {"scipy", "torch", "trimesh", "matplotlib"}
""")


def test_the_picture_of_the_rooms_is_that_of_the_code():
    assert PICTURE.read_text(encoding="utf-8") == picture(), "run python -m docs.rooms"
