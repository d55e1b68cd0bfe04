"""A kernel's cache notices when a kernel of another file changes (numba's own does not)."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import grasp_env
from grasp_env import carry_kernels
from grasp_env._compile import _imports, _stamp

PACKAGE = Path(grasp_env.__file__).parent
CODE = """
import numpy as np
from grasp_env.carry_kernels import least_norm
force = np.zeros(6)
least_norm(force, np.eye(6), np.array([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
print(force[0])
"""


def test_stamp_is_in_force():
    carry_kernels.turn(np.zeros(3), np.ones((1, 3)), *np.zeros((2, 1, 3, 3)), np.empty(3))
    stamped = carry_kernels.turn._cache._cache_file._source_stamp
    assert stamped[1] == _stamp(Path(carry_kernels.__file__))


def test_imports_of_every_form_are_followed(tmp_path):
    forms = tmp_path / "forms.py"
    forms.write_text(
        "from grasp_env.phi_kernels import phi\n"
        "from grasp_env.force.record import (\n    CODE,\n    FORCE,\n)\n"
        "from grasp_env.force import basis, step_size\n"
        "import grasp_env.errors\n"
        "def later():\n    from grasp_env.core import LARGEST\n"
    )
    named = ("phi_kernels.py", "force/record.py", "force/__init__.py", "force/basis.py", "force/step_size.py", "errors.py",
             "core/__init__.py")  # fmt: skip
    assert set(_imports(forms)) == {PACKAGE / name for name in named}
    found = {path.name for path in _imports(PACKAGE / "control_kernels.py")}
    assert {"phi_kernels.py", "carry_kernels.py"} <= found


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
    kernels = tmp_path / "grasp_env" / "phi_kernels.py"
    text = kernels.read_text()
    edited = text.replace("pivot = math.sqrt(pivot)", "pivot = 2.0 * math.sqrt(pivot)")
    assert edited != text
    kernels.write_text(edited)
    # a factor of twice the size divides what it solves for by four; 1e-9 is `least_norm`'s own
    assert before == pytest.approx(1.0, rel=2e-9)
    assert run() == pytest.approx(0.25, rel=2e-9)
