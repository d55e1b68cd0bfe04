"""The force that nearly balances a wrench where contacts cannot: of any contacts, one or many, hard,
frictionless or soft."""

from __future__ import annotations

import _core_test as insides
import numpy as np
import pytest
from cases import FIELDS, Case, case
from oracles import newton
from oracles import phi as oracle
from samples import Sample, wrenches

KINDS = ("hard", "frictionless", "some soft", "all soft", "slippery soft")


def part_of(c: Case, chosen: np.ndarray) -> Case:
    s = c.contacts
    few = Sample(s.positions[chosen], s.normals[chosen], s.scale[chosen], s.weights[chosen])
    return Case(few, c.gamma[chosen])


def solved(
    c: Case, touching: np.ndarray, load: np.ndarray, force: np.ndarray, torsion: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    bits = int(sum(1 << int(k) for k in np.flatnonzero(touching)))
    found, turned, steps = insides.elastic_balance(c.placement, bits, load, 300, force, torsion)
    assert 0 < steps < 300
    return found, turned


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 2, 3, 5, 9])
def test_it_is_the_least_of_phi_and_of_what_balance_misses(count, kind):
    """Phi + |G x + w|^2 / (2 softness) is convex: it is least where its gradient vanishes, measured
    by what a Newton step gains."""
    many = case(9, kind)
    rng = np.random.default_rng(count)
    turned_some = 0.0
    for load in wrenches(rng, 4, 0.3):  # steps from far away stall at the cones' surfaces
        touching = np.arange(9) < count
        rng.shuffle(touching)
        guess = np.column_stack([rng.uniform(0.2, 1.0, 9), 0.1 * rng.standard_normal((9, 2))])
        turn = 1e-3 * rng.standard_normal(9)
        guess[:, 1:] *= many.contacts.scale[:, 1:] > 0.0
        turn *= many.soft
        force, torsion = solved(many, touching, load, guess, turn)
        np.testing.assert_array_equal(force[~touching], guess[~touching])
        np.testing.assert_array_equal(torsion[~touching], turn[~touching])
        np.testing.assert_array_equal(torsion[~many.soft], 0.0)
        c = part_of(many, touching)
        # moments about the contacts' centre, over their length; one contact has none
        row = np.concatenate([force[touching].reshape(-1), np.zeros(3 * count), torsion[touching]])
        x = c.z(_as_record(row, count)).astype(np.longdouble)
        missed = c.matrix @ x + c.contacts.unit @ load
        slope = oracle.gradient(x, c.phi_weights) + c.matrix.T @ missed / insides.SOFTNESS
        full = oracle.hessian(x, c.phi_weights) + c.matrix.T @ c.matrix / insides.SOFTNESS
        value = float(oracle.phi(x, c.phi_weights)) + missed @ missed / (2.0 * insides.SOFTNESS)
        assert np.isfinite(value)
        assert slope @ newton.solve(full, slope) <= 1e-8 * value
        turned_some = max(turned_some, np.abs(torsion[touching]).max())
    assert turned_some > 1e-4 or count == 1 or not many.soft.any()


def _as_record(row: np.ndarray, count: int) -> np.ndarray:
    """A record with these forces, initial forces and torsions."""
    return np.concatenate([np.zeros(FIELDS["force"]), row, np.zeros(20 * count)])


@pytest.mark.parametrize("count", [1, 3, 5])
def test_without_torsional_friction_contacts_are_hard_bit_for_bit(count):
    hard = case(5, "hard")
    s = hard.contacts
    plain = insides.place(s.positions, s.normals, s.scale, s.weights)
    zeros = insides.place(s.positions, s.normals, s.scale, s.weights, torsion=np.zeros(5))
    bits = (1 << count) - 1
    for load in wrenches(np.random.default_rng(count), 4, 3.0):
        guess = np.tile([1.0, 0.1, -0.2], (5, 1))
        answers = [
            insides.elastic_balance(placement, bits, load, 500, guess, np.zeros(5))
            for placement in (plain, zeros)
        ]
        for one, other in zip(*answers, strict=True):
            np.testing.assert_array_equal(one, other)
        assert not answers[0][1].any()
