// Runs the planned algorithm of a call from its start, and falls back on the general program.
#pragma once
#include <grasp/optimizer/answers.hpp>
#include <grasp/optimizer/starts.hpp>

namespace grasp::detail {

// Solves one call into the record of `on` and the multipliers of its limits.
template <class V, int B> class Algorithms {
 public:
  Algorithms(Solvers<V, B>& on, CallState& call)
      : on_(on),
        call_(call),
        starts_(on, call),
        record_(on.record()),
        w_(call.w),
        cones_(on.newton.cones) {}

  // Run the planned algorithm. If a start that depends on more than contacts and wrench leads to no
  // answer, solve again from the default start.
  Code solve() {
    const Code code = run();
    if (code == CONVERGED || code == INFEASIBLE || starts_.is_default()) return code;
    const bool sound = is_sound(on_, code, record_);
    return code == REFUSED || (sound && code != STALLED) ? code : solve_again(code, sound);
  }

  // Write the start that `solve` would use as a record. Return STARTED, or why there is none.
  Code start() {
    clear_record();
    const ProblemKind kind = on_.placement.kind;
    const auto algorithm = algorithm_for(on_.options, kind);
    if (!algorithm) return unserved();
    const bool general_serves = algorithm == Algorithm::general ||
                                algorithm == Algorithm::limited_conic ||
                                (kind == ProblemKind::soft && starts_.requested() == Start::given);
    const Code code = general_serves ? UNDECIDED : starts_.find();
    if (code == CONVERGED) {
      const auto& x = on_.newton.x;
      cones_.store_force(x, record_.initial_force());
      cones_.certify(x, w_, record_);
      record_.summary().objective = phi_of(x);
      record_.summary().lower_bound = -infinity;
      return STARTED;
    }
    if (code == INFEASIBLE && kind != ProblemKind::soft) return write_proof();
    if (code == REFUSED || on_.has_flow()) return code;
    const Code answer = general({call_.stop.tolerance, 0});
    return answer == CONVERGED || answer == STALLED || answer == LIMIT ? STARTED : answer;
  }

 private:
  // of the mean normal force: smallest slack of a start within limits
  static constexpr double WELL_INSIDE = 1e-3;
  Solvers<V, B>& on_;
  CallState& call_;
  Starts<V, B> starts_;
  const Record record_;
  const Vec6& w_;
  const Cones<V, B>& cones_;

  // Solve again from the default start, within the steps that are left. The first force stays
  // if it is sound, unless the second answer is proven or better.
  [[gnu::cold, gnu::noinline]] Code solve_again(Code first, bool sound) {
    const Summary before = record_.summary();
    if (sound) on_.kept = on_.answer;
    const int spent = std::min(int(before.iterations), call_.stop.limit);
    const auto trace =
        call_.request.trace.subspan(std::min(std::size_t(spent), call_.request.trace.size()));
    const double traced = trace.empty() ? 0.0 : trace[0];
    const Request again{.wrench = call_.request.wrench,
                        .start = starts_.default_start(),
                        .optimum = call_.request.optimum,
                        .trace = trace};
    CallState second{.request = again,
                     .stop = {call_.stop.tolerance, call_.stop.limit - spent},
                     .wrench = call_.wrench,
                     .w = w_,
                     .offset = call_.offset};
    const Code code = Algorithms(on_, second).run();
    const bool proven = code == CONVERGED || code == INFEASIBLE || code == LIMITS_EXCEEDED;
    const bool better =
        is_sound(on_, code, record_) && record_.summary().objective < before.objective;
    if (sound && !proven && !better) {
      on_.answer = on_.kept;
      if (!trace.empty()) trace[0] = traced;
      return first;
    }
    record_.summary().iterations += before.iterations;
    record_.summary().trials += before.trials;
    call_.used = {.start = second.used.start, .replaced = true, .outside = second.used.outside};
    return code;
  }

  Code run() {
    Summary& s = record_.summary();
    s = Summary{};
    s.wrench = call_.wrench;
    const auto algorithm = algorithm_for(on_.options, on_.placement.kind);
    if (!algorithm) return unserved();
    switch (*algorithm) {
      case Algorithm::newton:
        return newton();
      case Algorithm::limited:
        return call_.is_study() ? general() : within_limits();
      case Algorithm::soft:
        return soft();
      case Algorithm::flow:
        return flow();
      case Algorithm::conic:
        return conic();
      case Algorithm::limited_conic:
        return limited_conic();
      default:
        return general();
    }
  }
  // The method has no algorithm for these contacts.
  Code unserved() const {
    return on_.current.now.placing == Placing::rank_lost ? RANK_LOST : REFUSED;
  }
  // Phi of a start, which has no torsion.
  double phi_of(const typename Solvers<V, B>::Field& x) {
    if (on_.placement.kind != ProblemKind::soft) return cones_.phi(x);
    on_.soft->begin(x);
    return on_.soft->newton.cones.phi(on_.soft->newton.x);
  }
  void clear_record() {
    record_.clear();
    record_.summary().wrench = call_.wrench;
  }
  // Record a proof that uses only the cones.
  Code write_proof() {
    std::fill(on_.answer.multipliers.begin(), on_.answer.multipliers.end(), 0.0);
    return record_.refute((1.0 / grasp::size(call_.twist)) * call_.twist, grasp::size(w_));
  }
  // Begin from the previous solution. Return false if the call does not.
  bool follows_previous(Call& call) {
    call_.used = {.start = starts_.requested()};
    if (call_.used.start != Start::previous || !GivenForce(on_, call_).load_previous())
      return false;
    take_given(call, From::tangent);
    return true;
  }
  void take_given(Call& call, From start) const {
    call.start = start;
    call.force = on_.given.force.data();
    call.torsion = on_.given.torsion.data();
  }

  Code newton() {
    const Code begun = starts_.find();
    if (begun == INFEASIBLE) return write_proof();
    if (begun == REFUSED) return REFUSED;
    Code code = REFUSED;
    if (begun == CONVERGED) {
      on_.begun = on_.newton.x;
      code = on_.newton.descend_from(on_.begun, call_.from(), w_, record_);
    }
    if (code == REFUSED && call_.used.start == Start::given) return REFUSED;
    if (!starts_.is_default()) return code == REFUSED ? UNDECIDED : code;
    if (code == REFUSED) return general();
    if (code != STALLED || call_.is_study()) return code;
    General* program = on_.general();
    return program ? program->phi_from(call_.stop, record_) : code;
  }

  Code flow() {
    const Code begun = starts_.find();
    if (begun == INFEASIBLE) return write_proof();
    if (begun != CONVERGED) return begun;
    FlowSolver<V, B>* flow = on_.flow();
    return flow ? flow->descend(on_.newton, call_.from(), w_, record_) : REFUSED;
  }

  Code within_limits() {
    auto& limited = *on_.limited;
    Call call = call_.from();
    Code begun = CONVERGED;
    const bool follows = follows_previous(call);
    if (follows)
      call.exceeding =
          call_.request.previous &&
          Record(const_cast<double*>(call_.request.previous)).code() == LIMITS_EXCEEDED;
    const auto begin = [&](const Vec6&, bool previous) {
      if (previous)
        begun = starts_.carry_previous() ? CONVERGED : UNDECIDED;
      else
        begun = follows ? starts_.find_replacement() : starts_.find();
      if (begun == CONVERGED) limited.newton.x = on_.newton.x;
      return begun == CONVERGED;
    };
    const Code code = limited.solve(call, record_, begin);
    if (code != REFUSED) {
      write_multipliers(code);
      return code;
    }
    if (begun == INFEASIBLE) return write_proof();
    if (begun == REFUSED) return REFUSED;
    return starts_.is_default() ? general() : UNDECIDED;
  }
  // Write the multipliers of an optimum of Phi or of a proof.
  void write_multipliers(Code code) {
    std::vector<double>& multipliers = on_.answer.multipliers;
    const LimitTable& table = on_.current.table;
    if (code == INFEASIBLE) {
      const double scale = on_.limited->proof_scale;
      on_.limited->newton.rows.multipliers(
          [&](int m, double multiplier) { multipliers[m] = scale * multiplier / table.sizes[m]; });
    } else {
      for (int k = 0; k < int(table.owners.size()); ++k) multipliers[k] = multiplier_at_optimum(k);
    }
  }
  // Multiplier of the k-th row of the current contacts at an optimum of Phi.
  double multiplier_at_optimum(int k) const {
    const LimitTable& table = on_.current.table;
    const int i = table.owners[k];
    double slack = table.bounds[k];
    for (int a = 0; a < 3; ++a)
      slack -=
          table.normals[3 * k + a] * record_.force()[3 * i + a] * on_.current.now.scale[3 * i + a];
    return slack > 0.0 ? table.weights[k] / (slack * slack * table.sizes[k]) : 0.0;
  }

  Code soft() {
    auto& soft = *on_.soft;
    Call call = call_.from();
    const bool follows = follows_previous(call);
    if (call_.used.start == Start::given) return general();
    const auto begin = [&](const Vec6&) {
      const Code begun = follows ? starts_.find_replacement() : starts_.find();
      if (begun == CONVERGED) soft.begin(on_.newton.x);
      return begun == CONVERGED;
    };
    const Code code = soft.solve(call, record_, begin);
    if (code != REFUSED) return code;
    return starts_.is_default() ? general() : UNDECIDED;
  }

  Code conic() {
    call_.used = {.start = Start::central};
    if (!on_.has_internal_force()) return limited_conic();
    const Code code = on_.conic().solve(call_.wrench.data(), record_);
    if (code == REFUSED) return general();
    if (code == CONVERGED) return code;
    General* program = on_.general();
    return program ? program->least_normal_from(call_.stop, record_) : code;
  }
  Code limited_conic() {
    call_.used = {.start = Start::central};
    const bool closed = on_.has_internal_force();
    if (!closed) {
      const Code interior = starts_.find_interior();
      call_.used.start = Start::central;
      const bool soft = on_.current.now.soft();
      if (interior == INFEASIBLE && !soft) return write_proof();
      if (interior != CONVERGED) return general();
    }
    const Code code = on_.solve_limited_conic(
        call_.wrench.data(), closed ? on_.internal_force() : on_.newton.x, !closed);
    if (code == CONVERGED || (code == INFEASIBLE && !on_.options.elastic)) return code;
    const bool hard = on_.placement.kind == ProblemKind::hard;
    if (hard && code != REFUSED && on_.finish_conic(call_.wrench.data()) == CONVERGED)
      return CONVERGED;
    return general();
  }

  // The least excess has steps of its own: where no force keeps the limits, a descent may spend all
  // of the call's.
  Code general() {
    const Code code = general(call_.stop);
    return on_.options.elastic && code == INFEASIBLE ? on_.general()->excess(record_) : code;
  }
  Code general(const StopRule& stop) {
    General* program = on_.general();
    if (!program) return UNDECIDED;
    Code code = REFUSED;
    if (on_.options.method == Method::conic) {
      call_.used.start = Start::central;
      code = program->least_normal(call_.wrench.data(), on_.options.criterion, stop, record_);
    } else {
      code = minimise_phi(*program, stop);
    }
    std::ranges::copy(program->multipliers(), on_.answer.multipliers.begin());
    return code;
  }
  Code minimise_phi(General& program, const StopRule& stop) {
    Call call = call_.from(From::combination);
    UsedStart& used = call_.used;
    GivenForce given(on_, call_);
    const Start start = starts_.requested();
    used.start = Start::phase_one;
    if (start == Start::given) {
      if (!given.load_inside(program)) return REFUSED;
      used.start = start;
      take_given(call, From::given);
    } else if (start == Start::previous && given.load_previous()) {
      used.start = start;
      take_given(call, From::tangent);
    }
    const bool is_default =
        start == Start::internal_force || start == Start::phase_one ||
        (start == Start::previous && !call_.request.previous && call_.request.force.empty());
    used.replaced = !is_default && (used.start == Start::phase_one || !program.starts_from(call));
    if (used.replaced) {
      used.start = Start::phase_one;
      call.start = From::combination;
    }
    int spent = 0;
    if (used.start == Start::phase_one && start != Start::phase_one) {
      // half of the steps at most, so that some are left if it fails
      const bool good = solve_without_limits(program, call_.stop.limit / 2, spent);
      if (good) take_given(call, From::given);
    }
    call.stop = {stop.tolerance, std::max(0, stop.limit - spent)};
    program.phi(call, record_);
    record_.summary().iterations += spent;
    record_.summary().trials += spent;
    return record_.code();
  }
  // Solve without limits into `given`. Return true if that optimum is well within the limits: such
  // a start costs a tenth of the deepest force. spent: number of steps.
  bool solve_without_limits(General& program, int limit, int& spent) {
    const ProblemKind kind = on_.placement.kind;
    if ((kind != ProblemKind::joined && kind != ProblemKind::soft_limited) || !on_.is_full_rank() ||
        !on_.has_internal_force())
      return false;
    auto& newton = on_.newton;
    const Contacts& now = on_.current.now;
    const Record record(newton.row.data(), now.count);
    const Call call{.wrench = call_.wrench.data(), .stop = {call_.stop.tolerance, limit}};
    grasp::begin(cones_, on_.internal_force(), w_, newton.x);
    Code code = REFUSED;
    if (now.soft()) {
      on_.place_soft();
      code = on_.soft->solve(call, record, [&](const Vec6&) {
        on_.soft->begin(newton.x);
        return true;
      });
    } else {
      on_.begun = newton.x;
      code = newton.descend_from(on_.begun, call, w_, record);
    }
    spent = int(record.summary().iterations);
    if (code != CONVERGED) return false;
    std::copy_n(record.force(), 3 * now.count, on_.given.force.data());
    std::copy_n(record.torsion(), now.count, on_.given.torsion.data());
    double normals = 0.0;
    for (int i = 0; i < now.count; ++i) normals += on_.given.force[3 * i] / now.count;
    return program.slack(on_.given.force.data(), on_.given.torsion.data()) > WELL_INSIDE * normals;
  }
};

}  // namespace grasp::detail
