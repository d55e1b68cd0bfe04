"""grasp.hpp has the results of the Python package, says what is wrong, and allocates nothing where it solves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_package import CORE, FLAGS, SHADOW, succeed, tool

from grasp_env import core
from grasp_env.errors import InfeasibleStartError, InfeasibleWrenchError, ModelFileError
from grasp_env.force import ForceLimits, ForceSolution, optimize_force
from grasp_env.grasp import Grasp, presets
from policies import LearnedInitialForce

WRENCH = [1, 0.5, -0.6, -0.1, 0.2, 0]
PROGRAMS = Path(__file__).parent / "programs"
OPTIMIZE = ["-O0", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math"]


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What the program printed, by the words that its lines begin with."""
    folder = tmp_path_factory.mktemp("front")
    model = LearnedInitialForce.pretrained().export(folder / "four.model", presets.paper_cuboid())
    program = folder / "front"
    flags = [*FLAGS, SHADOW["g++"], *OPTIMIZE, f"-I{CORE / 'include'}"]
    succeed(tool("g++"), *flags, PROGRAMS / "front.cpp", "-o", program)
    lines = succeed(program, model, "5000").splitlines()
    return {line.partition(":" if ":" in line else " ")[0]: line for line in lines}


def numbers(line: str) -> list[float]:
    """Code, objective, excess of limits, forces."""
    return [float(word) for word in line.partition(":")[2].split()]


def jacobian() -> np.ndarray:
    """In the object's frame; the program has it in the contacts' frames."""
    own = np.zeros((4, 3, 12))
    a, j = np.indices((3, 3))
    for i in range(4):
        own[i, :, 3 * i : 3 * i + 3] = 0.02 + 0.01 * ((a + 2 * j) % 3)
    return presets.paper_cuboid().frames @ own


LIMITS = ForceLimits(0.5, 6.0, jacobian(), 0.25)
TIGHT = ForceLimits(jacobian=jacobian(), torque_limit=0.1)
ELLIPTIC = Grasp.from_contacts(
    presets.paper_cuboid().positions, presets.paper_cuboid().normals, np.tile([0.4, 0.6], (4, 1))
)


@pytest.mark.parametrize(
    ("name", "asked"),
    [
        ("newton", {}),
        ("again", {}),
        ("from", {}),
        ("kept", {}),
        ("learned", {}),
        ("pipeline", {}),
        ("conic", {"method": "conic", "tolerance": 1e-6}),
        ("limited", {"limits": LIMITS}),
        ("elastic", {"limits": TIGHT, "elastic": True, "tolerance": 1e-4}),
        ("elliptic", {"grasp": ELLIPTIC, "force_weight": 2.0, "barrier_weight": 0.02}),
    ],
)
def test_results_are_those_of_python(said: dict[str, str], name: str, asked: dict) -> None:
    """Optima of Phi to 1e-9 lie within some 1e-5 N of each other; conic's and the excess's are flat."""
    code, objective, excess, *force = numbers(said[name])
    given = {"grasp": presets.paper_cuboid(), "method": "newton", "tolerance": 1e-9} | asked
    python: ForceSolution = optimize_force(given.pop("grasp"), WRENCH, **given)
    assert code == python._record[0]
    exact = given["tolerance"] == 1e-9
    assert objective == pytest.approx(python.objective, rel=2e-9 if exact else 2e-3)
    assert excess == pytest.approx(python.limit_excess, rel=2e-3, abs=1e-12)
    close = {"conic": 1e-4, "elastic": 0.5}.get(name, 2e-4)
    assert np.reshape(force, (4, 3)) == pytest.approx(python.force, abs=close)


@pytest.mark.parametrize(
    ("moved", "there"),
    [("limits moved there", "limits there"), ("limits followed there", "limits there"), ("moved there", "there")],
)
def test_contacts_that_moved_are_as_those_made_there(said: dict[str, str], moved: str, there: str) -> None:
    """Both to 1e-9 of the optimum, where forces lie within some 1e-5 N."""
    assert numbers(said[moved])[:2] == pytest.approx(numbers(said[there])[:2], rel=2e-9)
    assert numbers(said[moved])[3:] == pytest.approx(numbers(said[there])[3:], abs=2e-4)
    assert numbers(said[there])[1] != pytest.approx(
        numbers(said["limited" if "limits" in there else "newton"])[1], rel=1e-4
    )


def test_no_force_is_proven(said: dict[str, str]) -> None:
    code, objective, *_ = numbers(said["strict"])
    assert (code, objective) == (3, np.inf)
    with pytest.raises(InfeasibleWrenchError):
        optimize_force(presets.paper_cuboid(), WRENCH, method="newton", limits=TIGHT)


def test_what_is_no_number_is_refused(said: dict[str, str]) -> None:
    assert said["moved"] == "moved 0, then 4; back 1, then 0"
    for what in ("numbers", "sizes", "contacts"):
        assert set(said[what].split()[1:]) == {"4"}


@pytest.mark.parametrize(
    ("setup", "words"),
    [
        ("two contacts", "rank(G) < 6"),
        ("normals", "normals must be as many as positions"),
        ("length", "positions must be finite and normals of unit length"),
        ("nan", "positions must be finite and normals of unit length"),
        ("friction", "friction must be finite and >= 0"),
        ("weights", "weights must be finite and > 0"),
        ("nothing", "positions must be three numbers of each contact"),
        ("closure", "no force closure"),
        ("conic closure", "no force closure"),
        ("shared joints", "no joint may move two contacts"),
        ("jacobian", "the jacobian must be (N, 3, J)"),
        ("limits", "torque_bias must be (J,), or none"),
        ("file", "nowhere is no whole model file: LearnedInitialForce.export writes one"),
        ("three", "the model is for another number of contacts"),
    ],
)
def test_setup_says_what_is_wrong(said: dict[str, str], setup: str, words: str) -> None:
    assert words in said[setup]


def test_loops_allocate_nothing(said: dict[str, str]) -> None:
    counted = {name.removeprefix("allocations of "): line for name, line in said.items() if name.startswith("alloc")}
    assert not counted.pop("set-up").endswith(": 0, wrong: 0")  # they are seen
    assert set(counted) == {"newton", "conic", "learned", "pipeline", "limited", "elastic"}
    for line in counted.values():
        assert line.endswith(": 0, wrong: 0")


def test_a_model_comes_back_from_its_file(tmp_path: Path) -> None:
    rule, grasp = LearnedInitialForce.pretrained(), presets.paper_cuboid()
    blob = rule.export(tmp_path / "model", grasp).read_bytes()
    model = core.Model.load(blob)
    assert model is not None
    assert model.save() == blob
    rng = np.random.default_rng(0)
    spoiled = [blob[:k] for k in (0, 7, 8, 15, 16, len(blob) // 2, len(blob) - 1)] + [blob + b"0"]
    for at in rng.integers(0, len(blob), 200):
        spoiled.append(blob[:at] + bytes([blob[at] ^ 1 << int(rng.integers(8))]) + blob[at + 1 :])
    assert [core.Model.load(each) for each in spoiled] == [None] * len(spoiled)


def test_a_model_is_not_exported_for_contacts_that_it_does_not_know(tmp_path: Path) -> None:
    rule = LearnedInitialForce.pretrained()
    with pytest.raises(InfeasibleStartError, match="knows 4 contacts"):
        rule.export(tmp_path / "model", presets.tripod())
    with pytest.raises(ModelFileError):
        rule.export(tmp_path / "no folder/model", presets.paper_cuboid())
    assert not list(tmp_path.iterdir())
