"""Training of agents (`grasp rl`) with checkpoints, and scores beside other policies."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env.inputs.extras import need

with need("sim", "train", "report"):
    from rich.console import Console
    from rich.progress import Progress
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.logger import configure

    from training.evaluation.report.rl_page import claims
    from training.evaluation.results.shards import map_shards
    from training.evaluation.results.table import join, pd, table

from grasp_env.errors import InvalidInputError, ModelFileError
from policies import TrainedAgent
from policies.agent_files import checkpoints, find_checkpoint, read_meta
from training.evaluation.results import Run, understood
from training.evaluation.results.bars import progress
from training.evaluation.results.interrupts import interruptible
from training.rl.agent import build, first_seed, make_envs
from training.rl.baselines import baselines
from training.rl.checkpoint import FOLDER, Training, check_settings, check_space
from training.rl.rl_config import CURVE_SEED, HELD_OUT_SEED, RLConfig
from training.rl.score import score
from training.rl.speed import speeds

STOP = ".stop"
"""File in a run's folder that makes trainings save and end; workers ignore interrupts."""


@dataclass(frozen=True)
class Shard:
    """One job: train and score (seed, folder), score only (folder), or a baseline (neither)."""

    name: str
    config: RLConfig
    folder: Path | None = None
    seed: int | None = None


def rows_of(shard: Shard, bar: Progress | None = None) -> pd.DataFrame:
    """Finish the training of a shard and score it; this runs in a worker.

    Returns:
        Rows of the held-out episodes (case "held_out"), of those along the learning curve ("curve";
        for the zero policy the same episodes), and one row with the cost of training ("training").
    """
    config = shard.config
    name = shard.name
    folder = shard.folder
    keys = {"environment": config.env, "agent": name}
    extra = list[dict[str, Any]]()
    if folder is not None:
        if shard.seed is not None:
            resume = bool(checkpoints(folder / FOLDER))
            train_seed(config, folder, shard.seed, resume, bar, folder.parent / STOP)
        policy = TrainedAgent.load(folder)
        meta = policy.meta
        settings = meta["env_settings"]
        keys["training_seed"] = meta["seed"]
        cost = {
            "training_steps": meta["steps"],
            "seconds": meta["seconds"],
            "cpu_seconds": meta["cpu_seconds"],
        }
        extra = [{"case": "curve", **row} for row in meta["curve"]] + [{"case": "training", **cost}]
    else:
        policy, settings = baselines(config)[name].made(config)
        if name == "zero":
            curve = score(policy, settings, range(CURVE_SEED, CURVE_SEED + config.curve_episodes))
            extra = [{"case": "curve", **row} for row in curve if "return" in row]
    scores = score(policy, settings, range(HELD_OUT_SEED, HELD_OUT_SEED + config.episodes))
    return table({**keys, **row} for row in [{"case": "held_out", **row} for row in scores] + extra)


def train(config: RLConfig, out: Path, resume: bool = False, on: str = "") -> Run:
    """Train every seed and score the agents beside the baselines, in the run's folder `out`.

    With `resume` each seed continues from its last complete checkpoint. For `on` see `map_shards`;
    empty: inline for one seed, else one process with one thread per seed.

    Raises:
        InvalidInputError: no such environment; the folder cannot be written, holds another or a
            finished run, or its disk is too full.
        ModelFileError: a damaged checkpoint.
        KeyboardInterrupt: interrupted; every seed in training saves its last update.
    """
    config = config.resolved()
    settings = config.env_settings
    folders = {seed: out / f"seed-{seed}" for seed in config.seeds}
    begun = [folder for folder in folders.values() if checkpoints(folder / FOLDER)]
    if resume:
        for seed, folder in folders.items():
            if folder in begun:
                check_settings(folder, config, seed)
    finished = out / "run.json"
    if resume and finished.is_file():
        with understood(out, "choose another --out"):
            done = Run(out).read_json("run.json")["config"]
            complete = config.steps <= done["steps"] and set(config.seeds) <= set(done["seeds"])
        if complete:
            Console(stderr=True).print(
                f"{out} is finished, {done['steps']} steps: nothing is left to train; a larger --steps continues"
            )
            return Run(out)
        finished.unlink()
    run = Run.create(out.parent, out.name)
    if begun and not resume:
        raise InvalidInputError(
            f"{begun[0]} holds an unfinished training: add --resume, or choose another --out"
        )
    if resume and not begun:
        raise ModelFileError(
            f"{out} holds no checkpoint of seeds {config.seeds}: leave --resume out"
        )
    check_space(out, config)
    run.write_json("config.json", {**asdict(config), "env_settings": settings})
    name = f"{config.algorithm}/{config.action}"
    shards = {
        folder.name: Shard(name, config, folder.absolute(), seed)
        for seed, folder in folders.items()
    }
    return _finish(run, shards, config, on or ("inline" if len(shards) == 1 else "processes"))


def compare(folders: Sequence[Path], out: Path, config: RLConfig, on: str = "") -> Run:
    """Score the agents of several runs, and measure how fast they act and train in this process.

    The episodes are counted by `config`. For `on`, where agents are scored, see `map_shards`;
    empty: processes.

    Raises:
        InvalidInputError: a folder is no finished run or holds no agent, or `out` cannot be
            written.
    """
    runs = [Run.open(folder).folder for folder in folders]
    metas = {
        seed: read_meta(find_checkpoint(seed))
        for folder in runs
        for seed in sorted(folder.glob("seed-*"))
    }
    if not metas:
        raise InvalidInputError(
            f"no trained agent in {', '.join(map(str, folders))}: name folders of `grasp rl`"
        )
    config = config.resolved()
    shards = dict[str, Shard]()
    for seed, meta in metas.items():  # the zero policy plays the episodes of the agents' curves
        names = ("algorithm", "action", "env", "envs", "rollout", "curve_episodes")
        kept = {name: meta["config"][name] for name in names}
        same = replace(config, **kept, learning_rate=0.0, gamma=-1.0, deviation=0.0).resolved()
        shards[str(seed)] = Shard(f"{meta['algorithm']}/{meta['action']}", same, seed.absolute())
    run = Run.create(out.parent, out.name)
    kinds = {(shard.config.env, shard.name): shard.config for shard in shards.values()}
    rates = [
        {"environment": env, "agent": name, **row}
        for (env, name), kind in ({} if config.quick else kinds).items()
        for row in speeds(kind)
    ]
    return _finish(run, shards, config, on or "processes", rates)


def _finish(
    run: Run,
    shards: dict[str, Shard],
    config: RLConfig,
    on: str,
    speed_rows: Sequence[dict[str, Any]] = (),
) -> Run:
    """Train and score agents, score the baselines in the same environments, and save the run."""
    others = {
        f"{name} {shard.config.env}": Shard(name, shard.config)
        for shard in shards.values()
        for name in baselines(shard.config)
    }
    jobs = shards | others
    stop = run.path(STOP)
    stop.unlink(missing_ok=True)
    if on == "inline":
        with progress() as bar:  # also shows steps
            tracked = bar.track(jobs.values(), description="agents")
            rows = join([rows_of(job, bar) for job in tracked])
    else:
        try:
            with interruptible(orderly=False):
                rows, _ = map_shards(rows_of, jobs, on=on, label="agents")
        except KeyboardInterrupt:
            stop.touch()
            raise
    if speed_rows:
        rows = join([rows, table(speed_rows)])
    metas = [read_meta(find_checkpoint(shard.folder)) for shard in shards.values() if shard.folder]
    keys = ("algorithm", "action", "seed", "steps", "config", "env_settings", "provenance")
    agents = [{key: meta[key] for key in keys} for meta in metas]
    about = {"kind": "rl", "quick": config.quick, "config": asdict(config), "agents": agents}
    named = claims(f"{agent['algorithm']}/{agent['action']}" for agent in agents)
    run.save(rows, {**about, "claims": [asdict(claim) for claim in named]})
    return run


def train_seed(
    config: RLConfig,
    folder: Path,
    seed: int,
    resume: bool,
    bar: Progress | None = None,
    stop: Path | None = None,
) -> Path:
    """Train one agent to `config.steps`, from the start or from its checkpoint.

    `config` is resolved, `folder` receives checkpoints and TensorBoard events, and `bar` shows the
    steps. If the file `stop` exists, it interrupts the training as ctrl-C does.

    Returns:
        The last checkpoint.

    Raises:
        KeyboardInterrupt: interrupted; the last update's checkpoint is saved.
    """
    if resume and read_meta(find_checkpoint(folder))["steps"] >= config.steps:
        return find_checkpoint(folder)
    envs = make_envs(config.env_settings, config.envs, config.gamma)
    try:
        training = Training(folder, config, seed, build(config, envs, seed), envs)
        envs.seed(first_seed(seed, 0))  # replaces stable-baselines3's seeds
        if resume:
            training.resume()
        logger = configure(str(folder / "tensorboard"), ["tensorboard"])
        agent = training.agent
        agent.set_logger(logger)
        try:
            with interruptible() as interrupted:
                stopped = stop.exists if stop else lambda: False
                watch = _Watch(training, lambda: interrupted() or stopped(), bar)
                # PPO counts updates, SAC episodes
                interval = 1 if config.algorithm == "ppo" else config.envs
                options = {"log_interval": interval, "reset_num_timesteps": False}
                agent.learn(config.steps - agent.num_timesteps, watch, **options)
                return watch.finish()
        finally:
            logger.close()
    finally:
        envs.close()


class _Watch(BaseCallback):
    """Callback between updates: it scores, saves checkpoints, and ends after an interrupt."""

    def __init__(
        self, training: Training, interrupted: Callable[[], bool], bar: Progress | None
    ) -> None:
        super().__init__()
        self._training = training
        self._interrupted = interrupted
        self._bar = bar
        config = training.config
        done = training.agent.num_timesteps
        self._mark = _clock()
        self._saved = done
        label = f"{config.algorithm} {config.action} seed {training.seed}"
        self._task = bar.add_task(label, total=config.steps, completed=done) if bar else None

    def finish(self) -> Path:
        """Add the last score and save the last checkpoint."""
        self._score()
        path = self._save()
        if self._interrupted():
            raise KeyboardInterrupt
        return path

    def _on_rollout_start(self) -> None:
        config = self._training.config
        curve = self._training.curve
        steps = self.num_timesteps
        # the update comes after the log row of its rollout, so it gets its own
        if config.algorithm == "ppo":
            self.logger.dump(steps)
        if not curve or steps - curve[-1]["training_steps"] >= config.steps / config.curve_points:
            self._score()
        if self._interrupted() or steps - self._saved >= config.checkpoint_every:
            self._save()
        if self._interrupted():
            raise KeyboardInterrupt

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            self.logger.record_mean("rollout/iterations", float(info["iterations"]))
        if self._bar is not None and self._task is not None:
            done = min(self.num_timesteps, self._training.config.steps)
            self._bar.update(self._task, completed=done)
        return True

    def _score(self) -> None:
        training, steps = self._training, self.num_timesteps
        if training.curve and training.curve[-1]["training_steps"] == steps:
            return
        self._tick()
        seeds = range(CURVE_SEED, CURVE_SEED + training.config.curve_episodes)
        rows = score(training, training.config.env_settings, seeds)
        ends = [row for row in rows if "return" in row]
        point = {name: np.mean([row[name] for row in ends]) for name in ("return", "held")}
        point |= {"length": len(rows) / len(ends)}
        if iterations := [row["iterations"] for row in rows if "iterations" in row]:
            point |= {"iterations": np.mean(iterations), "median_iterations": np.median(iterations)}
        for name, value in point.items():
            self.logger.record(f"score/{name}", float(value))
        self.logger.dump(steps)  # now, not at the end of the next rollout
        now = {"training_steps": steps, "seconds": round(float(training.spent[0]), 2)}
        training.curve += [{**row, **now} for row in ends]
        self._mark = _clock()  # the time of scores does not count

    def _save(self) -> Path:
        self._saved = self.num_timesteps
        self._tick()
        return self._training.save()

    def _tick(self) -> None:
        now = _clock()
        self._training.spent += now - self._mark
        self._mark = now


def _clock() -> np.ndarray:
    """Return (wall, processor) time [s]; other programs on the machine do not change the second."""
    return np.array([time.perf_counter(), time.process_time()])
