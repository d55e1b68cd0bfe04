// The stiff part of `SmoothLanes`: problems whose multipliers are so high, with limits exceeded or
// almost, that the system of system.hpp loses its digits. One problem at a time.
#pragma once
#include <grasp/layer/system.hpp>

namespace grasp {

// Elastic problems, those beside a limit or with very high multipliers, and those whose contacts
// cannot balance all wrenches.
template <int W, int D> auto SmoothLanes<W, D>::stiff() const -> Mask {
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
    for (int j = 0; j < joints_; ++j) along_[j] += along(i, j, x_[i]);
  }
  for (int j = 0; j < joints_; ++j)
    tightest = min(tightest, min(rows_[j].high.bound - along_[j], rows_[j].low.bound + along_[j]) /
                                 rows_[j].unit);
  return stiff | rank_lost() | (tightest < TIGHT);
}

// With the Hessian's inverse L L^T of each contact's cone, and M = [A; sqrt(bend) R] L of balance
// and limits, the system of smooth.hpp is
//     s + M^T m = L^T g,    M s - C m = (h, 0),    p = L s,    q = the first six of m,
// with C the softness for balance and 1 for limits. (s, -sqrt(C) m) is the point nearest to (L^T g,
// 0) in the plane [M, sqrt(C)] (s, .) = (h, 0). Orthogonal factors find it with errors of the
// condition of M alone; M M^T + C has the square of it. If contacts cannot balance all wrenches,
// the rows of A are those along the axes of their reach. g: pull_; p: step_.
template <int W, int D> bool SmoothLanes<W, D>::solve_stiff(int lane, const Six<V>& h, Six<V>& q) {
  const bool normal = batch_.min_normal || batch_.max_normal;
  const double soft = get(softness_, lane);
  const WrenchSpace& reach = reach_[lane];
  const int n = count();
  const int balance = reach.rank;
  const int columns = balance + joints_ + (normal ? n : 0);
  const int first = soft > 0.0 ? 0 : balance;
  // row less number of the first column with a softness
  const int tail = D * n - first;
  stiff_.resize(tail + columns, columns);
  axes_.resize(n);
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
    const Axes<double, D> axes(of(x_[i], lane), of(block.weights, lane));
    std::copy(axes.axis, axes.axis + D, axes_[i].begin());
    const auto fill = [&](int column, double root, const Vec<double, D>& row) {
      for (int k = 0; k < D; ++k) stiff_(D * i + k, column) = root * dot(row, axes[k]);
    };
    const Vec<double, D> g = of(pull_[i], lane);
    for (int k = 0; k < D; ++k) nearest_[D * i + k] = dot(g, axes[k]);
    for (int r = 0; r < balance; ++r) {
      X pull = block.g[r];
      if (!reach.full()) {
        pull = X{};
        for (int k = 0; k < 6; ++k) pull += V(reach.axes[r][k]) * block.g[k];
      }
      fill(r, 1.0, of(pull, lane));
    }
    for (int j = 0; j < joints_; ++j)
      fill(balance + j, std::sqrt(get(rows_[j].high.bend, lane) + get(rows_[j].low.bend, lane)),
           of(column(i, j).c, lane));
    if (normal)
      fill(balance + joints_ + i, std::sqrt(get(c.high.bend, lane) + get(c.low.bend, lane)),
           axis<D>(1.0));
  }
  if (!stiff_.factor()) return false;
  stiff_.nearest(nearest_.data(), multipliers_.data());
  for (int i = 0; i < n; ++i) {
    Vec<double, D> step{};
    for (int k = 0; k < D; ++k) step += nearest_[D * i + k] * axes_[i][k];
    // rounding moves nothing that is not transmitted
    for (int a = 0; a < D; ++a)
      set(step_[i][a], lane, get(cones_.blocks[i].scale[a], lane) > 0.0 ? step[a] : 0.0);
  }
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

// The step as a fraction of the largest force and of the distances from the cones, either way.
template <int W, int D> auto SmoothLanes<W, D>::relative_step() const -> V {
  V moved{};
  const V largest = cones_.largest_normal(x_);
  for (int i = 0; i < count(); ++i) {
    const auto way = Boundary(x_[i]).way(step_[i]);
    moved = max(moved, way.away + abs(way.along));
    for (int a = 0; a < D; ++a) moved = max(moved, abs(step_[i][a]) / largest);
  }
  return moved;
}

// Newton's method with the stiff system. For elastic forces, damped, while the penalties grow: each
// stage starts close to its optimum, since steps along a curved cone are as short as the distance
// from it. For others, whole steps to the last digits. Where E no longer tells two points apart,
// the steps tell: each is much shorter than the one before. Return the lanes that have converged.
template <int W, int D> auto SmoothLanes<W, D>::finish(Mask open) -> Mask {
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
      pull_[i] = -at_[i].gradient - cones_.blocks[i].transposed(y_);
      step_[i] = X{};
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
    for (int i = 0; i < count(); ++i) x_[i] = select(open, x_[i] + taken * step_[i], x_[i]);
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
