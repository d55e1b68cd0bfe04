"""A kernel's cache notices when a kernel of another file changes (numba's own does not)."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import grasp_env
from grasp_env._compile import _imports, _stamp
from grasp_env.force import newton_kernels

PACKAGE = Path(grasp_env.__file__).parent
CODE = """
import numpy as np
from grasp_env.force.start_kernels import squeeze_scale
from grasp_env.force.start_kernels import best_on_segment
a, out = np.array([1.0, 0.0, 0.0]), np.empty(3)
best_on_segment(a, 2 * a, np.array([[1.0, 0.01]]), out)
print(out[0])
"""


def test_stamp_is_in_force():
    assert newton_kernels.newton._cache._cache_file._source_stamp[1] == _stamp(Path(newton_kernels.__file__))


def test_imports_of_every_form_are_followed():
    found = {path.name for path in _imports(PACKAGE / "force" / "methods.py")}
    assert {
        "kernels.py",
        "record.py",
        "newton_kernels.py",
        "conic_kernels.py",
    } <= found  # one line, in brackets, modules


def test_an_edit_of_a_callee_is_noticed(tmp_path):
    shutil.copytree(PACKAGE, tmp_path / "grasp_env", ignore=shutil.ignore_patterns("__pycache__", "sim"))
    (tmp_path / "grasp_env" / "sim").mkdir()
    # a PYTHONPATH entry beats the editable installation of this checkout
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}

    def run() -> float:
        run = subprocess.run(
            [sys.executable, "-c", CODE], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert run.returncode == 0, run.stderr
        return float(run.stdout)

    before = run()
    kernels = tmp_path / "grasp_env" / "force" / "kernels.py"
    text = kernels.read_text()
    edited = text.replace("total += 3.0 * weights", "total -= 3.0 * weights")
    assert edited != text
    kernels.write_text(edited)
    # Phi with the other sign prefers the far end of the segment
    assert (before, run()) == (1.0, 2.0)
