"""The core reports how it was built, is loaded from the right folder, and imports little."""

from __future__ import annotations

import ast
import ctypes
import os
import platform
import subprocess
import sys
import zipfile
from pathlib import Path

import _core_test
import pytest
from building import ROOT, run, tool

import grasp_env
from grasp_env import core
from grasp_env.core import _builds, _core

FLAGS = core.build_info()["flags"].split()
SANITIZED = any(flag.startswith("-fsanitize") for flag in FLAGS)


def _python(script: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, timeout=120, capture_output=True, text=True
    )


def test_build_info():
    info = core.build_info()
    assert info["version"] == _core_test.version == grasp_env.__version__
    assert info["compiler"].startswith(("GNU ", "Clang ", "AppleClang "))
    assert info["instruction_set"]
    assert info["build_type"] in ("Release", "RelWithDebInfo", "Debug")
    assert ("-O3" in FLAGS) == (info["build_type"] != "Debug")
    assert {"-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math"} <= set(FLAGS)
    # which drop the checks for NaN
    assert not {"-ffast-math", "-Ofast", "-ffinite-math-only"} & set(FLAGS)


def test_the_right_build_is_loaded():
    other = os.environ.get("GRASP_CORE_BUILD")
    homes = (
        [ROOT / other, ROOT / other] if other else [ROOT / "grasp_env/core", ROOT / "tests/core"]
    )
    assert [Path(str(module.__file__)).parent for module in (_core, _core_test)] == homes
    assert (other is not None and other.endswith("sanitize")) == SANITIZED


@pytest.mark.parametrize(
    ("right", "wrong", "verdict"),
    [
        ("read(4, 3)", "read(4, 4)", "AddressSanitizer: heap-buffer-overflow"),
        ("successor(1)", "successor(2**31 - 1)", "runtime error: signed integer overflow"),
    ],
)
def test_the_sanitizers_watch(right, wrong, verdict):
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
    [(2, "", 0), (4, "", 2), (5, "", 2), (4, "x86-64-v2", 0), (2, "x86-64-v3", 1)],
)
def test_a_wheel_takes_the_best_build_or_the_named_one(level, asked, taken, tmp_path, monkeypatch):
    for name in LEVELS:
        (tmp_path / name).mkdir()
    monkeypatch.setattr(_builds, "processor_level", lambda here: level)
    monkeypatch.setenv(_builds.VARIABLE, asked)
    assert _builds.folders(tmp_path) == [str(tmp_path / LEVELS[taken])]
    assert _builds.folders(tmp_path / LEVELS[0]) == []  # an install with one build


def test_a_wheel_refuses_an_old_processor_and_an_unknown_level(tmp_path, monkeypatch):
    (tmp_path / "x86-64-v2").mkdir()
    monkeypatch.delenv(_builds.VARIABLE, raising=False)
    monkeypatch.setattr(_builds, "processor_level", lambda here: 1)
    with pytest.raises(ImportError, match="x86-64-v2, and this one is older"):
        _builds.folders(tmp_path)
    monkeypatch.setenv(_builds.VARIABLE, "x86-64-v9")
    with pytest.raises(ImportError, match="GRASP_CORE_ARCH=x86-64-v9: this wheel holds x86-64-v2"):
        _builds.folders(tmp_path)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="levels of x86-64")
def test_the_level_is_what_the_compiler_finds(tmp_path):
    """processor.cpp agrees with GCC's own answer and with the instruction set of this build."""
    source = ROOT / "grasp_env/core/bindings/wheel/processor.cpp"
    own = tmp_path / "own.cpp"
    names = " : ".join(f'__builtin_cpu_supports("x86-64-v{k}") ? {k}' for k in (4, 3, 2))
    own.write_text(f'extern "C" int own() {{ __builtin_cpu_init(); return {names} : 1; }}')
    for one, library in ((source, "processor.so"), (own, "own.so")):
        run(
            tool("g++"),
            "-shared",
            "-fPIC",
            "-Wall",
            "-Wextra",
            "-Werror",
            one,
            "-o",
            tmp_path / library,
        )
    level = _builds.processor_level(tmp_path)
    least = {"AVX-512": 4, "AVX2": 3, "AVX": 2, "SSE4.2": 2}.get(
        core.build_info()["instruction_set"], 1
    )
    assert least <= level <= 4
    if (tmp_path / "own.so").exists():  # GCC 12 and later know the levels' names
        assert level == ctypes.CDLL(str(tmp_path / "own.so")).own()


def test_stub_has_every_public_name():
    stub = ast.parse((ROOT / "grasp_env/core/_core.pyi").read_text(encoding="utf-8"))
    described = {
        node.name for node in stub.body if isinstance(node, (ast.FunctionDef, ast.ClassDef))
    }
    named = [node.target for node in stub.body if isinstance(node, ast.AnnAssign)]
    described |= {target.id for target in named if isinstance(target, ast.Name)}
    public = {name for name in dir(_core) if not name.startswith("_")}
    assert public <= described
    assert set(core.__all__) <= public


def test_the_core_imports_no_optional_package():
    done = _python("import sys, grasp_env.core; print(*sys.modules)")
    assert done.returncode == 0, done.stderr
    loaded = {name.split(".")[0] for name in done.stdout.split()}
    assert not loaded & {
        "numba",
        "scipy",
        "torch",
        "pybullet",
        "matplotlib",
        "policies",
        "training",
    }


def test_a_missing_module_names_the_command_to_run():
    done = _python("import sys; sys.modules['grasp_env.core._core'] = None; import grasp_env.core")
    assert done.returncode != 0
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith(
        f"ImportError: grasp_env.core._core is not built in {ROOT / 'grasp_env/core'} for this Python"
    )
    assert "run `make install` there" in last


def test_a_build_for_another_numpy_says_how_to_build_for_all():
    """A build with numpy 1 finds no such interface in numpy 2: here it is taken away."""
    hidden = "next(module for name, module in sys.modules.items() if name.endswith('._multiarray_umath'))._ARRAY_API"
    done = _python(f"import sys, numpy; del {hidden}; import grasp_env.core")
    last = done.stderr.strip().splitlines()[-1]
    assert "was built for another numpy than" in last
    assert "_ARRAY_API" in last
    assert "`pip install .` in a clone, without --no-build-isolation" in last


def test_wheel_has_headers_and_data_and_no_development_files(tmp_path):
    """Without the module, which CMake adds."""
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "-q",
        "--no-deps",
        "--no-build-isolation",
        "-Cwheel.cmake=false",
    ]
    subprocess.run([*command, "-w", str(tmp_path), "."], cwd=ROOT, check=True, timeout=120)
    (wheel,) = tmp_path.glob("*.whl")
    files = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    sources = {
        path.relative_to(ROOT).as_posix()
        for package in ("grasp_env", "policies", "training")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.parent.name != "__pycache__" and path.suffix != ".so"
    }
    left_out = {name for name in sources if name.startswith("grasp_env/core/bindings/")}
    assert files == sources - left_out
    assert {
        "grasp_env/core/include/grasp/version.hpp",
        "grasp_env/core/_core.pyi",
        "grasp_env/py.typed",
    } <= files
