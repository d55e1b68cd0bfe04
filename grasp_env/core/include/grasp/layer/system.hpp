// The Newton system of `SmoothLanes`: problems, rows of limits, and blocks of the inverse Hessian.
#pragma once
#include <grasp/layer/smooth.hpp>

namespace grasp {

template <int W, int D>
void SmoothLanes<W, D>::load(int lane, std::ptrdiff_t k, const PosedProblem& posed, Regime regime) {
  problems_[lane] = {{batch_.positions[k], posed.normals.data(), posed.scale.data(),
                      posed.tangents.data(), posed.weights.data(), 1, batch_.torsion[k]},
                     k};
  for (int r = 0; r < 6; ++r) set(wrench_[r], lane, batch_.wrench[k][r]);
  for (int i = 0; i < count(); ++i) {
    Contact& c = at_[i];
    const double omega = posed.weights[2 * i];
    const double lambda = posed.weights[2 * i + 1];
    const double mu = posed.scale[3 * i];
    for (int a = 0; a < 3; ++a) {
      set(c.arm[a], lane, batch_.positions[k][3 * i + a]);
      set(c.frame[0][a], lane, posed.normals[3 * i + a]);
      set(c.along[a], lane, posed.tangents[3 * i + a]);
    }
    const double low = batch_.min_normal ? batch_.min_normal[k][i] : 0.0;
    const double high = batch_.max_normal ? batch_.max_normal[k][i] : infinity;
    load_side(c.low, lane, low > 0.0, -mu * low, lambda);
    load_side(c.high, lane, high < infinity, mu * high, lambda);
    set(c.lambda, lane, lambda);
    set(c.unit, lane, std::sqrt(lambda / omega));
  }
  choose(lane, regime, posed);
}

// Row j of the torque limits, divided by its length, as in `LimitTable` and `General`.
template <int W, int D> void SmoothLanes<W, D>::place_row(int j) {
  Row& row = rows_[j];
  V square{}, all_lambda{}, all_omega{};
  row.touches = row.lambda = row.omega = V{};
  for (int i = 0; i < count(); ++i) {
    const Contact& c = at_[i];
    const auto& block = cones_.blocks[i];
    Column& col = column(i, j);
    const Vec3<V> moves = motion(i, j, 0);
    for (int a = 0; a < 3; ++a) col.c[a] = dot(moves, c.frame[a]) / block.divisor[a];
    if constexpr (D == 4)
      col.c.v = batch_.jacobian_rows < 6 ? V{} : dot(motion(i, j, 3), c.frame[0]) / block.divisor.v;
    const V part = dot(col.c, col.c);
    const V& omega = block.weights.omega;
    square += part;
    col.touched = select(part > 0.0, V(1.0), V(0.0));
    col.any = grasp::any(part > 0.0);
    row.touches += col.touched;
    row.lambda += col.touched * c.lambda;
    row.omega += col.touched * omega;
    all_lambda += c.lambda;
    all_omega += omega;
  }
  row.own = select(row.touches > 1.5, V(0.0), V(1.0));
  shared_ = shared_ || any(row.own == V(0.0));
  const Mask empty = !(square > 0.0);
  row.empty = select(empty, V(1.0), V(0.0));
  row.size = select(empty, V(1.0), sqrt(square));
  row.touches = select(empty, V(count()), row.touches);
  row.lambda = select(empty, all_lambda, row.lambda) / row.touches;
  row.omega = select(empty, all_omega, row.omega) / row.touches;
  row.unit = sqrt(row.lambda / row.omega);
  for (int i = 0; i < count(); ++i) {
    Column& col = column(i, j);
    col.touched = select(empty, V(1.0), col.touched);
    col.c = (1.0 / row.size) * col.c;
  }
  for (int lane = 0; lane < W; ++lane) {
    const double limit = batch_.torque_limit[number(lane)][j];
    const double size = get(row.size, lane);
    const double weight = get(row.lambda, lane);
    const double bias = batch_.torque_bias ? batch_.torque_bias[number(lane)][j] : 0.0;
    const bool there = limit < infinity;
    load_side(row.high, lane, there, (limit - bias) / size, weight);
    load_side(row.low, lane, there, (limit + bias) / size, weight);
  }
}

// Blocks of the inverse Hessian, gradients and multipliers of the limits at z.
template <int W, int D> void SmoothLanes<W, D>::bind() {
  tightest_ = V(infinity);
  for (Row& row : rows_) row.along = V{};
  for (int i = 0; i < count(); ++i)
    for (int j = 0; j < joints_; ++j) rows_[j].along += along(i, j, x_[i]);
  for (Row& row : rows_) {
    row.high.bind(row.along, row.edge);
    row.low.bind(-row.along, row.edge);
    tightest_ =
        min(tightest_, min(row.high.bound - row.along, row.low.bound + row.along) / row.unit);
    const V bend = row.high.bend + row.low.bend;
    row.bend = row.own * bend;
    row.root = sqrt((1.0 - row.own) * bend);
    row.price = row.high.price - row.low.price;
  }
  for (int i = 0; i < count(); ++i) bind(i);
}

// All this, and the factored system at z.
template <int W, int D> void SmoothLanes<W, D>::assemble() {
  bind();
  const int size = 6 + shared_rows();
  schur_.resize(size);
  both_.resize(size);
  for (int r = 0; r < 6; ++r) schur_(r, r) = softness_;
  for (int j = 0; j < shared_rows(); ++j) schur_(6 + j, 6 + j) = V(1.0);
  for (int i = 0; i < count(); ++i) {
    for (int j = 0; j < shared_rows(); ++j) {
      const Column& from = column(i, j);
      scaled_[joints_ * i + j] = {rows_[j].root * from.c, V{}, from.any};
    }
    for (int r = 0; r < size; ++r) {
      const X h = at_[i].inverse * (r < 6 ? cones_.blocks[i].g[r] : scaled(i, r).c);
      for (int s = 0; s <= r && s < 6; ++s) schur_(r, s) += dot(h, cones_.blocks[i].g[s]);
      for (int s = 6; s <= r; ++s) schur_(r, s) += dot(h, scaled(i, s).c);
    }
  }
  schur_.factor();
}

// Terms of one contact. Each row changes the block by rank one.
template <int W, int D> void SmoothLanes<W, D>::bind(int i) {
  Contact& c = at_[i];
  const auto& weights = cones_.blocks[i].weights;
  const X& x = x_[i];
  c.inverse = inverse_hessian(x, weights);
  c.gradient = gradient(x, weights);
  if (batch_.min_normal || batch_.max_normal) {
    c.low.bind(-x.u, c.edge);
    c.high.bind(x.u, c.edge);
    c.gradient.u += c.high.price - c.low.price;
    subtract_rank_one(c.inverse, c.high.bend + c.low.bend, axis<D>(V(1.0)));
    tightest_ = min(tightest_, min(c.high.bound - x.u, c.low.bound + x.u) / c.unit);
  }
  for (int j = 0; j < joints_; ++j) {
    const Column& col = column(i, j);
    if (!col.any) continue;
    c.gradient += rows_[j].price * col.c;
    subtract_rank_one(c.inverse, rows_[j].bend, col.c);
  }
}

}  // namespace grasp
