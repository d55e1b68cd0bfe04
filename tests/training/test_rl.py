"""Agents begin as the paper, resume bit by bit, are scored as everything else is, and damaged files are refused."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import signal
from collections import namedtuple
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from training.rl.envs import first_seed, make_envs
from training.trials.rollouts import roll_out

import policies.agent_files
import policies.checkpoint
import training.rl.checkpoint
import training.rl.train
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import InvalidInputError, ModelFileError
from policies import TrainedAgent, ZeroPolicy
from policies.agent_files import checkpoints, find_checkpoint, read_meta
from training.cli import main
from training.rl.agent import build
from training.rl.score import score
from training.rl.settings import CURVE_SEED, HELD_OUT_SEED, RLConfig
from training.rl.train import train, train_seed

TINY: dict[str, Any] = {
    "steps": 96, "envs": 2, "episodes": 2, "curve_points": 1, "curve_episodes": 1, "rollout": 48, "warmup": 32,
    "buffer": 200, "checkpoint_every": 48,
}  # fmt: skip


@pytest.fixture(scope="module")
def ppo(tmp_path_factory):
    out = tmp_path_factory.mktemp("rl") / "ppo"
    train(RLConfig(**TINY, seeds=(0, 3)), out)
    return out


@pytest.fixture(scope="module")
def sac(tmp_path_factory):
    out = tmp_path_factory.mktemp("rl") / "sac"
    train_seed(RLConfig(**TINY, algorithm="sac").resolved(), out / "seed-0", 0, False)
    return out


def test_a_run_leaves_a_report_and_no_pickle(ppo):
    report = json.loads((ppo / "rl.json").read_text())
    assert list(report["rows"]) == ["zero", "learned", "previous", "ppo/initial_force"]
    assert report["rows"]["ppo/initial_force"]["seeds"] == 2
    assert report["rows"]["ppo/initial_force"]["episodes"] == 4
    assert report["rows"]["zero"]["iterations"]["n"] == 200
    assert [one["steps"] for one in report["training"]["ppo/initial_force"]] == [96, 96]
    text = (ppo / "rl.md").read_text()
    assert "PPO, adjusts the start" in text
    assert "quick" not in text
    assert (ppo / "learning_curve.png").stat().st_size > 10_000
    assert {path.suffix for path in ppo.rglob("*") if path.is_file() and "tfevents" not in path.name} == {
        ".json", ".md", ".png", ".npz", ".safetensors",
    }  # fmt: skip
    assert len(list(ppo.rglob("*tfevents*"))) == 2
    for path in ppo.rglob("*.npz"):
        with np.load(path, allow_pickle=False) as file:
            assert all(file[name].dtype != object for name in file.files)


def events(folder):
    """{name: steps} of the TensorBoard files of a seed."""
    found = EventAccumulator(str(folder / "tensorboard"))
    found.Reload()
    return {name: [event.step for event in found.Scalars(name)] for name in found.Tags()["scalars"]}


def test_every_update_is_logged_at_its_own_step(ppo, sac):
    found = events(ppo / "seed-3")
    assert found["rollout/iterations"] == [48, 96]
    assert found["train/loss"] == found["train/std"] == [48, 96]  # the last one, too
    assert found["score/iterations"] == [0, 96]
    found = events(sac / "seed-0")
    assert found["score/iterations"] == [0, 96]
    assert found["train/critic_loss"] == [96]


def test_sources_pickle_nothing():
    root = Path(training.rl.train.__file__).parent
    for path in (*root.glob("*.py"), *root.parents[1].glob("policies/agent*.py")):
        source = path.read_text()
        assert not re.search(
            r"import pickle|torch\.(save|load)\(|allow_pickle=True|(PPO|SAC|VecNormalize)\.load", source
        ), path


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_training_begins_at_the_paper(algorithm):
    config = RLConfig(**TINY, algorithm=algorithm).resolved()
    envs = make_envs(config.env_settings, config.envs, config.gamma)
    agent = build(config, envs, 0)
    envs.seed(0)
    envs.reset()
    mine = score(training.rl.train._Live(agent, envs), config.env_settings, range(5, 7))
    paper = score(ZeroPolicy(), config.env_settings, range(5, 7))
    assert mine["mean_iterations"] == pytest.approx(paper["mean_iterations"], rel=0.05)
    shaken = agent.predict(np.zeros((500, 83), dtype=np.float32), deterministic=False)[0]
    assert shaken.std() == pytest.approx(config.deviation, rel=0.1)
    envs.close()


def test_an_agent_is_filmed_in_its_own_environment(ppo, tmp_path, capsys):
    film = tmp_path / "agent.png"
    words = ["demo", "--agent", str(ppo / "seed-3"), "--video", str(film), "--seconds", "0.1", "--size", "160", "160"]
    assert main(words) == 0
    assert capsys.readouterr().out.startswith("held 0.1 s")
    assert film.stat().st_size > 2000
    assert main([*words, "--hand", "three_finger"]) != 0  # it sees other numbers
    assert "observation must be (83,)" in capsys.readouterr().err


def test_the_agent_is_stable_baselines3s_and_is_scored_by_the_same_evaluator(ppo, sac):
    for folder, algorithm in ((ppo, "ppo"), (sac, "sac")):
        agent = TrainedAgent.load(folder / "seed-0")
        config = RLConfig(**TINY, algorithm=algorithm).resolved()  # type: ignore[arg-type]
        envs = make_envs(config.env_settings, config.envs, config.gamma)
        theirs = build(config, envs, 1)
        training.rl.checkpoint.Training(folder / "seed-0", config, 0, theirs, envs).resume()
        envs.training = False
        seen = envs.reset()
        raw: Any = envs.get_original_obs()
        np.testing.assert_allclose(agent.predict(raw)[0], theirs.predict(seen, deterministic=True)[0], atol=1e-6)  # type: ignore[arg-type]
        np.testing.assert_allclose(agent.predict(raw[0])[0], agent.predict(raw)[0][0], atol=1e-7)
        assert np.abs(agent.predict(raw, deterministic=False)[0]).max() <= 1.0
        envs.close()
        rolled = roll_out("random", "linear_combination", HELD_OUT_SEED, policy=agent)
        mine = score(agent, config.env_settings, range(HELD_OUT_SEED, HELD_OUT_SEED + 1))
        np.testing.assert_array_equal(rolled["iterations"], mine["iterations"])
        assert rolled["reward"].sum() == pytest.approx(mine["return"][0])
    env = Monitor(FourFingerGrasp(disturbance="random", duration=0.1))
    assert evaluate_policy(agent, env, n_eval_episodes=1)[0] > 0.0  # type: ignore[arg-type]
    env.close()
    with pytest.raises(InvalidInputError, match="observation must be"):
        agent.predict(np.zeros(59))


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_two_resumes_from_one_checkpoint_are_equal_bit_by_bit(algorithm, ppo, sac, tmp_path):
    found = []
    config = RLConfig(**{**TINY, "steps": 192}, algorithm=algorithm).resolved()
    for name in ("one", "two"):
        folder = tmp_path / name
        shutil.copytree((ppo if algorithm == "ppo" else sac) / "seed-0", folder)
        before = find_checkpoint(folder)
        old = load_file(before / "policy.safetensors")
        found.append(train_seed(config, folder, 0, True))
        assert read_meta(found[-1])["steps"] == 192
        assert checkpoints(folder / "checkpoints") == [found[-1]]  # the older one is gone
    for stem in ("policy", "optimiser"):
        one, two = (load_file(path / f"{stem}.safetensors") for path in found)
        assert one.keys() == two.keys()
        for key, value in one.items():
            assert value.tobytes() == two[key].tobytes(), key
        assert stem == "optimiser" or any(not np.array_equal(value, old[key]) for key, value in one.items())
    stems = ("normaliser", "state", *(("replay",) if algorithm == "sac" else ()))
    for stem in stems:
        one, two = (np.load(path / f"{stem}.npz", allow_pickle=False) for path in found)
        for key in one.files:
            assert one[key].tobytes() == two[key].tobytes(), key
    curves = [[{**point, "seconds": 0} for point in read_meta(path)["curve"]] for path in found]
    assert curves[0] == curves[1]
    assert [point["steps"] for point in curves[0]][-1] == 192


def test_a_finished_run_says_so_and_others_are_refused(ppo, sac, tmp_path, capsys):
    same = ["--rollout", "48", "--warmup", "32", "--buffer", "200"]
    arguments = ["rl", "--out", str(ppo), "--steps", "96", "--envs", "2", *same]
    assert main([*arguments, "--resume"]) == 0
    assert "is finished, 96 steps" in capsys.readouterr().err
    assert main(arguments) == 2
    assert "holds a finished run" in capsys.readouterr().err
    shutil.copytree(sac, tmp_path / "sac")
    with pytest.raises(InvalidInputError, match="unfinished training: add --resume"):
        train(RLConfig(**TINY, algorithm="sac"), tmp_path / "sac")
    more = RLConfig(**{**TINY, "steps": 200}, algorithm="sac", learning_rate=0.1)
    with pytest.raises(InvalidInputError, match=r"learning_rate 0.0005, now 0.1"):
        train(more, tmp_path / "sac", resume=True)
    with pytest.raises(ModelFileError, match="no checkpoint of seeds"):
        train(RLConfig(**TINY), tmp_path / "new", resume=True)


def test_runs_are_compared_in_one_report(ppo, sac, tmp_path, capsys):
    assert main(["rl", "--compare", str(ppo), "--out", str(tmp_path / "all"), "--episodes", "1"]) == 0
    report = json.loads((tmp_path / "all/rl.json").read_text())
    assert [one["seed"] for one in report["training"]["ppo/initial_force"]] == [0, 3]
    assert main(["rl", "--compare", str(sac), "--out", str(tmp_path / "none")]) == 2  # it never finished
    assert "is not a finished run" in capsys.readouterr().err


def test_an_interrupt_leaves_a_whole_checkpoint_to_go_on_from(tmp_path, monkeypatch, capsys):
    real, handler = (
        training.rl.train.score,
        signal.getsignal(signal.SIGINT),
    )  # ignored, where a background job runs the tests

    def interrupted(*arguments: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return real(*arguments)

    arguments = ["rl", "--out", str(tmp_path / "cut"), "--envs", "2", "--rollout", "48", "--episodes", "1"]
    arguments += ["--curve-episodes", "1", "--curve-points", "1", "--steps"]
    monkeypatch.setattr(training.rl.train, "score", interrupted)
    assert main([*arguments, "96"]) == 130
    monkeypatch.undo()
    assert read_meta(find_checkpoint(tmp_path / "cut/seed-0"))["steps"] == 0
    assert signal.getsignal(signal.SIGINT) is handler
    for steps in (96, 144):  # the second goes on from a finished run
        assert main([*arguments, str(steps), "--resume"]) == 0
        assert read_meta(find_checkpoint(tmp_path / "cut/seed-0"))["steps"] == steps
    assert json.loads((tmp_path / "cut/run.json").read_text())["config"]["steps"] == 144


def _meta(folder: Path, **changes: Any) -> None:
    """Changes agent.json and signs it anew, as a forger would."""
    meta = {**json.loads((folder / "agent.json").read_text()), **changes}
    body = {name: value for name, value in meta.items() if name != "sha256"}
    (folder / "agent.json").write_text(json.dumps({**body, "sha256": policies.checkpoint.signature(body)}))


def _pickled(folder: Path) -> None:
    np.savez(folder / "normaliser.npz", mean=np.array([{}], dtype=object), allow_pickle=True)  # type: ignore[arg-type]
    files = json.loads((folder / "agent.json").read_text())["files"]
    digest = hashlib.sha256((folder / "normaliser.npz").read_bytes()).hexdigest()
    _meta(folder, files={**files, "normaliser.npz": digest})


def _cut(name: str) -> Any:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:-7])


def _other_byte(name: str) -> Any:
    def change(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        data[len(data) // 2] ^= 1
        (folder / name).write_bytes(bytes(data))

    return change


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_cut("policy.safetensors"), "does not match its sha256"),
        (_other_byte("policy.safetensors"), "does not match its sha256"),
        (_cut("normaliser.npz"), "does not match its sha256"),
        (_other_byte("normaliser.npz"), "does not match its sha256"),
        (_cut("agent.json"), "is not JSON"),
        (lambda folder: (folder / "agent.json").write_text("[]"), "has schema None"),
        (lambda folder: (folder / "policy.safetensors").unlink(), "No such file"),
        (lambda folder: (folder / "agent.json").unlink(), "holds no agent"),
        (lambda folder: _meta(folder, schema="grasp-force/rl-agent/0"), "this version reads"),
        (lambda folder: _meta(folder, env_id="FourFingerGrasp-v1"), "was trained on 'FourFingerGrasp-v1'"),
        (lambda folder: _meta(folder, observation_size=59), "sees 59 numbers"),
        (lambda folder: _meta(folder, action="contact_force"), "gives 6 numbers"),
        (lambda folder: _meta(folder, algorithm="td3"), "incomplete or malformed"),
        (lambda folder: _meta(folder, files=None), "does not match its sha256"),
        (
            lambda folder: (folder / "agent.json").write_text(
                (folder / "agent.json").read_text().replace('"steps": 96', '"steps": 97')
            ),
            "does not match its own sha256",
        ),
        (_pickled, "allow_pickle=False|malformed"),
    ],
)
def test_damaged_files_are_refused(ppo, tmp_path, damage, message):
    folder = tmp_path / "agent"
    shutil.copytree(find_checkpoint(ppo / "seed-0"), folder)
    damage(folder)
    with pytest.raises(ModelFileError, match=message):
        TrainedAgent.load(folder)


def test_no_room_and_no_folder_are_said_before_work(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInputError, match="cannot write to"):
        train(RLConfig(**TINY), tmp_path / "file" / "run")
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(training.rl.checkpoint.shutil, "disk_usage", lambda path: usage(10**9, 10**9 - 10**6, 10**6))
    with pytest.raises(InvalidInputError, match="1 MB free, this training needs up to"):
        train(RLConfig(**TINY), tmp_path / "full")


def test_a_write_that_fails_keeps_the_older_checkpoint(ppo, tmp_path, monkeypatch):
    shutil.copytree(ppo / "seed-0/checkpoints", tmp_path / "checkpoints")
    real = Path.write_bytes

    def full(path: Path, data: bytes) -> int:
        if path.suffix == ".npz":
            raise OSError(28, "No space left on device")
        return real(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(ModelFileError, match="No space left"):
        policies.agent_files.write_checkpoint(tmp_path / "checkpoints", 500, {}, {}, {"a": {"b": np.zeros(3)}})
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["step-000000096"]
    assert TrainedAgent.load(tmp_path / "checkpoints").meta["steps"] == 96


def test_training_never_sees_the_episodes_that_score():
    seeds = np.array([first_seed(seed, steps) for seed in range(50) for steps in range(0, 10**6, 10**5)])
    assert seeds.min() >= 2**30 > max(CURVE_SEED, HELD_OUT_SEED) + 10**6
    assert len(set(seeds)) == len(seeds)


@pytest.mark.parametrize(
    "wrong",
    [
        {"steps": 0}, {"envs": 0}, {"seed": -1}, {"seeds": (1, 1)}, {"gamma": 1.0}, {"learning_rate": float("nan")},
        {"deviation": 2.0}, {"warmup": -1},
    ],
)  # fmt: skip
def test_wrong_settings(wrong):
    with pytest.raises(InvalidInputError):
        RLConfig(**wrong)


def test_help(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["rl", "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert all(option in text for option in ("--algorithm", "--seeds", "--resume", "--quick", "--out", "--steps"))
