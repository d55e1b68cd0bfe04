"""One direction: benchmarks -> training -> policies -> grasp_env; the solver needs neither simulator, gymnasium nor torch."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOLVER = {"numpy", "scipy", "grasp_env"}
"""All that `grasp_env.grasp`, `grasp_env.force` and `grasp_env.quality` may import besides the standard library."""


def _imports(path: Path) -> set[str]:
    """Absolute names of the modules a file imports, anywhere in it, type checking included."""
    names: set[str] = set()
    package = path.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join([*package[: len(package) + 1 - node.level], *([node.module] if node.module else [])])
            start = base if node.level else str(node.module)
            names.update(f"{start}.{alias.name}" for alias in node.names)
            names.add(start)
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in (
            "import_module",
            "__import__",
        ):
            names.update(str(argument.value) for argument in node.args if isinstance(argument, ast.Constant))
    return names


def _files(*parts: str) -> list[Path]:
    """Of a package."""
    files = sorted((ROOT / Path(*parts)).rglob("*.py"))
    assert files, f"no sources under {parts}"
    return files


def _roots(path: Path) -> set[str]:
    return {name.split(".")[0] for name in _imports(path)}


@pytest.mark.parametrize(
    ("package", "forbidden"),
    [
        ("grasp_env", {"policies", "training", "benchmarks"}),
        ("policies", {"training", "benchmarks"}),
        ("training", {"benchmarks"}),
    ],
)
def test_packages_never_import_upwards(package: str, forbidden: set[str]) -> None:
    guilty = {str(path.relative_to(ROOT)): _roots(path) & forbidden for path in _files(package)}
    assert {path: roots for path, roots in guilty.items() if roots} == {}


@pytest.mark.parametrize("package", ["grasp", "force", "quality"])
def test_the_solver_imports_numpy_and_scipy_only(package: str) -> None:
    allowed = SOLVER | set(sys.stdlib_module_names)
    inside = (
        "grasp_env.core",
        "grasp_env.errors",
        "grasp_env._check",
        "grasp_env._files",
        "grasp_env.ranges",
        "grasp_env.grasp",
        "grasp_env.force",
        "grasp_env.quality",
    )
    for path in _files("grasp_env", package):
        assert _roots(path) <= allowed, path
        for name in _imports(path):
            # `from grasp_env import core` also names the package itself
            assert not name.startswith("grasp_env.") or name.startswith(inside), (path, name)
            # geometry knows nothing of forces, forces nothing of how good a grasp is
            above = {"grasp": ("grasp_env.force", "grasp_env.quality"), "force": "grasp_env.quality", "quality": ()}
            assert not name.startswith(above[package]), (path, name)


def test_the_core_is_below_everything_else() -> None:
    """Its door imports the compiled module and nothing else; geometry imports the door, so that nothing else loads for it."""
    for path in _files("grasp_env", "core"):
        assert {name for name in _roots(path) if name not in sys.stdlib_module_names} <= {"grasp_env", "numpy"}, path
        assert all(name.startswith("grasp_env.core") for name in _imports(path) if name.startswith("grasp_env")), path
    for path in _files("grasp_env", "grasp"):
        assert _roots(path) <= SOLVER | set(sys.stdlib_module_names), path


ROOMS: dict[str, dict[str, set[str]]] = {
    "grasp_env": {
        "errors": set(),
        "ranges": set(),
        "core": set(),
        "_extras": {"errors"},
        "_check": {"errors", "ranges", "core"},
        "_files": {"errors", "_check"},
        "grasp": {"errors", "ranges", "core", "_check", "_files"},
        "force": {"errors", "ranges", "core", "_check", "grasp"},
        "quality": {"errors", "ranges", "core", "_check", "grasp", "force"},
        "settings": {"errors", "ranges", "_check"},
        "sim": {"errors", "ranges", "core", "_extras", "_check", "_files", "settings", "grasp"},
        "task": {"errors", "ranges", "_check", "settings", "grasp"},
        "config": {"errors", "ranges", "_check", "settings", "force", "sim", "task"},
        "control": {"errors", "core", "_check", "grasp", "force", "sim", "task", "config"},
        "env": {"errors", "core", "_extras", "_check", "grasp", "force", "sim", "task", "config", "control"},
    },
    "training": {
        "results": set(),
        "live": set(),
        "data": set(),
        "demo": {"results", "data"},
        "compare": {"results", "data"},
        "fit": {"results", "data", "compare"},
        "report": {"results", "compare"},
        "rl": {"results", "data"},
        "pyramids": set(),
        "reproduce": {"results", "pyramids"},
        "commands": {"results", "demo", "fit", "compare", "report", "rl", "reproduce", "live"},
    },
}
"""The rooms of a package, the lowest first, and those that each may look into."""
DOORS = ("", "__main__", "cli")
"""What is in no room: the package itself, its program."""


def _modules(package: str) -> dict[str, Path]:
    """The files of a package by their names as modules."""
    found = {path.relative_to(ROOT).with_suffix("").parts: path for path in _files(package)}
    return {".".join(parts[:-1] if parts[-1] == "__init__" else parts): path for parts, path in found.items()}


def _arrows(package: str) -> dict[str, set[str]]:
    """Which modules of a package each of its modules imports, in functions too; `from room import module` means the module."""
    modules = _modules(package)
    out = {}
    for name, path in modules.items():
        asked = _imports(path) & set(modules)
        deeper = {one for one in asked if any(other.startswith(f"{one}.") for other in asked)}
        direct = {str(node.module) for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.ImportFrom)
                  and any(f"{node.module}.{alias.name}" not in modules for alias in node.names)}  # fmt: skip
        out[name] = asked - (deeper - direct) - {name}
    return out


@pytest.mark.parametrize("package", ROOMS)
def test_rooms_look_one_way(package: str) -> None:
    rooms = ROOMS[package]
    order = list(rooms)
    for room, below in rooms.items():
        assert {order.index(other) < order.index(room) for other in below} <= {True}, room
    found = {room: set[str]() for room in rooms}
    for name, targets in _arrows(package).items():
        room = name.split(".")[1] if name.count(".") else ""
        if room in DOORS:
            continue
        assert room in rooms, f"{name} lies in no room"
        found[room] |= {target.split(".")[1] for target in targets if target.count(".")} - {room}
    assert {room: others - rooms[room] for room, others in found.items() if others - rooms[room]} == {}
    assert found == rooms, "an arrow that nothing needs any more"


@pytest.mark.parametrize("package", ["grasp_env", "policies", "training", "benchmarks"])
def test_no_modules_import_each_other_in_a_circle(package: str) -> None:
    left = _arrows(package)
    while free := [name for name, targets in left.items() if not targets & set(left)]:
        for name in free:
            del left[name]
    assert left == {}


def test_tables_and_claims_are_read_without_solver_and_simulator() -> None:
    script = """
import sys
for name in ("torch", "gymnasium", "pybullet", "safetensors", "ray"):
    sys.modules[name] = None
import training.results.table, training.results.claims
print(*sorted(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, timeout=120, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not {
        name
        for name in done.stdout.split()
        if name.startswith(("grasp_env.force", "grasp_env.grasp", "grasp_env.sim", "policies"))
    }


def test_pybullet_is_imported_in_one_file() -> None:
    users = {str(path.relative_to(ROOT)) for part in ("grasp_env", "policies", "training", "benchmarks") for path in _files(part)
             if _roots(path) & {"pybullet", "pybullet_data", "pybullet_utils"}}  # fmt: skip
    assert users == {str(Path("grasp_env", "sim", "client.py"))}


def test_torch_appears_in_policies_first() -> None:
    for path in _files("grasp_env"):
        assert not _roots(path) & {"torch", "stable_baselines3", "matplotlib"}, path


@pytest.mark.parametrize("module", ["grasp_env.force", "grasp_env.grasp"])
def test_the_solver_loads_without_the_rest(module: str) -> None:
    """In a fresh interpreter; gymnasium only registers, if it is there at all, and is made unimportable here."""
    script = f"""
import sys
for name in ("pybullet", "gymnasium", "torch"):
    sys.modules[name] = None
import {module}
from grasp_env.grasp import presets
assert presets.paper_cuboid().n_contacts == 4
"""
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT, timeout=120)


@pytest.mark.parametrize("module", ["grasp_env", "grasp_env.force", "grasp_env.grasp"])
def test_the_solver_pulls_in_no_simulator_and_no_network(module: str) -> None:
    script = f"import sys, {module}; print(*sorted(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", script], check=True, cwd=ROOT, timeout=120, capture_output=True, text=True
    )
    loaded = {name.split(".")[0] for name in done.stdout.split()}
    assert not loaded & {"gymnasium", "pybullet", "torch", "stable_baselines3", "matplotlib", "policies", "training"}


@pytest.mark.parametrize(
    "imports",
    ["grasp_env, gymnasium", "gymnasium, grasp_env", "grasp_env.force, gymnasium", "grasp_env.env", "gymnasium.envs.registration, grasp_env"],
)  # fmt: skip
def test_the_environment_is_registered_whatever_is_imported_first(imports: str) -> None:
    script = f"""
import sys, {imports}, gymnasium
assert gymnasium.spec("FourFingerGrasp-v0").entry_point == "grasp_env.env:FourFingerGrasp"
assert not [finder for finder in sys.meta_path if type(finder).__module__ == "grasp_env"]
"""
    subprocess.run([sys.executable, "-W", "error", "-c", script], check=True, cwd=ROOT, timeout=120)


HARD = """
import sys
import numpy as np
import grasp_env.force as force
from grasp_env.grasp import presets

def loaded():
    return sorted({name.split(".")[0] for name in sys.modules} & {"scipy", "torch"})

grasp, wrench = presets.paper_cuboid(), np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])
assert not loaded(), ("import", loaded())
for method in ("reduced_flow", "full_flow", "newton", "conic"):
    optimizer = force.ForceOptimizer(grasp, method=method)
    for k in range(2):
        assert optimizer.solve(wrench).status is force.Status.OPTIMAL
    assert optimizer.solve(0.1 * wrench, positions=grasp.positions + 1e-3).status is force.Status.OPTIMAL
    optimizer.update(friction=0.5)
    assert optimizer.solve(0.1 * wrench, contacts=[True, True, True, False]).status is force.Status.OPTIMAL
    assert force.optimize_forces(grasp, np.tile(wrench, (3, 1)), method=method).optimal.all()
    assert not loaded(), (method, loaded())
for initial in ("previous", "linear_combination", "single_value", "lagrange", None):
    for method in ("reduced_flow", "full_flow", "newton"):
        force.optimize_force(grasp, wrench, method=method, initial=initial)
        assert not loaded(), (initial, loaded())
force.Repair()(grasp, wrench, np.ones((4, 3)))
assert not loaded(), ("repair", loaded())
"""


LEARNED = """
import sys
import numpy as np
import grasp_env.force as force
import policies
from grasp_env.grasp import presets

def loaded():
    return sorted({name.split(".")[0] for name in sys.modules} & {"scipy", "torch"})

grasp, wrench = presets.paper_cuboid(), np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])
assert not loaded(), ("import", loaded())
rule = policies.LearnedInitialForce.pretrained(remembers=True)
rule(grasp, wrench), rule.raw(grasp, wrench), rule.covers(grasp, wrench)
optimizer = force.ForceOptimizer(grasp, method="newton", initial=rule)
for k in range(2):
    assert optimizer.solve(wrench).status is force.Status.OPTIMAL
assert not loaded(), ("learned", loaded())
"""


def test_learned_starts_need_neither_scipy_nor_torch() -> None:
    done = subprocess.run([sys.executable, "-c", LEARNED], cwd=ROOT, timeout=120, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_hard_contacts_need_neither_scipy_nor_torch() -> None:
    """In a fresh process: what a control loop waits for before its first force."""
    done = subprocess.run([sys.executable, "-c", HARD], cwd=ROOT, timeout=120, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_hard_contacts_are_solved_where_they_cannot_be_imported() -> None:
    script = "import sys\nfor name in ('scipy', 'torch', 'gymnasium'):\n    sys.modules[name] = None\n"
    asked = """
import numpy as np
from grasp_env.force import optimize_force
from grasp_env.grasp import presets
for method in ("reduced_flow", "full_flow", "newton", "conic"):
    optimize_force(presets.paper_cuboid(), np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0]), method=method)
"""
    done = subprocess.run([sys.executable, "-c", script + asked], cwd=ROOT, timeout=120, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


EPISODE = """
import sys
import gymnasium
env = gymnasium.make("grasp_env:FourFingerGrasp-v0")
env.reset(seed=0)
env.step(env.action_space.sample())
env.close()
assert not {name.split(".")[0] for name in sys.modules} & {"scipy", "torch", "trimesh", "matplotlib"}
"""


def test_an_episode_starts_without_torch_and_other_heavy_packages() -> None:
    """In a fresh process: what a user waits for before the first step."""
    done = subprocess.run([sys.executable, "-c", EPISODE], cwd=ROOT, timeout=120, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
