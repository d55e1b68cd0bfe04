"""What a file says of masses, inertias, motors and ranges is believed where a hand can have it, and else replaced and told."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from urdf_text import finger, hand, joint, link, read

from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand.check import inertia_matrix
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.files.plausible import TIP_FORCE

BOX = link("palm", 0.06, 0.2)
SOLID = 1000.0 * 0.04 * 0.02 * 0.02  # [kg] of a finger's link at 1 g/cm^3


def moments(made: HandDescription) -> np.ndarray:
    """The largest principal moment of each link [kg m^2]."""
    return np.array([np.linalg.eigvalsh(inertia_matrix(each.inertia))[2] for each in made.links])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"effort": 0.35},  # Allegro's touch sensor hand: 4 N at the tip
        {"effort": 2.0},  # Shadow: 25 N
        {"effort": 6.0},  # the maker's own file of a prosthesis: 75 N
        {"mass": 0.05, "moment": 1e-4},  # with a rotor
        {"mass": 0.002},
        {"mass": 0.15},  # Barrett: 9 g/cm^3
        {"limits": (-1.57, 1.57)},
        {"limits": (-1.2, 1.95)},  # LEAP's thumb
    ],
)
def test_values_of_careful_files_are_believed(tmp_path: Path, options: dict[str, Any]) -> None:
    made, told = read(tmp_path, hand(**options))
    assert told == ""
    assert made.links[0].torque_limit == options.get("effort", 1.0)
    assert made.links[0].mass == options.get("mass", 0.03)
    assert (made.links[0].lower, made.links[0].upper) == options.get("limits", (-0.2, 1.6))


@pytest.mark.parametrize("moment", [1.0, 1e-2, 3e-4, 1e-8, 1e-12, 0.0])
def test_inertias_of_another_size_than_the_link_are_those_of_its_box(tmp_path: Path, moment: float) -> None:
    """As of kg mm^2 or g mm^2 written for kg m^2, or the other way round."""
    made, told = read(tmp_path, hand(moment=moment))
    assert f"'i1' ({moment:.2g} kg m^2, assumed 5e-06 kg m^2), 'i2'" in told
    assert "give the true ones as inertials=" in told
    np.testing.assert_allclose(moments(made), 0.03 * (0.04**2 + 0.02**2) / 12.0)
    assert made.links[0].center == (0.0, 0.0, 0.0)
    true = dict.fromkeys(("i1", "i2", "m1", "m2", "t1", "t2"), (0.02, (0.02, 0.0, 0.0), (4e-06, 0, 0, 5e-06, 0, 5e-06)))
    made, told = read(tmp_path, hand(moment=moment), inertials=true)
    assert told == ""
    assert (made.links[0].mass, made.links[0].center, made.links[0].inertia) == true["i1"]


def test_links_of_which_nothing_touches_are_judged_by_their_looks_or_the_finger(tmp_path: Path) -> None:
    for new, assumed in (("visual", "5e-06"), ("nothing", "5e-07")):
        text = (
            hand(moment=0.2).replace("collision>", f"{new}>")
            + link("tip", 0.01)
            + joint("e", "i2", "tip", kind="fixed")
        )
        made, told = read(tmp_path, text, fingertips=["tip"])
        assert f"'m2' (0.2 kg m^2, assumed {assumed} kg m^2)" in told
        assert max(moments(made)) < 2e-5


@pytest.mark.parametrize("mass", [30.0, 1.0, 3e-5])
def test_masses_that_no_link_of_this_size_has_are_those_of_its_shapes(tmp_path: Path, mass: float) -> None:
    """Grams, a whole hand's mass for each link, tons."""
    made, told = read(tmp_path, hand(mass=mass))
    assert "masses that links of this size cannot have" in told
    assert f"'i1' ({mass:.3g} kg, assumed 0.016 kg)" in told
    np.testing.assert_allclose([each.mass for each in made.links], SOLID)
    made, told = read(tmp_path, hand(mass=mass), inertials={each.name: 0.03 for each in made.links})
    assert told == ""
    np.testing.assert_allclose(moments(made), 0.03 * (0.04**2 + 0.02**2) / 12.0)  # the file's, scaled


def test_the_masses_of_a_hand_heavier_than_lead_are_replaced(tmp_path: Path) -> None:
    """Each link alone could weigh so much, were its shapes small."""
    made, told = read(tmp_path, hand(mass=0.27))
    assert "'t2' (0.27 kg, assumed 0.016 kg)" in told
    np.testing.assert_allclose([each.mass for each in made.links], SOLID)


def test_links_without_mass_and_centres_outside_are_replaced(tmp_path: Path) -> None:
    text = (
        BOX + joint("a", "palm", "one") + '<link name="one"/>' + joint("b", "one", "two") + link("two", place="0.3 0 0")
    )
    made, told = read(tmp_path, text)
    assert "without mass get that of their shapes at 1 g/cm^3: 'one' (1 g); give the true ones as inertials=" in told
    assert (
        "centres of mass farther outside their link than its size are moved to the middle of its shapes: 'two' (0.26 m)"
        in told
    )
    assert made.links[0].mass == 1e-3
    np.testing.assert_allclose(made.links[1].center, (0.02, 0.0, 0.0))
    made, _ = read(tmp_path, text, inertials={"one": 0.02})
    assert made.links[0].mass == 0.02


@pytest.mark.parametrize("effort", [10.0, 9.0, 100.0, 1000.0, None, 0.0, -1.0])
def test_efforts_that_no_finger_has_are_a_plain_force_at_its_tip(tmp_path: Path, effort: float | None) -> None:
    made, told = read(tmp_path, hand(effort=effort))
    last = math.sqrt(0.04**2 + 2.0 * 0.01**2)  # [m] to the corner of the box
    np.testing.assert_allclose(made.torque_limits, TIP_FORCE * (0.04 + last), rtol=0.05)  # two digits
    said = "no effort is given for" if effort is None else f"effort {effort:g} of"
    assert f"{said} 'ia', 'ib', 'ma', 'mb', 'ta', 'tb'" in told
    assert f"({(effort or 0.0) / (0.04 + last):.0f} N at a fingertip)" in told or not effort or effort < 0.0
    assert "assumed is 1.2 N m, 15 N at the tip of a straight finger; give the true one as torque_limit=" in told
    made, told = read(tmp_path, hand(effort=effort), torque_limit=0.7)
    assert (told, set(made.torque_limits)) == ("", {0.7})


def test_ten_for_all_joints_is_a_placeholder_also_for_long_fingers(tmp_path: Path) -> None:
    """8 N m for all, or 10 N m for some joints, may be true."""
    for efforts, doubted in (((10.0,) * 3, True), ((8.0,) * 3, False), ((10.0, 10.0, 9.0), False)):
        text = BOX + "".join(
            joint(f"{name}a", "palm", name, place, effort=effort) + link(name, 0.2, 0.1)
            for name, place, effort in zip("imt", ("0 0 0", "0 0.1 0", "0 0 0.1"), efforts, strict=True)
        )
        _, told = read(tmp_path, text)
        assert ("effort 10 of 'ia', 'ma', 'ta' is no motor's limit (50 N at a fingertip)" in told) == doubted
        assert bool(told) == doubted


def test_a_wrist_is_judged_by_all_fingers_that_it_carries(tmp_path: Path) -> None:
    wrist = link("arm") + joint("wrist", "arm", "palm", effort=20.0)
    made, told = read(tmp_path, wrist + hand())
    assert told == ""
    made, told = read(tmp_path, (wrist + hand()).replace('effort="20.0"', 'effort="0"'))
    assert made.torque_limits[0] == pytest.approx(
        3 * TIP_FORCE * 0.144, rel=0.05
    )  # three fingers, the longest 63 mm + 81 mm away


def test_a_motor_carries_the_joints_that_are_coupled_to_it(tmp_path: Path) -> None:
    coupled = joint("ib", "i1", "i2", mimic="ia").replace("<mimic ", '<mimic multiplier="2" ')
    made, _ = read(tmp_path, hand(effort=None).replace(joint("ib", "i1", "i2", effort=None), coupled))
    limits = {each.joint: each.torque_limit for each in made.links}
    assert limits["ia"] == pytest.approx(TIP_FORCE * (0.0824 + 2.0 * 0.0424), rel=0.05)
    assert limits["ma"] == pytest.approx(TIP_FORCE * 0.0824, rel=0.05)


def test_jaws_are_judged_by_their_force(tmp_path: Path) -> None:
    for effort, limit in ((70.0, 70.0), (235.0, 235.0), (1000.0, 20.0), (None, 20.0)):
        text = BOX + "".join(
            joint(name, "palm", f"{name}1", f"0 {y} 0", (0.0, 0.04), effort, "prismatic") + link(f"{name}1")
            for name, y in (("l", 0.03), ("r", -0.03))
        )
        made, told = read(tmp_path, text)
        assert made.torque_limits.tolist() == [limit, limit]
        assert ("assumed is 20 N; give the true one as torque_limit=" in told) == (limit != effort)


def test_a_motor_of_two_jaws_has_the_force_of_both(tmp_path: Path) -> None:
    def jaw(name: str, y: float, mimic: str = "") -> str:
        return joint(name, "palm", f"{name}1", f"0 {y} 0", (0.0, 0.04), 20.0, "prismatic", mimic) + link(f"{name}1")

    text = BOX + jaw("l", 0.03) + jaw("r", -0.03, "l")
    made, told = read(tmp_path, text)
    assert made.torque_limits[0] == 40.0
    assert "get the sum of the jaws' forces in the file: 'l' (40 N); give the true ones as torque_limit=" in told
    assert HandDescription.from_urdf(tmp_path / "hand.urdf", torque_limit=20.0).torque_limits[0] == 20.0


def test_wide_ranges_are_told_and_left(tmp_path: Path) -> None:
    for limits, words in (
        ((0.0, 3.14159), "'ia' (0 to 3.14 rad)"),
        ((-3.14159, 3.14159), "'ia' (-3.14 to 3.14 rad)"),
        ((-1.35, 4.49), "'ia' (-1.35 to 4.49 rad)"),
    ):
        made, told = read(tmp_path, hand(limits=limits))
        assert f"ranges too wide for a finger's joint are kept: {words}" in told
        assert "give the true ones as joint_limits=" in told
        assert (made.links[0].lower, made.links[0].upper) == limits
    endless = hand() + finger("e", "palm", "0 0 -0.03", kind="continuous")
    _, told = read(tmp_path, endless)
    assert "are kept: 'ea' (unlimited), 'eb' (unlimited);" in told
    made, told = read(tmp_path, endless, joint_limits={"ea": (-math.inf, math.inf), "eb": (0.0, 1.2)})
    assert told == ""
    limits = {each.joint: (each.lower, each.upper) for each in made.links}
    assert (limits["ea"], limits["eb"], limits["ia"]) == ((-math.inf, math.inf), (0.0, 1.2), (-0.2, 1.6))


def test_one_joint_may_fold_by_half_a_turn(tmp_path: Path) -> None:
    """Barrett's two spreading joints, Inspire's coupled ones."""
    text = (
        hand()
        + joint("s", "palm", "s1", "0 0 -0.03", (0.0, 3.14))
        + link("s1")
        + joint("u", "palm", "u1", "0 0.03 -0.03", (-3.14, 0.0))
        + link("u1")
    )
    assert read(tmp_path, text)[1] == ""


def test_degrees_are_read_as_degrees(tmp_path: Path) -> None:
    made, told = read(tmp_path, hand(limits=(-10.0, 90.0)))
    assert "ranges of more than two turns are taken as degrees: 'ia' (-0.175 to 1.57 rad)" in told
    np.testing.assert_allclose([(each.lower, each.upper) for each in made.links], [np.radians((-10.0, 90.0))] * 6)


def test_sizes_in_millimetres_are_told(tmp_path: Path) -> None:
    text = BOX + joint("a", "palm", "one") + link("one", 40.0)
    assert "'one' are larger than 1 m: a file is in metres, not millimetres" in read(tmp_path, text)[1]


def test_a_robot_without_a_hand_is_told_by_its_mass(tmp_path: Path) -> None:
    text = BOX + "".join(joint(name, "palm", f"{name}1") + link(f"{name}1", 0.9, 3.0) for name in "abcd")
    _, told = read(tmp_path, text)
    assert "the moving links weigh 12 kg together" in told


def test_a_joint_whose_limits_are_equal_holds_still(tmp_path: Path) -> None:
    text = (
        hand()
        + joint("n", "i2", "nail", limits=(0.4, 0.4))
        + link("nail")
        + joint("o", "nail", "end", mimic="n")
        + link("end")
    )
    made, told = read(tmp_path, text)
    assert (
        "joints with equal limits, lower = upper, hold still: 'n', 'o'; give the true ranges as joint_limits=" in told
    )
    assert made.joint_count == 6
    last = next(each for each in made.links if each.name == "i2")
    tilt = last.collision[1].rotation[1]
    assert tilt == pytest.approx(0.4)
    assert read(tmp_path, text, joint_limits={"n": (0.0, 0.4)})[0].joint_count == 8


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"joint_limits": {"no": (0.0, 1.0)}}, "joint_limits: no joint is called 'no'; joints are 'ia'"),
        ({"joint_limits": {"ia": 1.0}}, r"joint_limits of 'ia'=1.0 must be \(lower, upper\)"),
        ({"joint_limits": {"ia": (1.0, 0.0)}}, "joint_limits of 'ia': lower=1.0 must be below upper=0.0"),
        ({"joint_limits": [(0.0, 1.0)]}, "joint_limits=.* must be a dict with names of joints as keys"),
        ({"inertials": {"palm": 0.1}}, "inertials: no moving link is called 'palm'; moving links are 'i1'"),
        ({"inertials": {"i1": 0.0}}, r"inertials of 'i1': mass \[kg\]=0.0 must be above 0"),
        ({"inertials": {"i1": (0.1, (0, 0, 0))}}, r"must be a mass \[kg\], or \(mass, center, inertia\)"),
        (
            {"inertials": {"i1": (0.1, (0, 0, 0), (1, 0, 0, 1, 0, 9))}},
            "inertials of 'i1': inertia=.* the principal moments",
        ),
    ],
)
def test_what_is_given_is_checked(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        read(tmp_path, hand(), **options)
