"""Environments with a name of their own: `FourFingerGrasp` with settings that pose a problem."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

from grasp_env.config import EnvConfig
from grasp_env.env.env import FourFingerGrasp
from grasp_env.sim.engine import engine_of

_RATE = 1000
"""Rate of control and physics [Hz]."""
_IMPERFECT: dict[str, Any] = {
    "disturbance": "random",
    "duration": 4.0,
    "action_mode": "grip",
    "sensors": {"wrench": "estimated", "delay": 0.01, "joint_delay": 0.002},
    "controller": {"rate": _RATE, "friction_margin": 0.6, "preload": 0.5},
    # the cost of a fault exceeds what a light grip saves in an episode
    "reward": {"iterations": 0.0, "force": 0.6, "fault_cost": 50.0},
}
"""A hand with the sensors of a real one, whose grip an agent sets."""


class _Named(FourFingerGrasp):
    """Base class: `problem` holds the settings."""

    problem: ClassVar[dict[str, Any]] = {}

    def __init__(
        self,
        render_mode: str | None = None,
        config: EnvConfig | dict[str, Any] | str | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(render_mode, self.settings() if config is None else config, **settings)

    @classmethod
    def settings(cls) -> EnvConfig:
        """Return the settings of the problem."""
        engine = replace(engine_of(quiet=True), rate=_RATE)
        return EnvConfig().override(engine=engine, **cls.problem)


class UncertainGrasp(_Named):
    """Hold an object with as little force as its unknown friction and faulty motors allow.

    ## Description
    The four-finger hand holds a cuboid under a random wrench for 4 s. In each episode the friction
    is 0.4 to 0.7, and the controller believes in one that is 0 to 40 % higher. The object weighs
    0.1 to 0.4 kg, and the gains of the motors are wrong by 5 %, with 5 % of noise. Positions arrive
    10 ms late, and the wrench is estimated from the motion. A light grip slips in some episodes; a
    tight one wastes force in most.

    ## Action space
    `Box(-1, 1, (2,), float32)`: friction margin and preload, `agent.action_mode="grip"` of
    `FourFingerGrasp`. Zero is a margin of 0.6 with 0.5 N.

    ## Observation space
    `Box(-bound, bound, (91,), float32)`: as of `FourFingerGrasp`, with `tangential_share` and
    `slid` of each fingertip. The true friction is not among them.

    ## Rewards
    A step after which the object is held pays 1 less the costs: 0.6 times the share of the force
    above the least at the true friction, 0.1 times the torque and 0.1 times the change of force. The
    first fault that lasts costs 50, and no step pays after it.

    ## Starting state
    The hand holds the object at rest, without errors. Errors begin with the episode.

    ## Episode end
    Terminated if the object is lost, truncated after 200 steps (4 s).

    ## Scores
    Return, an interquartile mean over 200 episodes: random actions 100, zero actions 135, the best
    of twelve fixed margins 147, the best constant squeeze 104, SAC 151. The lightest fixed margin
    that holds all episodes is 0.5 without preload, at a mean squeeze of 9.9 N; with preload it
    takes 11.5 N. SAC holds 599 of 600 at 8.7 N.

    Args:
        render_mode: as of `FourFingerGrasp`.
        config: settings that replace those of this problem; None: those.
        **settings: changes to them, as of `FourFingerGrasp`.

    Example:
        >>> import gymnasium as gym
        >>> env = gym.make("grasp_env:UncertainGrasp-v0")
        >>> env.spec.max_episode_steps, env.action_space.shape, env.observation_space.shape
        (200, (2,), (91,))
        >>> env.close()
    """

    problem: ClassVar[dict[str, Any]] = {
        **_IMPERFECT,
        "randomize": {
            "mass": (0.1, 0.4),
            # a constant one would show the error of the friction believed in
            "friction": (0.4, 0.7),
            "controller.friction_error": (0.0, 0.4),
        },
        "motors": {"noise": 0.05, "gain_error": 0.05},
    }


class FragileGrasp(_Named):
    """Hold an object that breaks if a fingertip pushes with more than 8 N.

    ## Description
    The four-finger hand holds a ball of 50 mm and 60 g, like an egg, under a random wrench for 4 s.
    In each episode the friction is 0.3 to 0.5, the controller believes in one that is 30 % too low
    to 30 % too high, and its motors have 5 % of noise. Positions arrive 10 ms late, and the wrench
    is estimated from the motion. A light grip slips, a tight one breaks the object.

    ## Action space
    `Box(-1, 1, (2,), float32)`: friction margin and preload, `agent.action_mode="grip"` of
    `FourFingerGrasp`. Zero is a margin of 0.6 with 0.5 N.

    ## Observation space
    `Box(-bound, bound, (91,), float32)`: as of `FourFingerGrasp`, with `tangential_share` and
    `slid` of each fingertip. The true friction is not among them.

    ## Rewards
    As of `UncertainGrasp`.

    ## Starting state
    The hand holds the object at rest, without errors. Errors begin with the episode.

    ## Episode end
    Terminated if the object is lost or breaks, or at any other fault that lasts; truncated after
    200 steps (4 s).

    ## Scores
    Return, an interquartile mean over 50 episodes: random actions -49, zero actions 78, the best of
    twelve fixed margins, 0.85, 131; the best constant squeeze -42. No fixed margin holds more than
    39 of 50.

    Args:
        render_mode: as of `FourFingerGrasp`.
        config: settings that replace those of this problem; None: those.
        **settings: changes to them, as of `FourFingerGrasp`.

    Example:
        >>> import gymnasium as gym
        >>> env = gym.make("grasp_env:FragileGrasp-v0", limits={"max_force": 10.0})
        >>> env.unwrapped.config.limits.max_force, env.unwrapped.config.limits.end_at_fault
        (10.0, True)
        >>> env.close()
    """

    problem: ClassVar[dict[str, Any]] = {
        **_IMPERFECT,
        "object": {"shape": "sphere", "size": (0.05,), "mass": 0.06},
        "randomize": {"friction": (0.3, 0.5), "controller.friction_error": (-0.3, 0.3)},
        "motors": {"noise": 0.05},
        "limits": {"max_force": 8.0, "end_at_fault": True},
    }


PROBLEMS = {kind.__name__: kind for kind in (UncertainGrasp, FragileGrasp)}
"""The classes by their names."""
