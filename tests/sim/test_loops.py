"""Files whose links form closed loops, which are cut."""

from __future__ import annotations

import pytest
from urdf_text import finger, joint, link, read

from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand.files.loops import cut_loops

# two fingers of two links, with the joints fa, fb, ta and tb
FINGERS = link("palm") + finger("f", "palm", "0 0 0.02") + finger("t", "palm", "0 0 -0.02")


def chain(*names: str, mimic: str = "", first: str = "f1", last: str = "f2") -> str:
    """Return a chain of small links from one link to another, with a joint before each and one to
    the last."""
    text = "".join(link(name, 0.004, 0.001) for name in names)
    for parent, child in zip((first, *names), (*names, last), strict=True):
        text += joint(f"{parent}_to_{child}", parent, child, "0.004 0 0", mimic=mimic)
    return text


def test_a_finger_keeps_its_hinge_beside_a_flexure(tmp_path):
    """Wherever the flexure stands in the file, the hand is read without it, with a note."""
    flexure = chain("n1", "n2") + link("mark") + joint("m", "n2", "mark", kind="fixed")
    alone, before = read(tmp_path, FINGERS)
    assert "loop" not in before
    for text in (FINGERS + flexure, flexure + FINGERS):
        made, told = read(tmp_path, text)
        assert (made.links, made.fingertips) == (alone.links, alone.fingertips)
        assert "'f2' by 'fb', not by 'n2_to_f2'; the joints of a loop turn independently" in told
        assert "links that only closed a loop are left out: 'n1', 'n2', 'mark'" in told


def test_named_links_of_a_loop_stay(tmp_path):
    """So do links on the way to them; the joint that closes the loop is left out."""
    made, told = read(tmp_path, FINGERS + chain("n1", "n2", "n3"), ["n2", "t2"])
    assert [each.name for each in made.links if each.name[0] == "n"] == ["n1", "n2"]
    assert "links that only closed a loop are left out: 'n3';" in told


@pytest.mark.parametrize(("mimic", "kept"), [("f1_to_n1", ["n1"]), ("fb", [])])
def test_joints_that_drive_others_stay(tmp_path, mimic, kept):
    """A rod that drives a hinge stays, though it ends nowhere; one that follows it goes."""
    text = FINGERS + chain("n1")
    follower = "fb" if mimic == "f1_to_n1" else "f1_to_n1"
    at = text.index(f'<joint name="{follower}"')
    text = text[:at] + text[at:].replace("</joint>", f'<mimic joint="{mimic}"/></joint>', 1)
    made, _ = read(tmp_path, text, ["f2", "t2"])
    assert [each.name for each in made.links if each.name[0] == "n"] == kept
    coupled = {each.joint: each.mimic.joint for each in made.links if each.mimic}
    assert coupled == ({"fb": mimic} if kept else {})


def test_the_way_with_fewer_motors_is_kept():
    """A shorter way with more motors is cut, one through fixed joints is not; joints that mimic
    one motor count once."""
    base = ("base", "palm", "b")
    ends = [base, ("a", "b", "tip"), ("f", "b", "x"), ("g", "x", "tip")]
    assert cut_loops(["palm", "b", "x", "tip"], ends, {"f", "g"}, {}).joints == {"a"}
    ends = [base, ("a", "b", "x"), ("b", "x", "tip"), ("c", "b", "y"), ("d", "y", "tip")]
    links = ["palm", "b", "x", "y", "tip"]
    assert cut_loops(links, ends, (), {}).links == {"y"}
    assert cut_loops(links, ends, (), {"d": "c"}).links == {"x"}
    assert cut_loops(links, ends, (), {"b": "a", "d": "c"}).links == {"y"}


def test_a_loop_at_the_palm_is_refused(tmp_path):
    """Either way may be a finger. The palm is that which the caller names."""
    text = FINGERS + joint("gap", "t2", "f2")
    words = "'f2' is the child of two joints, 'fb' and 'gap'; a hand must be a tree, cut the loop"
    with pytest.raises(InvalidInputError, match=words):
        read(tmp_path, text)
    arm = link("base") + joint("arm", "base", "wrist") + link("wrist")
    arm += joint("flange", "wrist", "palm", kind="fixed") + text
    for palm in ("palm", "wrist"):
        with pytest.raises(InvalidInputError, match=words):
            read(tmp_path, arm, palm=palm)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (joint("again", "f1", "f2"), "'f2' is the child of two joints, 'fb' and 'again'"),
        (chain("n1") + link("lost"), "'f2' is the child of two joints"),
        (chain("n1") + joint("odd", "n1", "none"), "the link 'none', which is not in the file"),
        (chain("n1") + joint("fb", "n1", "t2"), "'t2' is the child of two joints"),
        (chain("n1") + joint("back", "f2", "palm"), "every link is carried by a joint"),
    ],
)
def test_loops_beside_other_faults_are_refused(tmp_path, more, words):
    """Two joints of one pair of links, or links of which the file does not say where they are."""
    with pytest.raises(InvalidInputError, match=words):
        read(tmp_path, FINGERS + more)


def test_a_loop_that_leads_back_is_cut(tmp_path):
    """A joint from a fingertip to the link before it adds nothing."""
    made, told = read(tmp_path, FINGERS + joint("back", "f2", "f1"))
    assert made.links == read(tmp_path, FINGERS)[0].links
    assert "'f1' by 'fa', not by 'back'" in told
    assert "left out: " not in told.partition("only closed a loop")[2]


def test_a_joint_that_drives_another_is_not_cut(tmp_path):
    """Without it the other could not follow; so the loop is refused as before."""
    text = FINGERS + chain("n1")
    at = text.index('<joint name="tb"')
    text = text[:at] + text[at:].replace("</joint>", '<mimic joint="n1_to_f2"/></joint>', 1)
    with pytest.raises(InvalidInputError, match="'f2' is the child of two joints"):
        read(tmp_path, text)
