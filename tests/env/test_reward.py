"""The reward: holding on always pays more, and every term is recomputed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from grasp_env.config.records import COSTS, MAX_COST, RewardSettings
from grasp_env.env.env import FourFingerGrasp
from grasp_env.force import ForceOptimizer
from grasp_env.grasp import Grasp

share = st.floats(0.0, 1.0)


@st.composite
def rewards(draw: st.DrawFn) -> RewardSettings:
    """Any allowed reward, the heaviest costs included."""
    parts = np.array([draw(share) for _ in COSTS])
    total = draw(st.sampled_from([MAX_COST, 0.5, 0.0]))
    weights = parts / max(parts.sum(), 1e-9) * total
    return RewardSettings(
        held=draw(st.floats(1e-6, 1e6)),
        iteration_scale=draw(st.floats(1e-6, 1e6)),
        fault_cost=draw(st.floats(0.0, 1e6)),
        **dict(zip(COSTS, np.minimum(weights, MAX_COST).tolist(), strict=True)),
    )


@given(
    reward=rewards(),
    iterations=st.floats(0.0, 1e9) | st.just(np.inf),
    force=share,
    torque=share,
    change=share,
    gamma=st.floats(0.0, 1.0, exclude_min=True),
)
def test_holding_on_pays_more_than_letting_go(reward, iterations, force, torque, change, gamma):
    held, dropped = (
        reward.terms(kept, iterations, (force, torque, change), not kept) for kept in (True, False)
    )
    passing = reward.terms(False, iterations, (force, torque, change))
    now = sum(dropped.values())
    later = sum(held.values()) + gamma * sum(dropped.values())
    assert held.keys() == dropped.keys() == {"reward/held", *(f"reward/{name}" for name in COSTS)}
    assert later > now
    assert (1.0 - MAX_COST) * reward.held * (1.0 - 1e-9) <= sum(held.values()) <= reward.held
    assert now == -reward.fault_cost
    assert not any(passing.values())


EVERYTHING = {
    "max_drift": 10.0,
    "max_slide": 10.0,
    "max_overlap": 1.0,
    "max_stray": 1e6,
    "max_imbalance": 1e6,
    "max_speed": 1e6,
    "end_at_fault": False,
}
"""Limits within which everything counts as held."""


@pytest.mark.parametrize(
    "settings",
    [
        {"shape": "sphere"},
        {"action_mode": "residual"},
        {"controller": {"friction_error": 0.2}},
        {"solver": {"force_weight": 4.0}},
        {"action_mode": "contact_force"},
        {"controller": {"kind": "pd"}},
    ],
    ids=str,
)
def test_terms_are_recomputed(settings):
    """At one control tick per step."""
    env = FourFingerGrasp(
        disturbance="random", limits=EVERYTHING, **{"agent.rate": 250}, **settings
    )
    observed, info = env.reset(seed=3)
    weights = env.config.reward
    limits = env.scene.config.hand.torque_limits
    action = np.zeros(env.action_space.shape or (), dtype=np.float32)
    for _ in range(12):
        before = info["commanded_force"]
        observed, reward, _, _, info = env.step(action)
        force = info["commanded_force"]
        terms = {key: value for key, value in info.items() if key.startswith("reward/")}
        assert reward == sum(terms.values())
        assert terms["reward/held"] == 1.0
        assert terms["reward/iterations"] == pytest.approx(
            -weights.iterations * min(1.0, info["iterations"] / 200.0)
        )
        moved = np.abs(force - before).sum()
        both = np.abs(force).sum() + np.abs(before).sum()
        assert terms["reward/force_change"] == pytest.approx(
            -weights.force_change * moved / both if both else 0.0
        )
        largest = np.abs(env._loop.torques / limits).max()
        assert info["torque_share"] == pytest.approx(largest)
        assert info["torque_margin"] == pytest.approx((limits - np.abs(env._loop.torques)).min())
        assert info["peak_torque"] >= np.abs(env._loop.torques).max() - 1e-12
        assert terms["reward/torque"] == pytest.approx(-weights.torque * largest)
        contacts = Grasp.from_contacts(
            observed[18:30].reshape(4, 3), observed[30:42].reshape(4, 3), info["object_friction"]
        )
        least = ForceOptimizer(contacts, method="conic").solve(info["wrench"]).total_normal_force
        total = force[:, 0].sum()
        excess = max(0.0, 1.0 - least / total) if total else 0.0
        # observations are float32
        assert terms["reward/force"] == pytest.approx(-weights.force * excess, abs=2e-4)
    env.close()


def test_lost_closure_costs_the_most():
    env = FourFingerGrasp(limits={**EVERYTHING, "max_tilt": 10.0, "max_contact_gap": 10.0})
    env.reset(seed=0, options={"wrench": [0.0, 0.0, 0.0, 0.0, 0.0, 3.0]})
    for _ in range(50):
        info = env.step(np.zeros(6, dtype=np.float32))[4]
        if not info["force_closure"]:
            break
    assert not info["force_closure"]
    assert (info["reward/iterations"], info["reward/force"]) == (-0.5, -0.1)
    env.close()
