"""The core as other people's programs see it: headers that stand alone, and a target that cmake finds."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from grasp_env import __version__
from grasp_env.force import optimize_force
from grasp_env.grasp import presets

ROOT = Path(__file__).parents[2]
CORE, CONSUMER = ROOT / "grasp_env/core", Path(__file__).parent / "programs/consumer"
HEADERS = sorted(
    path.relative_to(CORE / "include/grasp").as_posix() for path in (CORE / "include/grasp").rglob("*.hpp")
)
FLAGS = ["-std=c++20", "-Wall", "-Wextra", "-Wpedantic", "-Wno-psabi", "-Werror"]
SHADOW = {"g++": "-Wshadow=local", "clang++": "-Wshadow"}
"""GCC takes a constructor's parameters for shadows of what they fill."""
EXPECTED = optimize_force(presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0], tolerance=1e-9).objective


def tool(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not here")
    return found


def run(*command: str | Path, **options: object) -> subprocess.CompletedProcess[Any]:
    """With the environment of a user's shell, not that of these tests: they may preload a sanitizer."""
    plain = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
    return subprocess.run(command, env=plain, timeout=300, capture_output=True, **{"text": True, **options})  # type: ignore[call-overload]


def succeed(*command: str | Path) -> str:
    done = run(*command)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def check(compiler: str, headers: list[str], *flags: str) -> subprocess.CompletedProcess[str]:
    """Whether a file that includes these compiles without a warning."""
    options = [*FLAGS, SHADOW[compiler], *flags, "-fsyntax-only", f"-I{CORE / 'include'}", "-x", "c++", "-"]
    return run(tool(compiler), *options, input="".join(f"#include <grasp/{name}>\n" for name in headers))


@pytest.mark.parametrize("compiler", SHADOW)
def test_headers_without_a_warning(compiler: str) -> None:
    done = check(compiler, HEADERS)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("compiler", SHADOW)
def test_headers_stand_alone(compiler: str) -> None:
    with ThreadPoolExecutor(2) as pool:
        done = dict(zip(HEADERS, pool.map(lambda name: check(compiler, [name]), HEADERS), strict=True))
    assert len(done) > 30
    assert not "\n".join(f"{name}: {one.stderr}" for name, one in done.items() if one.returncode)


@pytest.mark.parametrize("flag", ["-Ofast", pytest.param("-ffinite-math-only", marks=pytest.mark.slow)])
def test_fast_math_is_refused(flag: str) -> None:
    done = check("g++", ["math/lanes.hpp"], flag)
    assert done.returncode != 0
    assert "-ffast-math drops the checks for NaN" in done.stderr


def installed(folder: Path) -> Iterator[str]:
    """With cmake --install; configured without Python."""
    for part, source, given in (("core", CORE, []), ("whole", ROOT, ["-DGRASP_PYTHON=OFF"])):
        build, prefix = folder / f"{part}-build", folder / f"{part}-prefix"
        hidden = [f"-D{name}_EXECUTABLE=/nowhere" for name in ("Python", "Python3")]
        succeed(tool("cmake"), "-S", source, "-B", build, f"-DCMAKE_INSTALL_PREFIX={prefix}", *given, *hidden)
        succeed(tool("cmake"), "--install", build)
        files = {path.relative_to(prefix).as_posix() for path in prefix.rglob("*") if path.is_file()}
        assert {"include/grasp/optimizer.hpp", "share/cmake/grasp/graspConfig.cmake"} <= files
        others = {name for name in files if not name.startswith(("include/grasp/", "share/cmake/grasp/"))}
        assert others == {"share/grasp/package.xml"}
    yield f"-DCMAKE_PREFIX_PATH={prefix}"


def packaged(folder: Path) -> Iterator[str]:
    """In the Python package, wherever that is."""
    package = folder / "site-packages/grasp_env/core"
    shutil.copytree(CORE, package, ignore=shutil.ignore_patterns("bindings", "_core*.so"))
    yield f"-Dgrasp_DIR={succeed(sys.executable, package / '__main__.py', '--cmake-dir').strip()}"


def dropped(folder: Path) -> Iterator[str]:
    """As a folder in the project."""
    shutil.copytree(CORE, folder / "core", ignore=shutil.ignore_patterns("bindings", "_core*.so"))
    yield f"-DGRASP_FOLDER={folder / 'core'}"


WAYS = [(way, compiler) for way in (installed, packaged, dropped) for compiler in SHADOW]


@pytest.mark.parametrize(
    ("way", "compiler"), [WAYS[0], *(pytest.param(*way, marks=pytest.mark.slow) for way in WAYS[1:])]
)
def test_a_program_builds_and_solves(way, compiler: str, tmp_path: Path) -> None:
    tool("cmake")
    (option,) = way(tmp_path)
    build = tmp_path / "build"
    configure = ["-S", CONSUMER, "-B", build, option, f"-DCMAKE_CXX_COMPILER={tool(compiler)}"]
    succeed("cmake", *configure, "-DCMAKE_BUILD_TYPE=Debug")
    succeed("cmake", "--build", build)
    code, objective = succeed(build / "consumer").split()
    assert code == "0"
    assert float(objective) == pytest.approx(EXPECTED, rel=2e-9)


@pytest.mark.parametrize("way", [packaged, dropped])
def test_a_program_finds_the_headers(way, tmp_path: Path) -> None:
    (option,) = way(tmp_path)
    succeed(tool("cmake"), "-S", CONSUMER, "-B", tmp_path / "build", option, "-DCMAKE_EXPORT_COMPILE_COMMANDS=ON")
    command = (tmp_path / "build/compile_commands.json").read_text()
    assert f"{tmp_path}/" in command.partition("-isystem ")[2]
    assert "-ffp-contract=fast" in command


@pytest.mark.parametrize(
    ("option", "warned"), [("", True), ("Debug", True), ("Release", False), ("RelWithDebInfo", False)]
)
def test_a_build_without_optimization_warns(option: str, warned: bool, tmp_path: Path) -> None:
    done = run(
        tool("cmake"), "-S", CONSUMER, "-B", tmp_path, f"-Dgrasp_DIR={CORE / 'cmake'}", f"-DCMAKE_BUILD_TYPE={option}"
    )
    assert done.returncode == 0, done.stderr
    assert ("not optimized" in done.stderr) == warned


def test_another_version_is_not_found(tmp_path: Path) -> None:
    (tmp_path / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.21)\nproject(asks LANGUAGES NONE)\nfind_package(grasp ${WANTED} REQUIRED CONFIG)\n"
    )
    for wanted, found in (("0.1", 1), ("0.1.0;EXACT", 1), ("0", 0), ("0.2", 0), ("0.1.9", 0), ("1", 0)):
        build = tmp_path / wanted.replace(";", "-")
        done = run(tool("cmake"), "-S", tmp_path, "-B", build, f"-Dgrasp_DIR={CORE / 'cmake'}", f"-DWANTED={wanted}")
        assert (done.returncode == 0) == found, (wanted, done.stderr)


def test_ros_tools_read_what_the_package_is() -> None:
    """The version is the project's; a consumer depends on the name that `find_package` finds."""
    package = ElementTree.parse(CORE / "package.xml").getroot()
    assert (package.tag, package.get("format")) == ("package", "3")
    said = {part.tag: part.text for part in package if len(part) == 0}
    assert len(said) == len(package) - 1, "each once, besides what is exported"
    assert (CORE / f"cmake/{said['name']}Config.cmake").exists()
    assert (said["version"], said["license"]) == (__version__, "MIT")
    assert {tag: said[tag] for tag in said if tag.endswith("depend")} == {"buildtool_depend": "cmake"}
    assert package.findtext("export/build_type") == "cmake"
    assert ElementTree.parse(CONSUMER / "package.xml").findtext("depend") == said["name"]


def test_a_colcon_workspace_builds_what_depends_on_it(tmp_path: Path) -> None:
    colcon = [tool("colcon"), "--log-base", tmp_path / "log"]
    source = tmp_path / "src"
    source.mkdir()
    for name, folder in (("a_consumer", CONSUMER), ("core", CORE)):  # by dependence core is first
        (source / name).symlink_to(folder)
    found = succeed(*colcon, "list", "--names-only", "--topological-order", "--base-paths", source)
    assert found.split() == ["grasp", "consumer"]
    bases = [word for part in ("build", "install") for word in (f"--{part}-base", tmp_path / part)]
    succeed(*colcon, "build", "--base-paths", source, *bases, "--cmake-args", "-DCMAKE_BUILD_TYPE=Debug")
    assert (tmp_path / "install/grasp/share/grasp/package.xml").exists()
    code, objective = succeed(tmp_path / "build/consumer/consumer").split()
    assert code == "0"
    assert float(objective) == pytest.approx(EXPECTED, rel=2e-9)
