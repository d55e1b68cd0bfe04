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

import gymnasium as gym
import numpy as np
import pytest
from matplotlib.figure import Figure
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import policies.agent_files
import policies.checkpoint
import training.rl.checkpoint
import training.rl.speed
import training.rl.train
from grasp_env.config import EnvConfig, as_config
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import InvalidInputError, ModelFileError, UnknownSettingError
from policies import TrainedAgent, ZeroPolicy
from policies.agent_files import ENV_ID, checkpoints, find_checkpoint, read_meta
from training.cli import main
from training.report import rl as page
from training.results import Run
from training.results.columns import TIMES
from training.results.table import pd, summary
from training.rl.agent import build, first_seed, make_envs
from training.rl.score import outcome, score
from training.rl.settings import CURVE_SEED, HELD_OUT_SEED, RLConfig
from training.rl.train import STOP, Shard, rows_of, train, train_seed

TINY: dict[str, Any] = {
    "steps": 96, "envs": 2, "episodes": 2, "curve_points": 1, "curve_episodes": 1, "rollout": 48, "warmup": 32,
    "buffer": 200, "checkpoint_every": 48,
}  # fmt: skip

BALL = '{"hand": "allegro", "shape": "sphere", "size": [0.06], "friction": 0.7, "mass": 0.15}'


@pytest.fixture(scope="module")
def ppo(tmp_path_factory):
    out = tmp_path_factory.mktemp("rl") / "ppo"
    train(RLConfig(**TINY, seeds=(0, 3)), out)  # a process for each
    return out


@pytest.fixture(scope="module")
def sac(tmp_path_factory):
    out = tmp_path_factory.mktemp("rl") / "sac"
    train_seed(RLConfig(**TINY, algorithm="sac").resolved(), out / "seed-0", 0, False)
    return out


def training_of(folder: Path, algorithm: str) -> training.rl.checkpoint.Training:
    """Resumed from its checkpoint, by an agent that was made with another seed."""
    config = RLConfig(**TINY, algorithm=algorithm).resolved()  # type: ignore[arg-type]
    envs = make_envs(config.env_settings, config.envs, config.gamma)
    resumed = training.rl.checkpoint.Training(folder, config, 0, build(config, envs, 1), envs)
    resumed.resume()
    return resumed


def test_a_run_leaves_rows_and_no_pickle(ppo):
    rows, about = Run(ppo).load()
    held_out = rows[rows["case"] == "held_out"]
    assert (about["kind"], about["quick"]) == ("rl", False)
    assert [(one["seed"], one["steps"]) for one in about["agents"]] == [(0, 96), (3, 96)]
    sizes = held_out.groupby(["agent", "seed"], sort=False)["step"].count()
    assert sizes.index.tolist() == [
        (agent, HELD_OUT_SEED + k) for agent in ("ppo/initial_force", "zero", "learned", "previous") for k in range(2)
    ]
    assert sizes.tolist() == [200] * 2 + [100] * 6  # two training seeds
    assert held_out["held"].count() == 10  # one outcome for each episode
    # what an environment says of the paper's start, step by step
    env: Any = gym.make(f"grasp_env:{ENV_ID}", config=RLConfig().env_settings)
    mine, total = held_out[(held_out["agent"] == "zero") & (held_out["seed"] == HELD_OUT_SEED + 1)], 0.0
    env.reset(seed=HELD_OUT_SEED + 1)
    for iterations in mine["iterations"]:
        _, reward, _, _, info = env.step(np.zeros(6))
        assert info["iterations"] == iterations
        total += reward
    env.close()
    end = mine.iloc[-1]
    assert (end["return"], end["mean_iterations"]) == pytest.approx((total, mine["iterations"].mean()))
    kinds = {path.suffix for path in ppo.rglob("*") if path.is_file() and "tfevents" not in path.name}
    assert kinds <= {".json", ".npz", ".safetensors", ".parquet", ".csv", ".html"}
    for path in ppo.rglob("*.npz"):
        with np.load(path, allow_pickle=False) as file:
            assert all(file[name].dtype != object for name in file.files)
    root = Path(training.rl.train.__file__).parent
    for path in (*root.glob("*.py"), *root.parents[1].glob("policies/agent*.py")):
        unsafe = r"import pickle|torch\.(save|load)\(|allow_pickle=True|(PPO|SAC|VecNormalize)\.load"
        assert not re.search(unsafe, path.read_text()), path


def test_processes_train_as_one_process_does(ppo, tmp_path):
    alone = rows_of(Shard("ppo/initial_force", RLConfig(**TINY, seeds=(0, 3)).resolved(), tmp_path / "seed-3", 3))
    rows = Run(ppo).load()[0]
    beside = rows[rows["training_seed"] == 3].dropna(axis=1, how="all").reset_index(drop=True)
    times = [name for name in TIMES if name in beside]
    pd.testing.assert_frame_equal(alone.drop(columns=times), beside.drop(columns=times), check_exact=True)


def test_the_page_is_made_of_the_rows(ppo):
    rows = Run(ppo).load()[0]
    label = {name: told for name, (told, _) in page.AGENTS.items()}
    scores, trained = (
        function(rows, summary(rows)).set_index(head)
        for (_, _, function), head in zip(page.TABLES[:2], ("policy", "seed"), strict=True)
    )
    assert scores.index.tolist() == [label[name] for name in ("zero", "learned", "previous", "ppo/initial_force")]
    assert scores.loc[label["ppo/initial_force"], "held"].startswith("4 of 4 [")
    assert scores.loc[label["zero"], "of the paper's"] == "1 [1, 1]"
    medians = rows[rows["case"] == "held_out"].groupby("agent")["mean_iterations"].median()
    ratio = float(scores.loc[label["previous"], "of the paper's"].split()[0])
    assert ratio == pytest.approx(medians["previous"] / medians["zero"], rel=1e-2)
    assert ratio < 0.5
    assert trained["environment steps"].to_dict() == {0: 96, 3: 96}
    figures = [function(rows, summary(rows)) for _, _, function in page.FIGURES]
    assert [isinstance(figure, Figure) for figure in figures] == [True, False, True]  # no agent without solver
    # agents without solver have no iterations, and an object that is lost counts as an episode
    lost = rows.assign(agent=rows["agent"].replace("ppo/initial_force", "sac/contact_force"))
    lost.loc[lost["agent"] == "sac/contact_force", ["iterations", "mean_iterations", "drift"]] = pd.NA
    lost["held"] = lost["held"].where((lost["seed"] != HELD_OUT_SEED) | lost["held"].isna(), False)
    row = page.scores_table(lost, summary(lost)).set_index("policy").loc[label["sac/contact_force"]]
    assert row["held"].startswith("2 of 4 [")
    assert pd.isna(row["of the paper's"])


def test_an_episode_is_held_only_where_it_ends_well():
    step = namedtuple("step", "reward info last")
    info = {
        "iterations": 3,
        "commanded_force": np.full((4, 3), 2.0),
        "torque_share": 0.25,
        "drift": 0.004,
        "fault": "",
        "is_success": True,
    }
    first, last = step(0.5, {**info, "drift": 0.01, "iterations": 5}, False), step(0.25, info, True)
    told = outcome([first, last])
    assert told == {"held": True, "failure": None, "return": 0.75, "mean_iterations": 4.0, "commanded_force": 8.0,
                    "torque_share": 0.25, "drift": pytest.approx(10.0), "end_drift": pytest.approx(4.0)}  # fmt: skip
    told = outcome([first, step(0.25, {**info, "is_success": False, "fault": "slid"}, True)])
    assert (told["held"], told["failure"], told["drift"], told["return"]) == (False, "slid", None, 0.75)


def events(folder):
    """{name: steps} of the TensorBoard files of a seed."""
    found = EventAccumulator(str(folder / "tensorboard"))
    found.Reload()
    return {name: [event.step for event in found.Scalars(name)] for name in found.Tags()["scalars"]}


def test_every_update_is_logged_at_its_own_step(ppo, sac):
    found = events(ppo / "seed-3")
    assert found["rollout/iterations"] == [48, 96]
    assert found["train/loss"] == found["train/std"] == [48, 96]  # the last one, too
    assert found["score/iterations"] == found["score/held"] == [0, 96]
    found = events(sac / "seed-0")
    assert found["score/iterations"] == [0, 96]
    assert found["train/critic_loss"] == [96]


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_training_begins_at_the_paper(algorithm, tmp_path):
    config = RLConfig(**TINY, algorithm=algorithm).resolved()
    envs = make_envs(config.env_settings, config.envs, config.gamma)
    agent = build(config, envs, 0)
    envs.seed(0)
    envs.reset()
    beginner = training.rl.checkpoint.Training(tmp_path, config, 0, agent, envs)
    mine, paper = (score(policy, config.env_settings, range(5, 7)) for policy in (beginner, ZeroPolicy()))
    for one, other in zip(mine, paper, strict=True):
        if "mean_iterations" in one:
            assert one["mean_iterations"] == pytest.approx(other["mean_iterations"], rel=0.05)
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


def test_the_agent_is_stable_baselines3s(ppo, sac):
    for folder, algorithm in ((ppo / "seed-0", "ppo"), (sac / "seed-0", "sac")):
        agent, theirs = TrainedAgent.load(folder), training_of(folder, algorithm)
        raw = np.random.default_rng(0).normal(size=(2, 83))
        seen = theirs.envs.normalize_obs(raw)
        assert np.abs(seen - raw).max() > 0.1  # the normaliser came along
        expected = theirs.agent.predict(seen, deterministic=True)[0]
        np.testing.assert_allclose(agent.predict(raw)[0], expected, atol=1e-6)
        np.testing.assert_array_equal(theirs.predict(raw)[0], expected)
        np.testing.assert_allclose(agent.predict(raw[0])[0], agent.predict(raw)[0][0], atol=1e-6)
        assert np.abs(agent.predict(raw, deterministic=False)[0]).max() <= 1.0
        theirs.envs.close()
    env = Monitor(FourFingerGrasp(disturbance="random", duration=0.1))
    assert evaluate_policy(agent, env, n_eval_episodes=1)[0] > 0.0  # type: ignore[arg-type]
    env.close()
    with pytest.raises(InvalidInputError, match="observation must be"):
        agent.predict(np.zeros(59))


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_two_resumes_from_one_checkpoint_are_equal_bit_by_bit(algorithm, ppo, sac, tmp_path):
    source = (ppo if algorithm == "ppo" else sac) / "seed-0"
    old, resumed = find_checkpoint(source), training_of(source, algorithm)
    seeds: Any = resumed.envs.venv
    assert seeds._seeds == [first_seed(0, 96), first_seed(0, 96) + 1]  # other episodes than those before
    resumed.envs.close()
    resumed.folder = tmp_path / "again"
    assert checkpoint(resumed.save()) == checkpoint(old)  # nothing was lost on the way into the agent
    found = []
    for name in ("one", "two"):
        shutil.copytree(source, tmp_path / name)
        path = train_seed(RLConfig(**{**TINY, "steps": 192}, algorithm=algorithm).resolved(), tmp_path / name, 0, True)
        assert checkpoints(tmp_path / name / "checkpoints") == [path]  # the older one is gone
        found.append(checkpoint(path))
    assert found[0] == found[1]
    assert all(found[0][name] != value for name, value in checkpoint(old).items() if name != "seed")
    assert [row["training_steps"] for row in read_meta(path)["curve"]] == [0, 96, 192]


def checkpoint(folder: Path) -> dict[str, Any]:
    """The bytes of a checkpoint's files, and what it counts."""
    meta = read_meta(folder)
    curve = [{**row, "seconds": 0} for row in meta["curve"]]
    files = {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix != ".json"}
    return {**files, **{name: meta[name] for name in ("seed", "steps", "updates")}, "curve": curve}


def test_a_finished_run_says_so_and_others_are_refused(ppo, sac, tmp_path, capsys):
    arguments = [
        "rl",
        "--out",
        str(ppo),
        "--envs",
        "2",
        "--rollout",
        "48",
        "--warmup",
        "32",
        "--buffer",
        "200",
        "--steps",
        "96",
    ]
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


def test_runs_are_compared_in_one_report(ppo, sac, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(training.rl.speed, "STEPS", 48)
    ball = tmp_path / "ball"
    train(RLConfig(**TINY, env=BALL), ball)
    arguments = ["rl", "--on", "inline", "--episodes", "1", "--compare"]
    assert main([*arguments, str(ppo), str(ball), "--out", str(tmp_path / "all")]) == 0
    rows, about = Run(tmp_path / "all").load()
    held_out = rows[rows["case"] == "held_out"]
    agents = held_out[held_out["agent"] == "ppo/initial_force"].groupby("environment")["training_seed"].unique()
    assert {place: seeds.tolist() for place, seeds in agents.items()} == {"{}": [0, 3], BALL: [0]}
    assert held_out["seed"].unique().tolist() == [HELD_OUT_SEED]
    assert held_out.groupby("environment")["agent"].nunique().to_dict() == {
        "{}": 4,
        BALL: 4,
    }  # each beside its own paper
    assert [one["seed"] for one in about["agents"]] == [0, 3, 0]
    assert rows[rows["case"] == "with training"].groupby("environment")["per_second"].count().to_dict() == {
        "{}": 3,
        BALL: 3,
    }
    scores, _, speed = (function(rows, summary(rows)) for _, _, function in page.TABLES)
    assert scores["environment"].unique().tolist() == ["cuboid", "sphere, allegro"]
    assert (speed[list(page.SPEEDS)] > 0).all(axis=None)
    assert len(page.CLAIMS[0].values(summary(rows))) == 2  # in both environments
    assert main([*arguments, str(sac), "--out", str(tmp_path / "none")]) == 2  # it never finished
    assert "is not a finished run" in capsys.readouterr().err


def test_an_interrupt_leaves_a_whole_checkpoint_to_go_on_from(tmp_path, monkeypatch):
    real, handler = (
        training.rl.train.score,
        signal.getsignal(signal.SIGINT),
    )  # ignored, where a background job runs the tests

    def interrupted(*arguments: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return real(*arguments)

    out, arguments = tmp_path / "cut", ["rl", "--envs", "2", "--rollout", "48", "--episodes", "1"]
    arguments += ["--out", str(out), "--curve-episodes", "1", "--curve-points", "1", "--steps"]
    with monkeypatch.context() as patch:
        patch.setattr(training.rl.train, "score", interrupted)
        assert main([*arguments, "96"]) == 130
    assert read_meta(find_checkpoint(out / "seed-0"))["steps"] == 0
    assert signal.getsignal(signal.SIGINT) is handler
    for steps in (96, 144):  # the second goes on from a finished run
        assert main([*arguments, str(steps), "--resume"]) == 0
        assert read_meta(find_checkpoint(out / "seed-0"))["steps"] == steps
    assert Run(out).load()[1]["config"]["steps"] == 144


def test_seeds_in_other_processes_save_and_end_where_the_run_is_interrupted(tmp_path, monkeypatch):
    config, out = RLConfig(**TINY, seeds=(0, 1)), tmp_path / "run"

    def interrupted(*arguments: Any, **options: Any) -> Any:
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(training.rl.train, "map_shards", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(config, out)
    assert (out / STOP).exists()
    with pytest.raises(KeyboardInterrupt):  # what a worker does then
        rows_of(Shard("ppo/initial_force", config.resolved(), out / "seed-1", 1))
    assert read_meta(find_checkpoint(out / "seed-1"))["steps"] == 0
    train(config, out, resume=True, on="inline")
    assert [read_meta(find_checkpoint(out / f"seed-{seed}"))["steps"] for seed in (0, 1)] == [96, 96]


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


def _changed(name: str, change: Any) -> Any:
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


def _other_byte(data: bytes) -> bytes:
    return data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 1]) + data[len(data) // 2 + 1 :]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_changed("policy.safetensors", lambda data: data[:-7]), "does not match its sha256"),
        (_changed("normaliser.npz", _other_byte), "does not match its sha256"),
        (_changed("agent.json", lambda data: data[:-7]), "is not JSON"),
        (_changed("agent.json", lambda data: b"[]"), "has schema None"),
        (_changed("agent.json", lambda data: data.replace(b'"steps": 96', b'"steps": 97')), "not match its own sha256"),
        (lambda folder: (folder / "policy.safetensors").unlink(), "No such file"),
        (lambda folder: (folder / "agent.json").unlink(), "holds no agent"),
        (lambda folder: _meta(folder, schema="grasp-force/rl-agent/0"), "this version reads"),
        (lambda folder: _meta(folder, env_id="FourFingerGrasp-v1"), "was trained on 'FourFingerGrasp-v1'"),
        (lambda folder: _meta(folder, observation_size=59), "goes from 59 numbers to 6"),
        (lambda folder: _meta(folder, action="contact_force"), "83 numbers to 6; .* takes 12"),
        (lambda folder: _meta(folder, algorithm="td3"), "incomplete or malformed"),
        (lambda folder: _meta(folder, files=None), "does not match its sha256"),
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
        {"deviation": 2.0}, {"warmup": -1}, {"buffer": 0}, {"curve_points": 0}, {"rollout": 10**10},
    ],
)  # fmt: skip
def test_wrong_settings(wrong):
    with pytest.raises(InvalidInputError):
        RLConfig(**wrong)
    assert RLConfig(warmup=0, seed=0).warmup == 0


def test_an_agent_is_trained_in_any_environment(tmp_path):
    config = RLConfig(**TINY, env=BALL).resolved()
    assert config.sizes == {"fingers": 4, "joints": 16, "observation_size": 87, "action_size": 6}
    train(config, tmp_path / "run")
    agent = TrainedAgent.load(tmp_path / "run" / "seed-0")
    made = EnvConfig().override(disturbance="random", **json.loads(BALL))
    assert as_config(agent.meta["env_settings"]) == made
    rows = pd.read_parquet(tmp_path / "run" / "rows.parquet")
    assert set(rows[rows["case"] == "held_out"]["agent"]) == {"ppo/initial_force", "zero", "learned", "previous"}
    env = gym.make(f"grasp_env:{ENV_ID}", config=agent.meta["env_settings"])
    assert env.observation_space.contains(env.reset(seed=0)[0])
    assert agent.predict(env.reset(seed=0)[0])[0].shape == env.action_space.shape
    env.close()


@pytest.mark.parametrize(
    ("env", "message"),
    [("{", "not JSON"), ("[]", "env must be"), ('{"form": 1}', "form"), ('{"action_mode": "none"}', "leave it out")],
)
def test_an_environment_that_cannot_be_made_is_refused_before_training(env, message, tmp_path):
    with pytest.raises((InvalidInputError, UnknownSettingError), match=message):
        train(RLConfig(**TINY, env=env), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_baselines_solve_whatever_the_agents_do():
    rows = rows_of(Shard("zero", RLConfig(**{**TINY, "episodes": 1}, action="contact_force").resolved()))
    played = rows[rows["case"] == "held_out"]
    assert played["held"].iloc[-1]
    assert (played["iterations"] > 0).all()


def test_normalised_rewards_differ():
    """A clip would make them equal: they are not centred, and lie above 10."""
    config = RLConfig().resolved()
    envs = make_envs(config.env_settings, 2, config.gamma)
    envs.seed(0)
    envs.reset()
    rewards = np.array([envs.step(np.zeros((2, 6), np.float32))[1] for _ in range(60)])[40:]
    envs.close()
    assert rewards.min() > 0.0
    assert len(np.unique(rewards)) == rewards.size
