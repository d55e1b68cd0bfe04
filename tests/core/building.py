"""Compilers and programs in C++ that the tests build: all of them in one, as the headers take most
of the time."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from grasp_env.core import build_info

ROOT = Path(__file__).parents[2]
CORE = ROOT / "grasp_env/core"
PROGRAMS = Path(__file__).parent / "programs"
HEADERS = sorted(
    path.relative_to(CORE / "include/grasp").as_posix()
    for path in (CORE / "include/grasp").rglob("*.hpp")
)
FLAGS = ["-std=c++20", "-Wall", "-Wextra", "-Wpedantic", "-Wno-psabi", "-Werror"]
SHADOW = {"g++": "-Wshadow=local", "clang++": "-Wshadow"}
"""GCC takes a constructor's parameters for shadows of the members that they fill."""
FLOATING = ["-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math"]
SANITIZED = [
    "-O1",
    "-g1",
    "-fsanitize=address,undefined,float-cast-overflow",
    "-fno-sanitize-recover=all",
    "-D_GLIBCXX_ASSERTIONS",
]
EXAMPLES = sorted(
    path for path in (CORE / "examples").glob("*.cpp") if re.match(r"\d\d_", path.name)
)
PAGES = (CORE / "README.md", ROOT / "docs/moving_contacts.md")
SOURCES = [*EXAMPLES, *sorted(PROGRAMS.glob("*.cpp"))]


def compiled() -> list[str | Path]:
    """Flags with which a program takes the solvers of the module under test, which holds them for
    its own processor."""
    info = build_info()
    folder = ROOT / os.environ.get("GRASP_CORE_BUILD", "build/core")
    processor = [flag for flag in info["flags"].split() if flag.startswith("-march")]
    return ["-DGRASP_COMPILED", *processor, folder / "solvers/libgrasp.a"]


def tool(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not here")
    return path


def run(*command: str | Path, **options: object) -> subprocess.CompletedProcess[Any]:
    """Run a command in a user's environment: that of the tests may preload a sanitizer."""
    plain = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
    return subprocess.run(
        command, env=plain, timeout=3000, capture_output=True, **{"text": True, **options}
    )  # type: ignore[call-overload]


def succeed(*command: str | Path) -> str:
    done = run(*command)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def shown(page: Path) -> str:
    """The C++ of a page, block after block."""
    return "\n".join(re.findall(r"```cpp\n(.*?)```", page.read_text(), re.DOTALL))


def joined() -> str:
    """The text of one program that runs the source it is called by; each header is included once,
    and what pages show is compiled too."""
    included = CORE / "examples/hand_controller.cpp"
    texts = [*(path.read_text() for path in (*SOURCES, included)), *map(shown, PAGES)]
    names = sorted(
        {name for text in texts for name in re.findall(r"#include (<.*?>)", text)}
        | {"<filesystem>"}
    )
    names += [
        *(f"<grasp/{header}>" for header in HEADERS),
        f'"{PROGRAMS.parent}/bindings/counting.hpp"',
    ]
    lines = [f"#include {name}" for name in names]
    choices = []
    for path in (*SOURCES, *PAGES):
        name = f"program_{path.stem}"
        text = shown(path) if path in PAGES else path.read_text()
        text = re.sub(r'#include (<.*>|.*counting.hpp")', "", text).replace(
            "../../../grasp_env/core", str(CORE)
        )
        text = re.sub(r"\bint main\(", "int run(", text)
        if path in SOURCES:  # main returns 0 at its end, other functions do not
            text = re.sub(r"\n\}(?=\n$| catch )", "\nreturn 0; }", text)
        lines += [f"namespace {name} {{", f'#line 1 "{path}"', text, "}"]
        if path in SOURCES:
            call = "run()" if "int run()" in text else "run(given, arguments)"
            choices.append(f'if (name == "{path.stem}") return {name}::{call};')
    main = ["int main(int given, char** arguments) {", "(void)given;"]
    main.append("const auto name = std::filesystem::path(arguments[0]).filename().string();")
    return "\n".join([*lines, *main, *choices, "return 9;", "}", ""])


def build(folder: Path, *flags: str | Path, compiler: str = "g++") -> Path:
    """Compile all programs; returns a folder with each by its name."""
    source = folder / "programs.cpp"
    programs = folder / "programs"
    programs.mkdir()
    source.write_text(joined())
    every = [
        *FLAGS,
        SHADOW[compiler],
        *FLOATING,
        "-DGRASP_SEEDED",
        f"-I{CORE / 'include'}",
        "-pthread",
    ]
    succeed(tool(compiler), *every, source, *flags, "-o", programs / "all")
    for path in SOURCES:
        (programs / path.stem).symlink_to("all")
    return programs


def spoiled(blob: bytes) -> list[bytes]:
    """A file cut short, too long, or with a bit changed."""
    rng = np.random.default_rng(0)
    changed = [(at, 1 << int(rng.integers(8))) for at in rng.integers(0, len(blob), 50)]
    return [blob[:k] for k in (0, 7, 8, 15, 16, len(blob) // 2, len(blob) - 1)] + [
        blob + b"0",
        *(blob[:at] + bytes([blob[at] ^ bit]) + blob[at + 1 :] for at, bit in changed),
    ]
