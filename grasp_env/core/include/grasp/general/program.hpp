// The general program of a grasp: any contacts, limits of normal forces and joint torques. It
// minimises the sum or the maximum of the normal forces, the excess over limits that no force
// keeps, or Phi; or it finds the force deepest inside all constraints. Forces are scaled by the
// least-norm one, so tolerances mean the same from 1e-6 to 1e4 N.
#pragma once
#include <variant>
#include <grasp/general/program_answers.hpp>
#include <grasp/general/program_starts.hpp>

namespace grasp {
namespace detail {

// Not inline: `extern template class ProgramOn<D>` keeps it out of a file.
template <int D> Code ProgramOn<D>::least(const double* wrench, Criterion criterion,
                                          const StopRule& options, const Record& record,
                                          double* multipliers, int budget) {
  const Arena::Scope scope;
  record.clear();
  std::fill(multipliers, multipliers + limits, 0.0);
  Summary& out = record.summary();
  out.code = REFUSED;
  if (!is_valid_wrench(wrench) || (criterion == Criterion::excess && !may_exceed_)) return REFUSED;
  std::copy(wrench, wrench + 6, out.wrench.begin());
  criterion_ = criterion;
  budget_ = budget;
  tolerance_ = options.tolerance;
  const Vec6 load = in_.in_frame(wrench);
  if (in_.is_out_of_reach(load)) return REFUSED;  // `deepest` has the proof
  const Vec6 turned = in_.solve_lower(load);
  size_ = in_.largest_of(turned);
  double most = 0.0;
  for (int k = 0; k < limits; ++k) most = std::max(most, -in_.bound[k]);
  for (int j = 0; criterion == Criterion::torque && j < in_.joints; ++j)
    most = std::max(most, std::abs(in_.bias[j]));
  if (size_ < NOTHING && !(most > 0.0)) {  // zero force is the answer
    out.code = CONVERGED;
    if (criterion == Criterion::largest) out.objective = out.lower_bound = in_.largest_offset();
    return CONVERGED;
  }
  size_ = std::max(size_, most);
  unit_ = (1.0 / size_) * load;
  turned_ = (1.0 / size_) * turned;
  best_value_ = infinity;
  best_bound_ = 0.0;
  best_nu_ = Vec6{};
  residual_ = 0.0;
  std::fill(best_multipliers_.begin(), best_multipliers_.end(), 0.0);
  has_inside_ = moved_ = false;
  const bool one_each = criterion == Criterion::sum || criterion == Criterion::torque;
  const Code code = one_each ? solve<0>(wrench, options, out) : solve<1>(wrench, options, out);
  if (code == INFEASIBLE) {
    std::copy(multipliers_.begin(), multipliers_.end(), multipliers);
    return record.refute(out.multipliers, size(load));
  }
  if (code == REFUSED) return code;
  write(code, record, multipliers);
  if (moved_) {
    const double residual = grasp::size(size_ * in_.wrench_of(best_) + load);
    stand_for(record, in_.out_of_unit(size_ * unit_), wrench, residual, options.tolerance);
  }
  return Code(int(out.code));
}

template <int D> Deepest ProgramOn<D>::deepest(const double* wrench, double tolerance, double* z,
                                               double* multipliers, bool inside) {
  const Arena::Scope scope;
  std::fill(multipliers, multipliers + limits, 0.0);
  Deepest result;
  if (!is_valid_wrench(wrench)) return result;
  Depth depth(in_, limits);
  result = depth.find(wrench, tolerance, inside_, inside);
  if (result.code == INFEASIBLE)
    std::copy(depth.multipliers().begin(), depth.multipliers().end(), multipliers);
  store_z(inside_, z);
  return result;
}

template <int D> Payload ProgramOn<D>::payload(const double* direction, const double* wrench,
                                               double tolerance, double* z, double* multipliers) {
  const Arena::Scope scope;
  std::fill(multipliers, multipliers + limits, 0.0);
  if (!is_valid_wrench(wrench) || !is_valid_wrench(direction)) return {};
  LargestLoad<D> largest(in_);
  const Payload result = largest.find(direction, wrench, tolerance, inside_);
  std::copy(largest.multipliers().begin(), largest.multipliers().end(), multipliers);
  store_z(inside_, z);
  return result;
}

template <int D> Code ProgramOn<D>::least_phi(const Call& call, const Weights<double, 4>* weights,
                                              const double* row_weights, const double* z,
                                              const Record& record, double* multipliers) {
  const Arena::Scope scope;
  record.clear();
  std::fill(multipliers, multipliers + limits, 0.0);
  record.summary().code = REFUSED;
  if (!is_valid_wrench(call.wrench)) return REFUSED;
  std::copy(call.wrench, call.wrench + 6, record.summary().wrench.begin());
  criterion_ = Criterion::sum;
  size_ = 1.0;
  unit_ = in_.in_frame(call.wrench);
  turned_ = in_.solve_lower(unit_);
  load_z(z, inside_);
  has_inside_ = true;
  const auto take_start = [&](auto& engine) {
    set_right(engine);
    for (int i = 0; i < count; ++i)
      engine.z[i] = wide<std::decay_t<decltype(engine.value)>>(inside_[i]);
  };
  int spent = 0, trials = 0;
  // descend on Phi with lambda multiplied by `raised`
  const auto descend = [&](auto& engine, Call stage, double raised, const StopRule& stop) {
    stage.stop = stop;
    for (int i = 0; i < count; ++i) {
      const Weights<double, D> fit = fitted<D>(weights[i]);
      auto& to = engine.weights[i];
      to.omega = fit.omega;
      to.lambda = raised * fit.lambda;
      if constexpr (D == 4) to.axial = fit.axial;
    }
    for (int k = 0; k < limits; ++k) engine.row_weights[k] = raised * row_weights[k];
    const Code code = engine.run(stage, LONG);
    spent += engine.iterations;
    trials += engine.trials;
    return code;
  };
  const auto written = [&](auto& engine, Code code) {
    engine.iterations = spent;
    engine.trials = trials;
    return code == REFUSED ? code : write_phi(engine, code, call, record, multipliers);
  };
  const auto [tolerance, limit] = call.stop;
  PhiRows<double, D> quick(in_.template rows<double, 0>(limits), limits);
  take_start(quick);
  const Code first = descend(quick, call, 1.0, {tolerance, std::min(limit, PATIENCE)});
  if (first != STALLED && (first != LIMIT || limit <= PATIENCE)) return written(quick, first);
  // steps along curved surfaces are short: follow the central path, which stays away from them
  double raised = 1.0;
  for (int i = 0; i < count; ++i)
    raised = std::max(raised, weights[i].omega * z[4 * i] * z[4 * i] / weights[i].lambda);
  PhiRows<DoubleDouble, D> careful(in_.template rows<DoubleDouble, 0>(limits), limits);
  take_start(careful);
  careful.balance();
  const Call path{.wrench = call.wrench};
  while ((raised /= FALL) > 1.0 && spent < limit)
    if (descend(careful, path, raised, {0.1, std::min(limit - spent, 2 * PATIENCE)}) == REFUSED)
      break;
  const Code code = descend(careful, call, 1.0, {tolerance, std::min(limit - spent, 2 * PATIENCE)});
  const bool worse =
      code == REFUSED || (code != CONVERGED && double(careful.value) > double(quick.value));
  if (worse) return written(quick, STALLED);
  return written(careful, code == LIMIT && spent < limit ? STALLED : code);
}

}  // namespace detail

// Memory, for construction and calls, comes from the arena in use or from the heap.
class Program {
 public:
  const int count, limits;

  explicit Program(const ProgramData& data)
      : count(data.count), limits(data.limits), on_(make(data)) {}
  // Bytes of an arena; joints: largest number of rows that act on several contacts.
  // torques: number of joints of `Criterion::torque`, or 0.
  static std::size_t bytes_needed(int count, int limits, int joints, int torques, bool soft) {
    return soft ? detail::ProgramOn<4>::bytes_needed(count, limits, joints, torques)
                : detail::ProgramOn<3>::bytes_needed(count, limits, joints, torques);
  }

  // Minimise a criterion, into a record, with multipliers (M,) >= 0 of the limits. INFEASIBLE: the
  // record's multipliers are the twist that proves it. REFUSED: numbers that are not finite, or
  // neither a force nor a proof. LIMITS_EXCEEDED: for Criterion::excess, to EXCESS_WITHIN. budget:
  // iterations of all attempts together.
  Code least(const double* wrench, Criterion criterion, const StopRule& options,
             const Record& record, double* multipliers, int budget = INT_MAX) {
    return std::visit(
        [&](auto& on) { return on.least(wrench, criterion, options, record, multipliers, budget); },
        on_);
  }
  // Find z (N, 4) [N], the force of largest depth m in all cones and rows, where forces and the
  // wrench's share r sum to one, m <= r. INFEASIBLE: multipliers (M,) of the proof.
  Deepest deepest(const double* wrench, double tolerance, double* z, double* multipliers,
                  bool inside = false) {
    return std::visit(
        [&](auto& on) { return on.deepest(wrench, tolerance, z, multipliers, inside); }, on_);
  }
  // Find the largest k for which forces hold `wrench + k direction`; writes z (N, 4) [N] that holds
  // `load`, and the multipliers (M,) of the bound or the proof.
  Payload payload(const double* direction, const double* wrench, double tolerance, double* z,
                  double* multipliers) {
    return std::visit(
        [&](auto& on) { return on.payload(direction, wrench, tolerance, z, multipliers); }, on_);
  }
  // Minimise Phi from z (N, 4), balanced and strictly inside, with weights (N,) of the contacts and
  // row_weights (M,). Uses wrench, stop, optimum and trace of the call. REFUSED: no such start.
  Code least_phi(const Call& call, const Weights<double, 4>* weights, const double* row_weights,
                 const double* z, const Record& record, double* multipliers) {
    return std::visit(
        [&](auto& on) { return on.least_phi(call, weights, row_weights, z, record, multipliers); },
        on_);
  }
  // Largest component of G z + w, z (N, 4), unit frame [N].
  double missed(const double* wrench, const double* z) {
    return std::visit([&](auto& on) { return on.missed(wrench, z); }, on_);
  }
  // Balance z (N, 4) by the least-norm change.
  void balance(const double* wrench, double* z) {
    std::visit([&](auto& on) { on.balance(wrench, z); }, on_);
  }
  // Smallest slack of z (N, 4) in cones and rows, less rounding.
  double slack(const double* z) {
    return std::visit([&](auto& on) { return on.least_slack(z); }, on_);
  }
  // Provide an internal force z (N, 4) for starts. Return false unless it is strictly inside the
  // cones; `least` then searches for one.
  bool set_internal_force(const double* z) {
    return std::visit([&](auto& on) { return on.set_internal_force(z); }, on_);
  }
  // Largest component of a wrench, unit frame [N].
  double unit_size(const double* wrench) const {
    return std::visit([&](const auto& on) { return on.unit_size(wrench); }, on_);
  }
  // True if the rows of balance that contacts can change are independent beyond rounding.
  bool independent() const {
    return std::visit([&](const auto& on) { return on.independent(); }, on_);
  }
  // True if no forces, of any sign, make the wrench.
  bool is_out_of_reach(const double* wrench) const {
    return std::visit([&](const auto& on) { return on.is_out_of_reach(wrench); }, on_);
  }

 private:
  using On = std::variant<detail::ProgramOn<3>, detail::ProgramOn<4>>;
  On on_;

  static On make(const ProgramData& data) {
    for (int i = 0; i < data.count; ++i)
      if (data.divisor[4 * i + 3] < infinity) return On(std::in_place_index<1>, data);
    return On(std::in_place_index<0>, data);
  }
};

}  // namespace grasp
