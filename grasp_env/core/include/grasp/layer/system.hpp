// The Newton system of `SmoothLanes`: problems, rows of limits, and blocks of the inverse Hessian.
#pragma once
#include <grasp/layer/smooth.hpp>

namespace grasp {

template <int W>
void SmoothLanes<W>::load(int lane, std::ptrdiff_t k, const PosedProblem& posed, Regime regime) {
  problems_[lane] = {{batch_.positions[k], posed.normals.data(), posed.scale.data(),
                      posed.tangents.data(), posed.weights.data()},
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
    const double gamma = batch_.torsion ? batch_.torsion[k][i] : 0.0;
    set(c.divisor_v, lane, gamma > 0.0 ? mu / gamma : infinity);
    set(c.lambda_v, lane, gamma > 0.0 ? lambda : 0.0);
    const double low = batch_.min_normal ? batch_.min_normal[k][i] : 0.0;
    const double high = batch_.max_normal ? batch_.max_normal[k][i] : infinity;
    load_side(c.low, lane, low > 0.0, -mu * low, lambda);
    load_side(c.high, lane, high < infinity, mu * high, lambda);
    set(c.unit, lane, std::sqrt(lambda / omega));
  }
  choose(lane, regime, posed);
}

// Row j of the torque limits, divided by its length, as in `LimitTable` and `General`.
template <int W> void SmoothLanes<W>::place_row(int j) {
  Row& row = rows_[j];
  V square{}, all_lambda{}, all_omega{};
  row.touches = row.lambda = row.omega = V{};
  for (int i = 0; i < count(); ++i) {
    const Contact& c = at_[i];
    const auto& block = cones_.blocks[i];
    Column& col = column(i, j);
    const Vec moves = motion(i, j, 0);
    for (int a = 0; a < 3; ++a) col.c[a] = dot(moves, c.frame[a]) / block.divisor[a];
    col.cv = batch_.jacobian_rows < 6 ? V{} : dot(motion(i, j, 3), c.frame[0]) / c.divisor_v;
    const V first = col.c.u + col.cv;
    const V part = first * first + col.c.o * col.c.o + col.c.t * col.c.t + col.cv * col.cv;
    const auto& weights = block.weights;
    square += part;
    col.touched = select(part > 0.0, V(1.0), V(0.0));
    col.any = grasp::any(part > 0.0);
    row.touches += col.touched;
    row.lambda += col.touched * weights.lambda;
    row.omega += col.touched * weights.omega;
    all_lambda += weights.lambda;
    all_omega += weights.omega;
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
    col.cv = col.cv / row.size;
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
template <int W> void SmoothLanes<W>::bind() {
  tightest_ = V(infinity);
  for (Row& row : rows_) row.along = V{};
  for (int i = 0; i < count(); ++i)
    for (int j = 0; j < joints_; ++j) rows_[j].along += along(i, j, x_[i], v_[i]);
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
template <int W> void SmoothLanes<W>::assemble() {
  bind();
  const int size = 6 + shared_rows();
  schur_.resize(size);
  both_.resize(size);
  for (int r = 0; r < 6; ++r) schur_(r, r) = softness_;
  for (int j = 0; j < shared_rows(); ++j) schur_(6 + j, 6 + j) = V(1.0);
  for (int i = 0; i < count(); ++i) {
    for (int j = 0; j < shared_rows(); ++j) {
      const Column& from = column(i, j);
      scaled_[joints_ * i + j] = {rows_[j].root * from.c, rows_[j].root * from.cv, V{}, from.any};
    }
    for (int r = 0; r < size; ++r) {
      Vec h;
      V hv;
      if (r < 6)
        applied(i, cones_.blocks[i].g[r], at_[i].gv[r], h, hv);
      else
        applied(i, scaled(i, r).c, scaled(i, r).cv, h, hv);
      for (int s = 0; s <= r && s < 6; ++s) {
        V& entry = schur_(r, s);
        entry += dot(h, cones_.blocks[i].g[s]);
        if (batch_.torsion) entry += hv * at_[i].gv[s];
      }
      for (int s = 6; s <= r; ++s) schur_(r, s) += dot(h, scaled(i, s).c) + hv * scaled(i, s).cv;
    }
  }
  schur_.factor();
}

// Terms of one contact: v is eliminated, dv = lever du + free (gradient along v), then each row
// changes the block by rank one.
template <int W> void SmoothLanes<W>::bind(int i) {
  Contact& c = at_[i];
  const auto& weights = cones_.blocks[i].weights;
  const Vec& x = x_[i];
  const V& v = v_[i];
  c.inverse = inverse_hessian(x, weights);
  c.gradient = gradient(x, weights);
  c.across = Vec{};
  c.turn = c.gradient_v = V{};
  V bend{}, lever{};
  if (batch_.torsion) {
    const V p = x.u - v;
    const V q = x.u + v;
    const V d = p * q;
    const V both = x.u * (x.u * x.u + 3.0 * v * v);
    const V near = 1.0 / (p * p);
    const V far = 1.0 / (q * q);
    const V soft = select(c.lambda_v > 0.0, V(1.0), V(0.0));
    const V safe = select(c.lambda_v > 0.0, c.lambda_v, V(1.0));
    lever = soft * v * (3.0 * x.u * x.u + v * v) / both;
    c.turn = soft * d * d * d / (4.0 * safe * both);
    c.gradient.u -= c.lambda_v * (near + far);
    c.gradient_v = c.lambda_v * (near - far);
    bend = 4.0 * c.lambda_v / both;
  }
  if (batch_.min_normal || batch_.max_normal) {
    c.low.bind(-x.u, c.edge);
    c.high.bind(x.u, c.edge);
    c.gradient.u += c.high.price - c.low.price;
    bend += c.high.bend + c.low.bend;
    tightest_ = min(tightest_, min(c.high.bound - x.u, c.low.bound + x.u) / c.unit);
  }
  if (batch_.torsion || batch_.min_normal || batch_.max_normal) {
    const Vec h{c.inverse.uu, c.inverse.uo, c.inverse.ut};
    subtract_rank_one(c, bend, h, V(0.0), h.u);
  }
  if (batch_.torsion) {
    c.across = lever * Vec{c.inverse.uu, c.inverse.uo, c.inverse.ut};
    c.turn += lever * lever * c.inverse.uu;
  }
  for (int j = 0; j < joints_; ++j) {
    const Column& col = column(i, j);
    if (!col.any) continue;
    c.gradient += rows_[j].price * col.c;
    c.gradient_v += rows_[j].price * col.cv;
    Vec h;
    V hv;
    applied(i, col.c, col.cv, h, hv);
    subtract_rank_one(c, rows_[j].bend, h, hv, dot(h, col.c) + hv * col.cv);
  }
}

}  // namespace grasp
