// Answers of the general program: forces balanced and inside to the last digit, bounds, the record.
#pragma once
#include <grasp/general/program_on.hpp>

namespace grasp::detail {

template <int D> template <class R, int T>
inline double ProgramOn<D>::consider(const Interior<R, T>& engine) {
  const auto right = [&](int k) { return in_.bound[k] / size_; };
  for (int i = 0; i < count; ++i) z_[i] = narrow(engine.at.z[i]);
  residual_ = in_.rebalance(z_, unit_);
  in_.write_slacks(z_, kept(), slacks_, right);
  double least = least_of(slacks_);
  if (least > 0.0 && keeps_interior(engine)) {
    inside_ = z_;
    has_inside_ = true;
  }
  if (least < 0.0 && has_inside_) {  // mix with just enough of a force inside
    in_.write_slacks(inside_, kept(), slacks_inside_, right);
    const double part = in_.part_inside(slacks_, slacks_inside_);
    for (int i = 0; i < count; ++i)
      for (int a = 0; a < D; ++a) z_[i][a] = (1.0 - part) * z_[i][a] + part * inside_[i][a];
    residual_ = grasp::size(in_.wrench_of(z_) + unit_);
    in_.write_slacks(z_, kept(), slacks_, right);
    least = least_of(slacks_);
  }
  certify(engine);
  double force = 0.0;
  for (int i = 0; i < count; ++i) {
    const double normal = price(i) * z_[i][0] + offset(i);
    force = T == 1 ? std::max(force, normal) : force + normal;
  }
  const double value = elastic() ? excess(z_) : of_torques() ? in_.torque_norm(z_, size_) : force;
  const bool good = least >= 0.0 && residual_ <= BALANCED * grasp::size(unit_) +
                                                     (ROUNDED + in_.reach.rounding) * force;
  if (good && value < best_value_) {
    best_value_ = value;
    best_ = z_;
    best_residual_ = residual_;
  }
  return gap();
}

template <int D> template <class R, int T>
inline void ProgramOn<D>::certify(const Interior<R, T>& engine) {
  const auto& rows = engine.rows;
  const auto& at = engine.at;
  in_.read_multipliers(engine, multipliers_, [](int) { return 1.0; });
  if constexpr (T == 0)
    if (of_torques()) return certify_torques(engine);
  double shares = 0.0;
  for (int k = 0; k < int(rows.own.size()); ++k)
    if (rows.own[k].label < 0) shares += std::max(double(at.own[k]), 0.0);
  double theta = 1.0, paid = 0.0;
  double offset_at_end = 0.0, offset_at_safe = 0.0;  // of `Criterion::largest`
  if (elastic()) {
    double price = 0.0;
    for (int k = 0; k < limits; ++k) price += multipliers_[k] * in_.shares[k];
    theta = price > 0.0 ? size_ / price : 0.0;
  }
  for (int i = 0; i < count; ++i) {
    Tuple<double, D> safe{}, end{};
    safe[0] = engine_price<T>(i);
    end[0] = elastic() ? 0.0 : price(i);
    if (T == 1 && !elastic()) {
      const double share = std::max(double(at.own[rows.first[i + 1] - 1]), 0.0) / shares;
      end[0] *= share;
      offset_at_end += share * offset(i);
      offset_at_safe += offset(i) / count;
    }
    for (int r = 0; r < 6; ++r) add(end, double(at.joint[r]), in_.turn[r][i]);
    for (int r = rows.equal; r < rows.joint; ++r)
      add(end, multipliers_[rows.label[r]], in_.limit[rows.label[r]][i]);
    for (int k = rows.first[i]; k < rows.first[i + 1]; ++k)
      if (rows.own[k].label >= 0)
        add(end, multipliers_[rows.own[k].label], in_.limit[rows.own[k].label][i]);
    const Vec<double, D> last = cone(end);
    if (slack(last) >= 0.0) continue;
    if (elastic()) {
      paid -= slack(last) * most_ / price(i);
      continue;
    }
    const double per = Boundary(cone(safe)).per(last - cone(safe));
    theta = per > 1.0 ? std::min(theta, 1.0 / per) : per == per ? theta : 0.0;
  }
  double value = 0.0;
  Vec6 y;
  for (int r = 0; r < 6; ++r) {
    y[r] = double(at.joint[r]);
    value += y[r] * turned_[r];
  }
  for (int k = 0; k < limits; ++k) value -= multipliers_[k] * in_.bound[k] / size_;
  value = theta * (value - paid + offset_at_end) + (1.0 - theta) * offset_at_safe;
  if (value > best_bound_ && value < infinity) {
    best_bound_ = value;
    best_nu_ = -theta * y;
    for (int k = 0; k < limits; ++k) best_multipliers_[k] = theta * multipliers_[k];
  }
}

template <int D> template <class R>
inline void ProgramOn<D>::certify_torques(const Interior<R, 0>& engine) {
  const auto& at = engine.at;
  double value = 0.0, square = 0.0;
  Vec6 y;
  for (int r = 0; r < 6; ++r) {
    y[r] = double(at.joint[r]);
    value += y[r] * turned_[r];
  }
  for (int j = 0; j < in_.joints; ++j) {
    const double part = double(at.joint[6 + j]);
    value += part * in_.bias[j] / size_;
    square += part * part;
  }
  for (int k = 0; k < limits; ++k) value -= multipliers_[k] * in_.bound[k] / size_;
  double most = 1.0;
  for (int i = 0; i < count; ++i) most = std::max(most, z_[i][0]);
  for (int i = 0; i < count; ++i) {
    Tuple<double, D> end{};
    for (int r = 0; r < 6; ++r) add(end, y[r], in_.turn[r][i]);
    for (int j = 0; j < in_.joints; ++j) add(end, double(at.joint[6 + j]), in_.torque[j][i]);
    for (int k = 0; k < limits; ++k) add(end, multipliers_[k], in_.limit[k][i]);
    value -= std::max(-slack(cone(end)), 0.0) * in_.FARTHEST * most;
  }
  // the multipliers of the torques have at most length one
  const double theta = square > 0.0 ? 1.0 / std::sqrt(square) : 0.0;
  if (!(theta * value > best_bound_ && theta < infinity)) return;
  best_bound_ = theta * value;
  best_nu_ = -theta * y;
  for (int k = 0; k < limits; ++k) best_multipliers_[k] = theta * multipliers_[k];
}

template <int D> template <class R>
inline Code ProgramOn<D>::write_phi(PhiRows<R, D>& engine, Code code, const Call& call,
                                    const Record& record, double* multipliers) {
  for (int i = 0; i < count; ++i) best_[i] = narrow(engine.z[i]);
  best_residual_ = in_.rebalance(best_, unit_);
  // move what rounding took outside back towards the start
  for (double part = 1e-15;; part = std::min(1.0, 4.0 * part)) {
    for (int i = 0; i < count; ++i) engine.z[i] = wide<R>(best_[i]);
    engine.evaluate();
    in_.write_slacks(best_, limits, slacks_, [&](int k) { return in_.bound[k]; });
    if ((least_of(slacks_) >= 0.0 && engine.value < infinity) || best_ == inside_) break;
    for (int i = 0; i < count; ++i)
      for (int a = 0; a < D; ++a)
        best_[i][a] =
            part < 1.0 ? best_[i][a] + part * (inside_[i][a] - best_[i][a]) : inside_[i][a];
    best_residual_ = grasp::size(in_.wrench_of(best_) + unit_);
  }
  best_value_ = double(engine.value);
  best_bound_ = double(engine.bound);
  for (int r = 0; r < 6; ++r) best_nu_[r] = -double(engine.proof.joint[r]);
  for (int k = 0; k < int(engine.rows.own.size()); ++k)
    best_multipliers_[engine.rows.own[k].label] = double(engine.proof.own[k]);
  for (int r = engine.rows.equal; r < engine.rows.joint; ++r)
    best_multipliers_[engine.rows.label[r]] = double(engine.proof.joint[r]);
  double force = 0.0;
  for (int i = 0; i < count; ++i) force = std::max(force, best_[i][0]);
  const bool good =
      least_of(slacks_) >= 0.0 && best_residual_ <= BALANCED * (force + grasp::size(unit_));
  const bool near =
      best_bound_ > 0.0 && best_value_ - best_bound_ <= call.stop.tolerance * best_bound_;
  if (code == CONVERGED && !(good && (near || call.optimum == call.optimum))) code = STALLED;
  write(code, record, multipliers);
  record.summary().iterations = engine.iterations;
  record.summary().trials = engine.trials;
  return code;
}

template <int D>
inline void ProgramOn<D>::write(Code code, const Record& record, double* multipliers) {
  Summary& out = record.summary();
  if (!(best_value_ < infinity)) {  // the last force known to be inside, or none
    if (!has_inside_ || elastic()) {
      out.code = REFUSED;
      return;
    }
    best_ = inside_;
  }
  // unit of the objective
  const double unit = elastic() ? 1.0 : of_torques() ? size_ * in_.torque_unit : size_;
  out.code = code;
  // torques that vanish but for rounding are none
  const bool none = of_torques() && best_value_ <= NO_TORQUE;
  out.objective = none ? 0.0 : unit * best_value_;
  out.lower_bound = unit * best_bound_;
  if (elastic()) {
    out.code = code == CONVERGED ? LIMITS_EXCEEDED : code;
    out.limit_excess = best_value_;
    best_nu_ = (1.0 / size_) * best_nu_;
    for (double& price : best_multipliers_) price /= size_;
  }
  if (of_torques()) {
    best_nu_ = in_.torque_unit * best_nu_;
    for (double& price : best_multipliers_) price *= in_.torque_unit;
  }
  out.residual = size_ * best_residual_;
  out.multipliers = in_.pull_back(best_nu_);
  out.margin = infinity;
  for (int i = 0; i < count; ++i) {
    Vec<double, D> x = cone(best_[i]);
    double* force = record.force() + 3 * i;
    for (int a = 0; a < 3; ++a) force[a] = size_ * x[a] / in_.divisor[4 * i + a];
    std::copy(force, force + 3, record.initial_force() + 3 * i);
    if (D == 4) record.torsion()[i] = size_ * x[D - 1] / in_.divisor[4 * i + 3];
    for (int a = 1; a < D; ++a)
      if (!(in_.divisor[4 * i + a] < infinity)) x[a] = 0.0;
    out.margin = std::min(out.margin, size_ * slack(x));
  }
  std::copy(best_multipliers_.begin(), best_multipliers_.end(), multipliers);
}

}  // namespace grasp::detail
