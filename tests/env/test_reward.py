"""The reward: holding on always pays more than letting go, and every term is what it says."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from env.reward_trial import BALL, POLICIES, faults, tried
from hypothesis import given
from hypothesis import strategies as st

from grasp_env.config.records import COSTS, MAX_COST, Reward
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import GraspWarning, InvalidInputError
from grasp_env.force import ForceOptimizer
from grasp_env.grasp import Grasp

ZERO = np.zeros(6, dtype=np.float32)
share = st.floats(0.0, 1.0)


@st.composite
def rewards(draw: st.DrawFn) -> Reward:
    """Any reward that is allowed, the heaviest costs included."""
    parts = np.array([draw(share) for _ in COSTS])
    total = draw(st.sampled_from([MAX_COST, 0.5, 0.0]))
    weights = parts / max(parts.sum(), 1e-9) * total
    return Reward(
        held=draw(st.floats(1e-6, 1e6)), iteration_scale=draw(st.floats(1e-6, 1e6)), failure_cost=draw(st.floats(0.0, 1e6)),
        **dict(zip(COSTS, np.minimum(weights, MAX_COST).tolist(), strict=True)),
    )  # fmt: skip


@given(
    reward=rewards(), iterations=st.floats(0.0, 1e9) | st.just(np.inf), force=share, torque=share, change=share,
    gamma=st.floats(0.0, 1.0, exclude_min=True),
)  # fmt: skip
def test_holding_one_step_longer_pays_more_than_letting_go_now(reward, iterations, force, torque, change, gamma):
    held, dropped = (reward.terms(kept, iterations, (force, torque, change)) for kept in (True, False))
    now, later = sum(dropped.values()), sum(held.values()) + gamma * sum(dropped.values())
    assert held.keys() == dropped.keys() == {"reward/held", *(f"reward/{name}" for name in COSTS)}
    assert later > now
    assert (1.0 - MAX_COST) * reward.held * (1.0 - 1e-9) <= sum(held.values()) <= reward.held
    assert now == -reward.failure_cost


def test_weights_that_could_make_letting_go_pay_are_refused():
    with pytest.raises(
        InvalidInputError, match=r"iterations 0\.5, force 0\.3, torque 0\.1, force_change 0\.1.* 1, .* at most 0\.9"
    ):
        Reward(force=0.3)
    with pytest.raises(InvalidInputError, match="held"):
        Reward(held=0.0)
    with pytest.raises(InvalidInputError, match=r"reward\.torque"):
        FourFingerGrasp(reward={"torque": -0.1})


@pytest.mark.parametrize(
    "settings", [{}, {"shape": "sphere"}, {"action_mode": "contact_force"}, {"controller": {"kind": "pd"}}], ids=str
)
def test_terms_are_what_they_say(settings):
    """Recomputed from what a user sees, at one control tick per step."""
    env = FourFingerGrasp(disturbance="random", limits={"max_drift": 10.0}, **{"agent.rate": 250}, **settings)
    observed, info = env.reset(seed=3)
    weights, limits = env.config.reward, env.scene.config.hand.torque_limits
    action = np.zeros(env.action_space.shape, dtype=np.float32)  # type: ignore[arg-type]
    for _ in range(12):
        before = info["commanded_force"]
        observed, reward, _, _, info = env.step(action)
        force, terms = info["commanded_force"], {key: value for key, value in info.items() if key.startswith("reward/")}
        assert reward == sum(terms.values())
        assert terms["reward/held"] == 1.0
        assert terms["reward/iterations"] == pytest.approx(-weights.iterations * min(1.0, info["iterations"] / 200.0))
        moved, both = np.abs(force - before).sum(), np.abs(force).sum() + np.abs(before).sum()
        assert terms["reward/force_change"] == pytest.approx(-weights.force_change * moved / both if both else 0.0)
        largest = np.abs(env._loop.torques / limits).max()
        assert info["torque_share"] == pytest.approx(largest)
        assert terms["reward/torque"] == pytest.approx(-weights.torque * largest)
        contacts = Grasp.from_contacts(
            observed[18:30].reshape(4, 3), observed[30:42].reshape(4, 3), float(observed[82])
        )
        least = ForceOptimizer(contacts, method="conic").solve(info["wrench"]).total_normal_force
        total = force[:, 0].sum()
        excess = max(0.0, 1.0 - least / total) if total else 0.0
        assert terms["reward/force"] == pytest.approx(-weights.force * excess, abs=2e-4)  # observations are float32
    env.close()


def test_without_force_closure_the_whole_cost_of_iterations_and_force_is_due():
    env = FourFingerGrasp(limits={"max_drift": 10.0, "max_tilt": 10.0, "max_contact_gap": 10.0})
    env.reset(seed=0, options={"wrench": [0.0, 0.0, 0.0, 0.0, 0.0, 3.0]})
    for _ in range(50):
        info = env.step(ZERO)[4]
        if not info["force_closure"]:
            break
    assert not info["force_closure"]
    assert (info["reward/iterations"], info["reward/force"]) == (-0.5, -0.1)
    env.close()


@pytest.mark.parametrize("cost", [0.0, 7.0])
def test_a_drop_earns_nothing_and_may_cost(cost):
    env = FourFingerGrasp(action_mode="contact_force", reward={"failure_cost": cost})
    env.reset(seed=0)
    for _ in range(100):
        _, reward, terminated, _, info = env.step(-np.ones(12, dtype=np.float32))
        assert reward > 0.0 or terminated
        if terminated:
            break
    assert terminated
    assert reward == info["reward/held"] == -cost
    assert all(info[f"reward/{name}"] == 0.0 for name in COSTS)
    env.close()


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"method": "newton"}, "Newton|newton"),
        ({"method": "conic"}, "no start"),
        ({"controller": {"kind": "pd"}}, "does not optimise"),
        ({"object": {"torsional_friction": 0.01}}, "soft contacts"),
    ],
)
def test_making_an_environment_in_which_actions_change_nothing_warns(settings, reason):
    with pytest.warns(GraspWarning, match=rf"({reason}).*action_mode='none'") as caught:
        gym.make("grasp_env:FourFingerGrasp-v0", **settings).close()
    assert caught[0].filename == __file__  # the line that made it


@pytest.mark.parametrize(
    "settings",
    [{}, {"initial_force": "previous"}, {"method": "newton", "action_mode": "none"}, {"action_mode": "contact_force"}],
)
def test_an_environment_in_which_actions_matter_does_not_warn(settings, recwarn):
    gym.make("grasp_env:FourFingerGrasp-v0", **settings).close()
    assert not recwarn.list


@pytest.mark.parametrize(
    "settings",
    [{"shape": "capsule"}, {"hand": "allegro", **BALL}, {"shape": "sphere", "method": "newton"}],
    ids=("capsule", "allegro", "newton"),
)
def test_the_zero_policy_earns_more_than_policies_that_drop(settings):
    """Three of the settings of `reward_trial.py`."""
    rows = list(tried("here", settings, POLICIES, range(1)))
    assert not faults(rows)
    assert {row.policy: row.failures for row in rows}["let go"] == "dropped"
    assert rows[0].failures == "held"
    assert rows[0].mean > 40.0
