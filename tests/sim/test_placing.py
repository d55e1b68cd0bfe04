"""Records of grasps: what placing finds, keeps, saves, and says when it finds nothing."""

from __future__ import annotations

import json
import pickle
from contextlib import closing
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hands import gripper
from PIL import Image

from grasp_env.config.env import as_config
from grasp_env.control.hand import HandController, HandControllerSettings
from grasp_env.env import stage
from grasp_env.errors import GraspError, GraspFileError, InvalidInputError, NoGraspError
from grasp_env.force import optimize_force
from grasp_env.grasp import load_grasp, presets, save_grasp
from grasp_env.sim import HandDescription, HandGrasp, HandKinematics, ObjectDescription, place_hand
from grasp_env.sim.config import START_CLEARANCE
from grasp_env.sim.grasping import placing, plan_grasp, sites
from grasp_env.sim.grasping.miss import NearestMiss
from grasp_env.sim.grasping.points import GraspSearch, limbs_of
from grasp_env.sim.objects.cache import entries
from grasp_env.sim.picture.portrait import grasp_portrait
from training.program import film
from training.program.cli import main

BALL = ObjectDescription("sphere", (0.06,), mass=0.15, friction=0.7)
SOFT = ObjectDescription("cuboid", (0.05, 0.05, 0.05), friction=0.7, torsional_friction=0.0056)
HAND = gripper(3, 2)
ENV = "grasp_env:FourFingerGrasp-v0"


pytestmark = pytest.mark.usefixtures("own_cache")


def no_search(*_: Any) -> Any:
    raise AssertionError("it searches again")


@pytest.mark.parametrize(
    ("hand", "item"), [(HAND, BALL), (gripper(2, 2), SOFT)], ids=["hard", "soft"]
)
def test_the_record_is_true_of_its_hand(hand, item):
    grasp = place_hand(hand, item)
    kinematics = HandKinematics(grasp.hand)
    radii = kinematics.tip_radii[:, None]
    touching = grasp.points - radii * grasp.normals
    np.testing.assert_allclose(kinematics.tips(grasp.angles), touching, atol=1e-6)
    gaps = [
        item.surface.nearest(tip)[2] - radius
        for tip, radius in zip(kinematics.tips(grasp.start), kinematics.tip_radii, strict=True)
    ]
    np.testing.assert_allclose(gaps, START_CLEARANCE, atol=1e-6)
    # the palm's frame is where the record says: its tips are the hand's, moved there
    at_home = HandKinematics(
        HandDescription(
            hand.name, hand.palm, hand.links, grasp.hand.fingertips, grasp.hand.home
        ).moved(grasp.position, grasp.rotation)
    )
    np.testing.assert_allclose(at_home.tips(grasp.angles), touching, atol=1e-6)
    contacts = grasp.contacts()
    assert contacts.models.names[0] == ("soft" if item is SOFT else "hard")
    optimize_force(contacts, [0.0, -1.5, 0.0, 0.0, 0.0, 0.0]).raise_for_status()


def test_a_record_is_saved_and_read_by_everyone(tmp_path, capsys):
    grasp = place_hand(HAND, BALL)
    path = grasp.save(tmp_path / "grasp.json")
    assert HandGrasp.load(path) == grasp
    np.testing.assert_array_equal(load_grasp(path).matrix, grasp.contacts().matrix)
    words = f"solve --grasp {path} --wrench 0 -1.5 0 0 0 0 --json"
    assert main(words.split()) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "optimal"
    controller = HandController()
    controller.configure(HandGrasp.load(path), HandControllerSettings(friction=0.7))
    state = controller.new_state()
    state.angles = grasp.angles
    controller.activate(state)
    assert controller.update(state, 1e-3).shape == grasp.angles.shape
    with pytest.raises(GraspFileError, match="has contacts, but no hand"):
        HandGrasp.load(save_grasp(presets.tripod(), tmp_path / "contacts.json"))
    for key in ("description", "start"):
        values = json.loads(path.read_text())
        del values["hand"][key]
        (tmp_path / "less.json").write_text(json.dumps(values))
        with pytest.raises(GraspFileError, match=rf"the keys \['{key}'\] are missing"):
            HandGrasp.load(tmp_path / "less.json")


def test_an_environment_keeps_its_grasp_and_another_begins_with_it(tmp_path, monkeypatch):
    settings: dict[str, Any] = {"object": BALL, "disturbance": "none", "duration": 0.1}
    with closing(gym.make(ENV, hand=HAND, **settings)) as env:
        grasp = env.unwrapped.grasp
        assert grasp == place_hand(HAND, BALL)
        first, _ = env.reset(seed=0)
    monkeypatch.setattr(placing, "_searched", no_search)
    path = grasp.save(tmp_path / "grasp.json")
    for given in (grasp, path, grasp.to_dict()):
        with closing(gym.make(ENV, grasp=given, **settings)) as env:
            assert env.unwrapped.grasp == grasp
            assert as_config(env.unwrapped.config.to_json()).grasp == grasp
            np.testing.assert_array_equal(env.reset(seed=0)[0], first)
            assert env.step(np.zeros(env.action_space.shape, np.float32))[4]["is_success"]
    for wrong, words in (
        (3, "grasp must be a HandGrasp, its dict, or the path of its file, got 3"),
        ({**grasp.to_dict(), "hand": 3}, "hand must be an object {...} that HandGrasp.save wrote"),
        (tmp_path / "none.json", "cannot read grasp file"),
    ):
        with pytest.raises(GraspError) as told:
            gym.make(ENV, grasp=wrong, **settings)
        assert words in str(told.value)
    with pytest.raises(InvalidInputError, match="grasp has a hand and its contact points: leave"):
        gym.make(ENV, grasp=grasp, approach="down", **settings)
    with pytest.raises(InvalidInputError, match="grasp belong to one shape and size"):
        gym.make(ENV, grasp=grasp, randomize=("size",), **settings)


def test_what_placing_found_is_kept_by_content(monkeypatch):
    first = place_hand(HAND, BALL, keep=False)
    assert entries() == []
    placing._placed.cache_clear()
    assert place_hand(HAND, BALL) == first
    assert [(entry.use, entry.name) for entry in entries()] == [
        ("grasp", f"{HAND.name} holds sphere")
    ]
    placing._placed.cache_clear()  # as in another process
    with monkeypatch.context() as patched:
        patched.setattr(placing, "_searched", no_search)
        assert place_hand(HAND, BALL) == first
        for other in (
            {"item": ObjectDescription("sphere", (0.06,), mass=0.15, friction=0.71)},
            {"hand": gripper(3, 2, torque=5.0)},
            {"seed": 1},
            {"friction_margin": 0.8},
            {"approach": "down"},
        ):
            with pytest.raises(AssertionError, match="searches again"):
                place_hand(**{"hand": HAND, "item": BALL, **other})


def test_failures_are_kept_too_but_not_those_of_a_time_limit(monkeypatch):
    large = ObjectDescription("sphere", (0.4,))
    with pytest.raises(InvalidInputError) as told:
        place_hand(HAND, large)
    placing._placed.cache_clear()
    with monkeypatch.context() as patched:
        patched.setattr(placing, "_searched", no_search)
        with pytest.raises(InvalidInputError) as again:
            place_hand(HAND, large)
    assert str(again.value) == str(told.value)
    monkeypatch.setattr(placing, "LONGEST", 0.0)
    with pytest.raises(InvalidInputError, match="no palm pose was found in 0 s"):
        place_hand(HAND, BALL)
    monkeypatch.setattr(placing, "LONGEST", 20.0)
    assert place_hand(HAND, BALL).hand.finger_count == 3


def test_a_grasp_that_is_found_in_the_end_is_kept(monkeypatch):
    times = iter([0.0, *[0.0] * 3, *[100.0] * 10_000])  # the time is over after the first round
    monkeypatch.setattr(placing.time, "process_time", lambda: next(times))
    first = place_hand(HAND, BALL)
    assert len(entries()) == 1
    placing._placed.cache_clear()
    monkeypatch.setattr(placing, "_searched", no_search)
    assert place_hand(HAND, BALL) == first


SLIPPERY = ObjectDescription("sphere", (0.06,), mass=0.15, friction=1e-3)


@pytest.fixture
def short_search(monkeypatch):
    monkeypatch.setattr(placing, "_MAX_ATTEMPTS", 1)
    monkeypatch.setattr(sites, "_ROUNDS", 4)


@pytest.mark.usefixtures("short_search")
def test_the_nearest_miss_is_told_kept_and_drawn(monkeypatch, tmp_path):
    """Without friction three fingers cannot balance a weight; their contacts are found."""
    with pytest.raises(NoGraspError) as told:
        place_hand(HAND, SLIPPERY)
    words = str(told.value)
    assert "The nearest miss, with the palm at (" in words
    assert "f0, f1, f2 find contacts, their choices are without force closure" in words
    nearest = told.value.nearest
    assert (nearest.reached, nearest.item) == (("f0", "f1", "f2"), SLIPPERY)
    # the tips are where contacts were looked for
    kinematics = HandKinematics(nearest.hand)
    gaps = [SLIPPERY.surface.nearest(tip)[2] for tip in kinematics.tips(kinematics.home)]
    assert np.abs(gaps - kinematics.tip_radii).max() < 0.02
    # it comes again from the cache, and passes between processes
    monkeypatch.setattr(placing, "_searched", no_search)
    with pytest.raises(NoGraspError) as again:
        place_hand(HAND, SLIPPERY)
    assert (str(again.value), again.value.nearest) == (words, nearest)
    assert pickle.loads(pickle.dumps(told.value)).nearest == nearest
    picture = nearest.draw(tmp_path / "new" / "miss.png", 200)
    with Image.open(picture) as image:
        assert image.size == (400, 200)
    with pytest.raises(InvalidInputError, match=r"must end with .png, got 'miss.jpg'"):
        nearest.draw("miss.jpg")
    with pytest.raises(InvalidInputError, match="size must be an integer >= 16, got 2"):
        nearest.draw("miss.png", 2)


def test_a_picture_of_a_grasp_shows_which_tips_touch():
    item = ObjectDescription("capsule", (0.02, 0.05))
    red, green = (
        grasp_portrait(HAND, item, touching, 200).astype(int)
        for touching in ((), HAND.finger_names)
    )
    differ = np.abs(red - green).max(axis=-1) > 60
    assert differ.sum() > 100
    assert (red[differ].argmax(axis=-1) == 0).all()
    assert (green[differ].argmax(axis=-1) == 1).all()


@pytest.mark.parametrize(
    "item",
    [
        ObjectDescription("cuboid", (0.02, 0.2, 0.02)),
        ObjectDescription("cylinder", (0.02, 0.2)),
        ObjectDescription("capsule", (0.02, 0.2)),
    ],
    ids=lambda item: item.shape,
)
def test_a_picture_shows_the_object_upright(item):
    lying = ObjectDescription("cuboid", (0.2, 0.02, 0.02))
    whole = {each: grasp_portrait(HAND, each, (), 120).astype(int) for each in (item, lying)}
    sizes = []
    for picture in whole.values():
        yellow = (picture[:, :120, 0] - picture[:, :120, 2] > 25).nonzero()
        sizes.append(np.ptp(yellow[0]) / np.ptp(yellow[1]))
    assert sizes[0] > 2.0 > 0.7 > sizes[1]


def test_where_the_palm_is_in_the_object_nothing_is_reached():
    large = ObjectDescription("cuboid", (0.4, 0.4, 0.4))
    search = GraspSearch(large, limbs_of(HandKinematics(HAND)), HAND, 0.8)
    assert search.run(np.random.default_rng(0)) is None
    assert search.in_palm
    assert search.reached == [False] * 3
    assert search.faults == {"with the object in the palm": 1}


def test_demo_draws_the_nearest_miss_beside_the_video(monkeypatch, tmp_path, capsys):
    def fail(*_: Any, **__: Any) -> Any:
        raise NoGraspError("no place", NearestMiss(HAND, BALL, ("f0",)))

    monkeypatch.setattr(film, "record", fail)
    assert main(["demo", "--video", str(tmp_path / "hand.webp")]) == 2
    said = capsys.readouterr().err
    assert f"the nearest miss: {tmp_path / 'hand-miss.png'}" in said
    assert "no place" in said
    assert {path.name for path in tmp_path.glob("hand*")} == {"hand-miss.png"}


def test_a_hand_with_a_name_is_placed_anew_where_its_own_place_fails():
    tall = {"shape": "cuboid", "size": (0.05, 0.4, 0.05), "mass": 0.1, "friction": 0.7}
    own = HandDescription.four_finger()
    with closing(gym.make(ENV, object=tall, disturbance="none", duration=0.1)) as env:
        assert env.unwrapped.grasp.hand != own
        env.reset(seed=0)
        assert env.step(np.zeros(env.action_space.shape, np.float32))[4]["is_success"]
    with closing(gym.make(ENV, disturbance="none", duration=0.1)) as env:
        assert env.unwrapped.grasp.hand == own
    # a place that is given is kept, or refused
    with pytest.raises(InvalidInputError, match=r"into the palm|finds no contact"):
        gym.make(ENV, object=tall, hand=own.moved((0.0, 1e-6, 0.0)))


def test_a_hand_with_a_name_moves_where_its_links_are_too_near(monkeypatch):
    """The object moves by some tenths of a millimetre, and then links would touch it."""
    own = HandDescription.four_finger()

    def hand_at(clearance: float) -> HandDescription:
        def plan(*args: Any) -> Any:
            return replace(plan_grasp(*args), clearance=clearance)

        monkeypatch.setattr(stage, "plan_grasp", plan)
        with closing(gym.make(ENV, object=BALL, disturbance="none", duration=0.1)) as env:
            return env.unwrapped.grasp.hand

    assert hand_at(3e-3) == own
    assert hand_at(1e-4) != own


def test_of_three_places_the_one_of_least_force_is_taken(monkeypatch):
    """The first is taken unless its force is large or its links are close to the object."""
    first = place_hand(HAND, BALL)

    def chosen(*numbers: tuple[float, float]) -> float:
        """The force of the place that is taken, of these with force [N] and clearance [m]."""

        def place(*_: Any, seed: int, **__: Any) -> HandGrasp:
            force, clearance = numbers[seed]
            return replace(first, force=force, clearance=clearance)

        monkeypatch.setattr(stage, "place_hand", place)
        with closing(gym.make(ENV, hand=HAND, object=BALL, duration=0.1)) as env:
            return env.unwrapped.grasp.force

    assert chosen((59.0, 3e-3)) == 59.0
    assert chosen((61.0, 3e-3), (70.0, 3e-3), (40.0, 3e-3)) == 40.0
    # 0.5 mm count as much as 2.4 times the force
    assert chosen((40.0, 5e-4), (97.0, 3e-3), (99.0, 3e-3)) == 97.0
    assert chosen((40.0, 5e-4), (99.0, 3e-3), (99.0, 3e-3)) == 40.0
