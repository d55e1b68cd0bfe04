"""Agents begin as the paper, resume bit by bit, and are scored."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import training.rl.rl_config as rl_config
import training.rl.speed
import training.rl.train
from grasp_env.config import EnvConfig
from grasp_env.config.env import as_config
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import GraspError, InvalidInputError
from grasp_env.grasp import Grasp
from policies import TrainedAgent, ZeroPolicy, agent_files
from policies.agent_files import ENV_ID, checkpoints, find_checkpoint, read_meta
from training.data.episodes import EpisodeStep
from training.evaluation.report import rl_page as page
from training.evaluation.results import Run
from training.evaluation.results.claims import Claim
from training.evaluation.results.columns import TIMES
from training.evaluation.results.shards import map_shards
from training.evaluation.results.statistics import iqm
from training.evaluation.results.table import pd, summary
from training.program.cli import main
from training.rl.agent import build, first_seed, make_envs, resting_action
from training.rl.baselines import GRIPS
from training.rl.checkpoint import Training
from training.rl.rl_config import CURVE_SEED, HELD_OUT_SEED, RLConfig
from training.rl.score import outcome, score
from training.rl.train import STOP, Shard, rows_of, train, train_seed

SHORT = '{"duration": 0.4}'
BALL = '{"hand": "three_finger", "shape": "sphere", "size": [0.08], "duration": 0.1}'
TINY: dict[str, Any] = {
    "steps": 96,
    "envs": 2,
    "episodes": 2,
    "curve_points": 1,
    "curve_episodes": 1,
    "rollout": 48,
    "warmup": 32,
    "buffer": 200,
    "checkpoint_every": 48,
    "env": SHORT,
}
SET = ("envs", "rollout", "warmup", "buffer", "env")
WORDS = ["rl", *(word for name in SET for word in (f"--{name}", str(TINY[name])))]


@pytest.fixture(scope="module")
def ppo(tmp_path_factory):
    out = tmp_path_factory.mktemp("rl") / "ppo"
    train(RLConfig(**TINY, seeds=(0, 3)), out, on="inline")
    return out


@pytest.fixture(scope="module")
def sac(tmp_path_factory):
    out = tmp_path_factory.mktemp("rl") / "sac"
    train_seed(RLConfig(**TINY, algorithm="sac").resolved(), out / "seed-0", 0, False)
    return out


def training_of(folder: Path, algorithm: str) -> Training:
    """Resume from a checkpoint with an agent that was made with another seed."""
    config = RLConfig(**TINY, algorithm=algorithm).resolved()
    envs = make_envs(config.env_settings, config.envs, config.gamma)
    resumed = Training(folder, config, 0, build(config, envs, 1), envs)
    resumed.resume()
    return resumed


def steps_of(folder: Path) -> int:
    return read_meta(find_checkpoint(folder))["steps"]


def test_rows_are_repeated_by_the_environment(ppo):
    rows, about = Run(ppo).load()
    held_out = rows[rows["case"] == "held_out"]
    assert (about["kind"], about["quick"]) == ("rl", False)
    assert [(one["seed"], one["steps"]) for one in about["agents"]] == [(0, 96), (3, 96)]
    sizes = held_out.groupby(["agent", "seed"], sort=False)["step"].count()
    agents = ("ppo/initial_force", "zero", "learned", "previous")
    assert sizes.index.tolist() == [
        (agent, HELD_OUT_SEED + k) for agent in agents for k in range(2)
    ]
    assert sizes.tolist() == [40] * 2 + [20] * 6  # two training seeds
    # of agents and of the zero policy
    assert {*rows[rows["case"] == "curve"]["seed"]} == {CURVE_SEED}
    env: Any = gym.make(f"grasp_env:{ENV_ID}", config=RLConfig(env=SHORT).env_settings)
    mine = held_out[(held_out["agent"] == "zero") & (held_out["seed"] == HELD_OUT_SEED + 1)]
    total = 0.0
    env.reset(seed=HELD_OUT_SEED + 1)
    for iterations in mine["iterations"]:
        _, reward, _, _, info = env.step(np.zeros(6))
        assert info["iterations"] == iterations
        total += reward
    env.close()
    end = mine.iloc[-1]
    assert (end["return"], end["mean_iterations"]) == pytest.approx(
        (total, mine["iterations"].mean())
    )
    for path in ppo.rglob("*.npz"):
        with np.load(path, allow_pickle=False) as file:
            assert all(file[name].dtype != object for name in file.files)


def test_processes_train_as_one_process_does(ppo, tmp_path):
    shard = Shard(
        "ppo/initial_force", RLConfig(**TINY, seeds=(0, 3)).resolved(), tmp_path / "seed-3", 3
    )
    alone, _ = map_shards(rows_of, {"seed-3": shard}, workers=1)
    rows = Run(ppo).load()[0]
    beside = rows[rows["training_seed"] == 3].dropna(axis=1, how="all").reset_index(drop=True)
    times = [name for name in TIMES if name in beside]
    pd.testing.assert_frame_equal(
        alone.drop(columns=times), beside.drop(columns=times), check_exact=True
    )


def test_the_page_is_made_of_the_rows(ppo):
    rows = Run(ppo).load()[0]
    label = {name: text for name, (text, _) in page.AGENTS.items()}
    scores = page.scores_table(rows, summary(rows)).set_index("policy")
    assert scores.index.tolist() == [
        label[name] for name in ("zero", "learned", "previous", "ppo/initial_force")
    ]
    assert scores.loc[label["ppo/initial_force"], "held"].startswith("4 of 4 [")
    assert scores.loc[label["zero"], "of the paper's"] == "1 [1, 1]"
    held_out = rows[rows["case"] == "held_out"]
    medians = held_out.groupby("agent")["mean_iterations"].median()
    ratio = float(scores.loc[label["previous"], "of the paper's"].split()[0])
    assert ratio == pytest.approx(medians["previous"] / medians["zero"], rel=1e-2)
    returns = held_out[held_out["agent"] == "ppo/initial_force"]["return"].dropna().to_numpy(float)
    assert float(scores.loc[label["ppo/initial_force"], "return"].split()[0]) == pytest.approx(
        iqm(returns), rel=1e-2
    )


def test_an_episode_is_held_only_if_it_ends_well():
    info = {
        "iterations": 3,
        "commanded_force": np.full((4, 3), 2.0),
        "torque_share": 0.25,
        "drift": 0.004,
    }
    info |= {"fault": "", "is_success": True}
    first = EpisodeStep(0.5, {**info, "drift": 0.01, "iterations": 5}, False)
    last = EpisodeStep(0.25, info, True)
    assert outcome([first, last]) == {
        "held": True,
        "failure": None,
        "return": 0.75,
        "mean_iterations": 4.0,
        "commanded_force": 8.0,
        "torque_share": 0.25,
        "drift": pytest.approx(10.0),
        "end_drift": pytest.approx(4.0),
    }
    lost = outcome([first, last._replace(info={**info, "is_success": False, "fault": "slid"})])
    assert (lost["held"], lost["failure"]) == (False, "slid")
    assert (lost["drift"], lost["return"]) == (None, 0.75)


def test_the_last_update_is_logged(ppo):
    events = EventAccumulator(str(ppo / "seed-3" / "tensorboard")).Reload()
    assert [event.step for event in events.Scalars("train/loss")] == [48, 96]


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_training_begins_at_the_paper(algorithm, tmp_path):
    config = RLConfig(**TINY, algorithm=algorithm).resolved()
    envs = make_envs(config.env_settings, config.envs, config.gamma)
    agent = build(config, envs, 0)
    envs.seed(0)
    envs.reset()
    beginner = Training(tmp_path, config, 0, agent, envs)
    mine, paper = (
        score(policy, config.env_settings, range(5, 7)) for policy in (beginner, ZeroPolicy())
    )
    for one, other in zip(mine, paper, strict=True):
        if "mean_iterations" in one:
            assert one["mean_iterations"] == pytest.approx(other["mean_iterations"], rel=0.05)
    envs.close()


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
@pytest.mark.parametrize("hand", ["four_finger", "allegro"])
def test_contact_forces_begin_at_rest(algorithm, hand):
    """An untrained agent holds the object without a disturbance; equal forces throw it."""
    env = json.dumps(
        {"disturbance": "none", "duration": 0.1, "hand": hand, "shape": "sphere", "size": [0.06]}
    )
    config = RLConfig(
        **{**TINY, "env": env}, algorithm=algorithm, action="contact_force"
    ).resolved()
    assert config.env_settings["reward"]["fault_cost"] == 0.0
    envs = make_envs(config.env_settings, config.envs, config.gamma)
    agent = build(config, envs, 0)
    plain: Any = envs.venv
    inner: Any = plain.envs[0].unwrapped
    action = resting_action(inner)
    _, info = inner.reset(seed=0)
    scale = inner.config.agent.action_scale
    force = scale * action.reshape(-1, 3) + [scale, 0.0, 0.0]
    grasp = inner._loop.grasp(inner.scene.look().points, inner.scene.look().normals)
    # at rest the measured forces balance within 1 %
    assert grasp.residual(force, info["wrench"]) < 0.02 * np.linalg.norm(info["wrench"])
    assert force[:, 0].max() == pytest.approx(1.5 * scale)
    assert grasp.cone_margin(force) > 0.0
    held = []
    for zeros in (False, True):
        seen, _ = inner.reset(seed=0)
        lost = False
        steps = 0
        while not lost and steps < 5:
            acted = (
                np.zeros(12, np.float32) if zeros else agent.predict(seen, deterministic=True)[0]
            )
            seen, _, lost, _, _ = inner.step(acted)
            steps += 1
        held.append((steps, lost))
    assert held[0] == (5, False)
    assert held[1][1]
    envs.close()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"mass": 1.0}, "do not hold the object at rest: raise them"),
        ({"agent": {"action_scale": 1.0}}, "at most 2 N, by agent.action_scale 1 N"),
        ({"limits": {"max_force": 1.0}}, "at most 1 N, .* limits.max_force 1.0"),
    ],
)
def test_contact_forces_that_cannot_hold_are_refused(settings, message):
    config = RLConfig(**{**TINY, "env": json.dumps(settings)}, action="contact_force").resolved()
    envs = make_envs(config.env_settings, config.envs, config.gamma)
    with pytest.raises(GraspError, match=message):
        build(config, envs, 0)
    envs.close()


def test_resting_forces_on_random_objects():
    """Objects, hands and ranges of actions at random, under a wrench from the first tick on."""
    rng = np.random.default_rng(0)
    held = 0
    for k in range(12):
        env = FourFingerGrasp(
            hand=("four_finger", "allegro", "leap", "three_finger")[k % 4],
            shape="sphere",
            size=(float(rng.uniform(0.055, 0.075)),),
            mass=float(rng.uniform(0.05, 0.4)),
            friction=float(rng.uniform(0.5, 1.0)),
            disturbance=("constant", "paper_path", "random")[k % 3],
            action_mode="contact_force",
            agent={"action_scale": float(rng.uniform(2.0, 10.0))},
        )
        try:
            action = resting_action(env)
        except InvalidInputError:  # of at most two, see below
            continue
        finally:
            env.close()
        held += 1
        _, info = env.reset(seed=0)
        seen = env.scene.look()
        scale = env.config.agent.action_scale
        force = scale * action.reshape(-1, 3) + [scale, 0.0, 0.0]
        grasp = Grasp.from_contacts(seen.points, seen.normals, info["object_friction"])
        weight = [*(info["object_mass"] * seen.rotation.T @ env.scene.gravity), 0.0, 0.0, 0.0]
        assert grasp.residual(force, weight) < 1e-9 * np.linalg.norm(force)
        assert grasp.cone_margin(force) > 0.0
        env.close()
    assert held >= 10


def test_squeeze_is_saved_at_equal_success_only():
    def scores(**rows: tuple[float, float]) -> pd.DataFrame:
        values = np.array(list(rows.values()))
        columns = {"commanded_force_mean": values[:, 0], "held_mean": values[:, 1]}
        return pd.DataFrame(columns, [name.replace("_", " ") for name in rows])

    fixed = {"margin_0.5": (20.0, 1.0), "margin_0.7": (10.0, 0.8), "margin_0.3": (30.0, 1.0)}
    for held, saved in ((1.0, 0.4), (0.9, 0.2), (0.8, -0.2), (0.7, np.nan)):
        found = page.squeeze_saved(scores(**fixed, agent=(12.0, held)), "agent")
        assert found == pytest.approx(saved, nan_ok=True)
    for held, saved in ((1.0, 0.25), (0.9, 0.25), (0.8, np.nan)):
        found = page.squeeze_saved(scores(zero=(8.0, 0.9), agent=(6.0, held)), "agent")
        assert found == pytest.approx(saved, nan_ok=True)


def test_baselines_earn_the_rewards_of_the_agent():
    config = RLConfig(action="contact_force").resolved()
    _, settings = GRIPS["zero"].made(config)
    assert (settings.reward.fault_cost, settings.agent.action_mode) == (0.0, "initial_force")


def test_learning_rates_of_ppo_fall_to_a_tenth():
    config = RLConfig(**TINY).resolved()
    envs = make_envs(config.env_settings, config.envs, config.gamma)
    agent = build(config, envs, 0)
    assert [agent.lr_schedule(left) for left in (1.0, 0.0)] == [1e-3, 1e-4]
    envs.close()


def test_settings_of_the_environment_come_before_usual_ones():
    """An agent of contact forces has no cost of a fault, unless the environment gives one."""
    cost = RLConfig(action="contact_force", env='{"reward": {"fault_cost": 3.0}}').env_settings
    assert cost["reward"]["fault_cost"] == 3.0
    assert RLConfig(action="residual").env_settings["reward"]["fault_cost"] == 10.0


def test_the_agent_is_stable_baselines3s(ppo, sac, tmp_path, capsys):
    for folder, algorithm in ((ppo / "seed-0", "ppo"), (sac / "seed-0", "sac")):
        agent = TrainedAgent.load(folder)
        theirs = training_of(folder, algorithm)
        raw = np.random.default_rng(0).normal(size=(2, 83))
        seen = theirs.envs.normalize_obs(raw)
        assert np.abs(seen - raw).max() > 0.1  # the normaliser was restored
        expected = theirs.agent.predict(seen, deterministic=True)[0]
        np.testing.assert_allclose(agent.predict(raw)[0], expected, atol=1e-6)
        np.testing.assert_array_equal(theirs.predict(raw)[0], expected)
        assert np.abs(agent.predict(raw, deterministic=False)[0]).max() <= 1.0
        theirs.envs.close()
    words = f"demo --agent {ppo / 'seed-3'} --video {tmp_path / 'a.png'} --seconds 0.1 --size 64 64"
    assert main(words.split()) == 0
    assert capsys.readouterr().out.startswith("held 0.1 s")


def checkpoint(folder: Path) -> dict[str, Any]:
    """The bytes of a checkpoint's files, and its counters."""
    meta = read_meta(folder)
    curve = [{**row, "seconds": 0} for row in meta["curve"]]
    files = {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix != ".json"}
    return {**files, **{name: meta[name] for name in ("seed", "steps", "updates")}, "curve": curve}


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_two_resumes_are_equal(algorithm, ppo, sac, tmp_path):
    source = (ppo if algorithm == "ppo" else sac) / "seed-0"
    old = find_checkpoint(source)
    resumed = training_of(source, algorithm)
    seeds: Any = resumed.envs.venv
    # other episodes than those before
    assert seeds._seeds == [first_seed(0, 96), first_seed(0, 96) + 1]
    resumed.envs.close()
    resumed.folder = tmp_path / "again"
    # nothing was lost on the way into the agent
    assert checkpoint(resumed.save()) == checkpoint(old)
    found = []
    for name in ("one", "two"):
        shutil.copytree(source, tmp_path / name)
        path = train_seed(
            RLConfig(**{**TINY, "steps": 144}, algorithm=algorithm).resolved(),
            tmp_path / name,
            0,
            True,
        )
        assert checkpoints(tmp_path / name / "checkpoints") == [path]  # the older one is gone
        found.append(checkpoint(path))
    assert found[0] == found[1]
    assert all(found[0][name] != value for name, value in checkpoint(old).items() if name != "seed")
    assert [row["training_steps"] for row in read_meta(path)["curve"]] == [0, 96, 144]


def test_finished_and_foreign_runs_are_refused(ppo, sac, tmp_path, capsys):
    words = [*WORDS, "--steps", "96"]
    assert main([*words, "--out", str(ppo), "--resume"]) == 0
    assert "is finished, 96 steps" in capsys.readouterr().err
    assert main([*words, "--out", str(ppo)]) == 2
    assert "holds a finished run" in capsys.readouterr().err
    assert main(["rl", "--compare", str(sac), "--out", str(tmp_path / "none")]) == 2
    assert "is not a finished run" in capsys.readouterr().err
    shutil.copytree(sac, tmp_path / "sac")
    (tmp_path / "file").write_text("")
    for changes, name, resume, message in (
        ({"algorithm": "sac"}, "sac", False, "unfinished training: add --resume"),
        ({"algorithm": "sac", "learning_rate": 0.1}, "sac", True, r"learning_rate 0.0005, now 0.1"),
        ({}, "new", True, "no checkpoint of seeds"),
        ({}, "file/run", False, "cannot write to"),
        ({"seeds": (1, 1)}, "never", False, "seeds must be different"),
        ({"gamma": 1.0}, "never", False, "gamma below 1"),
        ({"env": "{"}, "never", False, "not JSON"),
        ({"env": "UncertanGrasp"}, "never", False, "did you mean .UncertainGrasp"),
        ({"env": '{"form": 1}'}, "never", False, "form"),
        ({"env": '{"action_mode": "none"}'}, "never", False, "leave it out"),
    ):
        with pytest.raises(GraspError, match=message):
            train(RLConfig(**{**TINY, **changes}), tmp_path / name, resume=resume)
    assert not (tmp_path / "never").exists()


def test_runs_are_compared(ppo, tmp_path, monkeypatch):
    monkeypatch.setattr(training.rl.speed, "STEPS", 48)
    monkeypatch.setattr(training.rl.speed, "ROUNDS", 1)
    ball = tmp_path / "ball"
    config = RLConfig(**{**TINY, "env": BALL, "steps": 48}).resolved()
    sizes = RLConfig(env='{"hand": "allegro"}').sizes
    assert sizes == {"fingers": 4, "joints": 16, "observation_size": 87, "action_size": 6}
    train(config, ball)
    agent = TrainedAgent.load(ball / "seed-0")
    assert as_config(agent.meta["env_settings"]) == EnvConfig().override(
        disturbance="random", action_mode="initial_force", **json.loads(BALL)
    )
    words = f"rl --on inline --episodes 1 --compare {ppo} {ball} --out {tmp_path / 'all'}"
    assert main(words.split()) == 0
    rows, about = Run(tmp_path / "all").load()
    held_out = rows[rows["case"] == "held_out"]
    agents = (
        held_out[held_out["agent"] == "ppo/initial_force"]
        .groupby("environment")["training_seed"]
        .unique()
    )
    assert {place: seeds.tolist() for place, seeds in agents.items()} == {SHORT: [0, 3], BALL: [0]}
    assert held_out["seed"].unique().tolist() == [HELD_OUT_SEED]
    # each has its baselines
    assert held_out.groupby("environment")["agent"].nunique().to_dict() == {SHORT: 4, BALL: 4}
    assert [one["seed"] for one in about["agents"]] == [0, 3, 0]
    first = Claim(**about["claims"][0])
    assert len(first.values(summary(rows))) == 2  # in both environments
    assert {claim["name"].split(":")[0] for claim in about["claims"]} == {"PPO, adjusts the start"}


def test_interrupts_leave_a_whole_checkpoint(tmp_path, monkeypatch):
    real = training.rl.train.score
    handler = signal.getsignal(signal.SIGINT)

    def interrupted(*arguments: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return real(*arguments)

    few = "--episodes 1 --curve-episodes 1 --curve-points 1"
    out = tmp_path / "cut"
    words = [word.replace("0.4", "0.1") for word in WORDS] + few.split()
    with monkeypatch.context() as patch:
        patch.setattr(training.rl.train, "score", interrupted)
        assert main([*words, "--out", str(out), "--steps", "48"]) == 130
    assert steps_of(out / "seed-0") == 0
    assert signal.getsignal(signal.SIGINT) is handler
    for steps in (48, 96):  # the second continues a finished run
        assert main([*words, "--out", str(out), "--steps", str(steps), "--resume"]) == 0
        assert steps_of(out / "seed-0") == steps
    assert Run(out).load()[1]["config"]["steps"] == 96


def test_seeds_end_with_the_run(tmp_path, monkeypatch):
    config = RLConfig(**TINY, seeds=(0, 1))
    out = tmp_path / "run"
    monkeypatch.setattr(
        training.rl.train,
        "map_shards",
        lambda *given, **options: signal.raise_signal(signal.SIGTERM),
    )
    with pytest.raises(KeyboardInterrupt):
        train(config, out)
    assert (out / STOP).exists()
    with pytest.raises(KeyboardInterrupt):  # as in a worker
        rows_of(Shard("ppo/initial_force", config.resolved(), out / "seed-1", 1))
    assert steps_of(out / "seed-1") == 0


def test_training_never_sees_the_episodes_that_score():
    seeds = np.array(
        [first_seed(seed, steps) for seed in range(50) for steps in range(0, 10**6, 10**5)]
    )
    assert seeds.min() >= 2**30 > max(CURVE_SEED, HELD_OUT_SEED) + 10**6
    assert len(set(seeds)) == len(seeds)


def test_baselines_solve_and_rewards_are_whole():
    config = RLConfig(**{**TINY, "episodes": 1}, action="contact_force").resolved()
    rows = rows_of(Shard("zero", config))
    played = rows[rows["case"] == "held_out"]
    assert played["held"].iloc[-1]
    assert (played["iterations"] > 0).all()
    config = RLConfig().resolved()
    envs = make_envs(config.env_settings, 2, config.gamma)
    envs.seed(0)
    envs.reset()
    rewards = np.array([envs.step(np.zeros((2, 6), np.float32))[1] for _ in range(60)])[40:]
    envs.close()
    assert rewards.min() > 0.0  # not centred and above 10: a clip would make them equal
    assert len(np.unique(rewards)) == rewards.size


def test_agents_of_a_named_environment_stand_beside_fixed_grips(tmp_path, capsys):
    few = {**TINY, "env": "UncertainGrasp", "steps": 32, "rollout": 16, "episodes": 1}
    run = train(RLConfig(**few), tmp_path / "grip", on="inline")
    rows, about = run.load()
    held_out = rows[rows["case"] == "held_out"]
    assert about["agents"][0]["action"] == "grip"
    assert tuple(rl_config.ACTIONS) == agent_files.ACTIONS
    assert {*held_out["agent"]} == {"ppo/grip", *GRIPS}
    ends = held_out[held_out["held"].notna()].set_index("agent")
    force = ends["commanded_force"]
    assert force["margin 0.3"] > force["margin 0.5"] > force["margin 0.85"]
    assert force["squeeze 60 N"] == pytest.approx(60.0, abs=1.0)
    # the margin of the settings
    assert force["zero"] == force["margin 0.6"]
    assert not {"ppo/initial_force", "sac/grip"} & {*rows["agent"]}
    text = page.scores_text(rows)
    assert "PPO, sets the grip" in text
    assert "margin 0.85" in text
