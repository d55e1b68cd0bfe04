// The solution part of `SmoothLanes`: descent, polishing, certificate, answer.
#pragma once
#include <grasp/layer/stiff.hpp>

namespace grasp {

// The barriers of limits are parabolas below the edge, which is lowered until all slacks are above.
template <int W, int D> auto SmoothLanes<W, D>::descend(Mask live, int most) -> Mask {
  edge_ = select(live, V(LARGEST_EDGE), edge_);
  place_edges();
  V value = energy();
  iterations = select(live, V(0.0), iterations);
  live &= value < infinity;
  Mask converged{};
  for (int round = 0; round < most && any(live); ++round) {
    const Six<V> next = newton_step(value);
    for (int r = 0; r < 6; ++r) y_[r] = select(live, next[r], y_[r]);
    const auto [decrement, reach] = judged_step();
    // the barriers have their final form
    const Mask whole = (edge_ <= last_) | (tightest_ >= edge_);
    Mask harder = live & ~whole & !(decrement > CLOSE * value);
    const Mask lost = harder & (last_ == 0.0) & (edge_ < LEAST_EDGE);
    const Mask done = live & whole & !(decrement > SETTLED * value);
    converged |= done;
    live &= ~(done | lost);
    harder &= ~lost;
    V alpha = min(V(1.0), LONG / reach);
    V taken{};
    Mask open = live & ~harder;
    for (int halving = 0; halving < HALVINGS && any(open); ++halving, alpha = 0.5 * alpha) {
      const V after = energy_along(alpha);
      const Mask good = open & (after < value - 1e-4 * alpha * decrement);
      taken = select(good, alpha, taken);
      value = select(good, after, value);
      open &= ~good;
    }
    converged |= open & whole;
    live &= ~(open & whole);
    harder |= open & ~whole;  // only rounding is left
    for (int i = 0; i < count(); ++i) x_[i] += taken * step_[i];
    iterations += select(taken > 0.0, V(1.0), V(0.0));
    if (!any(harder)) continue;
    edge_ = select(harder, max(EDGE_FACTOR * edge_, last_), edge_);
    place_edges();
    value = select(harder, energy(), value);
  }
  edge_ = last_;
  place_edges();
  return converged;
}

template <int W, int D> void SmoothLanes<W, D>::polish(const Mask& which) {
  V value = energy();
  const auto left = [&](const Six<V>& y) { return size(missed() - softness_ * y); };
  residual = select(which, left(y_), residual);
  Mask open = which & ~(last_ > 0.0) & ~rank_lost();
  for (int round = 0; round < WHOLE_STEPS && any(open); ++round) {
    Six<V> next = newton_step(value);
    std::fill(pull_.begin(), pull_.end(), X{});
    // remove the rounding left in the balance, in the same metric
    Six<V> rest = softness_ * next - missed();
    for (int i = 0; i < count(); ++i)
      for (int r = 0; r < 6; ++r) rest[r] -= dot(cones_.blocks[i].g[r], step_[i]);
    next = next + solve_once(pull_, rest, back_);
    for (int i = 0; i < count(); ++i) {
      step_[i] += back_[i];
      back_[i] = x_[i];  // the previous point
    }
    const V after = energy_along(V(1.0));
    for (int i = 0; i < count(); ++i) x_[i] += step_[i];
    const V missing = left(next);
    open &= (after <= value + RAISED * value) &
            (missing <= max(residual, ROUNDED * (cones_.largest_normal(x_) + size(w_))));
    for (int i = 0; i < count(); ++i) x_[i] = select(open, x_[i], back_[i]);
    y_ = select(open, next, y_);
    value = select(open, after, value);
    residual = select(open, missing, residual);
  }
  const Mask hard = which & stiff();
  if (any(hard)) {
    converged = finish(hard);
    residual = select(hard, left(y_), residual);
  }
  // if missed balance is a penalty, report all of it
  residual = select(which & (softness_ > 0.0), size(missed()), residual);
}

template <int W, int D> auto SmoothLanes<W, D>::gap() const -> V {
  V bound{}, room = infinity;
  for (int r = 0; r < 6; ++r) bound += y_[r] * w_[r];
  std::vector<V> multipliers(joints_);
  std::fill(along_.begin(), along_.end(), V{});
  for (int i = 0; i < count(); ++i)
    for (int j = 0; j < joints_; ++j) along_[j] += along(i, j, x_[i]);
  // minimum of weight / s + price s over s, less price * bound
  const auto conjugate = [&](const Limit& side, const V& slack) {
    const V price = side.weight / (slack * slack);
    bound += 2.0 * side.weight / slack - price * side.bound;
    return price;
  };
  for (int j = 0; j < joints_; ++j)
    multipliers[j] = conjugate(rows_[j].high, rows_[j].high.bound - along_[j]) -
                     conjugate(rows_[j].low, rows_[j].low.bound + along_[j]);
  for (int i = 0; i < count(); ++i) {
    const Contact& c = at_[i];
    X pull = -cones_.blocks[i].transposed(y_);
    for (int j = 0; j < joints_; ++j) pull -= multipliers[j] * column(i, j).c;
    pull.u -= conjugate(c.high, c.high.bound - x_[i].u) - conjugate(c.low, c.low.bound + x_[i].u);
    V inside;
    bound += dual(pull, cones_.blocks[i].weights, inside);
    room = min(room, inside);
  }
  const V value = energy();
  const V above = max(value - bound, V(0.0));
  return select((room > 0.0) & (bound > 0.0) & (value < infinity), above / bound, V(infinity));
}

template <int W, int D>
void SmoothLanes<W, D>::write(int lane, double* force, double* torsion, double* multipliers) const {
  const Six<V> y = cones_.unit.pull_back(y_);
  for (int r = 0; r < 6; ++r) multipliers[r] = -get(y[r], lane);
  for (int i = 0; i < count(); ++i) {
    const Vec3<V> world = object_force(i, x_[i]);
    for (int a = 0; a < 3; ++a) force[3 * i + a] = get(world[a], lane);
    torsion[i] = get(moment(i, x_[i]), lane);
  }
}

}  // namespace grasp
