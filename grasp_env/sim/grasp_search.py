"""Compiled search for the contacts with which a hand holds an object best.

Every finger has a pool of places that it reaches on its own (`grasp_places`). A choice of one place per finger is rated
by the total normal force that the worst of some wrenches needs. That is a maximum over directions y in wrench space,

    max_y  max_w (-w . y) / h(y),  h(y) = max_i max {f . v_i(y) : f in cone i, normal part 1},

in which each place enters on its own: its part of h is tabulated for a few hundred y, so that a choice takes a
microsecond. The choices that do best by the table are solved exactly, by linear programming whose columns, rays of the
round cones, are made as they are needed; the multipliers of that are further directions y for the table, the ones that
matter.
"""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled
from grasp_env.sim.clearance import segment_gap

_PENALTY = 1e6  # [N] of what no contact force balances
_PIVOTS = 120
_EXACT = 0.02  # relative gap of the total normal force
_SWEEPS = 8


@compiled
def _reply(point, normal, friction, length, y, ray):
    """Most work that a contact force of normal part 1 does along y (6,); writes its wrench (6,)."""
    vx = y[0] + (y[4] * point[2] - y[5] * point[1]) / length
    vy = y[1] + (y[5] * point[0] - y[3] * point[2]) / length
    vz = y[2] + (y[3] * point[1] - y[4] * point[0]) / length
    along = vx * normal[0] + vy * normal[1] + vz * normal[2]
    tx, ty, tz = vx - along * normal[0], vy - along * normal[1], vz - along * normal[2]
    size = math.sqrt(tx * tx + ty * ty + tz * tz)
    part = friction / size if size > 0.0 else 0.0
    fx, fy, fz = normal[0] + part * tx, normal[1] + part * ty, normal[2] + part * tz
    ray[0], ray[1], ray[2] = fx, fy, fz
    ray[3] = (point[1] * fz - point[2] * fy) / length
    ray[4] = (point[2] * fx - point[0] * fz) / length
    ray[5] = (point[0] * fy - point[1] * fx) / length
    return along + friction * size


@compiled
def least_force(points, normals, friction, length, load, y):
    """Total normal force [N] of contact forces whose wrench is `load`, at most 2 % above the least possible.

    Args:
        points: Contacts [m], (N, 3).
        normals: Inward, unit, (N, 3).
        friction: Coefficient.
        length: By which moments are divided [m].
        load: Force [N] and moment / length [N], (6,).
        y: Output: multipliers, (6,); load . y over the largest `_reply` is a lower bound.

    Returns:
        inf where no force was found.
    """
    inverse, amount, cost = np.zeros((6, 6)), np.empty(6), np.empty(6)
    ray, best_ray, column = np.empty(6), np.empty(6), np.empty(6)
    for r in range(6):
        inverse[r, r] = 1.0 if load[r] >= 0.0 else -1.0
        amount[r], cost[r] = abs(load[r]), _PENALTY
    for _ in range(_PIVOTS):
        upper, value = 0.0, 0.0
        for k in range(6):
            y[k] = 0.0
            upper += cost[k] * amount[k]
            for r in range(6):
                y[k] += cost[r] * inverse[r, k]
            value += y[k] * load[k]
        reply = -math.inf
        for i in range(len(points)):
            work = _reply(points[i], normals[i], friction, length, y, ray)
            if work > reply:
                reply = work
                best_ray[:] = ray
        if reply <= 1.0 + 1e-9 or (upper < 0.1 * _PENALTY and upper * reply <= (1.0 + _EXACT) * value):
            break
        leaving, least = -1, math.inf
        for r in range(6):
            column[r] = 0.0
            for k in range(6):
                column[r] += inverse[r, k] * best_ray[k]
            if column[r] > 1e-10 and amount[r] < least * column[r]:
                leaving, least = r, amount[r] / column[r]
        if leaving < 0:
            break
        for r in range(6):
            if r != leaving:
                amount[r] = max(amount[r] - least * column[r], 0.0)
                for k in range(6):
                    inverse[r, k] -= column[r] / column[leaving] * inverse[leaving, k]
        for k in range(6):
            inverse[leaving, k] /= column[leaving]
        amount[leaving], cost[leaving] = least, 1.0
    total = 0.0
    for r in range(6):
        if cost[r] > 1.0 and amount[r] > 1e-9:
            return math.inf
        total += amount[r] * (cost[r] == 1.0)
    return total


@compiled
def worst_force(points, normals, friction, length, loads, multipliers):
    """Largest `least_force` over loads (L, 6) [N]; writes their multipliers (L, 6). inf: one cannot be balanced."""
    worst = 0.0
    for m in range(len(loads)):
        worst = max(worst, least_force(points, normals, friction, length, loads[m], multipliers[m]))
    return worst


@compiled
def _tabulate(points, normals, counts, friction, length, loads, directions, first, last, table, needs):
    """Fill columns first to last: `table` (N, K, D) the replies of all places, `needs` (D,) the largest load . y."""
    ray = np.empty(6)
    for d in range(first, last):
        needs[d] = -math.inf
        for m in range(len(loads)):
            work = 0.0
            for k in range(6):
                work += loads[m, k] * directions[d, k]
            needs[d] = max(needs[d], work)
        for i in range(len(counts)):
            for k in range(counts[i]):
                table[i, k, d] = _reply(points[i, k], normals[i, k], friction, length, directions[d], ray)


@compiled
def _rate(table, needs, count, choice, limit):
    """The lower bound of a choice [N] by the table; stops above `limit`."""
    worst = 0.0
    for d in range(count):
        reply = 0.0
        for i in range(len(choice)):
            reply = max(reply, table[i, choice[i], d])
        if needs[d] > worst * reply:
            worst = needs[d] / reply if reply > 0.0 else math.inf
            if worst >= limit:
                return worst
    return worst


@compiled
def _apart(limbs, carried, starts, ends, choice, i, k, last, space):
    """Whether finger i at its place k keeps `space` [m] from the fingers before `last` at their chosen places."""
    for j in range(last):
        if j == i:
            continue
        m = choice[j]
        for c in range(len(limbs.links)):
            if not carried[i, c]:
                continue
            for e in range(len(limbs.links)):
                if carried[j, e] and not carried[i, e] and not carried[j, c]:
                    gap = segment_gap(starts[i, k, c], ends[i, k, c], starts[j, m, e], ends[j, m, e])
                    if gap < limbs.radii[c] + limbs.radii[e] + space:
                        return False
    return True


@compiled
def choose(
    limbs, carried, counts, points, normals, starts, ends, friction, length, loads, space, directions, given, picks,
    choices, forces,
):  # fmt: skip
    """Write the best choices found, one a round, and the total normal force [N] that each needs in the worst case.

    Args:
        limbs: The hand's `Limbs`.
        carried: Whether a finger moves a limb, (N, C) bool.
        counts: Number of places of each finger, (N,) int64.
        points, normals, starts, ends: The pools, (N, K, ...).
        friction: Coefficient.
        length: By which moments are divided [m].
        loads: Wrenches to balance, as in `least_force`, (L, 6); their convex hull holds 0 inside.
        space: Between fingers [m].
        directions: (D, 6), overwritten from row `given` on with the multipliers found.
        given: Rows of `directions` to begin with.
        picks: Random integers >= 0 for the choices to begin with, (P, N) int64.
        choices: Output, (R, N) int64; what does not balance all loads has force inf.
        forces: Output [N], (R,).
    """
    fingers, most = points.shape[0], points.shape[1]
    table, needs = np.empty((fingers, most, len(directions))), np.empty(len(directions))
    choice, best = np.empty(fingers, np.int64), np.zeros(fingers, np.int64)
    chosen_points, chosen_normals = np.empty((fingers, 3)), np.empty((fingers, 3))
    known = given
    _tabulate(points, normals, counts, friction, length, loads, directions, 0, known, table, needs)
    have = False
    begun = 0
    for turn in range(len(forces)):
        forces[turn] = math.inf
        rating = _rate(table, needs, known, best, math.inf) if have else math.inf
        share = len(picks) // 2 if turn == 0 else len(picks) // (2 * len(forces))
        for start in range(share + 1):
            if start == share:
                if not have:
                    break
                choice[:] = best
            else:
                row = picks[begun % len(picks)]
                begun += 1
                for i in range(fingers):
                    choice[i] = row[i] % counts[i]
                    for _ in range(counts[i]):
                        if _apart(limbs, carried, starts, ends, choice, i, choice[i], i, space):
                            break
                        choice[i] = (choice[i] + 1) % counts[i]
                apart = True
                for i in range(fingers):
                    apart = apart and _apart(limbs, carried, starts, ends, choice, i, choice[i], i, space)
                if not apart:
                    continue
            found = _rate(table, needs, known, choice, math.inf)
            for _ in range(_SWEEPS):
                better = False
                for i in range(fingers):
                    kept = choice[i]
                    for k in range(counts[i]):
                        choice[i] = k
                        rated = _rate(table, needs, known, choice, found)
                        if rated < found and _apart(limbs, carried, starts, ends, choice, i, k, fingers, space):
                            found, kept, better = rated, k, True
                    choice[i] = kept
                if not better:
                    break
            if found < rating or not have:
                rating, have = found, True
                best[:] = choice
        if not have:
            return
        for i in range(fingers):
            chosen_points[i], chosen_normals[i] = points[i, best[i]], normals[i, best[i]]
        choices[turn] = best
        multipliers = directions[known : known + len(loads)]
        forces[turn] = worst_force(chosen_points, chosen_normals, friction, length, loads, multipliers)
        _tabulate(
            points, normals, counts, friction, length, loads, directions, known, known + len(loads), table, needs
        )  # fmt: skip
        known += len(loads)
