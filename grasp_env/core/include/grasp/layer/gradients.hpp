// Gradients of a loss by all inputs of the problems, by the adjoint system of `SmoothLanes`.
#pragma once
#include <grasp/layer/stiff.hpp>

namespace grasp {

template <int W, int D> void SmoothLanes<W, D>::gradients(Mask chosen, const BatchLosses& losses,
                                                          const BatchGradients& to) {
  const int n = count();
  const auto gather = [&](const double* from, int width, int at) {
    V values{};
    for (int lane = 0; from && lane < W; ++lane)
      if (chosen[lane]) set(values, lane, from[width * number(lane) + at]);
    return values;
  };
  const auto gather3 = [&](const double* from, int width, int at) {
    return Vec3<V>{gather(from, width, at), gather(from, width, at + 1),
                   gather(from, width, at + 2)};
  };
  const auto scatter = [&](double* out, int width, int at, const V& from) {
    for (int lane = 0; lane < W; ++lane)
      if (chosen[lane]) out[width * number(lane) + at] = get(from, lane);
  };
  const auto scatter3 = [&](double* out, int width, int at, const Vec3<V>& from) {
    for (int a = 0; a < 3; ++a) scatter(out, width, at + a, from[a]);
  };
  assemble();
  // the adjoint system
  for (int i = 0; i < n; ++i) {
    const Contact& c = at_[i];
    const X& divisor = cones_.blocks[i].divisor;
    const Vec3<V> by = gather3(losses.force, 3 * n, 3 * i);
    for (int a = 0; a < 3; ++a) pull_[i][a] = dot(by, c.frame[a]) / divisor[a];
    if constexpr (D == 4) pull_[i].v = gather(losses.torsion, n, i) / divisor.v;
  }
  Six<V> by_nu;
  for (int r = 0; r < 6; ++r) by_nu[r] = -gather(losses.multipliers, 6, r);
  const Six<V> hu = cones_.unit.of(by_nu);
  const Mask hard = chosen & stiff();
  Mask solved{};
  Six<V> hard_q{};
  for (int lane = 0; lane < W; ++lane)
    if (hard[lane]) solved[lane] = solve_stiff(lane, hu, hard_q) ? -1 : 0;
  if (any(hard)) rest_ = step_;
  const auto allowed = [&](const Six<V>&) {
    return MISSES * (cones_.largest_normal(step_) + size(hu));
  };
  Six<V> qu = solve(pull_, hu, step_, allowed);  // p in step_
  if (any(hard)) {
    copy_where(hard, rest_, step_);
    qu = select(hard, hard_q, qu);
    chosen &= ~hard | solved;
  }
  V total = size(qu);
  for (int i = 0; i < n; ++i)
    for (int a = 0; a < D; ++a) total += abs(step_[i][a]);
  chosen &= total < LARGEST * LARGEST;  // no gradient if digits are lost
  // multipliers as twists about the contacts' centre
  const V per_length = cones_.unit.scale();
  const Vec3<V> y_turn = per_length * Vec3<V>{y_[3], y_[4], y_[5]};
  const Vec3<V> y_move{y_[0], y_[1], y_[2]};
  const Vec3<V> q_turn = per_length * Vec3<V>{qu[3], qu[4], qu[5]};
  const Vec3<V> q_move{qu[0], qu[1], qu[2]};
  if (to.wrench) {
    const Six<V> q = cones_.unit.pull_back(qu);
    for (int r = 0; r < 6; ++r) scatter(to.wrench, 6, r, -q[r]);
  }
  // a missed balance is measured about the contacts' centre, in units of their length
  const Vec3<V> by_centre = softness_ * (cross(y_move, q_turn) + cross(q_move, y_turn));
  const V by_length = 2.0 * softness_ * cones_.unit.length * dot(q_turn, y_turn);
  const V share = 1.0 / double(n);
  const V stretch =
      select(cones_.unit.length > 0.0, share * by_length / cones_.unit.length, V(0.0));

  // torque limits: T_j = price (torque of p), which depends on bias, limit, length, weight and edge
  struct OfRow {
    V by_force, by_p, by_size;  // derivatives by J . F, by J . P, by the row's length
  };
  std::vector<OfRow> of(joints_);
  std::vector<V> lambda_share(joints_);
  std::vector<V> omega_share(joints_);
  for (int j = 0; j < joints_; ++j) {
    const Row& row = rows_[j];
    const Limit &high = row.high, &low = row.low;
    V along{};
    for (int i = 0; i < n; ++i) along += this->along(i, j, step_[i]);
    const V per = 1.0 / row.size;
    const V bends = high.bend + low.bend;
    const V high_slack = high.bound - row.along;
    const V low_slack = low.bound + row.along;
    // without a limit the slack is meaningless and the bend zero
    const V uneven = select(high.weight > 0.0, high.bend * high_slack, V(0.0)) -
                     select(low.weight > 0.0, low.bend * low_slack, V(0.0));
    of[j] = {-along * bends * per, -row.price * per,
             select(row.empty > 0.0, V(0.0), -along * (uneven - row.price) * per)};
    if (to.torque_bias) scatter(to.torque_bias, batch_.joints, j, of[j].by_force);
    if (to.torque_limit)
      scatter(to.torque_limit, batch_.joints, j, -along * (low.bend - high.bend) * per);
    const V by_edge =
        -along * (high.by_edge(row.along, row.edge) - low.by_edge(-row.along, row.edge));
    lambda_share[j] =
        (-along * row.price / row.lambda + 0.5 * row.edge * by_edge / row.lambda) / row.touches;
    omega_share[j] = -0.5 * row.edge * by_edge / row.omega / row.touches;
  }

  for (int i = 0; i < n; ++i) {
    const Contact& c = at_[i];
    const Block<V, D>& block = cones_.blocks[i];
    const X& p = step_[i];
    const Vec3<V> force = object_force(i, x_[i]);
    const Vec3<V> other = object_force(i, p);
    const V turn = moment(i, x_[i]);
    const V other_turn = moment(i, p);
    Vec3<V> by_f = gather3(losses.force, 3 * n, 3 * i) - q_move - cross(q_turn, c.arm);
    Vec3<V> by_p = -y_move - cross(y_turn, c.arm);
    Vec3<V> by_turn = -q_turn;  // derivatives by the moments along the normal
    Vec3<V> by_other_turn = -y_turn;
    Vec3<V> by_frame[3] = {};
    X by_divisor{};
    V by_lambda{};
    V by_omega = -3.0 * p.u;
    for (int j = 0; j < joints_; ++j) {
      const Column& col = column(i, j);
      const Vec3<V> moves = motion(i, j, 0);
      const Vec3<V> turns = batch_.jacobian_rows < 6 ? Vec3<V>{} : motion(i, j, 3);
      by_f += of[j].by_force * moves;
      by_p += of[j].by_p * moves;
      by_turn += of[j].by_force * turns;
      by_other_turn += of[j].by_p * turns;
      // the row's length
      X part;
      for (int a = 0; a < D; ++a) {
        part[a] = of[j].by_size * col.c[a] / block.divisor[a];
        by_frame[a % 3] += part[a] * (a < 3 ? moves : turns);  // v is along the normal
        by_divisor[a] -= part[a] * rows_[j].size * col.c[a];
      }
      by_lambda += col.touched * lambda_share[j];
      by_omega += col.touched * omega_share[j];
      if (to.jacobian) {
        const int width = n * batch_.jacobian_rows * batch_.joints;
        const Vec3<V> moved = of[j].by_force * force + of[j].by_p * other + part.u * c.frame[0] +
                              part.o * c.frame[1] + part.t * c.frame[2];
        V turned = of[j].by_force * turn + of[j].by_p * other_turn;
        if constexpr (D == 4) turned += part.v;
        for (int r = 0; r < batch_.jacobian_rows; ++r)
          scatter(to.jacobian, width, (i * batch_.jacobian_rows + r) * batch_.joints + j,
                  r < 3 ? moved[r] : turned * c.frame[0][r - 3]);
      }
    }
    if (to.positions)
      scatter3(to.positions, 3 * n, 3 * i,
               share * by_centre + stretch * c.arm - cross(other, y_turn) - cross(force, q_turn));
    // directions of the force, and the normal as the axis of torsion
    for (int a = 0; a < 3; ++a) {
      const V f = x_[i][a] / block.divisor[a];
      const V g = p[a] / block.divisor[a];
      by_frame[a] += f * by_f + g * by_p;
      by_divisor[a] -= (f * dot(by_f, c.frame[a]) + g * dot(by_p, c.frame[a])) / block.divisor[a];
    }
    by_frame[0] += turn * by_turn + other_turn * by_other_turn;
    if constexpr (D == 4)
      by_divisor.v -= (turn * (dot(by_turn, c.frame[0]) + gather(losses.torsion, n, i)) +
                       other_turn * dot(by_other_turn, c.frame[0])) /
                      block.divisor.v;
    // limits of the normal force: bounds of u
    const V low_there = select(c.low.weight > 0.0, V(1.0), V(0.0));
    const V high_there = select(c.high.weight > 0.0, V(1.0), V(0.0));
    const V by_low = p.u * c.low.bend * low_there;
    const V by_high = p.u * c.high.bend * high_there;
    if (to.min_normal) scatter(to.min_normal, n, i, by_low * block.scale.u);
    if (to.max_normal) scatter(to.max_normal, n, i, by_high * block.scale.u);
    by_divisor.u +=
        (by_high * c.high.bound * high_there - by_low * c.low.bound * low_there) / block.scale.u;
    const V normal_price = c.high.price * high_there - c.low.price * low_there;
    const V normal_edge =
        -p.u * (c.high.by_edge(x_[i].u, c.edge) - c.low.by_edge(-x_[i].u, c.edge));
    // weights: the barriers are linear in lambda
    Weights<V, D> barrier = block.weights;
    barrier.omega = V(0.0);
    const X cone = gradient(x_[i], barrier);
    by_lambda -= (dot(p, cone) + p.u * normal_price) / c.lambda;
    by_lambda += 0.5 * c.edge * normal_edge / c.lambda;
    by_omega -= 0.5 * c.edge * normal_edge / block.weights.omega;
    if (to.force_weight) scatter(to.force_weight, n, i, by_omega);
    if (to.barrier_weight) scatter(to.barrier_weight, n, i, by_lambda);
    // friction: the scales; that of torsion is mu / gamma
    if constexpr (D == 4) {
      const V by_mu = by_divisor.v * block.scale.v / block.scale.u;
      if (to.torsion) scatter(to.torsion, n, i, -block.scale.v * by_mu);
      by_divisor.u += by_mu;
    }
    if (to.friction)
      for (int lane = 0; lane < W; ++lane) {
        if (!chosen[lane]) continue;
        const double* mu = batch_.friction[number(lane)] + 2 * i;
        double* out = to.friction + 2 * (n * number(lane) + i);
        const bool grips = mu[0] > 0.0 && mu[1] > 0.0;
        const double u = get(by_divisor.u, lane) * get(block.scale.u, lane);
        const double o = get(by_divisor.o, lane) * get(block.scale.o, lane);
        const double t = get(by_divisor.t, lane) * get(block.scale.t, lane);
        out[0] = grips ? 0.5 * (u - o + t) / mu[0] : 0.0;
        out[1] = grips ? 0.5 * (u + o - t) / mu[1] : 0.0;
      }
    // frames: t = n x o, o the direction of along - (along . n) n
    Vec3<V> by_n = by_frame[0] + cross(c.frame[1], by_frame[2]);
    Vec3<V> by_o = by_frame[1] + cross(by_frame[2], c.frame[0]);
    const V lean = dot(c.along, c.frame[0]);
    const V reach = length(c.along - lean * c.frame[0]);
    const Vec3<V> by_flat = (1.0 / reach) * (by_o - dot(by_o, c.frame[1]) * c.frame[1]);
    by_n -= dot(by_flat, c.frame[0]) * c.along + lean * by_flat;
    if (to.normals || to.tangents) {
      const Vec3<V> turned = by_n - dot(by_n, c.frame[0]) * c.frame[0];
      const Vec3<V> leant = by_flat - dot(by_flat, c.frame[0]) * c.frame[0];
      const auto per_size = [&](const Slices& from, const Vec3<V>& direction, double* out) {
        for (int lane = 0; lane < W; ++lane) {
          if (!chosen[lane]) continue;
          const double size = length(point(from[number(lane)] + 3 * i));
          for (int a = 0; a < 3; ++a)
            out[3 * (n * number(lane) + i) + a] = get(direction[a], lane) / size;
        }
      };
      if (to.normals) per_size(batch_.normals, turned, to.normals);
      if (to.tangents)
        per_size(batch_.tangents, leant - dot(leant, c.along) * c.along, to.tangents);
    }
  }
}

}  // namespace grasp
