"""One direction: training -> policies -> grasp_env; the solver needs neither simulator, gymnasium nor torch."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOLVER = {"numpy", "scipy", "numba", "grasp_env"}
"""All that `grasp_env.grasp` and `grasp_env.force` may import besides the standard library."""


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
    files = sorted((ROOT / Path(*parts)).rglob("*.py"))
    assert files, f"no sources under {parts}"
    return files


def _roots(path: Path) -> set[str]:
    return {name.split(".")[0] for name in _imports(path)}


@pytest.mark.parametrize(
    ("package", "forbidden"),
    [("grasp_env", {"policies", "training"}), ("policies", {"training"})],
)
def test_packages_never_import_upwards(package: str, forbidden: set[str]) -> None:
    guilty = {str(path.relative_to(ROOT)): _roots(path) & forbidden for path in _files(package)}
    assert {path: roots for path, roots in guilty.items() if roots} == {}


@pytest.mark.parametrize("package", ["grasp", "force"])
def test_the_solver_imports_numpy_scipy_numba_only(package: str) -> None:
    allowed = SOLVER | set(sys.stdlib_module_names)
    inside = (
        "grasp_env.errors",
        "grasp_env._check",
        "grasp_env._compile",
        "grasp_env._views",
        "grasp_env.grasp",
        "grasp_env.force",
    )
    for path in _files("grasp_env", package):
        assert _roots(path) <= allowed, path
        for name in _imports(path):
            assert not name.startswith("grasp_env") or name.startswith(inside), (path, name)
            # geometry knows nothing of forces
            assert package == "force" or not name.startswith("grasp_env.force"), (path, name)


def test_pybullet_is_imported_in_one_file() -> None:
    users = {str(path.relative_to(ROOT)) for part in ("grasp_env", "policies", "training") for path in _files(part)
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
    assert not loaded & {"pybullet", "torch", "stable_baselines3", "matplotlib", "policies", "training"}
