"""Each extra brings what the pages promise of it, with the size that they tell: `make slow
ARGS=tests/test_installs.py`, ten minutes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_setup import SIZES

ROOT = Path(__file__).parents[1]
TORCH = "torch==2.13.0"
"""Installed first: resolved together with other packages, a newer build with gigabytes of CUDA may
come."""
SOLVE = "grasp solve --wrench 1 0.5 -0.6 -0.1 0.2 0"
HAND = "import gymnasium as gym; env = gym.make('grasp_env:FourFingerGrasp-v0'{}); env.reset(seed=0); env.step(env.action_space.sample()); env.close()"
PICTURE = (
    "import gymnasium as gym, trimesh; from grasp_env.sim import ObjectDescription;"
    "trimesh.creation.annulus(20, 40, 90).export('ring.stl');"
    "mesh = ObjectDescription.from_mesh('ring.stl', scale=0.001, mass=0.2);"
    "env = gym.make('grasp_env:FourFingerGrasp-v0', object=mesh, render_mode='rgb_array');"
    "env.reset(seed=0); assert env.render().std() > 10; env.close()"
)
LAYER = (
    "import torch; from policies import grasp_force; from grasp_env.grasp import presets; g = presets.paper_cuboid();"
    "t = torch.tensor([1, 0.5, -0.6, -0.1, 0.2, 0], dtype=torch.float64, requires_grad=True);"
    "grasp_force(torch.tensor(g.positions), torch.tensor(g.normals), 0.4, t).force.sum().backward(); assert t.grad.isfinite().all()"
)
EXTRAS: dict[str, list[str]] = {
    "": ["python -c 'from grasp_env.force import optimize_force'"],
    "cli": [SOLVE],
    "sim": [f'python -c "{HAND.format("")}"', f'python -c "{PICTURE}"'],
    "cli,sim": ["grasp demo --seconds 0.2", "grasp hand allegro"],
    "sim,mujoco": [f"""python -c "{HAND.format(", engine='mujoco'")}" """],
    "sim,xacro": ["python -c 'import xacrodoc, grasp_env.sim'"],
    "live": ["grasp live --help", SOLVE],
    "layer": [f'python -c "{LAYER}"'],
    "train": ["grasp fit --help", "grasp rl --quick --out runs"],
    "report": ["grasp report --help", "python -c 'import training.evaluation.report.page'"],
    "sim,report": ["grasp evaluate starts --quick --out runs"],
    "cli,sim,video": ["grasp demo --video hand.mp4 --seconds 0.2"],
    "ray,sim,report": ["python -c 'import ray'", "grasp evaluate starts --quick --out runs"],
    "all": [SOLVE, "grasp evaluate --quick --out runs"],
}
"""Commands that must succeed with each extra."""


@pytest.fixture(scope="session")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, ROOT],
        check=True,
    )
    (found,) = folder.glob("*.whl")
    return found


def megabytes(folder: Path) -> float:
    return sum(path.lstat().st_blocks * 512 for path in folder.rglob("*")) / 1e6


@pytest.mark.slow
@pytest.mark.parametrize("extra", EXTRAS)
def test_an_extra_brings_what_it_promises(extra, wheel, tmp_path):
    venv = tmp_path / "venv"
    extras = extra.split(",") if extra else []
    home = {"PATH": f"{venv / 'bin'}:{os.environ['PATH']}", "HOME": str(tmp_path)}

    def run(command: str) -> None:
        done = subprocess.run(
            command,
            shell=True,
            cwd=tmp_path,
            env=home,
            capture_output=True,
            text=True,
            timeout=1800,
        )
        assert done.returncode == 0, (command, done.stdout[-2000:], done.stderr[-3000:])

    subprocess.run([sys.executable, "-m", "venv", venv], check=True)
    pip = f"pip install --quiet -c {ROOT / 'constraints.txt'}"
    run(f"{pip} '{wheel}'")
    before = megabytes(venv)
    if extra in ("layer", "train", "all"):
        run(f"{pip} {TORCH}")
    if extras:
        run(f"{pip} '{wheel}[{extra}]'")
    added = megabytes(venv) - before
    for command in EXTRAS[extra]:
        run(command)
    # as the sizes were measured
    if sys.version_info[:2] == (3, 11) and not [*venv.rglob("nvidia")]:
        assert added == pytest.approx(sum(SIZES[name] for name in extras), rel=0.1, abs=10.0)
