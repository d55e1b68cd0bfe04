"""Fingertips of files for which no caller names them: ends, gears, frames of tips, rods."""

from __future__ import annotations

import pytest
from urdf_text import finger, hand, joint, link, read, solid

from grasp_env.sim.hand.description import Fingertip

FRAME = '<link name="{}"/>'
SPINNING = "turn without end, or by more than a turn, are not fingertips: 'gear'; name them as"
RODS = "rods that only move a finger are not fingertips: "


def gear(mimic: str = "") -> str:
    """Return a link on the palm that turns without end."""
    return joint("spin", "palm", "gear", "0.06 0 0", kind="continuous", mimic=mimic) + link("gear")


def behind(tip: str) -> str:
    """Return a hand with one finger whose last link ends 18 mm before its joint and 12 mm behind."""
    box = solid('<box size="0.03 0.01 0.01"/>', "-0.003 0 0")
    return link("palm", 0.06) + joint("a", "palm", "end") + f'<link name="end">{box}</link>' + tip


def fixed(name: str, place: str, shape: str = "") -> str:
    """Return a link that is fixed to the link `end` at `place` [m]."""
    text = joint(f"{name}_joint", "end", name, place, kind="fixed")
    return f'{text}<link name="{name}">{shape}</link>'


def test_an_end_may_carry_a_moving_frame(tmp_path):
    more = joint("s", "i2", "frame", kind="prismatic") + FRAME.format("frame")
    made, told = read(tmp_path, hand() + more)
    assert made.finger_names == ("i2", "m2", "t2")
    assert "end links without a shape are not fingertips: 'frame'" in told


DRIVEN = joint("d", "palm", "jaw", "0.06 0.03 0", mimic="spin") + link("jaw")


@pytest.mark.parametrize(
    ("text", "options", "names"),
    [
        (hand() + gear(), {}, ("i2", "m2", "t2")),
        (hand() + gear(), {"fingertips": ["i2", "gear"]}, ("i2", "gear")),
        (hand() + gear(), {"joint_limits": {"spin": (0.0, 1.0)}}, ("i2", "m2", "t2", "gear")),
        # a drum of a tendon, and a joint that folds
        (hand() + gear(), {"joint_limits": {"spin": (-2.0, 6.0)}}, ("i2", "m2", "t2")),
        (hand() + gear(), {"joint_limits": {"spin": (-3.1, 3.1)}}, ("i2", "m2", "t2", "gear")),
        # one other end is no hand
        (link("palm") + finger("i", "palm", "0.04 0 0") + gear(), {}, ("i2", "gear")),
        # a finger that moves others, and one that another moves
        (hand() + gear() + DRIVEN, {}, ("i2", "m2", "t2", "gear", "jaw")),
        (hand() + gear("ia"), {}, ("i2", "m2", "t2", "gear")),
        # ranges of CAD programs
        (
            hand() + finger("e", "palm", "0.06 0 0", kind="continuous"),
            {},
            ("i2", "m2", "t2", "e2"),
        ),
        (hand(kind="continuous") + gear(), {}, ("i2", "m2", "t2", "gear")),
    ],
    ids=[
        "gear",
        "named",
        "limits",
        "drum",
        "folds",
        "one finger",
        "driver",
        "driven",
        "two joints",
        "no limits",
    ],
)
def test_a_gear_is_no_finger(tmp_path, text, options, names):
    made, told = read(tmp_path, text, **options)
    assert made.finger_names == names
    assert (SPINNING in told) == ("gear" not in names and "gear" in text)


DRAWN = solid('<box size="0.002 0.002 0.002"/>', role="visual")
PAD = solid('<box size="0.004 0.004 0.004"/>')
BALL = solid('<sphere radius="0.003"/>', "-0.003 0 0")
AHEAD, BACK = 0.007, -0.013  # centres of balls of 5 mm that come near the ends of the link [m]


@pytest.mark.parametrize(
    ("tip", "name", "x"),
    [
        ("", "end", BACK),
        (fixed("end_tip", "0.012 0 0"), "end_tip", AHEAD),
        (fixed("IndexFingertip", "0.02 0 0"), "IndexFingertip", AHEAD),
        (fixed("rh_fftip_1", "0.012 0 0", DRAWN), "rh_fftip_1", AHEAD),
        (fixed("tip", "0.010 0 0", PAD), "tip", AHEAD),
        (fixed("tip", "0.012 0 0", BALL), "tip", 0.009),
        (fixed("tip", "0.012 0 0") + fixed("tip_far", "-0.018 0 0"), "tip_far", BACK),
        # no name of a tip, too far away, on the axis of the joint
        (fixed("tipping", "0.012 0 0") + fixed("pip", "0.012 0 0"), "end", BACK),
        (fixed("tip", "0.03 0 0"), "end", BACK),
        (fixed("tip", "0 0.004 0"), "end", BACK),
    ],
)
def test_a_link_that_is_called_a_tip_shows_the_end(tmp_path, tip, name, x):
    made, _ = read(tmp_path, behind(tip))
    assert made.finger_names == (name,)
    assert made.fingertips[0].link == "end"
    # a slightly smaller ball lies anywhere in the end
    assert made.fingertips[0].center == pytest.approx((x, 0.0, 0.0), abs=1e-3)


def test_a_ball_at_the_frame_of_a_tip_is_the_tip(tmp_path):
    ball = solid('<sphere radius="0.006"/>', "0.012 0 0")
    text = behind("").removesuffix("</link>") + ball + "</link>" + fixed("tip", "0.018 0 0")
    made, _ = read(tmp_path, text)
    assert made.fingertips == (Fingertip("tip", "end", (0.012, 0.0, 0.0), 0.006),)


def test_ends_without_a_tip_beside_named_ones_are_rods(tmp_path):
    """The thumb has motors of its own, so it stays."""
    names = "".join(
        joint(f"{end}f", end, f"{end}_tip", kind="fixed") + FRAME.format(f"{end}_tip")
        for end in ("i2", "m2")
    )
    bar = joint("r", "palm", "bar", "0.06 0.05 0", mimic="ia") + link("bar")
    made, told = read(tmp_path, hand() + names + bar)
    assert made.finger_names == ("i2_tip", "m2_tip", "t2")
    assert f"{RODS}'bar'" in told
    one, _ = read(tmp_path, (hand() + bar + names).replace("m2_tip", "m2_end"))
    assert one.finger_names == ("i2_tip", "m2", "t2", "bar")


@pytest.mark.parametrize("count", [2, 3])
def test_rods_with_motors_are_found_in_a_hand_of_too_many_fingers(tmp_path, count):
    """Each rod lies at a finger's first link and is shorter than the finger."""
    text = link("palm", 0.06, 0.2)
    for number, name in enumerate("abcd"):
        y = 0.05 * number
        text += finger(name, "palm", f"0.06 {y} 0")
        if number < count:
            text += joint(f"{name}s", "palm", f"{name}slider", f"0.03 {y} 0.03", kind="prismatic")
            text += link(f"{name}slider", 0.02)
            text += joint(f"{name}r", f"{name}slider", f"{name}rod", "0.02 0.02 -0.03")
            text += link(f"{name}rod", 0.03)
    made, told = read(tmp_path, text)
    rods = tuple(f"{name}rod" for name in "abcd"[:count])
    assert set(made.finger_names) - {*rods} == {"a2", "b2", "c2", "d2"}
    assert ((f"{RODS}{', '.join(map(repr, rods))}") in told) == (count == 3)
    assert made.finger_count == (4 if count == 3 else 6)
