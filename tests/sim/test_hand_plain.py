"""A hand survives JSON to the last bit; a wrong dict is named."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hands import gripper, make_link

from grasp_env.errors import GraspError, UnknownSettingError
from grasp_env.sim import HANDS, HandDescription
from grasp_env.sim.hand.plain import hand_of, hand_to_plain
from grasp_env.sim.hand.tree import Fingertip, Geometry, Mimic, Palm

HULL = Geometry("hull", (), corners=tuple(map(tuple, np.vstack([np.eye(3), -np.eye(3)]) / 30.0)))
DRAWN = Geometry("mesh", (1.0, 1.0, 1.0), color=(0.1, 0.2, 0.3), file="/nowhere/tip.stl")
ODD = HandDescription(
    "odd",
    Palm(visual=(DRAWN,)),
    (
        make_link("a", lower=-np.inf, upper=np.inf, collision=(HULL,), visual=(DRAWN,)),
        make_link("b", "a", sliding=True, lower=0.0, upper=1.0 / 30.0),
        make_link("c", "b", mimic=Mimic("a_joint", 1.0 / 3.0, 0.1)),
    ),
    (Fingertip("tip", "c", (0.0, 0.0, 0.1), 0.01),),
    home=(0.7, 0.01, 0.0),
    tip_friction=0.9,
    placed=False,
)
HAND = hand_to_plain(gripper(3, 3))


@pytest.mark.parametrize(
    "hand",
    [
        *(make().moved((0.01, 0.1, 0.0), (0.1, 0.2, 0.3)) for make in HANDS.values()),
        gripper(3, 3, coupled=True),
        ODD,
    ],
    ids=[*HANDS, "coupled", "odd"],
)
def test_a_hand_survives_json_to_the_last_bit(hand):
    text = json.dumps(hand_to_plain(hand), allow_nan=False)
    again = hand_of(json.loads(text), "hand")
    assert (again, hash(again)) == (hand, hash(hand))


def test_a_built_in_hand_is_its_name_alone():
    for name, make in HANDS.items():
        assert hand_to_plain(make()) == {"name": name}
        assert hand_of({"name": name}, "hand") == make()
        assert "links" in hand_to_plain(replace(make(), name=f"my_{name}"))


def changed(**fields: Any) -> dict[str, Any]:
    return {**HAND, **fields}


def link(**fields: Any) -> dict[str, Any]:
    first, *rest = HAND["links"]
    return changed(links=[{**first, **fields}, *rest])


WRONG: list[tuple[Callable[[], Any], str]] = [
    (list, "hand must be a dict of the fields of a HandDescription"),
    (lambda: changed(colour="red"), r"'hand.colour'.* 'hand.name', 'hand.palm'"),
    (
        lambda: {"name": "alegro"},
        r"unknown hand 'alegro': did you mean 'allegro'.* or give all fields",
    ),
    (lambda: {"name": "a", "home": []}, "hand.palm, hand.links, hand.fingertips must be given"),
    (lambda: changed(palm=None), "palm must be a Palm"),
    (lambda: changed(palm=3), "hand.palm must be a dict of the fields of a Palm"),
    (lambda: changed(links="ab"), "hand.links must be a list of dicts"),
    (lambda: changed(links=["ab"]), r"hand.links\[0\] must be a dict of the fields of a Link"),
    (lambda: link(mass=-1.0), "mass"),
    (lambda: link(axis=[1.0, 1.0, 0.0]), "length 1"),
    (lambda: link(mimic={"joint": "f0_1_joint", "ratio": 0.0}), "ratio=0.0"),
    (lambda: link(lower=None), "joint limits"),
    (lambda: link(collision=[{"kind": "ball", "size": [1.0]}]), "kind of geometry 'ball'"),
    (
        lambda: link(collision=[{"kind": "box", "size": [1, 1, 1], "corners": 3}]),
        "got corners=3, file=''",
    ),
    (
        lambda: link(visual=[{"kind": "mesh", "size": [1, 1, 1], "file": 3}]),
        r"visual\[0\].file must be the path of a mesh",
    ),
]


@pytest.mark.parametrize(("make", "message"), WRONG, ids=range(len(WRONG)))
def test_a_wrong_dict_is_named(make, message):
    with pytest.raises(GraspError, match=message) as caught:
        hand_of(make(), "hand")
    assert isinstance(caught.value, UnknownSettingError) == ("colour" in message)
