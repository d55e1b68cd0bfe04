"""The solver installs alone; a missing extra gives one line with the command that installs it."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from grasp_env.errors import MissingExtraError
from grasp_env.inputs.extras import EXTRAS, need

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
OPTIONAL: dict[str, list[str]] = PROJECT["optional-dependencies"]


def _names(requirements: list[str]) -> set[str]:
    """Return the distributions of a list of requirements, without included extras."""
    return {re.split(r"[^\w.-]", one)[0] for one in requirements} - {"grasp-force"}


def _brought(extra: str) -> set[str]:
    """Return an extra and all extras that it includes."""
    named = re.findall(r"grasp-force\[(.*?)\]", " ".join(OPTIONAL[extra]))
    return {extra}.union(*(_brought(name) for listed in named for name in listed.split(",")))


def _without(names: tuple[str, ...], script: str) -> subprocess.CompletedProcess[str]:
    """Run a script in which these packages cannot be found."""
    start = f"""
import sys
from importlib.machinery import PathFinder
class Finder(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name in {names} else PathFinder.find_spec(name, path, target)
sys.meta_path[sys.meta_path.index(PathFinder)] = Finder
"""
    return subprocess.run(
        [sys.executable, "-c", start + script],
        cwd=ROOT,
        timeout=120,
        capture_output=True,
        text=True,
    )


ENGINE, OTHER_PYTHONS = (
    ("pybullet", ">= '3.12'") if sys.version_info < (3, 12) else ("mujoco", "< '3.12'")
)
"""Engine of the extra `sim` on this CPython, and the marker of the engine on others."""
OTHER_MACHINES = f"platform_machine {'==' if EXTRAS['sim'].count('coacd') else '!='} 'aarch64'"
NOT_IN_ALL = {"cvxpy", "mend", "ray", "video"}
"""Large ones that few need, and MeshFix, whose licence is the GPL."""
HEAVY = tuple(name for extra in ("sim", "train", "report", "video") for name in EXTRAS[extra])


def test_the_table_is_what_pip_installs():
    solver = _names(PROJECT["dependencies"])
    assert solver == {"numpy", "scipy", "safetensors"}
    homes = packages_distributions()
    for extra, modules in EXTRAS.items():
        asked = _names(
            [
                one
                for one in OPTIONAL[extra]
                if not re.search(f"{OTHER_PYTHONS}|{OTHER_MACHINES}", one)
            ]
        )
        # in no list of packages are a single compiled file and what is not installed: they bear
        # their distribution's name
        found = [
            {home.lower().replace("_", "-") for home in homes.get(name, [name])} for name in modules
        ]
        assert all(some & asked for some in found)  # MuJoCo is one module of several distributions
        assert asked <= solver.union(*found)  # an extra may ask for a later numpy
    assert _brought("all") == {"all", *EXTRAS} - NOT_IN_ALL
    assert _brought("train") == {"train", "sim", "cli", "report"}
    assert _brought("live") == {"live", "sim", "cli"}


@pytest.mark.parametrize(
    "page",
    ["README.md", *sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md"))],
)
def test_pages_install_extras_that_exist_and_torch_for_the_cpu_first(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    for command in re.finditer(r"pip install [^`\n]*\[(.*?)\]", text):
        brought = set().union(*(_brought(name) for name in command[1].split(",")))
        first = text.find("pip install torch --index-url https://download.pytorch.org/whl/cpu")
        assert "train" not in brought or 0 <= first < command.start(), command[0]


IMPORTS = {
    "import grasp_env.env": "sim",
    "import grasp_env.sim": "sim",
    "import gymnasium; gymnasium.make('grasp_env:FourFingerGrasp-v0')": "sim",
    "import policies.network": "train",
    "from policies import GraspForceLayer": "layer",
    "import training.fit.one_grasp": "train",
}


def test_imports_name_their_extra():
    """In one process, because a failed import must leave nothing behind."""
    script = f"""
for statement, extra in {IMPORTS}.items():
    try:
        exec(statement)
        print(statement, "works")
    except ImportError as error:
        name = {{"sim": "trimesh, {ENGINE}", "layer": "torch"}}.get(extra, "stable_baselines3, tensorboard, torch")
        wanted = f'this needs {{name}}: pip install "grasp-force[{{extra}}]"'
        if (type(error).__name__, str(error)) != ("MissingExtraError", wanted):
            print(statement, repr(error))
"""
    # gym.make needs gymnasium itself
    done = _without(("pybullet", "mujoco", "trimesh", *EXTRAS["train"]), script)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


def test_mp4_needs_video(monkeypatch, tmp_path):
    from training.program.film import record

    for name in EXTRAS["video"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(
        MissingExtraError,
        match=r'needs imageio_ffmpeg, moviepy: pip install "grasp-force\[video\]"',
    ):
        record(tmp_path / "hand.mp4")


COMMANDS = {
    "fit": "train",
    "fit --env {}": "sim,train",
    "rl": "sim,train,report",
    "evaluate env": "sim,report",
    "report nowhere": "report",
    "replay nowhere.csv": "sim,report",
    "reproduce": "report",
    "demo --video hand.gif": "sim",
}


def test_commands_name_their_extras_in_one_line(tmp_path):
    script = f"""
import contextlib, io, os
sys.path.insert(0, {str(ROOT)!r})
os.chdir({str(tmp_path)!r})
from training.program.cli import main
for words, extras in {COMMANDS}.items():
    with contextlib.redirect_stderr(io.StringIO()) as told:
        code = main(words.split())
    line = told.getvalue()
    if code != 2 or not line.startswith("grasp: this needs ") or not line.endswith(f': pip install "grasp-force[{{extras}}]"\\n'):
        print(words, code, line)
    if line.count("\\n") != 1:
        print(words, "more than a line")
"""
    done = _without(HEAVY, script)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert not list(tmp_path.iterdir())


def test_the_program_itself_names_its_extra():
    done = _without(
        EXTRAS["cli"],
        "from training.program.cli import main; sys.exit(main(['solve', '--wrench', *'100000']))",
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == 'grasp: this needs rich, tyro: pip install "grasp-force[cli]"\n'


def test_only_what_is_missing_is_named(monkeypatch):
    need(*({*EXTRAS} - NOT_IN_ALL))
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(MissingExtraError) as told:
        need("sim", "report")
    assert str(told.value) == 'this needs trimesh: pip install "grasp-force[sim]"'
    assert isinstance(told.value, ImportError)


def test_where_pybullet_has_no_wheel_mujoco_comes_instead_and_is_recommended():
    engines = [one for one in OPTIONAL["sim"] if re.match("pybullet|mujoco", one)]
    assert [re.sub(r">=[\d.]+", "", one) for one in engines] == [
        "pybullet; python_version < '3.12'",
        "mujoco; python_version >= '3.12'",
    ]
    script = """
import gymnasium
from grasp_env.errors import MissingExtraError
try:
    gymnasium.make("grasp_env:FourFingerGrasp-v0", engine="bullet")
except MissingExtraError as error:
    print(error)
"""
    done = _without(("pybullet",), script)
    told = (
        "CPython 3.10 and 3.11 only, and this is"
        if sys.version_info >= (3, 12)
        else "this needs pybullet: pip install"
    )
    assert told in done.stdout
    assert done.stderr == ""
