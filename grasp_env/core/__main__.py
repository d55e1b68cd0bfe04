"""`python -m grasp_env.core`: folders of this package for builds of C++ programs."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def main() -> None:
    """Print a folder."""
    parser = argparse.ArgumentParser(
        prog="python -m grasp_env.core", description="Print a folder of the C++ core."
    )
    group = parser.add_mutually_exclusive_group(required=True)
    folder = Path(__file__).resolve().parent
    for option, path, text in (
        (
            "--cmake-dir",
            folder / "cmake",
            "for find_package(grasp): -Dgrasp_DIR=$(python -m grasp_env.core --cmake-dir)",
        ),
        ("--include-dir", folder / "include", "of <grasp/optimizer.hpp>"),
    ):
        group.add_argument(option, dest="path", action="store_const", const=path, help=text)
    sys.stdout.write(f"{parser.parse_args().path}\n")


if __name__ == "__main__":
    main()
