"""The core is built as it says, from where the tests think it is, and its door needs little."""

from __future__ import annotations

import ast
import ctypes
import os
import platform
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import _core_test
import pytest

import grasp_env
from grasp_env import core
from grasp_env.core import _builds, _core

ROOT = Path(__file__).parents[2]
FLAGS = core.build_info()["flags"].split()
SANITIZED = any(flag.startswith("-fsanitize") for flag in FLAGS)


def _python(script: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", script], cwd=ROOT, timeout=120, capture_output=True, text=True)


def test_build_info() -> None:
    info = core.build_info()
    assert info["version"] == _core_test.version == grasp_env.__version__
    assert info["compiler"].startswith(("GNU ", "Clang ", "AppleClang "))
    assert info["instruction_set"]
    assert info["build_type"] in ("Release", "RelWithDebInfo", "Debug")
    assert ("-O3" in FLAGS) == (info["build_type"] != "Debug")


def test_flags_keep_nan() -> None:
    assert {"-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math"} <= set(FLAGS)
    assert not {"-ffast-math", "-Ofast", "-ffinite-math-only"} & set(FLAGS)


def test_the_build_asked_for_is_loaded() -> None:
    other = os.environ.get("GRASP_CORE_BUILD")
    homes = [ROOT / other, ROOT / other] if other else [ROOT / "grasp_env/core", ROOT / "tests/core"]
    assert [Path(str(module.__file__)).parent for module in (_core, _core_test)] == homes
    assert (other is not None and other.endswith("sanitize")) == SANITIZED


@pytest.mark.parametrize(
    ("right", "wrong", "verdict"),
    [
        ("read(4, 3)", "read(4, 4)", "AddressSanitizer: heap-buffer-overflow"),
        ("successor(1)", "successor(2**31 - 1)", "runtime error: signed integer overflow"),
    ],
)
def test_the_sanitizers_watch(right: str, wrong: str, verdict: str) -> None:
    assert hasattr(_core_test, right.partition("(")[0]) == SANITIZED
    if SANITIZED:
        module = f"import sys; sys.path.insert(0, {str(Path(str(_core_test.__file__)).parent)!r}); import _core_test"
        assert _python(f"{module}; _core_test.{right}").returncode == 0
        done = _python(f"{module}; _core_test.{wrong}; print('survived')")
        assert done.returncode != 0
        assert verdict in done.stderr
        assert "survived" not in done.stdout


LEVELS = ("x86-64-v2", "x86-64-v3", "x86-64-v4")


@pytest.mark.parametrize(
    ("level", "asked", "taken"),
    [(2, "", 0), (3, "", 1), (4, "", 2), (5, "", 2), (4, "x86-64-v2", 0), (2, "x86-64-v3", 1)],
)
def test_a_wheel_takes_the_best_build_for_the_processor_or_the_one_asked_for(
    level: int, asked: str, taken: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in LEVELS:
        (tmp_path / name).mkdir()
    monkeypatch.setattr(_builds, "processor_level", lambda here: level)
    monkeypatch.setenv(_builds.VARIABLE, asked)
    assert _builds.folders(tmp_path) == [str(tmp_path / LEVELS[taken])]


def test_a_wheel_refuses_a_processor_or_a_level_that_it_has_nothing_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "x86-64-v2").mkdir()
    monkeypatch.delenv(_builds.VARIABLE, raising=False)
    monkeypatch.setattr(_builds, "processor_level", lambda here: 1)
    with pytest.raises(ImportError, match="x86-64-v2, and this one is older"):
        _builds.folders(tmp_path)
    monkeypatch.setenv(_builds.VARIABLE, "x86-64-v9")
    with pytest.raises(ImportError, match="GRASP_CORE_ARCH=x86-64-v9: this wheel holds x86-64-v2"):
        _builds.folders(tmp_path)


def test_an_install_with_one_build_chooses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(_builds.VARIABLE, "x86-64-v2")
    assert _builds.folders(tmp_path) == []


@pytest.mark.skipif(platform.machine() != "x86_64", reason="levels of x86-64")
def test_the_level_is_what_the_compiler_finds(tmp_path: Path) -> None:
    """processor.cpp beside GCC's own answer, and beside what this very build runs on."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++")
    source = ROOT / "grasp_env/core/bindings/wheel/processor.cpp"
    own = tmp_path / "own.cpp"
    own.write_text(
        """extern "C" int own() { __builtin_cpu_init(); return __builtin_cpu_supports("x86-64-v4") ? 4 :
        __builtin_cpu_supports("x86-64-v3") ? 3 : __builtin_cpu_supports("x86-64-v2") ? 2 : 1; }"""
    )
    library = tmp_path / "processor.so"
    command = [compiler, "-shared", "-fPIC", "-Wall", "-Wextra", "-Werror", str(source), "-o", str(library)]
    subprocess.run(command, check=True, timeout=60)
    level = _builds.processor_level(tmp_path)
    least = {"AVX-512": 4, "AVX2": 3, "AVX": 2, "SSE4.2": 2}.get(core.build_info()["instruction_set"], 1)
    assert least <= level <= 4
    made = subprocess.run(
        [*command[:-3], str(own), *command[-2:-1], str(tmp_path / "own.so")], timeout=60, capture_output=True
    )
    if made.returncode == 0:  # GCC 12 and later know the levels' names
        assert level == ctypes.CDLL(str(tmp_path / "own.so")).own()


def test_stub_has_every_public_name() -> None:
    stub = ast.parse((ROOT / "grasp_env/core/_core.pyi").read_text(encoding="utf-8"))
    described = {node.name for node in stub.body if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
    named = [node.target for node in stub.body if isinstance(node, ast.AnnAssign)]
    described |= {target.id for target in named if isinstance(target, ast.Name)}
    public = {name for name in dir(_core) if not name.startswith("_")}
    assert public <= described
    assert set(core.__all__) <= public


def test_the_core_needs_no_compiler_of_python_and_no_network() -> None:
    done = _python("import sys, grasp_env.core; print(*sys.modules)")
    assert done.returncode == 0, done.stderr
    loaded = {name.split(".")[0] for name in done.stdout.split()}
    assert not loaded & {"numba", "scipy", "torch", "pybullet", "matplotlib", "policies", "training"}


def test_a_missing_module_says_what_to_run() -> None:
    done = _python("import sys; sys.modules['grasp_env.core._core'] = None; import grasp_env.core")
    assert done.returncode != 0
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith(
        f"ImportError: grasp_env.core._core is not built in {ROOT / 'grasp_env/core'} for this Python"
    )
    assert "run `make install` there" in last


def test_wheel_has_headers_and_data_and_no_development_files(tmp_path: Path) -> None:
    """All that is copied into a wheel; the module, which CMake adds, is left out here."""
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-Cwheel.cmake=false"]
    subprocess.run([*command, "-w", str(tmp_path), "."], cwd=ROOT, check=True, timeout=120)
    (wheel,) = tmp_path.glob("*.whl")
    files = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    sources = {
        path.relative_to(ROOT).as_posix()
        for package in ("grasp_env", "policies", "training")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.parent.name != "__pycache__" and path.suffix != ".so"
    }
    left_out = {name for name in sources if name.startswith(("grasp_env/core/bindings/", "training/assets/"))}
    assert files == sources - left_out
    assert {"grasp_env/core/include/grasp/version.hpp", "grasp_env/core/_core.pyi", "grasp_env/py.typed"} <= files
