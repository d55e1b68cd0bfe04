"""One thread for numpy, as threads that wait for each other make small systems slow; one
compilation of the programs in C++."""

import fcntl
import os

import pytest
from building import build, compiled

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read once, when numpy is loaded


@pytest.fixture(scope="session")
def programs(tmp_path_factory):
    """Folder of all programs in C++, compiled once for all processes of the tests."""
    if os.environ.get("GRASP_CORE_BUILD", "").endswith("sanitize"):
        pytest.skip("the programs are compiled without the sanitizers; `make slow` runs them with")
    base = tmp_path_factory.getbasetemp()
    folder = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    with (folder / "programs.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return (
            folder / "programs"
            if (folder / "programs/front").exists()
            else build(folder, "-O0", *compiled())
        )
