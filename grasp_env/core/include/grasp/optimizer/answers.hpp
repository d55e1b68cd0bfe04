// Checks the answer of a call and writes it as a row of all contacts.
#pragma once
#include <grasp/optimizer/call_state.hpp>
#include <grasp/optimizer/solvers.hpp>

namespace grasp::detail {

inline void write_sizes(const CurrentContacts& current, Summary& s) {
  s.contacts = current.home.count;
  s.joints = current.joints;
  s.limits = current.limits.rows;
}
// Begin the row of a call: its sizes and its wrench.
template <class V, int B>
Record open_row(const Solvers<V, B>& on, const Request& request, double* row) {
  Summary& s = *reinterpret_cast<Summary*>(row);
  s = Summary{};
  write_sizes(on.current, s);
  if (is_valid_wrench(request.wrench)) std::copy_n(request.wrench, 6, s.wrench.begin());
  return Record(row);
}

// True for an optimum, a proof, or a force that is balanced and inside the cones.
template <class V, int B> bool is_sound(const Solvers<V, B>& on, Code code, const Record& record) {
  // fraction of the largest force: effect of its rounding on balance
  constexpr double ROUNDED = 1e-13;
  if (code == CONVERGED || !Record::has_force(code)) return code == CONVERGED || code == INFEASIBLE;
  const Summary& s = record.summary();
  const Contacts& now = on.current.now;
  double most = 0.0;
  for (int i = 0; i < now.count; ++i) most = std::max(most, record.force()[3 * i]);
  const double allowed =
      balance_tolerance(grasp::size(on.newton.cones.unit.of(s.wrench.data())), most) +
      (ROUNDED + now.reach.rounding * now.count) * most + NOTHING;
  return s.residual <= allowed && s.margin >= 0.0 && s.objective < infinity && most <= LARGEST &&
         grasp::size(s.multipliers) < infinity;
}

template <class V, int B> class AnswerWriter {
 public:
  AnswerWriter(Solvers<V, B>& on, const CallState& call)
      : on_(on), current_(on.current), call_(call) {}

  // Write an optimum, a proof, or neither. If rounding left no usable force: UNDECIDED.
  Code write(Code code, const Record& out) {
    const bool usable = !Record::has_force(code) || is_sound(on_, code, on_.record());
    code = usable ? code : UNDECIDED;
    if (code == INFEASIBLE) return write_proof(out);
    if (!Record::has_force(code)) return write_nothing(code, out);
    write_force(code, out);
    const bool optimal = code != LIMITS_EXCEEDED;
    current_.fill_multipliers(out.limit_multipliers(),
                              [&](int row) { return optimal ? on_.answer.multipliers[row] : 0.0; });
    if (code == LIMITS_EXCEEDED) out.summary().objective = out.summary().limit_excess;
    return code;
  }
  // Write a start. Its balance may be as inexact as that of a given force; it has no multipliers.
  Code write_start(Code code, const Record& out) {
    if (code == INFEASIBLE) return write_proof(out);
    const bool usable = code == STARTED && on_.record().summary().objective < infinity;
    if (!usable) return write_nothing(code == STARTED ? UNDECIDED : code, out);
    write_force(code, out);
    current_.fill_multipliers(out.limit_multipliers(), [](int) { return 0.0; });
    return code;
  }

 private:
  static constexpr double NOT_TOUCHING = std::numeric_limits<double>::quiet_NaN();
  Solvers<V, B>& on_;
  const CurrentContacts& current_;
  const CallState& call_;

  Code write_nothing(Code code, const Record& out) const {
    Summary& s = out.summary();
    s.code = code;
    std::fill(out.force(),
              out.force() +
                  record_size(current_.home.count, current_.joints, current_.limits.rows) - SUMMARY,
              0.0);
    s.objective = infinity;
    s.lower_bound = -infinity;  // of no force
    return code;
  }
  Code write_proof(const Record& out) {
    write_nothing(INFEASIBLE, out);
    const Record record = on_.record();
    const Summary& from = record.summary();
    Summary& s = out.summary();
    s.wrench_with_preload = call_.wrench;
    s.iterations = from.iterations;
    s.trials = from.trials;
    s.residual = from.residual;
    s.multipliers = from.multipliers;
    s.lower_bound = infinity;  // every bound holds where no force exists
    s.start = double(call_.used.start);
    s.replaced = call_.used.replaced;
    current_.fill_multipliers(out.limit_multipliers(),
                              [&](int row) { return on_.answer.multipliers[row]; });
    return INFEASIBLE;
  }
  void write_force(Code code, const Record& out) {
    const Record from = on_.record();
    Summary& s = out.summary();
    const Vec6 wrench = s.wrench;
    s = from.summary();
    s.code = code;
    s.wrench = wrench;
    s.wrench_with_preload = call_.wrench;
    if (code != LIMITS_EXCEEDED) {
      s.objective += call_.offset;
      s.lower_bound += call_.offset;
    }
    write_sizes(current_, s);
    s.start = double(call_.used.start);
    s.replaced = call_.used.replaced;
    s.outside = call_.used.outside;
    add_offset_to_trace(int(s.iterations));
    write_contacts(from, out);
    if (current_.joints) current_.torques(from, out.torques());
    if (current_.limits.rows) s.limit_excess = current_.excess(out);
  }
  // Add the preloads to the forces and write them, in the order of all contacts.
  void write_contacts(const Record& from, const Record& out) const {
    const int all = current_.home.count;
    const Contacts& now = current_.now;
    current_.preload.add_to(from.force(), now.count);
    current_.preload.add_to(from.initial_force(), now.count);
    if (now.count == all) {
      std::copy_n(from.force(), 7 * all, out.force());
      std::copy_n(now.frames.data(), 9 * all, out.frames());
      write_friction_used(now, current_.friction_margin, from, out.friction_used());
      return;
    }
    std::fill(out.force(), out.frames() + 9 * all, 0.0);
    std::fill_n(out.friction_used(), all, NOT_TOUCHING);
    for (int i = 0; i < now.count; ++i) {
      const int to = current_.chosen[i];
      std::copy_n(from.force() + 3 * i, 3, out.force() + 3 * to);
      std::copy_n(from.initial_force() + 3 * i, 3, out.initial_force() + 3 * to);
      out.torsion()[to] = from.torsion()[i];
      std::copy_n(&now.frames[9 * i], 9, out.frames() + 9 * to);
    }
    double* used = from.initial_force();  // copied above
    write_friction_used(now, current_.friction_margin, from, used);
    for (int i = 0; i < now.count; ++i) out.friction_used()[current_.chosen[i]] = used[i];
  }
  void add_offset_to_trace(int iterations) const {
    if (call_.offset == 0.0) return;
    const std::span<double> trace = call_.request.trace;
    for (double& value : trace.first(std::min(trace.size(), std::size_t(iterations) + 1)))
      value += call_.offset;
  }
};

}  // namespace grasp::detail
