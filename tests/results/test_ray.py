"""The map on two Ray nodes of this machine. Ray listens on all interfaces, so it gets a network namespace with nothing but loopback."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("ray", reason="the extra 'ray' is not installed")
HERE = Path(__file__).parent
NAMESPACE = ("unshare", "--net", "--map-root-user")


def alone() -> bool:
    """True if network namespaces can be made on this machine."""
    if not all(map(shutil.which, ("unshare", "ip"))):
        return False
    return subprocess.run([*NAMESPACE, "true"], capture_output=True, timeout=30).returncode == 0


@pytest.mark.skipif(not alone(), reason="no network namespace can be made here")
def test_two_nodes_give_the_bytes_of_the_loop_and_a_killed_worker_loses_nothing(tmp_path):
    paths = [str(path) for path in (HERE.parents[1], HERE.parent)]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"}
    command = [*NAMESPACE, sys.executable, str(HERE / "ray_cluster.py"), str(tmp_path)]
    run = subprocess.run(command, env=env, cwd=HERE.parents[1], capture_output=True, text=True, timeout=240)
    assert run.returncode == 0, run.stderr[-3000:]
    assert "workers 2, processes 2, dead [0, 1, 2, 3], kept 4" in run.stdout
    assert (tmp_path / "ray.parquet").read_bytes() == (tmp_path / "inline.parquet").read_bytes()
    starts = {(tmp_path / f"starts-{on}.parquet").read_bytes() for on in ("ray", "processes", "inline")}
    assert len(starts) == 1
