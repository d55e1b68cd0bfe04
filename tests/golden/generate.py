"""Writes the golden files: `python tests/golden/generate.py [--only GROUP ...] [--out FOLDER]`; see CONTRIBUTING.md."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1])]  # pytest's `pythonpath`, in its order

from golden.judge import GROUPS  # noqa: E402
from golden.record import FOLDER, save  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=[*GROUPS], default=[*GROUPS], help="groups to write; default: all")
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder of the files; default: this one")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.only:
        path = given.out / f"{name}.npz"
        cases = [(case.name, case.run()) for case in GROUPS[name]().values()]
        save(path, cases)
        print(
            f"{path}: {len(cases)} cases, {sum(len(rows) for _, rows in cases)} outcomes, {path.stat().st_size} bytes"
        )


if __name__ == "__main__":
    main()
