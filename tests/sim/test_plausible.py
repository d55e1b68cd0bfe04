"""Implausible masses, inertias, motors and ranges are replaced with a warning."""

from __future__ import annotations

import math

import numpy as np
import pytest
from urdf_text import finger, hand, joint, link, read

from grasp_env.sim.hand.description import Link
from grasp_env.sim.hand.inertia import inertia_matrix

BOX = link("palm", 0.06, 0.2)
MASS, MOMENT, TORQUE = (
    0.016,
    0.03 * (0.04**2 + 0.02**2) / 12.0,
    15.0 * (0.04 + math.hypot(0.04, 0.01, 0.01)),
)
"""Mass of a finger's link at 1 g/cm^3 [kg]; moment of its box with the file's mass [kg m^2]; torque
of 15 N at the end of a finger [N m]."""
ALL = "'ia', 'ib', 'ma', 'mb', 'ta', 'tb'"
SIZE = "that links of this size cannot have"
ENDLESS = (
    hand()
    + joint("s", "palm", "s1", "0 0 -0.03", (0.0, 3.14))
    + link("s1")
    + finger("e", "palm", "0 0 -0.03", kind="continuous")
)
LONG = "".join(
    joint(f"{name}a", "palm", name, place, effort=10.0) + link(name, 0.2, 0.1)
    for name, place in zip("imt", ("0 0 0", "0 0.1 0", "0 0 0.1"), strict=True)
)
WRIST = link("arm") + joint("wrist", "arm", "palm", effort=20.0) + hand()
BARE = (
    BOX + joint("a", "palm", "one") + '<link name="one"/>' + joint("b", "one", "two") + link("two")
)
ASTRAY = BOX + joint("b", "palm", "two") + link("two", place="0.3 0 0")
TWO = joint("ib", "i1", "i2", mimic="ia", effort=None).replace("<mimic ", '<mimic multiplier="2" ')
COUPLED = hand(effort=None).replace(joint("ib", "i1", "i2", effort=None), TWO)
SEEN, UNSEEN = (
    hand(moment=0.2).replace("collision>", f"{role}>")
    + joint("e", "m2", "tip", kind="fixed")
    + link("tip", 0.01)
    for role in ("visual", "none")
)


def jaws(effort: float | None, mimic: str = "") -> str:
    rows = (("l", 0.03, ""), ("r", -0.03, mimic))
    return BOX + "".join(
        joint(n, "palm", f"{n}1", f"0 {y} 0", (0.0, 0.04), effort, "prismatic", m) + link(f"{n}1")
        for n, y, m in rows
    )


def moment(made: Link) -> float:
    """Return the largest principal moment [kg m^2]."""
    return float(np.linalg.eigvalsh(inertia_matrix(made.inertia))[2])


VALUES = [
    # Allegro's touch sensor hand: 4 N at the tip
    (hand(effort=0.35), "", "torque_limit", 0.35),
    (hand(effort=6.0), "", "torque_limit", 6.0),  # the maker's own file of a prosthesis: 75 N
    (hand(moment=1.5e-4), "", "moment", 1.5e-4),  # with a rotor
    (hand(mass=0.002), "", "mass", 0.002),
    (hand(mass=0.15), "", "mass", 0.15),  # Barrett: 9 g/cm^3
    (hand(limits=(-1.2, 1.95)), "", "upper", 1.95),  # LEAP's thumb
    # one effort for all that is no power of 10
    (LONG.replace('"10.0"', '"8.0"') + BOX, "", "torque_limit", 8.0),
    # 10 N m for some joints
    (LONG.replace('"10.0"', '"9.0"', 1) + BOX, "", "torque_limit", 9.0),
    (WRIST, "", "torque_limit", 20.0),  # moves three fingers
    (jaws(235.0), "", "torque_limit", 235.0),
    # such as kg mm^2 or g mm^2 written for kg m^2
    *(
        (
            hand(moment=each),
            f"inertias {SIZE} are replaced by those of boxes around them: 'i1' ({', '.join(3 * [f'{each:.2g}'])} kg m^2, assumed 2e-06, 5e-06, 5e-06 kg m^2), 'i2'",
            "moment",
            MOMENT,
        )
        for each in (1.0, 3e-4, 1e-8, 0.0)
    ),
    # judged by what is drawn
    (SEEN, "'i2' (0.2, 0.2, 0.2 kg m^2, assumed 2e-06, 5e-06, 5e-06 kg m^2)", "moment", MOMENT),
    # by the length of the finger
    (UNSEEN, "'i2' (0.2, 0.2, 0.2 kg m^2, assumed 5e-07, 5e-07, 5e-07 kg m^2)", "moment", 5e-7),
    # grams, a hand's mass, tons; 0.27 for all links is heavier than lead
    *(
        (
            hand(mass=each),
            f"masses {SIZE} are replaced by those of their shapes at 1 g/cm^3: 'i1' ({each:.3g} kg, assumed 0.016 kg), 'i2'",
            "mass",
            MASS,
        )
        for each in (30.0, 1.0, 3e-5, 0.27)
    ),
    (BARE, "without mass get that of their shapes at 1 g/cm^3: 'one' (1 g);", "mass", 1e-3),
    (
        ASTRAY,
        "farther outside their link than its size are moved to the middle of its shapes: 'two' (0.26 m)",
        "moment",
        MOMENT,
    ),
    *(
        (
            hand(effort=each),
            f"effort {each:g} of {ALL} is no motor's limit ({each / (TORQUE / 15.0):.0f} N at a fingertip): assumed is 1.2 N m, "
            "15 N at the tip of a straight finger;",
            "torque_limit",
            TORQUE,
        )
        for each in (9.0, 10.0, 1000.0)
    ),
    (
        hand(effort=None),
        f"no effort is given for {ALL}: assumed is 1.2 N m",
        "torque_limit",
        TORQUE,
    ),
    *(
        (
            hand(effort=each),
            f"effort {each:g} of {ALL} is no motor's limit: assumed",
            "torque_limit",
            TORQUE,
        )
        for each in (0.0, -1.0)
    ),
    (
        LONG + BOX,
        "effort 10 of 'ia', 'ma', 'ta' is no motor's limit (50 N at a fingertip)",
        "torque_limit",
        15.0 * 0.2,
    ),
    # the longest finger is 63 mm + 81 mm away
    (WRIST.replace('"20.0"', '"0"'), "effort 0 of 'wrist'", "torque_limit", 3 * 15.0 * 0.144),
    # moves the next joint twice as far
    (COUPLED, "no effort is given", "torque_limit", 15.0 * (0.0824 + 2.0 * 0.0424)),
    (jaws(1000.0), "assumed is 20 N;", "torque_limit", 20.0),
    (jaws(None), "assumed is 20 N;", "torque_limit", 20.0),
    (
        jaws(20.0, "l"),
        "get the sum of the jaws' forces in the file: 'l' (40 N);",
        "torque_limit",
        40.0,
    ),
    (
        hand(limits=(0.0, 3.14159)),
        "too wide for a finger's joint are kept: 'ia' (0 to 3.14 rad)",
        "upper",
        3.14159,
    ),
    (
        hand(limits=(-1.35, 4.49)),
        "too wide for a finger's joint are kept: 'ia' (-1.35 to 4.49 rad)",
        "upper",
        4.49,
    ),
    # one joint may fold by half a turn
    (ENDLESS, "kept: 'ea' (unlimited), 'eb' (unlimited);", "upper", 1.6),
    (
        hand(limits=(-10.0, 90.0)),
        "more than two turns are taken as degrees: 'ia' (-0.175 to 1.57 rad)",
        "upper",
        math.pi / 2,
    ),
    (
        BOX + joint("a", "palm", "one") + link("one", 40.0),
        "'one' are larger than 1 m: a file is in metres, not millimetres",
        "mass",
        0.03,
    ),
    (
        BOX + "".join(joint(n, "palm", f"{n}1") + link(f"{n}1", 0.9, 3.0) for n in "abcd"),
        "links weigh 12 kg together",
        "mass",
        3.0,
    ),
]


@pytest.mark.parametrize(("text", "words", "field", "value"), VALUES)
def test_implausible_values_are_replaced(tmp_path, text, words, field, value):
    made, told = read(tmp_path, text)
    first = made.links[-1 if text in (SEEN, UNSEEN) else 0]
    assert (moment(first) if field == "moment" else getattr(first, field)) == pytest.approx(
        value, rel=0.05
    )
    assert words in told
    assert bool(told) == bool(words)


I1 = (0.02, (0.02, 0.0, 0.0), (4e-06, 0.0, 0.0, 5e-06, 0.0, 5e-06))


GIVEN = [
    (
        hand(moment=1.0),
        {"inertials": dict.fromkeys(("i1", "i2", "m1", "m2", "t1", "t2"), I1)},
        "center",
        I1[1],
    ),
    # the file's, scaled
    (
        hand(mass=30.0),
        {"inertials": dict.fromkeys(("i1", "i2", "m1", "m2", "t1", "t2"), 0.03)},
        "moment",
        MOMENT,
    ),
    (BARE, {"inertials": {"one": 0.02}}, "mass", 0.02),
    (hand(effort=10.0), {"torque_limit": 0.7}, "torque_limit", 0.7),
    (jaws(20.0, "l"), {"torque_limit": 20.0}, "torque_limit", 20.0),
    (ENDLESS, {"joint_limits": {"ea": (-math.inf, math.inf), "eb": (0.0, 1.2)}}, "upper", 1.6),
]


@pytest.mark.parametrize(("text", "options", "field", "value"), GIVEN)
def test_given_values_are_taken_without_a_word(tmp_path, text, options, field, value):
    made, told = read(tmp_path, text, **options)
    assert told == ""
    first = made.links[0]
    assert (moment(first) if field == "moment" else getattr(first, field)) == pytest.approx(value)
