"""Meanings of an agent's actions: one entry of `MODES` for each `agent.action_mode`."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from grasp_env.config import EnvConfig
from grasp_env.control.loop import NOTHING, AgentRequest, adjustment_size
from grasp_env.inputs.arguments import Array

TIGHTEST = 0.2
"""Friction margin at action 1 of the mode "grip"."""


class ActionMode(NamedTuple):
    """A meaning of actions.

    Attributes:
        size: function of the number of fingertips: the size of an action.
        request: function (action, settings): what it asks of the controller.
        asks_with_zeros: zero actions ask something, too; else the solver acts alone.
    """

    size: Callable[[int], int]
    request: Callable[[Array, EnvConfig], AgentRequest]
    asks_with_zeros: bool = False


def _adjustment(action: Array, config: EnvConfig) -> AgentRequest:
    if len(action) == 1:  # the one squeeze of two soft contacts is not adjusted
        return NOTHING
    return AgentRequest(adjustment=config.agent.action_scale * action)


def _residual(action: Array, config: EnvConfig) -> AgentRequest:
    return AgentRequest(residual=config.agent.action_scale * action.reshape(-1, 3))


def _forces(action: Array, config: EnvConfig) -> AgentRequest:
    forces = config.agent.action_scale * action.reshape(-1, 3)
    forces[:, 0] += config.agent.action_scale
    return AgentRequest(forces=forces)


def _grip(action: Array, config: EnvConfig) -> AgentRequest:
    """Go from the margin of the settings to no margin at -1, and to a tight grip at 1."""
    controller = config.controller
    friction, preload = controller.friction_margin, controller.preload
    ends = np.array([[1.0, 0.0], [TIGHTEST, preload + config.agent.action_scale]])
    own = np.array([friction, preload])
    towards = np.where(action < 0.0, ends[0], ends[1])
    return AgentRequest(margin=own + np.abs(action) * (towards - own))


def _nothing(action: Array, config: EnvConfig) -> AgentRequest:
    return NOTHING


MODES = {
    "initial_force": ActionMode(adjustment_size, _adjustment),
    "residual": ActionMode(lambda tips: 3 * tips, _residual),
    "grip": ActionMode(lambda tips: 2, _grip, asks_with_zeros=True),
    "contact_force": ActionMode(lambda tips: 3 * tips, _forces, asks_with_zeros=True),
    "none": ActionMode(lambda tips: 1, _nothing),
}
"""The meanings of `agent.action_mode`."""
