// The stiff part of `SmoothLanes`: problems whose multipliers are so high, with limits exceeded or
// almost, that the system of system.hpp loses its digits. One problem at a time.
#pragma once
#include <grasp/layer/system.hpp>

namespace grasp {

// Elastic problems, those beside a limit or with very high multipliers, and those whose contacts
// cannot balance all wrenches.
template <int W> auto SmoothLanes<W>::stiff() const -> Mask {
  V largest{}, tightest = infinity;
  for (const V& y : y_) largest = max(largest, abs(y));
  Mask stiff = last_ > 0.0;
  std::fill(along_.begin(), along_.end(), V{});
  for (int i = 0; i < count(); ++i) {
    const Contact& c = at_[i];
    const V& u = x_[i].u;
    const V per = c.unit;
    stiff |= largest > DEAR * cones_.blocks[i].weights.omega;
    if (batch_.min_normal || batch_.max_normal)
      tightest = min(tightest, min(c.high.bound - u, c.low.bound + u) / per);
    for (int j = 0; j < joints_; ++j) along_[j] += along(i, j, x_[i], v_[i]);
  }
  for (int j = 0; j < joints_; ++j)
    tightest = min(tightest, min(rows_[j].high.bound - along_[j], rows_[j].low.bound + along_[j]) /
                                 rows_[j].unit);
  return stiff | rank_lost() | (tightest < TIGHT);
}

// With the Hessian's inverse L L^T of each contact's cone, and M = [A; sqrt(bend) R] L of balance
// and limits, the system of smooth.hpp is
//     s + M^T m = L^T g,    M s - D m = (h, 0),    p = L s,    q = the first six of m,
// with D the softness for balance and 1 for limits. (s, -sqrt(D) m) is the point nearest to (L^T g,
// 0) in the plane [M, sqrt(D)] (s, .) = (h, 0). Orthogonal factors find it with errors of the
// condition of M alone; M M^T + D has the square of it. If contacts cannot balance all wrenches,
// the rows of A are those along the axes of their reach. g: pull_, pull_v_; p: step_, step_v_.
template <int W> bool SmoothLanes<W>::solve_stiff(int lane, const Six<V>& h, Six<V>& q) {
  const bool normal = batch_.min_normal || batch_.max_normal;
  const double soft = get(softness_, lane);
  const WrenchSpace& reach = reach_[lane];
  const int n = count();
  const int balance = reach.rank;
  const int columns = balance + joints_ + (normal ? n : 0);
  const int width = batch_.torsion ? 4 : 3;  // variables of a contact
  const int first = soft > 0.0 ? 0 : balance;
  // row less number of the first column with a softness
  const int tail = width * n - first;
  stiff_.resize(tail + columns, columns);
  axes_.resize(16 * n);
  nearest_.assign(tail + columns, 0.0);
  multipliers_.assign(columns, 0.0);
  Vec6 missing;
  for (int r = 0; r < 6; ++r) missing[r] = get(h[r], lane);
  for (int r = 0; r < balance; ++r)
    multipliers_[r] = reach.full() ? missing[r] : dot(reach.axes[r], missing);
  for (int j = first; j < columns; ++j) stiff_(tail + j, j) = j < balance ? std::sqrt(soft) : 1.0;
  for (int i = 0; i < n; ++i) {
    const Contact& c = at_[i];
    const auto& block = cones_.blocks[i];
    double* axes = &axes_[16 * i];
    axes_of(lane, i, axes);
    const auto along = [&](const double (&row)[4], int k) {
      double total = 0.0;
      for (int a = 0; a < width; ++a) total += row[a] * axes[4 * a + k];
      return total;
    };
    const auto fill = [&](int column, double root, const double (&row)[4]) {
      for (int k = 0; k < width; ++k) stiff_(width * i + k, column) = root * along(row, k);
    };
    const auto entries = [&](const Vec& of, const V& turn, double (&row)[4]) {
      for (int a = 0; a < 4; ++a) row[a] = a < 3 ? get(of[a], lane) : get(turn, lane);
    };
    double row[4];
    entries(pull_[i], pull_v_[i], row);
    for (int k = 0; k < width; ++k) nearest_[width * i + k] = along(row, k);
    for (int r = 0; r < balance; ++r) {
      Vec pull = block.g[r];
      V turn = c.gv[r];
      if (!reach.full()) {
        pull = Vec{};
        turn = V{};
        for (int k = 0; k < 6; ++k) {
          pull += V(reach.axes[r][k]) * block.g[k];
          turn += reach.axes[r][k] * c.gv[k];
        }
      }
      entries(pull, turn, row);
      fill(r, 1.0, row);
    }
    for (int j = 0; j < joints_; ++j) {
      entries(column(i, j).c, column(i, j).cv, row);
      fill(balance + j, std::sqrt(get(rows_[j].high.bend, lane) + get(rows_[j].low.bend, lane)),
           row);
    }
    if (normal)
      fill(balance + joints_ + i, std::sqrt(get(c.high.bend, lane) + get(c.low.bend, lane)),
           {1.0, 0.0, 0.0, 0.0});
  }
  if (!stiff_.factor()) return false;
  stiff_.nearest(nearest_.data(), multipliers_.data());
  for (int i = 0; i < n; ++i)
    for (int a = 0; a < width; ++a) {
      double total = 0.0;
      for (int k = 0; k < width; ++k) total += axes_[16 * i + 4 * a + k] * nearest_[width * i + k];
      set(a < 3 ? step_[i][a] : step_v_[i], lane, total);
    }
  if (width == 3)
    for (int i = 0; i < n; ++i) set(step_v_[i], lane, 0.0);
  Vec6 solved{};
  for (int r = 0; r < balance; ++r) {
    if (reach.full())
      solved[r] = multipliers_[r];
    else
      solved = solved + multipliers_[r] * reach.axes[r];
  }
  for (int r = 0; r < 6; ++r) set(q[r], lane, solved[r]);
  return true;
}

// L of contact i, (4, 4) row-major: inverse Hessian = L L^T without limits, from p = u - s and q =
// u + s, s = |(o, t)|.
template <int W> void SmoothLanes<W>::axes_of(int lane, int i, double* axes) const {
  const double u = get(x_[i].u, lane);
  const double o = get(x_[i].o, lane);
  const double t = get(x_[i].t, lane);
  const double v = get(v_[i], lane);
  const double lambda = get(cones_.blocks[i].weights.lambda, lane);
  const double turning = get(at_[i].lambda_v, lane);
  const double s = std::sqrt(o * o + t * t);
  const double p = u - s;
  const double q = u + s;
  const double eo = s > 1e-140 ? o / s : 1.0;
  const double et = s > 1e-140 ? t / s : 0.0;
  double lever = 0.0, rest = 0.0, gain = 0.0;  // torsion v = lever u + rest, an axis of its own
  if (turning > 0.0) {
    const double m = u - v;
    const double f = u + v;
    const double cubes = m * m * m + f * f * f;
    lever = (f * f * f - m * m * m) / cubes;
    gain = 2.0 * turning / cubes;
    rest = std::sqrt(m * m * m * f * f * f / (2.0 * turning * cubes));
  }
  // in (p, q) the Hessian is diag(near, far) + k (1, 1)(1, 1)^T: two axes, and one across both
  const double near = 2.0 * lambda / (p * p * p);
  const double far = 2.0 * lambda / (q * q * q);
  const double k = 0.5 * lambda / (u * u * u) + gain;
  const double a = near + k;
  const double b = std::sqrt(far + k * (near / a));
  const double ra = std::sqrt(a);
  const double normal[2] = {0.5 / ra, 0.5 * (near / a) / b};
  const double outward[2] = {-0.5 / ra, 0.5 * (1.0 + k / a) / b};
  const double around = 0.5 * p * q / std::sqrt(lambda * u);
  for (int c = 0; c < 2; ++c) {
    axes[c] = normal[c];
    axes[4 + c] = eo * outward[c];
    axes[8 + c] = et * outward[c];
    axes[12 + c] = lever * normal[c];
  }
  axes[2] = axes[12 + 2] = 0.0;
  axes[4 + 2] = -et * around;
  axes[8 + 2] = eo * around;
  axes[3] = axes[4 + 3] = axes[8 + 3] = 0.0;
  axes[12 + 3] = rest;
}

// The step as a fraction of the largest force and of the distances from the cones, either way.
template <int W> auto SmoothLanes<W>::relative_step() const -> V {
  V moved{};
  const V largest = cones_.largest_normal(x_);
  for (int i = 0; i < count(); ++i) {
    const auto way = Boundary<V>(x_[i]).way(step_[i]);
    moved = max(moved, way.away + abs(way.along));
    moved = max(moved, max(abs(step_[i].u), max(abs(step_[i].o), abs(step_[i].t))) / largest);
    if (!batch_.torsion) continue;
    const V turned = max(abs(step_v_[i] - step_[i].u) / (x_[i].u - v_[i]),
                         abs(step_v_[i] + step_[i].u) / (x_[i].u + v_[i]));
    moved = max(moved, select(at_[i].lambda_v > 0.0, turned, V(0.0)));
  }
  return moved;
}

// Newton's method with the stiff system. For elastic forces, damped, while the penalties grow: each
// stage starts close to its optimum, since steps along a curved cone are as short as the distance
// from it. For others, whole steps to the last digits. Where E no longer tells two points apart,
// the steps tell: each is much shorter than the one before. Return the lanes that have converged.
template <int W> auto SmoothLanes<W>::finish(Mask open) -> Mask {
  const Mask elastic = open & (last_ > 0.0);
  const V soft = softness_;
  const auto harden = [&](const Mask& which, const V& edge) {
    const V times = edge / max(last_, V(1e-100));
    edge_ = select(which, edge, edge_);
    softness_ = select(which, soft * times * times * times, softness_);
    place_edges();
  };
  harden(elastic, V(LARGEST_EDGE));
  Mask converged{};
  V before = infinity;
  V value = energy();
  for (int round = 0; round < STIFF_STEPS && any(open); ++round) {
    bind();
    const Six<V> missing = missed();
    const Six<V> h = softness_ * y_ - missing;
    for (int i = 0; i < count(); ++i) {
      pull_[i] = -at_[i].gradient - Block<V>::combined(cones_.blocks[i].g, y_);
      pull_v_[i] = -at_[i].gradient_v;
      for (int r = 0; r < 6; ++r) pull_v_[i] -= at_[i].gv[r] * y_[r];
      step_[i] = Vec{};
      step_v_[i] = V{};
    }
    Six<V> change{};
    for (int lane = 0; lane < W; ++lane)
      if (open[lane] && !solve_stiff(lane, h, change)) open[lane] = 0;
    const auto [decrement, reach] = judged_step();
    const V moved = relative_step();
    const Mask last = edge_ == last_;
    const Mask close = last & (moved < SHORT);
    // a step that does not shorten any more
    const Mask rounding = open & close & !(moved < 0.25 * before);
    converged |= rounding & (moved < ROUGH);
    open &= ~rounding & (moved == moved);
    open &= elastic | (reach < 0.5);
    V alpha = min(V(1.0), LONG / reach);
    V taken{};
    Mask trying = open;
    for (int halving = 0; halving < HALVINGS && any(trying); ++halving, alpha = 0.5 * alpha) {
      const V after = energy_along(alpha);
      const Mask good =
          trying & (close | (after <= value + NOISE * value - 1e-4 * alpha * decrement));
      taken = select(good, alpha, taken);
      value = select(good, after, value);
      trying &= ~good;
    }
    open &= ~trying | ~last;
    for (int i = 0; i < count(); ++i) {
      x_[i] = select(open, x_[i] + taken * step_[i], x_[i]);
      v_[i] = select(open, v_[i] + taken * step_v_[i], v_[i]);
    }
    y_ = select(open, y_ + change, y_);
    iterations += select(open & elastic, V(1.0), V(0.0));
    const Mask whole = taken == V(1.0);
    const Mask done = open & close & (moved < LEAST);
    converged |= done;
    open &= ~done;
    before = select(close, moved, V(infinity));
    const Mask harder = open & ~last & ((whole & (moved < STAGE)) | (taken == V(0.0)));
    if (!any(harder)) continue;
    harden(harder, max(ELASTIC_FACTOR * edge_, last_));
    value = select(harder, energy(), value);
    before = select(harder, V(infinity), before);
  }
  harden(elastic, last_);
  return converged;
}

}  // namespace grasp
