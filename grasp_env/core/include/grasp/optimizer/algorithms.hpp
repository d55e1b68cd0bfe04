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
                                (on_.current.now.soft() && starts_.requested() == Start::given);
    if (algorithm == Algorithm::limited && !general_serves)
      return on_.soft_limited ? start_within(*on_.soft_limited) : start_within(*on_.limited);
    const Code code = general_serves ? UNDECIDED : starts_.find();
    if (code == CONVERGED) return write_start(cones_, on_.newton.x, phi_of(on_.newton.x));
    if (code == INFEASIBLE && kind != ProblemKind::soft) return write_proof();
    return code == REFUSED || on_.has_flow() ? code : general_start();
  }

 private:
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
  template <int D> Code write_start(const Cones<V, B, D>& cones,
                                    const typename Cones<V, B, D>::Field& x, double objective) {
    cones.store_force(x, record_.initial_force());
    cones.certify(x, w_, record_);
    record_.summary().objective = objective;
    record_.summary().lower_bound = -infinity;
    return STARTED;
  }
  Code general_start() {
    const Code answer = general({call_.stop.tolerance, 0});
    return answer == CONVERGED || answer == STALLED || answer == LIMIT ? STARTED : answer;
  }
  template <int D> Code start_within(LimitedNewton<V, B, D>& limited) {
    int steps = 0;
    const Code code = begin_within_limits(limited, false, steps);
    const auto& on = limited.newton;
    if (code == CONVERGED) return write_start(on.cones, on.x, on.cones.phi(on.x, on.rows));
    return code == UNDECIDED ? general_start() : code;
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
    return on_.soft_limited ? within_limits(*on_.soft_limited) : within_limits(*on_.limited);
  }
  template <int D> Code within_limits(LimitedNewton<V, B, D>& limited) {
    Call call = call_.from();
    const bool follows = follows_previous(call);
    if (call_.used.start == Start::given && on_.current.now.soft()) return general();
    if (follows) {
      if (follow_excess()) return LIMITS_EXCEEDED;
      const Code code = limited.follow(call, w_, record_);
      if (code != REFUSED) return finish(limited, code);
      call = call_.from();
    }
    int steps = 0;
    Code code = begin_within_limits(limited, follows, steps);
    if (code == INFEASIBLE && steps > 0 && on_.options.elastic) return least_excess();
    if (code == INFEASIBLE || code == REFUSED) return code;
    if (code == CONVERGED) {
      call.stop.limit -= steps;
      code = limited.descend(call, w_, record_);
      record_.summary().iterations += steps;
      record_.summary().trials += steps;
    }
    if (code == CONVERGED || code == LIMIT) return finish(limited, code);
    return starts_.is_default() ? general() : UNDECIDED;
  }
  // Find a start inside the limits. follows: a previous solution was of no use. steps: number of
  // steps taken. CONVERGED: it is in `limited`. INFEASIBLE: with the proof; after steps, `newton.x`
  // is balanced and in the cones. UNDECIDED: there is none, or it is not found quickly.
  template <int D>
  Code begin_within_limits(LimitedNewton<V, B, D>& limited, bool follows, int& steps) {
    const Code begun = follows ? starts_.find_replacement() : starts_.find();
    if (begun == INFEASIBLE) return D == 3 ? write_proof() : UNDECIDED;
    if (begun != CONVERGED || limited.begin(on_.newton.x)) return begun;
    const bool closed = on_.has_internal_force();
    call_.used.replaced = !starts_.is_default();
    call_.used.start = Start::phase_one;
    const Code code = on_.template find_inside_limits<D>(
        call_, closed ? on_.internal_force() : on_.newton.x, !closed, limited.newton.x);
    steps = int(record_.summary().iterations);
    return code == CONVERGED || code == INFEASIBLE ? code : UNDECIDED;
  }
  template <int D> Code finish(LimitedNewton<V, B, D>& limited, Code code) {
    limited.store_multipliers(on_.answer.multipliers.data());
    return code;
  }
  // Follow a previous least excess. Return false if there is none.
  bool follow_excess() {
    const double* previous = call_.request.previous;
    if (!on_.has_excess() || !previous ||
        Record(const_cast<double*>(previous)).code() != LIMITS_EXCEEDED ||
        !starts_.carry_previous())
      return false;
    cones_.store_force(on_.newton.x, record_.initial_force());
    return on_.excess->follow(cones_, w_, on_.newton.x, record_) == LIMITS_EXCEEDED;
  }
  // Replace a proof that no force keeps the limits by the force that exceeds them least. `newton.x`
  // holds a balanced force in the cones.
  Code least_excess() {
    Summary& s = record_.summary();
    if (on_.has_excess()) {
      const Summary proof = s;
      cones_.store_force(on_.newton.x, record_.initial_force());
      if (on_.excess->solve(cones_, w_, on_.newton.x, record_) == LIMITS_EXCEEDED)
        return LIMITS_EXCEEDED;
      s = proof;
    }
    General* program = on_.general();
    return program ? program->excess(record_) : INFEASIBLE;
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
    const auto solve = [&](Criterion criterion) {
      return on_.solve_limited_conic(criterion, call_.wrench.data(),
                                     closed ? on_.internal_force() : on_.newton.x, !closed);
    };
    const Criterion criterion = on_.options.criterion;
    Code code = solve(criterion);
    if (code == CONVERGED) return code;
    if (criterion != Criterion::sum) code = solve(Criterion::sum) == INFEASIBLE ? INFEASIBLE : code;
    if (code == INFEASIBLE && !on_.options.elastic) return code;
    const bool plain = on_.placement.kind == ProblemKind::hard && criterion == Criterion::sum;
    if (plain && code != REFUSED &&
        on_.finish_conic(call_.wrench.data(), call_.stop.limit) == CONVERGED)
      return CONVERGED;
    return general();
  }

  // With the steps that a faster algorithm left. The least excess has steps of its own: where no
  // force keeps the limits, a descent may spend all of the call's.
  Code general() {
    const double spent = record_.summary().iterations;
    const int left = std::max(0, call_.stop.limit - int(spent));
    const Code code = general({call_.stop.tolerance, left});
    record_.summary().iterations += spent;
    record_.summary().trials += spent;
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
    call.stop = stop;
    program.phi(call, record_);
    return record_.code();
  }
};

}  // namespace grasp::detail
