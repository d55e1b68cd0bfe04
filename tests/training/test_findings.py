"""The first sentences of the reports of holds, hands, engines and agents say what their numbers say, and nothing of what a run lacks."""

from __future__ import annotations

from typing import Any

import pytest

from training.report.hands import rates, table_of_rates
from training.report.rl import learning_found
from training.report.style import close
from training.trials.hold_findings import hands_found, holds_found, transfer_found


def row(held: int, episodes: int, **more: Any) -> dict[str, Any]:
    return {
        "held": held, "episodes": episodes, "rate": held / episodes, "rate_low": 0.0, "rate_high": 1.0,
        "normal_force": {"mean": 12.0}, "failures": {"dropped": episodes - held} if held < episodes else {}, "against": None, **more,
    }  # fmt: skip


def of_hand(hand: str, label: str, held: int, engine: str = "bullet", **more: Any) -> dict[str, Any]:
    return row(held, 20, hand=hand, label=label, scenario=f"{hand}/{label}", engine=engine, **more)


def test_holds():
    cells = [
        row(10, 10, name="objects/paper"),
        row(4, 10, name="objects/pd"),
        row(7, 10, name="all/paper/0.7"),
        row(2, 10, name="all/pd/30"),
    ]
    chosen = {"all": {"paper": "all/paper/0.7", "pd": "all/pd/30"}}
    held, errors = holds_found({"cells": cells, "chosen": chosen})
    assert held.startswith("Held: ")
    assert "measured” holds 10 of 10 at a squeeze of 12 N; “PD only” holds 4 of 10" in held
    assert errors.startswith("With errors: ")
    assert "measured” holds 7 of 10" in errors
    assert holds_found({"cells": [], "chosen": {}}) == []


def test_hands():
    rows = [of_hand("a", "cube", 20), of_hand("b", "cube", 20), of_hand("c", "cube", 20), of_hand("c", "ball", 5)]
    held, hardest, falls = hands_found(rows)
    assert held == "Held: of 3 hands most by a, b, 20 of 20 each; least by c, 25 of 40."
    assert hardest == "Hardest: ball, 5 of 20; easiest: cube, 60 of 60."
    assert falls == "What falls: 15 of 80 episodes: 15 dropped."
    assert hands_found(rows[:1]) == ["Held: a, 20 of 20 episodes.", "What falls: none of 20 episodes."]
    assert hands_found(rows[:2])[0] == "Held: of 2 hands most by a, b, 20 of 20 each."


def test_engines():
    apart = {"base": "bullet", "chance": 0.01, "only_this": 0, "only_base": 8}
    rows = [of_hand("a", "cube", 20), of_hand("a", "cube", 12, "mujoco", against=apart)]
    held, differ, falls = transfer_found(rows)
    assert "20 of 20 (100 %)" in held
    assert "12 of 20 (60 %)" in held
    assert differ.startswith(
        "Differences: 1 of 1 comparisons with the first engine differ beyond chance (5 %), most in a, cube, "
    )
    rows[1]["against"] = {**apart, "chance": 0.5}
    assert (
        transfer_found(rows)[1] == "Differences: 0 of 1 comparisons with the first engine differ beyond chance (5 %)."
    )
    assert falls == "What falls: 8 of 40 episodes: 8 dropped."


@pytest.mark.parametrize(
    ("low", "high", "said"), [(0.7, 0.9, "fewer"), (1.1, 1.3, "more"), (0.9, 1.1, "no clear difference")]
)
def test_agents(low, high, said):
    spread = {"iqm": 1.0, "low": 0.0, "high": 2.0}
    ratio = {"ratio": 1.0, "low": low, "high": high}
    agent = {"label": "SAC", "held": 9, "episodes": 10, "iterations_against_paper": ratio, "return": spread}
    rows = {
        "zero": {**agent, "label": "the paper's start", "iterations_against_paper": {"ratio": 1.0}},
        "sac/initial_force": agent,
    }
    agents, outcome = learning_found({"rows": {**rows, "learned": agent}, "training": {"sac/initial_force": []}})[::2]
    assert f"“SAC” 1 [{low}, {high}], {said}." in agents
    assert outcome == "Held and return: “SAC” 9 of 10, return 1 [0, 2]; “the paper's start” 9 of 10, return 1 [0, 2]."
    assert learning_found({}) == []


def test_rates_have_a_place_for_every_hand_and_scenario():
    rows = [of_hand("a", "cube", 20), of_hand("b", "cube", 3), of_hand("b", "a rather long name of a scenario", 5)]
    figure, _, caption = table_of_rates(rows)
    (axes,) = figure.axes
    assert [text.get_text() for text in axes.texts] == ["20/20", "3/20", "5/20"]
    assert [text.get_text() for text in axes.get_yticklabels()] == ["a", "b"]
    assert "Empty: not asked" in caption
    close(figure)
    figure, *_ = rates([rows[0], of_hand("a", "cube", 12, "mujoco")])
    assert figure.axes[0].get_xlabel() == "episodes held [%]"
    close(figure)
