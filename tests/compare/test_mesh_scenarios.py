"""Objects from mesh files in comparisons of hands: the plan, its names, and what an episode says of them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from engines import needs_bullet

from grasp_env.errors import InvalidInputError
from training.compare.holds import HoldsConfig, Shard, work
from training.compare.scenarios import LABELS, PUSHES, mesh_settings

OBJECTS = ("parts/duck.obj=0.06", "mug.stl")


def test_a_plan_of_meshes_has_a_scenario_for_each_hand_object_and_push() -> None:
    plan = HoldsConfig("objects", ("allegro", "leap"), episodes=5, objects=OBJECTS).plan()
    assert len(plan) == len({scenario.name for scenario in plan}) == 2 * 2 * len(PUSHES)
    assert {scenario.keys["object"] for scenario in plan} == {"duck", "mug"}
    assert {scenario.case for scenario in plan} <= {*LABELS}
    for scenario in plan:
        assert scenario.episodes == (5 if scenario.case == "mesh_random" else 1)
        item = scenario.settings["object"]
        assert (item["shape"], item["size"]) == ("mesh", (0.06,) if scenario.keys["object"] == "duck" else (1.0,))


@pytest.mark.parametrize(
    ("objects", "message"),
    [(("a/mug.obj", "b/mug.stl"), "objects need different names"), (("mug.obj=small",), "must be FILE or FILE=SCALE")],
)
def test_objects_have_names_and_scales_that_are_numbers(objects, message) -> None:
    with pytest.raises(InvalidInputError, match=message):
        HoldsConfig("objects", ("allegro",), objects=objects)
    assert mesh_settings("C:\\parts\\mug.stl=0.001")[0] == "mug"
    for text in ("lr=2/mug.stl=1", "lr=2/mug.stl"):
        assert mesh_settings(text)[1]["object"]["mesh"] == "lr=2/mug.stl"


@needs_bullet
def test_an_object_of_a_file_is_held_and_named(tmp_path) -> None:
    path = str(tmp_path / "brick.stl")
    trimesh.creation.box((50, 50, 50)).export(path)
    plan = HoldsConfig("objects", ("allegro",), ("bullet", "faces"), objects=(f"{path}=0.001",)).plan()
    scenario = next(scenario for scenario in plan if scenario.case == "mesh_gravity")
    rows = work(Shard(scenario, (0,)))
    assert rows["held"].all()
    assert rows["object"].tolist() == ["brick", "brick"]
    assert rows["engine"].tolist() == ["bullet", "faces"]
    np.testing.assert_allclose(rows["mass"], 0.15)
