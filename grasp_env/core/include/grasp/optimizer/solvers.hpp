// The solvers of an optimizer, placed on the contacts and limits of the current call.
#pragma once
#include <utility>
#include <grasp/conic/limited.hpp>
#include <grasp/flow/flow.hpp>
#include <grasp/general/general.hpp>
#include <grasp/many/basis.hpp>
#include <grasp/newton/excess.hpp>
#include <grasp/newton/limited.hpp>
#include <grasp/newton/soft.hpp>
#include <grasp/optimizer/call_state.hpp>
#include <grasp/optimizer/checks.hpp>
#include <grasp/optimizer/current_contacts.hpp>
#include <grasp/optimizer/plans.hpp>

namespace grasp::detail {

// The contacts that the solvers are placed on.
struct Placement {
  std::uint64_t number = 0;  // counts placements
  bool home = false;         // true: the contacts and limits of the problem
  Code code = REFUSED;       // CONVERGED if the solvers can be used
  ProblemKind kind = ProblemKind::hard;
};

// A value computed once for each placement, when first needed.
template <class T> class PerPlacement {
 public:
  template <class F> T& at(const Placement& placement, F&& compute) {
    if (number_ != placement.number) {
      value_ = compute();
      number_ = placement.number;
    }
    return value_;
  }

 private:
  std::uint64_t number_ = 0;
  T value_{};
};

// A value that takes no room until it is made; copies copy it.
template <class T> class Rare {
 public:
  explicit operator bool() const { return !one_.empty(); }
  T& operator*() { return one_[0]; }
  T* operator->() { return &one_[0]; }
  const T* operator->() const { return &one_[0]; }
  template <class... A> void emplace(A&&... arguments) {
    one_.clear();
    one_.emplace_back(std::forward<A>(arguments)...);
  }

 private:
  std::vector<T> one_;
};

// A force and its torsions; an answer with the multipliers of the limits. Space for all contacts.
struct Given {
  std::vector<double> force, torsion;
};
struct StoredAnswer {
  std::vector<double> row, multipliers;
};

// The exact solvers of a criterion. One of them is there.
template <class V, int B, Criterion C> struct Exact {
  Rare<LimitedConic<V, B, 3, C>> hard;
  Rare<LimitedConic<V, B, 4, C>> soft;
  PerPlacement<bool> placed;

  explicit operator bool() const { return hard || soft; }
  void make(bool is_soft, int count, const StopRule& stop) {
    if (is_soft)
      soft.emplace(count, stop);
    else
      hard.emplace(count, stop);
  }
  void reserve(int rows, int joints) {
    if (hard) hard->reserve(rows, joints);
    if (soft) soft->reserve(rows, joints);
  }
};

template <class V, int B> class Solvers {
 public:
  using Field = typename Cones<V, B>::Field;
  const Options options;
  CurrentContacts current;
  NewtonSolver<V, B> newton;
  Starter<V, B> starter;
  Rare<LimitedNewton<V, B>> limited;
  Rare<LimitedNewton<V, B, 4>> soft_limited;
  Rare<LeastExcess<V, B>> excess;  // of limits on one contact each
  Rare<SoftNewton<V, B>> soft;
  std::optional<Prediction<V, B>> prediction;
  Tangents<V, B> home_tangents;
  Placement placement;

  // Work space of a call.
  Field begun, work, predicted;  // start of a descent; another start; prediction of a model
  // A force of the caller, or the previous one, on the touching contacts. The searches for an
  // internal force write here, too: call `general()` before a force is loaded.
  Given given;
  // of the current contacts; an answer to which another may be preferred
  StoredAnswer answer, kept;

  // Throws std::invalid_argument.
  Solvers(const Problem& problem, const Options& options)
      : options(options),
        current(problem),
        newton(count()),
        starter(newton.cones),
        home_tangents(newton.cones),
        begun(newton.cones.field()),
        work(begun),
        predicted(begun),
        given{std::vector<double>(3 * count()), std::vector<double>(count())},
        answer{std::vector<double>(record_size(count())), std::vector<double>(current.limits.rows)},
        kept(answer),
        conic_(count(), {options.gap(), std::min(options.limit, General::CONIC_ITERATIONS)}),
        general_(count(), current.limits.rows, current.home.soft(),
                 options.criterion == Criterion::torque ? current.joints : 0) {
    check(current, options);
    const bool conic = options.method == Method::conic;
    const bool is_soft = current.home.soft();
    const bool has_limits = current.limits.rows > 0;
    const StopRule stop{options.gap(), std::min(options.limit, LIMITED_ITERATIONS)};
    if (is_soft && !conic) soft.emplace(count());
    if (has_limits && !conic && is_soft) soft_limited.emplace(count());
    if (has_limits && !conic && !is_soft) limited.emplace(count());
    if (has_limits || conic) sum_.make(is_soft, count(), stop);
    if (options.criterion == Criterion::largest) largest_.make(is_soft, count(), stop);
    if (options.criterion == Criterion::torque) torque_.make(is_soft, count(), stop);
    current.tabulates = options.elastic && !conic && !is_soft;
    if (current.tabulates) excess.emplace(newton.cones);
    place_home();
    if (options.method == Method::reduced_flow)
      flow_.emplace(newton.cones, options.step_rule, Form::reduced);
    if (options.method == Method::full_flow)
      flow_.emplace(newton.cones, options.step_rule, Form::full);
    if (options.model) prediction.emplace(newton.cones, *options.model);
    if (needs_basis()) fill_basis();
  }

  bool has_flow() const { return bool(flow_); }
  Record record() { return Record(answer.row.data(), current.now.count); }

  // --- placing

  // Load the contacts and limits of a call. Return CONVERGED if the solvers can be used.
  Code place(const Changes& now) {
    const bool home = now.keeps_problem() && current.all_touch(now.contacts);
    if (home && placement.home) return placement.code;
    placement.home = home;
    return placement.code = load(now);
  }
  // Load the contacts and limits of the problem, with space for all of them.
  void place_home() {
    placement.home = false;
    if (limited) limited->reserve(current.limits.rows);
    if (soft_limited) soft_limited->reserve(current.limits.rows);
    if (excess)
      excess->rows.reserve(newton.cones, std::min(current.limits.rows, LimitTable::MOST_ROWS));
    sum_.reserve(current.limits.rows, current.joints);
    largest_.reserve(current.limits.rows, current.joints);
    torque_.reserve(current.limits.rows, current.joints);
    home_depth_ = 0.0;
    const bool uses_it = options.method == Method::newton || options.method == Method::conic;
    if (place({}) == CONVERGED && uses_it && is_full_rank() && has_internal_force()) {
      home_rest_ = conic_.rest;
      home_depth_ = newton.cones.depth(home_rest_);
    }
    home_tangents.load(current.home.frames.data(), count());
  }
  // Replace the contacts and limits of the problem. Return false, with nothing changed, if the
  // numbers are refused.
  bool replace_home(const Changes& now) {
    if (place(now) == REFUSED) {
      place_home();
      return false;
    }
    current.take_over(now);
    place_home();
    starter.has_basis = false;
    if (needs_basis()) fill_basis();
    return true;
  }

  // --- solvers and forces of the current contacts

  // True if forces alone balance wrenches of every direction.
  bool is_full_rank() const { return is_full_rank(current.now); }
  static bool is_full_rank(const Contacts& contacts) { return contacts.placing == Placing::good; }

  ConicSolver<V, B>& conic() {
    conic_placed_.at(placement, [&] {
      conic_.cones = newton.cones;
      return true;
    });
    return conic_;
  }
  void place_soft() { pack(soft->newton.cones); }
  // True if `excess` can be used: each limit acts on one contact.
  bool has_excess() const { return excess && current.separate; }
  // Solve the exact problem with limits, soft contacts or without force closure from `inside`,
  // which is strictly inside the cones: a balanced force, or an internal one. REFUSED: numbers are
  // too large.
  Code solve_limited_conic(Criterion criterion, const double* wrench, const Field& inside,
                           bool balanced) {
    switch (criterion) {
      case Criterion::largest:
        return solve_limited_conic(largest_, wrench, inside, balanced);
      case Criterion::torque:
        return solve_limited_conic(torque_, wrench, inside, balanced);
      default:
        return solve_limited_conic(sum_, wrench, inside, balanced);
    }
  }
  // Find a force strictly inside cones and limits, near the optimum of Phi, into x.
  template <int D> Code find_inside_limits(const CallState& call, const Field& inside,
                                           bool balanced, typename Cones<V, B, D>::Field& x) {
    auto& solver = [&]() -> auto& {
      if constexpr (D == 3)
        return *sum_.hard;
      else
        return *sum_.soft;
    }();
    if (!place_conic(sum_, solver, inside)) return REFUSED;
    solver.options.limit = std::min(call.stop.limit, LIMITED_ITERATIONS);
    double product = 0.0;
    for (int i = 0; i < current.now.count; ++i)
      product += std::sqrt(current.now.lambda[i] * squeezing_cost(current.now.omega[i]));
    return solver.centre(call.wrench.data(), balanced, ABOVE * product / current.now.count, x,
                         record(), answer.multipliers.data());
  }
  // Go on without limits from its last iterate, with more digits. Spoils the internal force.
  Code finish_conic(const double* wrench, int limit) {
    const double before = record().summary().iterations;
    if (before >= limit) return LIMIT;
    ConicSolver<V, B>& solver = conic();
    internal_force_.at(placement, [] { return false; }) = false;
    sum_.hard->store_iterate(solver);
    const int most = std::exchange(solver.options.limit, limit - int(before));
    const Code code = solver.solve_from_iterate(wrench, record());
    solver.options.limit = most;
    record().summary().iterations += before;
    record().summary().trials += before;
    return code;
  }
  // The flow, or null if G has lost rank.
  FlowSolver<V, B>* flow() {
    return flow_placed_.at(placement, [&] { return flow_->place(newton.cones); }) ? &*flow_
                                                                                  : nullptr;
  }
  // The general program, or null if it cannot be placed on these contacts and limits.
  General* general() {
    const auto place = [&] {
      const bool with_torques = options.criterion == Criterion::torque;
      const bool limited = current.limits.rows > 0 || with_torques;
      return general_.place(current.now, limited ? current.limits_in_place() : ForceLimits{}, 4,
                            internal_force_array(), current.preload, with_torques) == Placing::good;
    };
    return general_placed_.at(placement, place) ? &general_ : nullptr;
  }

  // An internal force of least Phi, if `has_internal_force`. The exact solver starts from it.
  const Field& internal_force() const { return conic_.rest; }
  // True if an internal force strictly inside the cones is known, or found with as many steps as
  // are nearly always enough. Overwrites `newton.x`.
  bool has_internal_force() {
    return internal_force_.at(placement,
                              [&] { return carries_home_rest() || newton.find_rest(conic_.rest); });
  }

  // --- the 12-basis

  // Compute the 12-basis of the problem's contacts. Without force closure no basis exists, and
  // starts that need it are replaced. warm: start from the basis of nearby contacts. Return the
  // worst relative gap; inf: not converged, nan: no force closure.
  double fill_basis(bool warm = false) {
    starter.has_basis = false;
    const bool usable = placement.code == CONVERGED && is_full_rank();
    if (!usable || (!warm && !find_any_internal_force()))
      return std::numeric_limits<double>::quiet_NaN();
    return make_basis(newton, starter, warm);
  }

 private:
  static constexpr int LIMITED_ITERATIONS = 40;  // of the exact solver within limits; 8 are usual
  // Slack times multiplier at a start within limits, of the usual product at the optimum of Phi.
  static constexpr double ABOVE = 10.0;
  // of the depth of the problem's internal force: enough for the current contacts
  static constexpr double AS_DEEP = 0.5;
  ConicSolver<V, B> conic_;
  Rare<FlowSolver<V, B>> flow_;
  General general_;
  Exact<V, B, Criterion::sum> sum_;  // also for proofs, and for starts within limits
  Exact<V, B, Criterion::largest> largest_;
  Exact<V, B, Criterion::torque> torque_;
  PerPlacement<bool> conic_placed_, flow_placed_, general_placed_;
  PerPlacement<bool> internal_force_;
  // Internal force of the problem's contacts and its depth; 0: none is known.
  Field home_rest_;
  double home_depth_ = 0.0;

  int count() const { return current.home.count; }

  // True if the internal force of the problem's contacts, balanced for the current ones, is still
  // nearly as deep inside the cones. It becomes the internal force, which takes a tenth of a
  // search.
  bool carries_home_rest() {
    if (!(home_depth_ > 0.0) || current.now.count != count()) return false;
    if (placement.home) {
      conic_.rest = home_rest_;
      return true;
    }
    newton.x = home_rest_;
    newton.cones.balance(newton.x, Vec6{});
    if (!(newton.cones.depth(newton.x) > AS_DEEP * home_depth_)) return false;
    if (options.method == Method::conic)  // which scales it itself
      conic_.rest = newton.x;
    else
      newton.scale_rest(conic_.rest);
    return newton.cones.phi(conic_.rest) < infinity;
  }
  Code load(const Changes& now) {
    ++placement.number;
    const Code code = current.load_call(now);
    if (code != CONVERGED) return code;
    set_count(current.now.count);
    newton.cones.pack(current.now);
    starter.tangents.load(current.now.frames.data(), current.now.count);
    placement.kind = kind();
    if (soft && placement.kind == ProblemKind::soft) place_soft();
    if (has_excess()) excess->rows.pack(newton.cones, current.table.rows());
    const bool packed =
        (!limited || pack_limits(*limited)) && (!soft_limited || pack_limits(*soft_limited));
    return packed ? CONVERGED : REFUSED;
  }
  template <int D> bool pack_limits(LimitedNewton<V, B, D>& to) {
    pack(to.newton.cones);
    return to.newton.rows.pack(to.newton.cones, current.limits_in_place(), current.preload,
                               current.now.lambda);
  }
  // Pack the current contacts.
  template <int D> void pack(Cones<V, B, D>& to) {
    to.count = current.now.count;
    if constexpr (D == 3)
      to = newton.cones;
    else
      to.pack(current.now);
  }
  ProblemKind kind() const {
    const bool soft = current.now.soft();
    const bool limited = current.limits.rows > 0;
    if (!is_full_rank()) return ProblemKind::other;
    if (soft) return limited ? ProblemKind::soft_limited : ProblemKind::soft;
    return limited ? ProblemKind::limited : ProblemKind::hard;
  }
  // Set the number of contacts. Unused lanes hold a contact without effect.
  void set_count(int count) {
    if (newton.cones.count == count) return;
    newton.cones.count = count;
    const auto clear = [](auto& field) {
      for (auto& x : field) x = axis<std::decay_t<decltype(x)>::size>(all<V>(1.0));
    };
    for (Field* field : {&newton.x, &begun, &work, &predicted, &conic_.rest}) clear(*field);
    if (limited) clear(limited->newton.x);
    if (soft) clear(soft->newton.x);
    if (soft_limited) clear(soft_limited->newton.x);
  }

  template <Criterion C> Code solve_limited_conic(Exact<V, B, C>& exact, const double* wrench,
                                                  const Field& inside, bool balanced) {
    const auto solve = [&](auto& solver) {
      return place_conic(exact, solver, inside)
                 ? solver.solve(wrench, balanced, record(), answer.multipliers.data())
                 : REFUSED;
    };
    return exact.hard ? solve(*exact.hard) : solve(*exact.soft);
  }
  // Place an exact solver, with an `inside`. Return false if numbers are too large.
  template <Criterion C, class Solver>
  bool place_conic(Exact<V, B, C>& exact, Solver& solver, const Field& inside) {
    const auto place = [&] {
      pack(solver.cones);
      if (options.method == Method::newton)
        for (auto& c : solver.cones.blocks) c.cost = squeezing_cost(c.weights.omega);
      return solver.pack(current.limits_in_place(), current.preload);
    };
    if (!exact.placed.at(placement, place)) return false;
    for (std::size_t b = 0; b < solver.inside.size(); ++b)
      for (int a = 0; a < 3; ++a) solver.inside[b][a] = inside[b][a];
    return true;
  }
  bool needs_basis() const {
    const Start start = options.start;
    return flow_ || start == Start::linear_combination ||
           start == Start::linear_combination_printed || start == Start::single_value ||
           start == Start::lagrange;
  }
  bool find_any_internal_force() {
    if (newton.internal_force()) return true;
    const double nothing[6] = {};
    General* program = general();
    if (!program || program->deepest(nothing, 1e-7, given.force.data(), nullptr).code != CONVERGED)
      return false;
    newton.cones.load_point(given.force.data(), newton.x);
    return newton.is_start(Vec6{});
  }
  // An internal force in the form the general program takes; null if there is none.
  const double* internal_force_array() {
    if (!is_full_rank() || !has_internal_force()) return nullptr;
    newton.cones.store_force(internal_force(), given.force.data());
    return given.force.data();
  }
};

}  // namespace grasp::detail
