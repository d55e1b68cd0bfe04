"""Commands of a hand's controller in device units, and settings that are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from held import JOINTS, KINEMATICS, PERIOD, made, updated
from numpy.testing import assert_allclose, assert_array_equal

from grasp_env import core
from grasp_env.control import Calibration, HandController, HandState
from grasp_env.errors import InvalidInputError
from grasp_env.sim import HandDescription


def test_an_inactive_controller_commands_the_units_of_zero_torque():
    limits = np.array(KINEMATICS.torque_limits)
    table = Calibration(
        np.column_stack([-limits, 0.0 * limits, limits]),
        np.tile([-200.0, 10.0, 240.0], (JOINTS, 1)),
    )
    controller = HandController()
    controller.configure(KINEMATICS.hand, calibration=table)
    state = controller.new_state()
    assert_array_equal(updated(controller, state), 10.0)
    controller.activate(state)
    updated(controller, state, 5)
    controller.deactivate()
    assert_array_equal(updated(controller, state), 10.0)


def test_without_a_calibration_commands_are_torques():
    hand = HandDescription.allegro()
    controller = HandController()
    controller.configure(hand)
    state = controller.new_state()
    state.angles = np.array(hand.home)
    state.gravity[:] = 0.0, 0.0, -9.81
    controller.activate(state)
    commands = updated(controller, state, 100)
    assert_allclose(commands, controller.torques, atol=1e-14)
    assert np.abs(commands).max() > 0.01
    losses = Calibration.newton_metres(hand, friction=np.full(16, 0.05))
    assert_allclose(losses.to_units(np.full(16, 0.1), np.ones(16)), 0.15)


def test_commands_are_multiples_of_the_resolution():
    limits = np.ones(JOINTS)
    table = np.column_stack([-limits, limits])
    rough = Calibration(table, 100.0 * table, resolution=4.0)
    torques = np.linspace(-0.9, 0.9, JOINTS)
    # half a step may go either way
    assert_allclose(rough.to_units(torques), 100.0 * torques, atol=2.0 + 1e-9)
    assert not (rough.to_units(torques) % 4.0).any()


def test_a_dead_band_goes_the_way_of_descending_units():
    turned = Calibration([[-1.0, 1.0]], [[100.0, -100.0]], dead_band=[20.0])
    for torque, units in ((0.5, -70), (-0.5, 70), (0.9, -100)):
        assert turned.to_units([torque]).tolist() == [units]


def test_a_joint_without_limit_has_none():
    """Its table ends at 1e6 N m; it has no limit of its own."""
    hand = HandDescription.four_finger()
    links = tuple(replace(link, torque_limit=1e7) for link in hand.links)
    free = Calibration.newton_metres(replace(hand, links=links))
    assert np.isinf(free.limits).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("squeeze", np.nan),
        ("friction", 0.0),
        ("torsional_friction", -1.0),
        ("release", -5),
        ("budget", np.nan),
        ("grace", np.inf),
        ("fade", np.inf),
        ("force_rate", np.inf),
        ("torque_rate", np.inf),
        ("stale", np.inf),
    ],
)
def test_settings_that_make_no_finite_command_are_refused(name, value):
    """By the core, too: in C++ there is nothing before it."""
    settings = core.HandControllerSettings()
    setattr(settings, name, value)
    tree = KINEMATICS.tree
    motors = core.Calibration.newton_metres(tree)
    with pytest.raises(ValueError, match=name):
        core.HandController().configure(tree, settings, motors, KINEMATICS.home.tolist())


def test_places_without_stiffness_are_no_fault():
    settings = core.HandControllerSettings()
    settings.place = core.Spring(0.0, 1.0, np.inf)
    tree = KINEMATICS.tree
    controller = core.HandController()
    motors = core.Calibration.newton_metres(tree)
    controller.configure(tree, settings, motors, KINEMATICS.home.tolist())
    _, state = made()
    controller.activate(state)
    controller.hold = core.Hold.place
    assert np.isfinite(controller.update(state, PERIOD)).all()


def test_wrong_uses_are_named():
    with pytest.raises(InvalidInputError, match=r"call configure\(hand\) before activate"):
        HandController().activate(HandState(JOINTS, 4))
    for largest in ([0.6], [0.6, 0.7, 0.8]):
        with pytest.raises(InvalidInputError, match="one number for each joint"):
            Calibration.currents([0.5, 0.5], largest, [1000.0, 1000.0])
    with pytest.raises(InvalidInputError, match="resolution"):
        Calibration([[-1.0, 1.0]], [[-1.0, 1.0]], resolution=np.nan)
