"""The general program on dense rows (m, N, 4) in (u, o, t, w), w = u - v: what the core's insides and the dense twin are given."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from cases import Case, with_slack
from oracles.interior_point import ConicProgram, Iterate


class Asked(NamedTuple):
    """A program: the first `equal` rows are equations."""

    rows: np.ndarray
    coupling: np.ndarray
    right: np.ndarray
    equal: int
    cost: np.ndarray
    shared_cost: np.ndarray
    soft: np.ndarray


class State(NamedTuple):
    """Its variables: y the multipliers of all rows, slack of those that are limits."""

    z: np.ndarray
    s: np.ndarray
    t: np.ndarray
    y: np.ndarray
    slack: np.ndarray


def limit_rows(c: Case) -> tuple[np.ndarray, np.ndarray]:
    """-torsion <= its limit of soft contacts, which is w <= 2u, then the limits, each of length one: rows and right sides."""
    which, (given, bound, _) = np.flatnonzero(c.soft), c.given_rows
    torsion = np.zeros((len(which), c.count, 4))
    torsion[np.arange(len(which)), which, 0], torsion[np.arange(len(which)), which, 3] = -2.0, 1.0
    rows = np.concatenate([torsion, with_slack(given / c.sizes[:, None, None])])
    return rows, np.append(np.zeros(len(which)), bound / c.sizes)


def asked_of(c: Case, load: np.ndarray, kind: str) -> Asked:
    """The least sum, the least maximum (`largest`), or the deepest force."""
    balance, (rows, bound) = with_slack(c.balance), limit_rows(c)
    unit, count, limits = c.contacts.unit @ load, c.count, len(bound)
    every, right = np.concatenate([balance, rows]), np.concatenate([-unit, bound])
    cost, price = np.zeros((count, 4)), 1.0 / c.contacts.divisor[:, 0]
    if kind == "sum":
        cost[:, 0] = price
        return Asked(every, np.zeros((len(every), 0)), right, 6, cost, np.zeros(0), c.soft)
    if kind == "largest":
        most = np.zeros((count, count, 4))
        most[np.arange(count), np.arange(count), 0] = price
        coupling = np.concatenate([np.zeros((len(every), 1)), -np.ones((count, 1))])
        every, right = np.concatenate([every, most]), np.append(right, np.zeros(count))
        return Asked(every, coupling, right, 6, cost, np.ones(1), c.soft)
    inward, total = np.zeros((count, 4)), np.zeros((1, count, 4))
    inward[:, 0], inward[:, 3], total[0, :, 0] = 1.0, c.soft, 1.0
    coupling = np.zeros((8 + limits, 2))
    coupling[:6, 0], coupling[:6, 1], coupling[6] = np.einsum("rna,na->r", balance, inward), unit, (count, 1.0)
    coupling[7:-1, 0] = np.einsum("rna,na->r", rows, inward) + 1.0
    coupling[7:-1, 1], coupling[-1] = -bound, (1.0, -1.0)
    every = np.concatenate([balance, total, rows, np.zeros((1, count, 4))])
    return Asked(every, coupling, np.eye(len(every))[6], 7, cost, np.array([-1.0, 0.0]), c.soft)


def cold(asked: Asked) -> State:
    units = np.tile([1.0, 0.0, 0.0, 1.0], (len(asked.cost), 1))
    y = np.concatenate([np.zeros(asked.equal), np.ones(len(asked.right) - asked.equal)])
    return State(units, units.copy(), np.zeros(len(asked.shared_cost)), y, np.maximum(1.0, asked.right))


def twin(asked: Asked) -> ConicProgram:
    """Cones of the contacts, then w of soft contacts, then slacks of the limits."""
    m, count = len(asked.right), len(asked.cost)
    limits = m - asked.equal
    matrix = np.hstack([asked.rows[:, :, :3].reshape(m, -1), asked.rows[:, asked.soft, 3], np.eye(m)[:, asked.equal :]])
    cost = np.concatenate([asked.cost[:, :3].reshape(-1), asked.cost[asked.soft, 3], np.zeros(limits)])
    sizes = (3,) * count + (1,) * (int(asked.soft.sum()) + limits)
    return ConicProgram(
        matrix, asked.right, cost, asked.coupling, asked.shared_cost, sizes, len(sizes), (0.9, 0.095), 1e-10
    )  # fmt: skip


def flat(asked: Asked, state: State) -> Iterate:
    """The variables as the twin's; the multiplier of a limit is its slack's dual."""
    z, s, t, y, slack = state
    x = np.concatenate([z[:, :3].reshape(-1), z[asked.soft, 3], slack[asked.equal :]])
    return Iterate(x, np.concatenate([s[:, :3].reshape(-1), s[asked.soft, 3], y[asked.equal :]]), t, y)
