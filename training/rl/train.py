"""`grasp rl`: train agents, one seed after another, with checkpoints that a later call goes on from."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env._extras import need

with need("sim", "train", "report"):
    from rich.console import Console
    from rich.progress import Progress
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.logger import configure
    from stable_baselines3.common.vec_env import VecNormalize

from grasp_env.errors import InvalidInputError, ModelFileError
from policies.agent_files import checkpoints, find_checkpoint, read_meta
from training.rl.agent import build
from training.rl.checkpoint import FOLDER, Training, check_settings, check_space
from training.rl.envs import first_seed, make_envs
from training.rl.evaluate import evaluate_runs
from training.rl.score import score
from training.rl.settings import CURVE_SEED, RLConfig
from training.runs import Run, provenance, understood
from training.runs.interrupts import interruptible
from training.runs.workers import progress


def train(config: RLConfig, out: Path, resume: bool = False, console: Console | None = None) -> dict[str, Any]:
    """Trains every seed, scores the agents beside the paper, and returns the metrics; all lies in `out`.

    Args:
        config: the settings.
        out: folder of the run.
        resume: go on from the last whole checkpoint of each seed.
        console: for the progress; None: stderr.

    Raises:
        InvalidInputError: the folder cannot be written, holds another or a finished run, or its disk is too full.
        ModelFileError: a checkpoint to go on from that is damaged.
        KeyboardInterrupt: interrupted; the last update's checkpoint is saved.
    """
    console = console or Console(stderr=True)
    config = config.resolved()
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
            console.print(f"{out} is finished, {done['steps']} steps: nothing is left to train; more --steps go on")
            return Run(out).read_json("rl.json")
        finished.unlink()
    run = Run.create(out.parent, out.name)
    if begun and not resume:
        raise InvalidInputError(f"{begun[0]} holds an unfinished training: add --resume, or choose another --out")
    if resume and not begun:
        raise ModelFileError(f"{out} holds no checkpoint of seeds {config.seeds}: leave --resume out")
    check_space(out, config)
    run.write_json("config.json", {**asdict(config), "env_settings": config.env_settings})
    with progress(console) as bar:
        for seed, folder in folders.items():
            train_seed(config, folder, seed, folder in begun, bar)
    report = evaluate_runs([out], out, config.episodes, config.quick, console)
    run.write_json("run.json", {"kind": "rl", **provenance(), "config": asdict(config)})
    return report


def train_seed(config: RLConfig, folder: Path, seed: int, resume: bool, bar: Progress | None = None) -> Path:
    """Trains one agent to `config.steps`, or on from its checkpoint.

    Args:
        config: resolved.
        folder: receives checkpoints and TensorBoard events.
        seed: of the training.
        resume: whether `folder` holds a checkpoint to go on from.
        bar: shows the steps; None: nothing is shown.

    Returns:
        The last checkpoint.
    """
    if resume and read_meta(find_checkpoint(folder))["steps"] >= config.steps:
        return find_checkpoint(folder)
    envs = make_envs(config.env_settings, config.envs, config.gamma)
    try:
        training = Training(folder, config, seed, build(config, envs, seed), envs)
        envs.seed(first_seed(seed, 0))  # stable-baselines3 seeded them with its own
        if resume:
            training.resume()
        logger = configure(str(folder / "tensorboard"), ["tensorboard"])
        agent = training.agent
        agent.set_logger(logger)
        try:
            with interruptible() as interrupted:
                watch = _Watch(training, interrupted, bar)
                every = 1 if config.algorithm == "ppo" else config.envs  # PPO counts updates, SAC episodes
                agent.learn(config.steps - agent.num_timesteps, watch, log_interval=every, reset_num_timesteps=False)
                return watch.finish()
        finally:
            logger.close()
    finally:
        envs.close()


class _Live:
    """The agent in training as a deterministic `Policy` on raw observations."""

    def __init__(self, agent: PPO | SAC, envs: VecNormalize) -> None:
        self._agent, self._envs = agent, envs

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        seen = self._envs.normalize_obs(np.asarray(observation))
        return self._agent.predict(seen, deterministic=deterministic)[0], state  # type: ignore[arg-type]


class _Watch(BaseCallback):
    """Between two updates: a score for the learning curve, a checkpoint, the end where an interrupt asked for it."""

    def __init__(self, training: Training, interrupted: Callable[[], bool], bar: Progress | None) -> None:
        super().__init__()
        self._training, self._interrupted, self._bar = training, interrupted, bar
        config, done = training.config, training.agent.num_timesteps
        self._spent = np.array([training.seconds, training.cpu_seconds])
        self._mark, self._saved = _clock(), done
        label = f"{config.algorithm} {config.action} seed {training.seed}"
        self._task = bar.add_task(label, total=config.steps, completed=done) if bar else None

    def finish(self) -> Path:
        """The last score and checkpoint."""
        self._score()
        path = self._save()
        if self._interrupted():
            raise KeyboardInterrupt
        return path

    def _on_rollout_start(self) -> None:
        config, curve, steps = self._training.config, self._training.curve, self.num_timesteps
        if config.algorithm == "ppo":  # an update comes after its rollout's row: give it one of its own
            self.logger.dump(steps)
        if not curve or steps - curve[-1]["steps"] >= config.steps / config.curve_points:
            self._score()
        if self._interrupted() or steps - self._saved >= config.checkpoint_every:
            self._save()
        if self._interrupted():
            raise KeyboardInterrupt

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            self.logger.record_mean("rollout/iterations", float(info["iterations"]))
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=min(self.num_timesteps, self._training.config.steps))
        return True

    def _score(self) -> None:
        training = self._training
        if training.curve and training.curve[-1]["steps"] == self.num_timesteps:
            return
        self._tick()
        seeds = range(CURVE_SEED, CURVE_SEED + training.config.curve_episodes)
        told = score(_Live(training.agent, training.envs), training.config.env_settings, seeds)
        point = {
            "iterations": float(told["iterations"].mean()),
            "median_iterations": float(np.median(told["iterations"])),
            "return": float(told["return"].mean()),
            "length": float(told["steps"].mean()),
            "held": float(told["held"].mean()),
        }
        for name, value in point.items():
            self.logger.record(f"score/{name}", value)
        self.logger.dump(self.num_timesteps)  # now, not at the end of the rollout that follows
        training.curve.append({"steps": self.num_timesteps, "seconds": round(float(self._spent[0]), 2), **point})
        self._mark = _clock()  # scores are not training time

    def _save(self) -> Path:
        self._saved = self.num_timesteps
        self._tick()
        self._training.seconds, self._training.cpu_seconds = self._spent.round(2).tolist()
        return self._training.save()

    def _tick(self) -> None:
        now = _clock()
        self._spent += now - self._mark
        self._mark = now


def _clock() -> np.ndarray:
    """(wall, processor) [s]: where programs share the cores, the second says what training costs."""
    return np.array([time.perf_counter(), time.process_time()])
