// Starts of the general program: slacks and multipliers strictly inside, for the interior point.
#pragma once
#include <grasp/general/program_on.hpp>

namespace grasp::detail {

template <int D> template <class R>
inline void ProgramOn<D>::raise(Interior<R, 1>& engine, const Field& z) {
  excess_unit_ = BEGIN * excess(z) + EXCESS_FLOOR;
  most_ = 1.0;
  best_bound_ = 0.0;
  for (int i = 0; i < count; ++i) most_ = std::max(most_, price(i) * z[i][0]);
  most_ *= in_.FARTHEST;
  const auto raise = [&](Tuple<R, 1>& shared, int label) {
    if (label >= 0) shared[0] = -excess_unit_ * in_.shares[label] / size_;
  };
  for (int r = 0; r < engine.rows.joint; ++r) raise(engine.rows.coupling[r], engine.rows.label[r]);
  for (auto& row : engine.rows.own) {
    raise(row.shared, row.label);
    if (row.label < 0 && row.contact < count) row.right = most_;
  }
}

template <int D> template <class R, int T> inline bool ProgramOn<D>::begin(Interior<R, T>& engine) {
  if (!has_internal_force_) {
    const Arena::Scope scope;
    const double nothing[6] = {};
    const Deepest result = Depth(in_, 0).find(nothing, 1e-2, internal_force_);
    has_internal_force_ = result.code == CONVERGED && result.margin > DEEP;
  }
  if (*has_internal_force_) {
    for (auto& z : z_) z = {};
    in_.subtract(z_, turned_);
    double squeeze = 1e-6;
    in_.write_slacks(z_, 0, slacks_, [](int) { return 0.0; });
    in_.write_slacks(internal_force_, 0, slacks_inside_, [](int) { return 0.0; });
    for (std::size_t k = 0; k < slacks_.size(); ++k)
      if (slacks_[k] < infinity) squeeze = std::max(squeeze, -slacks_[k] / slacks_inside_[k]);
    for (int i = 0; i < count; ++i) add(z_[i], 1.3 * squeeze, internal_force_[i]);
  } else {
    for (auto& z : z_) z = in_.inwards();
  }
  for (int i = 0; i < count; ++i) engine.at.z[i] = wide<R>(z_[i]);
  const bool slack = place(engine, *has_internal_force_ ? 1e-3 : 1.0);
  return *has_internal_force_ && slack;
}

template <int D> template <class R, int T>
inline bool ProgramOn<D>::place(Interior<R, T>& engine, double least) {
  auto& at = engine.at;
  const auto& rows = engine.rows;
  R largest = 0.0, product = 0.0, normal = 0.0;
  double offset = 0.0;
  for (int i = 0; i < count; ++i) {
    largest = max(largest, at.z[i][0]);
    normal = max(normal, price(i) * at.z[i][0]);
    offset = std::max(offset, this->offset(i));
    at.s[i] = engine.cost[i];
    if (T == 1 || of_torques()) at.s[i][0] = engine_price<T>(i);
    product += at.z[i][0] * at.s[i][0] / count;
  }
  if constexpr (T == 1) {
    at.t = {2.0 * normal + offset};
    if (elastic()) {
      for (int i = 0; i < count; ++i) z_[i] = narrow(at.z[i]);
      raise(engine, z_);
      at.t = {1.0};
    }
  }
  bool kept = true;
  const R floor = max(least * largest, 1e-12 * largest);
  const auto lift = [&](const R& slack) {
    if (slack > 0.0 && least == 0.0) return slack;
    kept = kept && slack > 0.0;
    return max(slack, floor);
  };
  const double share = 0.1 / std::max(1, limits);
  for (int i = 0; i <= count; ++i)
    for (int k = rows.first[i]; k < rows.first[i + 1]; ++k) {
      const auto& row = rows.own[k];
      R slack = row.right - inner(row.shared, at.t);
      if (i < count) slack -= inner(row.row, at.z[i]);
      at.own_slack[k] = lift(slack);
      if (row.label < 0)
        at.own[k] = R(1.0) / count;
      else
        at.own[k] = min(product / at.own_slack[k], R(i < count ? share * engine_price<T>(i) : 1.0));
    }
  for (int r = 0; r < rows.joint; ++r) {
    at.joint[r] = at.joint_slack[r] = 0.0;
    if (r < rows.equal) continue;
    R slack = rows.right[r] - inner(rows.coupling[r], at.t);
    R price = infinity;
    for (int i = 0; i < count; ++i) {
      slack -= inner(rows.columns[rows.joint * i + r], at.z[i]);
      price = min(price, R(engine_price<T>(i)));
    }
    at.joint_slack[r] = lift(slack);
    at.joint[r] = min(product / at.joint_slack[r], share * price);
  }
  if constexpr (T == 1)
    if (elastic()) {  // t's price from its equation, if that is positive
      R left = 1.0;
      for (int r = rows.equal; r < rows.joint; ++r) left += at.joint[r] * rows.coupling[r][0];
      for (std::size_t k = 0; k + 1 < rows.own.size(); ++k)
        left += at.own[k] * rows.own[k].shared[0];
      at.own.back() = max(left, R(1e-3));
    }
  if constexpr (T == 0)
    if (of_torques()) {
      place_norm(engine);
      return kept;
    }
  for (int i = 0; i < count; ++i) {  // s from its equation
    Tuple<R, D> s = engine.cost[i];
    for (int k = rows.first[i]; k < rows.first[i + 1]; ++k) add(s, at.own[k], rows.own[k].row);
    for (int r = rows.equal; r < rows.joint; ++r)
      add(s, at.joint[r], rows.columns[rows.joint * i + r]);
    at.s[i] = s;
  }
  return kept;
}

template <int D> template <class R> inline void ProgramOn<D>::place_norm(Interior<R, 0>& engine) {
  constexpr double AROUND = 1.3, LEAST = 0.1;  // of the norm, of a unit of force
  auto& z = engine.at.z;
  for (int i = 0; i < count; ++i) z_[i] = narrow(z[i]);
  for (int b = 0; b < in_.norm_cones(); ++b) {
    Tuple<R, D>& norm = z[count + b] = {};
    double square = 0.0;
    for (int slot = 0; slot < in_.SLOTS; ++slot) {
      const int k = in_.SLOTS * b + slot;
      if (k >= in_.norm_equations()) break;
      norm[1 + slot] =
          k < in_.joints ? R(in_.torque_at(k, z_, size_)) : z[count + k - in_.joints][0];
      square += double(norm[1 + slot] * norm[1 + slot]);
    }
    norm[0] = AROUND * std::sqrt(square) + LEAST;
    engine.at.s[count + b] = wide<R>(in_.inwards());
  }
}

}  // namespace grasp::detail
