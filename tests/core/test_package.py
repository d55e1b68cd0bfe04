"""The core in other people's programs: headers without warnings, and a target that cmake and colcon
find."""

from __future__ import annotations

import platform
import shutil
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from xml.etree import ElementTree

import pytest
from building import CORE, FLAGS, HEADERS, PROGRAMS, ROOT, SHADOW, run, succeed, tool

from grasp_env import __version__
from grasp_env.force import optimize_force
from grasp_env.grasp import presets

CONSUMER = PROGRAMS / "consumer"


def check(compiler: str, headers: list[str], *flags: str) -> str:
    """Errors of a compiler for a file that includes these headers; empty without a warning."""
    options = [
        *FLAGS,
        SHADOW[compiler],
        *flags,
        "-fsyntax-only",
        f"-I{CORE / 'include'}",
        "-x",
        "c++",
        "-",
    ]
    done = run(
        tool(compiler), *options, input="".join(f"#include <grasp/{name}>\n" for name in headers)
    )
    return done.stderr if done.returncode else ""


@pytest.mark.slow
@pytest.mark.parametrize("compiler", SHADOW)
def test_headers_stand_alone(compiler):
    """GCC compiles all of them together for `programs` in every run."""
    with ThreadPoolExecutor(2) as pool:
        said = list(pool.map(lambda name: check(compiler, [name]), HEADERS))
    assert len(said) > 30
    assert [text for text in said if text] == []


@pytest.mark.parametrize("flag", ["-Ofast", "-ffinite-math-only"])
def test_fast_math_is_refused(flag):
    assert "-ffast-math drops the checks for NaN" in check("g++", ["math/lanes.hpp"], flag)


def installed(folder: Path) -> list[str]:
    """With cmake --install; configured without Python."""
    for part, source, given in (("whole", ROOT, ["-DGRASP_PYTHON=OFF"]), ("core", CORE, [])):
        prefix = install(source, folder / part, "-DGRASP_LIBRARY=OFF", *given)
        files = {
            path.relative_to(prefix).as_posix() for path in prefix.rglob("*") if path.is_file()
        }
        headers = {f"include/grasp/{name}" for name in HEADERS}
        config = {
            f"share/cmake/grasp/{name}.cmake" for name in ("graspConfig", "graspConfigVersion")
        }
        assert files == headers | config | {"share/grasp/package.xml"}
    return [f"-DCMAKE_PREFIX_PATH={prefix}", "-DTAKEN=grasp::core"]


def install(source: Path, folder: Path, *given: str) -> Path:
    prefix = folder / "prefix"
    hidden = [f"-D{name}_EXECUTABLE=/nowhere" for name in ("Python", "Python3")]
    succeed(
        tool("cmake"),
        "-S",
        source,
        "-B",
        folder,
        f"-DCMAKE_INSTALL_PREFIX={prefix}",
        *given,
        *hidden,
    )
    succeed(tool("cmake"), "--build", folder)
    succeed(tool("cmake"), "--install", folder)
    return prefix


def with_library(folder: Path) -> list[str]:
    """The same with the library."""
    prefix = install(CORE, folder / "core", "-DCMAKE_BUILD_TYPE=Debug")
    assert (prefix / "lib/libgrasp.a").exists()
    return [f"-DCMAKE_PREFIX_PATH={prefix}"]


def packaged(folder: Path) -> list[str]:
    """In the Python package, wherever that is."""
    package = folder / "site-packages/grasp_env/core"
    shutil.copytree(CORE, package, ignore=shutil.ignore_patterns("bindings", "_core*.so"))
    return [
        f"-Dgrasp_DIR={succeed(sys.executable, package / '__main__.py', '--cmake-dir').strip()}"
    ]


def dropped(folder: Path) -> list[str]:
    """Copied into the project."""
    shutil.copytree(CORE, folder / "core", ignore=shutil.ignore_patterns("bindings", "_core*.so"))
    return [f"-DGRASP_FOLDER={folder / 'core'}"]


WAYS = (installed, packaged, dropped)


def configure(way: Callable[[Path], list[str]], folder: Path, *given: str | Path) -> Path:
    build = folder / "build"
    succeed(tool("cmake"), "-S", CONSUMER, "-B", build, *way(folder), *given)
    return build


@pytest.mark.parametrize("way", WAYS)
def test_a_program_finds_the_headers(way, tmp_path):
    build = configure(way, tmp_path, "-DCMAKE_EXPORT_COMPILE_COMMANDS=ON")
    command = (build / "compile_commands.json").read_text()
    assert f"{tmp_path}/" in command.partition("-isystem ")[2]
    assert "-ffp-contract=fast" in command


def solves(program: Path) -> None:
    wanted = optimize_force(
        presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0], tolerance=1e-9
    ).objective
    code, objective = succeed(program).split()
    assert (code, float(objective)) == ("0", pytest.approx(wanted, rel=2e-9))


@pytest.mark.slow
@pytest.mark.parametrize("compiler", SHADOW)
@pytest.mark.parametrize("way", [*WAYS, with_library])
def test_a_program_builds_and_solves(way, compiler, tmp_path):
    build = configure(
        way, tmp_path, f"-DCMAKE_CXX_COMPILER={tool(compiler)}", "-DCMAKE_BUILD_TYPE=Debug"
    )
    succeed("cmake", "--build", build)
    solves(build / "consumer")


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() != "x86_64", reason="levels of x86-64")
def test_a_library_for_other_registers_does_not_link(tmp_path):
    build = configure(
        with_library, tmp_path, "-DCMAKE_BUILD_TYPE=Debug", "-DCMAKE_CXX_FLAGS=-march=x86-64-v3"
    )
    done = run("cmake", "--build", build)
    assert done.returncode != 0
    assert "make_engine<4>" in done.stdout + done.stderr


@pytest.mark.parametrize(("option", "warned"), [("", True), ("Release", False)])
def test_a_build_without_optimization_warns(option, warned, tmp_path):
    given = [f"-Dgrasp_DIR={CORE / 'cmake'}", f"-DCMAKE_BUILD_TYPE={option}"]
    done = run(tool("cmake"), "-S", CONSUMER, "-B", tmp_path, *given)
    assert done.returncode == 0, done.stderr
    assert ("not optimized" in done.stderr) == warned


def test_another_version_is_not_found(tmp_path):
    (tmp_path / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.21)\nproject(asks LANGUAGES NONE)\nfind_package(grasp ${WANTED} REQUIRED CONFIG)\n"
    )
    for wanted, found in (
        ("0.1", 1),
        ("0.1.0;EXACT", 1),
        ("0", 0),
        ("0.2", 0),
        ("0.1.9", 0),
        ("1", 0),
    ):
        build = tmp_path / wanted.replace(";", "-")
        done = run(
            tool("cmake"),
            "-S",
            tmp_path,
            "-B",
            build,
            f"-Dgrasp_DIR={CORE / 'cmake'}",
            f"-DWANTED={wanted}",
        )
        assert (done.returncode == 0) == found, (wanted, done.stderr)


def test_ros_tools_read_the_package():
    """The version is the project's; a consumer depends on the name that `find_package` finds."""
    package = ElementTree.parse(CORE / "package.xml").getroot()
    assert (package.tag, package.get("format")) == ("package", "3")
    said = {part.tag: part.text for part in package if len(part) == 0}
    assert len(said) == len(package) - 1, "each once, besides the exports"
    assert (CORE / f"cmake/{said['name']}Config.cmake").exists()
    assert (said["version"], said["license"]) == (__version__, "MIT")
    assert {tag: said[tag] for tag in said if tag.endswith("depend")} == {
        "buildtool_depend": "cmake"
    }
    assert package.findtext("export/build_type") == "cmake"
    assert ElementTree.parse(CONSUMER / "package.xml").findtext("depend") == said["name"]


@pytest.mark.slow
def test_a_colcon_workspace_builds_what_depends_on_it(tmp_path):
    colcon = [tool("colcon"), "--log-base", tmp_path / "log"]
    source = tmp_path / "src"
    source.mkdir()
    # in order of dependence core is first
    for name, folder in (("a_consumer", CONSUMER), ("core", CORE)):
        (source / name).symlink_to(folder)
    found = succeed(*colcon, "list", "--names-only", "--topological-order", "--base-paths", source)
    assert found.split() == ["grasp", "consumer"]
    bases = [word for part in ("build", "install") for word in (f"--{part}-base", tmp_path / part)]
    succeed(
        *colcon, "build", "--base-paths", source, *bases, "--cmake-args", "-DCMAKE_BUILD_TYPE=Debug"
    )
    assert (tmp_path / "install/grasp/share/grasp/package.xml").exists()
    solves(tmp_path / "build/consumer/consumer")
