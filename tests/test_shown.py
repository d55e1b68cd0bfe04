"""No public object is shown by its address: each has a repr of its own."""

from __future__ import annotations

import importlib
import inspect
import re
import time
from typing import Any

import numpy as np
from engines import Client, needs_bullet

from grasp_env.config import EnvConfig
from grasp_env.control.loop import ForceLoop
from grasp_env.env import FourFingerGrasp
from grasp_env.errors import shown
from grasp_env.force import ForceOptimizer, optimize_force
from grasp_env.force.rules import RULES
from grasp_env.grasp import presets
from grasp_env.sim import HandDescription, HandKinematics, Scene
from grasp_env.sim.picture.camera import Camera
from policies import LearnedInitialForce, ZeroPolicy

ROOMS = (
    "grasp_env.env",
    "grasp_env.force",
    "grasp_env.grasp",
    "grasp_env.sim",
    "grasp_env.task",
    "policies",
)
ADDRESS = re.compile("0x[0-9a-f]{6}")
WRENCH = [1.0, 0.5, -0.6, -0.1, 0.2, 0.0]


def test_public_classes_have_a_repr():
    values = [
        getattr(room, name) for room in map(importlib.import_module, ROOMS) for name in room.__all__
    ]
    for kind in filter(inspect.isclass, (*values, EnvConfig, ForceLoop)):
        own = {base for base in kind.__mro__ if "__repr__" in vars(base) and base is not object}
        assert own or getattr(kind, "_is_protocol", False), (
            f"{kind.__name__} is shown as object.__repr__ does"
        )


def test_no_object_is_shown_by_its_address():
    grasp = presets.paper_cuboid()
    model = LearnedInitialForce.pretrained()
    config = EnvConfig().resolved()
    starts: list[Any] = [
        None,
        "previous",
        model,
        lambda grasp, wrench: np.ones((4, 3)),
        np.ones((4, 3)),
    ]
    things = [
        model,
        *RULES.values(),
        *(ForceOptimizer(grasp, method="newton", initial=start) for start in starts),
        ZeroPolicy(),
        grasp,
        config,
        ForceLoop(config, model),
        HandKinematics(HandDescription.four_finger()),
        optimize_force(grasp, WRENCH, initial=model),
    ]
    for thing in (*things, object(), lambda: None, [object()], {"rule": len}):
        assert not ADDRESS.search(shown(thing))
    assert [thing for thing in things if ADDRESS.search(repr(thing) + str(thing))] == []
    assert shown("at 0x123456789") == "'at 0x123456789'"


class Unwilling:
    @property
    def shape(self) -> tuple[int, ...]:
        raise RuntimeError("no shape")

    def __repr__(self) -> str:
        raise KeyError("no repr")


def test_texts_of_anything_are_short_and_made_at_once():
    """Each of these would take seconds, or fail, if it were written whole."""
    begin = time.perf_counter()
    big = dict.fromkeys(range(1_000_000))
    made = [
        np.zeros((10_000_000, 0)),
        np.zeros(10_000_000),
        big,
        set(big),
        bytes(100_000_000),
        [big],
        memoryview(bytearray(8)),
        10**100_000,
        [Unwilling()],
        Unwilling(),
        "x" * 100_000_000,
        np.zeros(3, dtype=[(f"f{k}", float) for k in range(3000)]),
    ]
    made_in = time.perf_counter() - begin
    begin = time.perf_counter()
    texts = [shown(each) for each in made]
    assert time.perf_counter() - begin < 1.0 + made_in
    assert max(map(len, texts)) < 400
    assert texts[0] == "ndarray of shape (10000000, 0) and type float64"
    assert texts[2] == "a dict of length 1000000"
    assert "Unwilling" in texts[-3]
    assert shown(np.zeros(0)) == "[]"


@needs_bullet
def test_simulated_things_are_not_shown_by_their_address():
    scene = Scene()
    env = FourFingerGrasp()
    client = Client()
    for thing in (scene, env, client, Camera(scene)):
        assert not ADDRESS.search(repr(thing))
        assert repr(thing).startswith(type(thing).__name__)
    for thing in (env, client, scene):
        thing.close()
        assert not ADDRESS.search(repr(thing))
