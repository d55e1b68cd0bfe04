// The force deepest inside the limits of a program, or the twist that proves that none is inside.
#pragma once
#include <grasp/general/constraints.hpp>

namespace grasp {

// Margins up to this, relative to forces that sum to one, count as the boundary.
inline constexpr double CLEAR = 1e-9;

// CONVERGED: the force is strictly inside and balances `wrench`, which is within BOUNDARY of the
// given one. INFEASIBLE: `twist` proves that no force is strictly inside.
struct Deepest {
  Code code = REFUSED;
  int iterations = 0;
  double margin = 0.0;
  Vec6 twist{};        // [linear; angular], largest component one
  Vec6 wrench{};       // [N, N m]
  bool moved = false;  // `wrench` is not the given one
};

namespace detail {

// Let the optimum for the wrench `solved` stand for a wrench close by, with this balance residual.
// The bound is linear in the wrench: the smaller one holds for both. STALLED if it no longer proves
// the tolerance.
inline void stand_for(const Record& record, const Vec6& solved, const double* wrench,
                      double residual, double tolerance) {
  Summary& s = record.summary();
  std::copy_n(wrench, 6, s.wrench.begin());
  s.residual = residual;
  double there = s.lower_bound;
  for (int r = 0; r < 6; ++r) there -= s.multipliers[r] * (wrench[r] - solved[r]);
  s.lower_bound = std::min(s.lower_bound, there);
  if (record.code() == CONVERGED && !(record.gap() <= tolerance)) s.code = STALLED;
}

// max m <= r with depth m in all cones and the first limits; forces and the wrench's share r sum
// to one.
template <int D> class Depth {
 public:
  using Field = typename Constraints<D>::Field;

  Depth(const Constraints<D>& in, int many)
      : in_(&in), many_(many), slacks_(in.slacks()), multipliers_(in.limits) {}

  // Write the force into z [N]. inside: move a force nearer than NEAR to the boundary away from it.
  Deepest find(const double* wrench, double tolerance, Field& z, bool inside = false);
  // Multipliers of the limits if no force is inside. With the twist v they prove it: G^T v + sum
  // multiplier row lies in every dual cone, v . w > sum multiplier bound.
  const ArenaVector<double>& multipliers() const { return multipliers_; }

 private:
  static constexpr double UNMOVED = 1e-15;  // of the terms of a contact's motion: rounding
  static constexpr double COVERED = 1e10,
                          SEEN = 1e6;  // forces of which a proof speaks, in units of the wrench
  static constexpr double NEEDLESS = 1e-9;  // of the twist: a smaller price of a limit is rounding
  static constexpr double NEAR = 1e-6;      // margin, relative to forces that sum to one
  // fraction of the depth gained by moving inside that rounding must leave
  static constexpr double ENOUGH = 0.5;
  // of BOUNDARY: how far a wrench is moved; the rest is for rounding
  static constexpr double SHORT = 0.9;
  const Constraints<D>* in_;
  int many_;
  ArenaVector<double> slacks_, multipliers_;

  template <class R> Deepest find(const double* wrench, double tolerance, Field& z) {
    const Arena::Scope scope;
    auto engine = in_->template engine<R, 2>(many_);
    const Vec6 load = in_->in_frame(wrench);
    double size = grasp::size(load);
    bool free = size == 0.0;
    for (int k = 0; k < many_; ++k) {
      size = std::max(size, -in_->bound[k]);
      free = free && in_->bound[k] == 0.0;
    }
    if (!(size > NOTHING)) {  // at rest, the tightest limit is the unit
      size = 1.0;
      for (int k = 0; k < many_; ++k)
        if (in_->bound[k] > NOTHING) size = std::min(size, in_->bound[k]);
    }
    const Vec6 unit = (1.0 / size) * load;
    const Vec6 turned = in_->solve_lower(unit);
    set_up(engine, turned, size);
    const auto& at = engine.at;
    Deepest result;
    std::copy_n(wrench, 6, result.wrench.begin());
    result.code = engine.run(tolerance, (std::is_same_v<R, double> ? 0.1 : 1e-5) * CLEAR, 0.0, 200,
                             [] { return 0.0; });
    result.iterations = engine.iterations;
    result.margin = double(at.t[0]);
    const double part = double(at.t[1]);
    const double scale = free ? 1.0 : 1.0 / part;
    for (int i = 0; i < in_->count; ++i) {
      z[i] = narrow(at.z[i]);
      add(z[i], result.margin, in_->inwards());
      for (double& value : z[i]) value *= scale;
    }
    if (free || part > 0.0) in_->rebalance(z, unit);
    for (auto& zi : z)
      for (double& value : zi) value *= size;
    Vec6 y;
    for (int r = 0; r < 6; ++r) y[r] = double(at.joint[r]);
    y = in_->solve_upper(y);
    const Vec6 twist = in_->out_of_frame(y);
    const double per = 1.0 / std::max(grasp::size(twist), 1e-300);
    result.twist = per * twist;
    in_->read_multipliers(engine, multipliers_, [&](int k) { return in_->row_scale(k, size); });
    drop_needless_multipliers(y, size);
    const bool at_rest = !(grasp::size(load) > 0.0);
    const bool proven = proves_infeasible(y, unit, size);
    const bool shut = at_rest && result.code == CONVERGED && result.margin <= CLEAR;
    if (result.margin > CLEAR && least_slack(z) > 0.0) {
      result.code = CONVERGED;
    } else if (shut) {
      result.code = INFEASIBLE;
    } else if (proven && separation(y, unit, size) > BOUNDARY) {
      result.code = INFEASIBLE;
      result.margin = std::min(result.margin, 0.0);
    } else if (!at_rest && part > 0.0 && move_inside(load, z, result)) {
      result.code = CONVERGED;
      result.margin = std::max(result.margin, 0.0);
    } else if (proven && !std::is_same_v<R, double>) {
      result.code = INFEASIBLE;
      result.margin = std::min(result.margin, 0.0);
    } else if (result.code == CONVERGED) {
      result.code = STALLED;  // slow does not mean infeasible
    }
    for (double& price : multipliers_) price *= per;
    return result;
  }
  // The proof that a wrench is out of reach: along this twist contacts move so little that forces
  // of up to SEEN times the wrench do not make up for it.
  Deepest beyond_reach(const double* wrench) {
    Deepest result;
    const Vec6 load = in_->in_frame(wrench);
    const Vec6 beyond = in_->reach.beyond(load);
    const double distance = grasp::size(beyond);
    const Vec6 y = (1.0 / distance) * beyond;
    double moved = 0.0;
    for (int i = 0; i < in_->count; ++i)
      for (int a = 0; a < D; ++a) {
        double motion = 0.0, terms = 0.0;
        for (int r = 0; r < 6; ++r) {
          const double part = y[r] * in_->balance[r][i][a];
          motion += part;
          terms += std::abs(part);
        }
        moved = std::max(moved, std::abs(motion) + UNMOVED * terms);
      }
    std::fill(multipliers_.begin(), multipliers_.end(), 0.0);
    std::copy_n(wrench, 6, result.wrench.begin());
    const Vec6 twist = in_->out_of_frame(y);
    result.twist = (1.0 / grasp::size(twist)) * twist;
    if (distance > SEEN * moved * grasp::size(load)) result.code = INFEASIBLE;
    return result;
  }
  double least_slack(const Field& z) {
    in_->write_slacks(z, many_, slacks_, [&](int k) { return in_->bound[k]; });
    return least_of(slacks_);
  }
  // Drop multipliers of limits that are mere rounding beside the twist.
  void drop_needless_multipliers(const Vec6& y, double size) {
    for (int k = 0; k < many_; ++k)
      if (multipliers_[k] * std::max(1.0, std::abs(in_->bound[k]) / size) <
          NEEDLESS * grasp::size(y))
        multipliers_[k] = 0.0;
  }
  // Distance of the wrench from those that can be balanced, as the multipliers show it: a fraction
  // of the wrench.
  double separation(const Vec6& y, const Vec6& unit, double size) const {
    double value = dot(y, unit);
    for (int k = 0; k < many_; ++k) value -= multipliers_[k] * in_->bound[k] / size;
    return value / (sum_of_sizes(y) * grasp::size(unit));
  }
  // Move z from the boundary of the constraints towards a force well inside, which changes the
  // wrench by less than BOUNDARY of it. Return true if z is then strictly inside; `result` has the
  // wrench that it balances.
  bool move_inside(const Vec6& load, Field& z, Deepest& result) {
    const double size = grasp::size(load);
    const Arena::Scope scope;
    Field inside(in_->count);
    for (double length : {1.0, 0.1, 0.01, 1e-3, 10.0, 100.0}) {
      for (int i = 0; i < in_->count; ++i) {
        inside[i] = {};
        add(inside[i], length * size, in_->inwards());
      }
      const double room = least_slack(inside);
      if (!(room > 0.0)) continue;
      const double part =
          std::min(1.0, SHORT * BOUNDARY * size / grasp::size(in_->wrench_of(inside) + load));
      for (int i = 0; i < in_->count; ++i)
        for (int a = 0; a < D; ++a) inside[i][a] = (1.0 - part) * z[i][a] + part * inside[i][a];
      const Vec6 balanced = in_->wrench_of(inside);
      if (!(least_slack(inside) > ENOUGH * part * room &&
            grasp::size(balanced + load) <= BOUNDARY * size))
        continue;
      z = inside;
      result.moved = true;
      result.wrench = in_->out_of_unit(-1.0 * balanced);
      return true;
    }
    return false;
  }
  // Slack of a limit that a unit of depth uses.
  double depth_slack(int k) const {
    double total = 1.0;
    for (int i = 0; i < in_->count; ++i) total += in_->limit[k][i][0];
    return total;
  }
  // True if the twist y (unit frame) and the limits' multipliers prove that no force is within the
  // limits: G^T y + sum multiplier row lies in every dual cone, and y . w > sum multiplier bound.
  // What it lacks of a dual cone must not matter for any force of up to COVERED times the wrench
  // or, if rounding hides it, SEEN times.
  bool proves_infeasible(const Vec6& y, const Vec6& unit, double size) {
    const double rounding = PROOF_ROUNDING * (8 + many_);
    double lacking = 0.0, hidden = 0.0;
    for (int i = 0; i < in_->count; ++i) {
      Tuple<double, D> dual{};
      double terms = 0.0;
      const auto take = [&](double part, const Tuple<double, D>& row) {
        add(dual, part, row);
        for (double value : row) terms += std::abs(part * value);
      };
      for (int r = 0; r < 6; ++r) take(y[r], in_->balance[r][i]);
      for (int k = 0; k < many_; ++k) take(multipliers_[k], in_->limit[k][i]);
      const double room = slack(cone(dual));
      const double lost = SUM_ROUNDING * terms;
      lacking = std::max(lacking, -room - lost);
      hidden = std::max(hidden, lost - room);
    }
    double value = 0.0, terms = 0.0;
    const auto take = [&](double part) {
      value += part;
      terms += std::abs(part);
    };
    for (int r = 0; r < 6; ++r) take(y[r] * unit[r]);
    for (int k = 0; k < many_; ++k) take(-multipliers_[k] * in_->bound[k] / size);
    return value > rounding * terms + COVERED * lacking + SEEN * hidden && terms < infinity;
  }
  // Set up the program for a wrench, scaled to its size.
  template <class R>
  void set_up(InteriorPoint<R, D, 2>& engine, const Vec6& turned, double size) const {
    auto& at = engine.at;
    const auto shared = [&](int k) -> Tuple<R, 2> {
      const double part = in_->row_scale(k, size);
      return {R(part * depth_slack(k)), R(-part * in_->bound[k] / size)};
    };
    for (int r = 0; r < engine.rows.joint; ++r) {
      const int label = engine.rows.label[r];
      if (r < 6) engine.rows.coupling[r][1] = turned[r];
      engine.rows.right[r] = r == 6 ? 1.0 : 0.0;
      if (label >= 0) engine.rows.coupling[r] = shared(label);
      at.joint[r] = r < 7 ? 0.0 : 1.0;
      at.joint_slack[r] = 1.0;
    }
    for (int k = 0; k < int(engine.rows.own.size()); ++k) {
      auto& row = engine.rows.own[k];
      if (row.label >= 0) row.shared = shared(row.label);
      at.own[k] = at.own_slack[k] = 1.0;
    }
    in_->scale_rows(engine.rows, size);
    at.t = {};
    for (int i = 0; i < in_->count; ++i) at.z[i] = at.s[i] = wide<R>(in_->inwards());
  }
};

// Not inline, see `ProgramOn`.
template <int D>
Deepest Depth<D>::find(const double* wrench, double tolerance, Field& z, bool inside) {
  if (in_->is_out_of_reach(in_->in_frame(wrench))) return beyond_reach(wrench);
  Deepest result = find<double>(wrench, tolerance, z);
  if (result.code != CONVERGED && result.code != INFEASIBLE)
    result = find<DoubleDouble>(wrench, tolerance, z);
  if (inside && result.code == CONVERGED && !result.moved && result.margin < NEAR)
    move_inside(in_->in_frame(wrench), z, result);
  return result;
}

}  // namespace detail
}  // namespace grasp
