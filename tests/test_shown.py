"""Nothing that a user meets is shown by its address: every public object has a repr of its own."""

from __future__ import annotations

import importlib
import inspect
import re
from typing import Any

import numpy as np
import pytest
from engines import Client, needs_bullet

from grasp_env.config import EnvConfig
from grasp_env.control.loop import ForceLoop
from grasp_env.env import FourFingerGrasp
from grasp_env.errors import shown
from grasp_env.force import RULES, ForceOptimizer, initial_rule, optimize_force
from grasp_env.grasp import presets
from grasp_env.sim import Camera, HandDescription, HandKinematics, Scene
from grasp_env.task import DISTURBANCES
from policies import LearnedInitialForce, ZeroPolicy
from policies.agent import TrainedAgent

ROOMS = ("grasp_env.env", "grasp_env.force", "grasp_env.grasp", "grasp_env.sim", "grasp_env.task", "policies")
"""The packages that say what is public of them."""
ADDRESS = re.compile("0x[0-9a-f]{6}")
WRENCH = [1.0, 0.5, -0.6, -0.1, 0.2, 0.0]


def _classes() -> list[type]:
    values = [
        getattr(importlib.import_module(room), name) for room in ROOMS for name in importlib.import_module(room).__all__
    ]
    found = [value for value in (*values, EnvConfig, ForceLoop, TrainedAgent) if inspect.isclass(value)]
    return [kind for kind in dict.fromkeys(found) if not getattr(kind, "_is_protocol", False)]


@pytest.mark.parametrize("kind", _classes(), ids=lambda kind: kind.__name__)
def test_public_classes_say_what_they_are(kind: type) -> None:
    own = {base for base in kind.__mro__ if "__repr__" in vars(base) and base is not object}
    assert own, f"{kind.__name__} is shown as object.__repr__ does"


def _objects() -> list[Any]:
    grasp = presets.paper_cuboid()
    model = LearnedInitialForce.pretrained()
    rules = [initial_rule(name) for name in RULES]
    starts: list[Any] = [None, "previous", model, *rules, lambda grasp, wrench: np.ones((4, 3)), np.ones((4, 3))]
    config = EnvConfig().resolved()
    return [model, *rules, *RULES.values(), *(ForceOptimizer(grasp, method="newton", initial=start) for start in starts),
            ZeroPolicy(), ForceLoop(config, model),
            HandKinematics(HandDescription.four_finger()), optimize_force(grasp, WRENCH, initial=model), grasp, config]  # fmt: skip


def test_no_object_is_shown_by_its_address() -> None:
    for thing in _objects():
        for text in (repr(thing), str(thing), shown(thing)):
            assert not ADDRESS.search(text), text


@needs_bullet
def test_simulated_things_say_what_they_are() -> None:
    scene = Scene()
    env = FourFingerGrasp()
    client = Client()
    for thing in (scene, env, client, Camera(scene)):
        assert not ADDRESS.search(repr(thing))
        assert repr(thing).startswith(type(thing).__name__)
    env.close()
    client.close()
    scene.close()
    assert repr(client) == "Client(closed)"
    repr(scene), repr(env)


def test_what_was_given_is_told_without_its_address() -> None:
    for value in (object(), lambda: None, [object()], {"rule": len}, DISTURBANCES["constant"], ForceOptimizer):
        assert not ADDRESS.search(shown(value))
    assert shown("at 0x123456789") == "'at 0x123456789'"


@pytest.mark.parametrize("name", RULES)
def test_solutions_name_their_start(name: str) -> None:
    assert optimize_force(presets.tripod(), np.array(WRENCH), initial=name).initial == name
