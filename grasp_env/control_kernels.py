"""One control tick, compiled: the wrench to balance, the forces that balance it, the torques that make them."""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled
from grasp_env._views import cut, inlined, small
from grasp_env.carry_kernels import bound_change, carry, least_norm, write_contact_geometry
from grasp_env.phi_kernels import cholesky, cholesky_solve
from grasp_env.sim.kinematics_kernels import add_force_torques, write_jacobian
from grasp_env.sim.snapshot import add_point_velocity, split, unpack_tree, write_rotation

MASS, POSITION_GAIN, POSITION_DAMPING, ROTATION_GAIN, ROTATION_DAMPING = range(5)
REACH_GAIN, REACH_DAMPING, REACH_LIMIT, REACH_DEPTH, POSTURE_GAIN, POSTURE_DAMPING, MOST_CHANGE = range(5, 12)
INERTIA = 12
"""Places in a belief: the object's mass and inertia (9, from INERTIA on), gains of the pose feedback, of fingers that reach for
their contact [N/m, N s/m, N, m], of the joints' posture, and the most a force may change in one tick [N]."""
BELIEF = 21

OPTIMISED, SQUEEZE, REACH, DIRECT, LOST = range(5)
"""What a finger in contact does: carry the optimised forces along; a constant squeeze; hold its place; a given force; what is left
without force closure: given forces, balanced as far as the cones let them."""

WRENCH, REPAIRED, PEAK = 0, 6, 7
COMMAND = 8
"""Places in a command: the wrench that is balanced, how often the forces had to be repaired, largest |torque| so far; from
COMMAND on M torques, (N, 3) forces in contact frames, (N, 9) contact frames, and what a tick needs while it runs."""
LEAST_NORMAL = 0.1
"""[N] of a finger without force closure."""
_NO_TANGENTS = np.zeros((0, 3))


def command_size(tips: int, joints: int) -> int:
    """Numbers in a command."""
    return COMMAND + joints + 12 * tips + 58 * tips


@compiled
def rotation_vector(rotation, out):
    """Axis times angle (3,) [rad] of a rotation matrix, exact below pi."""
    x, y, z = rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    sine = 0.5 * math.sqrt(x * x + y * y + z * z)
    cosine = 0.5 * (rotation[0, 0] + rotation[1, 1] + rotation[2, 2] - 1.0)
    factor = 0.5 * (math.atan2(sine, cosine) / sine if sine > 1e-9 else 1.0)
    out[0], out[1], out[2] = factor * x, factor * y, factor * z


@inlined
def pose_error(s, target, out):
    """Position [m], orientation [rad], velocities [m/s], [rad/s] of the object minus the target's: (12,), world."""
    wanted, relative = cut(small(9), 0, (3, 3)), cut(small(9), 0, (3, 3))
    write_rotation(target[3:7], wanted)
    for k in range(3):
        out[k] = s.position[k] - target[k]
        out[6 + k] = s.linear[k] - target[7 + k]
        out[9 + k] = s.angular[k] - target[10 + k]
        for q in range(3):
            relative[k, q] = 0.0
            for r in range(3):
                relative[k, q] += s.rotation[k, r] * wanted[q, r]
    rotation_vector(relative, out[3:6])


@inlined
def wrench_to_balance(s, target, told, gravity, belief, out):
    """Out (6,) = external wrench + weight - inertial wrench of the wanted motion + pose feedback [N, N m], object frame."""
    error, force, twist, turn = small(12), small(3), small(3), small(3)
    pose_error(s, target, error)
    mass = belief[MASS]
    for k in range(3):
        force[k] = mass * (gravity[k] - target[13 + k])
        force[k] += belief[POSITION_GAIN] * error[k] + belief[POSITION_DAMPING] * error[6 + k]
        # feedback and wanted motion as angular accelerations, world frame: the inertia makes moments of both
        twist[k] = belief[ROTATION_GAIN] * error[3 + k] + belief[ROTATION_DAMPING] * error[9 + k] - target[16 + k]
        turn[k] = 0.0
        for q in range(3):
            turn[k] += s.rotation[q, k] * target[10 + q]  # the wanted turn in the object frame
    for k in range(3):
        p, q = (k + 1) % 3, (k + 2) % 3
        spin_p, spin_q = 0.0, 0.0
        out[k], out[3 + k] = told[k], told[3 + k]
        for r in range(3):
            out[k] += s.rotation[r, k] * force[r]
            spin_p += belief[INERTIA + 3 * p + r] * turn[r]
            spin_q += belief[INERTIA + 3 * q + r] * turn[r]
            asked = 0.0
            for t in range(3):
                asked += s.rotation[t, r] * twist[t]
            out[3 + k] += belief[INERTIA + 3 * k + r] * asked
        out[3 + k] -= turn[p] * spin_q - turn[q] * spin_p


@compiled
def balance(buffer, indices, target, told, gravity, belief, out):
    """`wrench_to_balance` of a snapshot's buffer."""
    wrench_to_balance(split(buffer, indices[1], indices[0]), target, told, gravity, belief, out)


@inlined
def _reach(tree, s, i, anchor, rotation, position, goal, inward, depth, belief, force):
    """Spring and damper that bring tip i to its place `depth` inside the surface at `goal`, carried by a pose: force (3,), world."""
    velocity = small(3)
    velocity[:] = 0.0
    add_point_velocity(tree.parents, tree.tip_links[i], s.origins, s.axes, s.rates, s.tips[i], velocity)
    total = 0.0
    for k in range(3):
        place = position[k]
        for q in range(3):
            place += rotation[k, q] * (goal[q] - (tree.tip_radii[i] - depth) * inward[q])
        p, q = (k + 1) % 3, (k + 2) % 3
        drift = (
            s.linear[k] + s.angular[p] * (s.tips[i, q] - s.position[q]) - s.angular[q] * (s.tips[i, p] - s.position[p])
        )
        speed = velocity[k] - (0.0 if anchor else drift)
        force[k] = belief[REACH_GAIN] * (place - s.tips[i, k]) - belief[REACH_DAMPING] * speed
        total += force[k] * force[k]
    if total > belief[REACH_LIMIT] ** 2:
        force *= belief[REACH_LIMIT] / math.sqrt(total)


@compiled
def _posture(tree, s, home, belief, torques):
    """Adds what keeps a redundant hand near its rest posture without moving the tips: the null space of all tip Jacobians."""
    m, n = s.angles.size, s.tips.shape[0]
    pull, jacobian, normal, y = np.empty(m), np.empty((3 * n, m)), np.zeros((3 * n, 3 * n)), np.zeros(3 * n)
    for j in range(m):
        pull[j] = -belief[POSTURE_GAIN] * (s.angles[j] - home[j]) - belief[POSTURE_DAMPING] * s.rates[j]
    for i in range(n):
        write_jacobian(tree, tree.tip_links[i], s.origins, s.axes, s.tips[i], jacobian[3 * i : 3 * i + 3])
    for a in range(3 * n):
        for j in range(m):
            y[a] += jacobian[a, j] * pull[j]
        for b in range(a + 1):
            for j in range(m):
                normal[a, b] += jacobian[a, j] * jacobian[b, j]
        normal[a, a] += 1e-10
    if not cholesky(normal):
        return
    cholesky_solve(normal, y)
    for j in range(m):
        torques[j] += pull[j]
        for a in range(3 * n):
            torques[j] -= jacobian[a, j] * y[a]


@compiled
def tick(
    numbers, indices, home, buffer, target, told, gravity, belief, mode, fingers, given, given_frames, divisor, weights, basis,
    basis_frames, goals, inwards, fresh, command,
):  # fmt: skip
    """Torques of one control tick; see the places in `command`.

    Args:
        numbers, indices: the hand, from `pack_tree`. home: (M,) its rest posture [rad].
        buffer: the snapshot of now.
        target: (19,) the wanted pose and motion of the object, see `task.Plan`.
        told: (6,) external wrench as far as known [N, N m], object frame. gravity: (3,) as far as known.
        belief: (BELIEF,) see above.
        mode: OPTIMISED, SQUEEZE, REACH, DIRECT or LOST.
        fingers: (n,) the fingers in contact; all others reach for their places.
        given: (3n,) the last optimum in cone coordinates, in `given_frames` (n, 3, 3); (3n,) the internal force to hold
            (SQUEEZE) or the forces (DIRECT, LOST), contact frames; (N,) depths of the tips' places (REACH).
        divisor: (n, 3) of cone coordinates. weights: (n, 2). basis, basis_frames: (13, 3n), (n, 3, 3) the offline basis.
        goals, inwards: (N, 3) the grasp's contact points and inward normals, object frame.
        fresh: whether nothing was commanded before: the change of the forces is then not bounded.
        command: holds the last commanded forces; overwritten, but for REPAIRED and PEAK, which add up.
    """
    tree = unpack_tree(numbers, indices)
    m, n = indices[0], indices[1]
    s = split(buffer, n, m)
    torques = cut(command, COMMAND, (m,))
    forces = cut(command, COMMAND + m, (n, 3))
    frames = cut(command, COMMAND + m + 3 * n, (n, 3, 3))
    own = COMMAND + m + 12 * n
    before, frames_before = cut(command, own, (n, 3)), cut(command, own + 3 * n, (n, 3, 3))
    matrix, cone_matrix = cut(command, own + 12 * n, (6, 3 * n)), cut(command, own + 30 * n, (6, 3 * n))
    f, scale, acting = (
        cut(command, own + 48 * n, (3 * n,)),
        cut(command, own + 51 * n, (n, 3)),
        cut(command, own + 54 * n, (n,)),
    )
    wrench = cut(command, WRENCH, (6,))
    wrench_to_balance(s, target, told, gravity, belief, wrench)
    for j in range(m):
        torques[j] = s.gravity_torques[j]
    count = fingers.size if mode != REACH else 0
    for i in range(n):
        acting[i] = 0.0
        for k in range(3):
            before[i, k], forces[i, k] = forces[i, k], 0.0
            scale[i, k] = 1.0
            for q in range(3):
                frames_before[i, k, q] = frames[i, k, q]
    for a in range(count):
        acting[fingers[a]] = 1.0
        for k in range(3):
            scale[fingers[a], k] = divisor[a, k]
    write_contact_geometry(s.points, s.normals, scale, _NO_TANGENTS, frames, matrix, cone_matrix)
    if mode == OPTIMISED and count == n:
        if not carry(given, given_frames, basis, basis_frames, frames, cone_matrix, divisor, wrench, weights, f):
            command[REPAIRED] += 1.0
        if not fresh:
            bound_change(
                f,
                before,
                frames_before,
                basis,
                basis_frames,
                frames,
                cone_matrix,
                divisor,
                wrench,
                weights,
                belief[MOST_CHANGE],
            )
        for i in range(n):
            for k in range(3):
                f[3 * i + k] /= divisor[i, k]
    elif count > 0:
        _other_forces(
            command, indices, fingers, mode, given, given_frames, basis, basis_frames, divisor, wrench, weights, fresh,
            belief[MOST_CHANGE],
        )  # fmt: skip
    world, wanted = small(3), cut(small(9), 0, (3, 3))
    for a in range(count):
        i = fingers[a]
        world[:] = 0.0
        for q in range(3):
            along = 0.0
            for r in range(3):
                along += frames[i, q, r] * f[3 * a + r]
            for k in range(3):
                world[k] += s.rotation[k, q] * along
            forces[i, q] = f[3 * a + q]
        add_force_torques(tree, tree.tip_links[i], s.origins, s.axes, s.touch[i], world, torques)
    if count < n:
        write_rotation(target[3:7], wanted)
    for i in range(n):
        if acting[i] == 0.0:
            if mode == REACH:
                _reach(tree, s, i, True, wanted, target[:3], goals[i], inwards[i], given[i], belief, world)
            else:
                _reach(
                    tree, s, i, False, s.rotation, s.position, goals[i], inwards[i], belief[REACH_DEPTH], belief, world
                )
            add_force_torques(tree, tree.tip_links[i], s.origins, s.axes, s.tips[i], world, torques)
    if m > 3 * n:
        _posture(tree, s, home, belief, torques)
    peak = command[PEAK]
    for j in range(m):
        limit = tree.torque_limits[j]
        torques[j] = min(max(torques[j], -limit), limit)
        peak = max(peak, abs(torques[j]))
    command[PEAK] = peak


@compiled
def _other_forces(
    command, indices, fingers, mode, given, given_frames, basis, basis_frames, divisor, wrench, weights, fresh, most
):  # fmt: skip
    """The forces of a tick where not all fingers are in contact, or nothing is optimised, into the command's `f`; as in `tick`."""
    m, n = indices[0], indices[1]
    count = fingers.size
    own = COMMAND + m + 12 * n
    f = cut(command, own + 48 * n, (3 * count,))
    if mode == DIRECT:
        f[:] = given
        return
    frames, before = cut(command, COMMAND + m + 3 * n, (n, 3, 3)), cut(command, own, (n, 3))
    frames_before = cut(command, own + 3 * n, (n, 3, 3))
    matrix, cone_matrix = cut(command, own + 12 * n, (6, 3 * n)), cut(command, own + 30 * n, (6, 3 * n))
    held, cones = np.empty((6, 3 * count)), np.empty((6, 3 * count))
    for a in range(count):
        for k in range(3):
            for r in range(6):
                held[r, 3 * a + k] = matrix[r, 3 * fingers[a] + k]
                cones[r, 3 * a + k] = cone_matrix[r, 3 * fingers[a] + k]
    if mode == SQUEEZE:
        f[:] = given
        least_norm(f, held, wrench)
        return
    if mode == LOST:
        f[:] = given
        least_norm(f, held, wrench)
        for a in range(count):
            normal = max(f[3 * a], LEAST_NORMAL)
            tangential = math.sqrt(f[3 * a + 1] ** 2 + f[3 * a + 2] ** 2)
            share = min(1.0, divisor[a, 0] * normal / max(tangential, 1e-12))
            f[3 * a], f[3 * a + 1], f[3 * a + 2] = normal, share * f[3 * a + 1], share * f[3 * a + 2]
        return
    now = frames[fingers]
    if not carry(given, given_frames, basis, basis_frames, now, cones, divisor, wrench, weights, f):
        command[REPAIRED] += 1.0
    if not fresh:
        bound_change(
            f, before[fingers], frames_before[fingers], basis, basis_frames, now, cones, divisor, wrench, weights, most
        )
    for j in range(3 * count):
        f[j] /= divisor[j // 3, j % 3]
