// Damped Newton on Phi under balance; linear in the number of contacts.
#pragma once
#include <grasp/phi/internal.hpp>
#include <grasp/phi/descent.hpp>
#include <grasp/phi/qr_system.hpp>

namespace grasp {

// Rows: further terms of Phi, the limits (`Barriers`). D: variables of a contact, see
// `Cones`.
template <class V, int B, class Rows = NoRows, int D = 3> class NewtonSolver {
 public:
  using Field = typename Cones<V, B, D>::Field;
  using X = Vec<V, D>;
  Cones<V, B, D> cones;
  System<V, B, D, Rows> system;
  QrSystem<V, B, D> qr_system;
  Rows rows;
  Field x;                  // the start, then the iterate
  std::vector<double> row;  // work space for a record

  explicit NewtonSolver(int count)
      : cones(count),
        system(cones),
        qr_system(cones),
        x(cones.field()),
        row(record_size(count)),
        step_(cones.field()),
        begun_(cones.field()),
        best_(cones.field()),
        centring_(cones.field()) {}

  // Solve from the internal force `rest`. REFUSED: numbers are not finite, or no start.
  Code solve_from(const Field& rest, const Call& call, const Record& record) {
    record.summary().code = REFUSED;
    if (!is_valid_wrench(call.wrench)) return REFUSED;
    const Vec6 w = cones.unit.of(call.wrench);
    grasp::begin(cones, rest, w, x);
    begun_ = x;
    return descend_from(begun_, call, w, record);
  }

  // Descend from the start in x, copied in `begun`, and write the record. Steps reach `fraction` of
  // the way to the boundary; if they stall, the descent follows the central path. leaping: the
  // start is the optimum of another wrench, and the first step is a full one that restores balance
  // and descends at once; REFUSED if it leaves the cones.
  Code descend_from(const Field& begun, const Call& call, const Vec6& w, const Record& record,
                    double fraction = SHORT, bool leaping = false) {
    cones.store_force(x, record.initial_force());
    const bool known = call.optimum == call.optimum;
    DescentProgress at{
        .value = cones.phi(x, rows), .bound = known ? call.optimum : -infinity, .known = known};
    if (!(at.value < infinity)) return REFUSED;
    Code code = descend(call, w, at, fraction, leaping);
    if (code == REFUSED) return REFUSED;
    // the central path knows only the cones; the general program takes over from other terms
    if constexpr (!Rows::has_terms) {
      if (code == STALLED) {
        const double value = at.value;
        best_ = x;
        x = begun;
        code = follow_central_path(call, w, at);
        if (code == STALLED && value < at.value) x = best_;
      }
    }
    return finish(code, begun, call, w, at, record);
  }

  // True if x is balanced and strictly inside.
  bool is_start(const Vec6& w) const {
    if (!cones.is_in_range(x) || !(cones.phi(x, rows) < infinity)) return false;
    return size(cones.wrench(x) + w) <= MISSED * (cones.largest_normal(x) + size(w));
  }

  // Take one more full step from a converged x unless it raises Phi.
  void polish(const Vec6& w) {
    if (!system.assemble(cones, x)) return;
    const Vec6 left = system.applied + w;
    const double value = cones.phi(x);
    find_step(system.multipliers(left), left, value);
    if (cones.phi_along(x, step_, 1.0) <= value)
      for (int b = 0; b < int(x.size()); ++b) x[b] += step_[b];
  }

  // Find an internal force strictly inside the cones, in x, by infeasible-start Newton from the
  // axes. few: only as many steps as are nearly always enough. Return false without force closure.
  bool internal_force(bool few = false) {
    const auto plain = [&](Vec6& missed) { return system.internal_step(cones, x, missed, step_); };
    const auto careful = [&](Vec6& missed) {  // the barrier and any part of the squeezing cost
      if (!qr_system.assemble(cones, x, missed = cones.wrench(x), step_, centring_)) return false;
      const double part = reachable_part(0.0);
      for (int b = 0; b < int(x.size()); ++b) step_[b] = all<V>(part) * step_[b] + centring_[b];
      return true;
    };
    return balance_inside(cones, x, step_, x, few ? FEW_STEPS : MANY_STEPS, plain) ||
           (!few && balance_inside(cones, x, step_, x, MANY_STEPS, careful));
  }
  // The same with few steps, scaled to least Phi, into `rest`.
  bool find_rest(Field& rest) {
    if (!internal_force(true)) return false;
    scale_rest(rest);
    return true;
  }
  // x, an internal force, scaled to least Phi.
  void scale_rest(Field& rest) const {
    const V scale = all<V>(best_scale(cones, x));
    for (int b = 0; b < int(x.size()); ++b) rest[b] = scale * x[b];
  }

  // Check balance, cones and gap of the answer.
  Code finish(Code code, const Field& safe, const Call& call, const Vec6& w,
              const DescentProgress& at, const Record& record) {
    Summary& s = record.summary();
    if (at.iterations > 0) cones.balance(x, w);  // rounding of G x + w
    cones.certify(x, w, record);
    if (!(s.margin > 0.0 && cones.balanced(x, w, s.residual))) repair(safe, w, record);
    s.objective = By::unless_rounding(cones.phi(x, rows), at.value);
    s.lower_bound = at.bound;
    s.multipliers = cones.unit.pull_back(at.nu);
    if (!cones.balanced(x, w, s.residual) ||
        (code == CONVERGED && !certified(call, s.objective, at)))
      code = STALLED;
    s.code = code;
    s.iterations = at.iterations;
    s.trials = at.trials;
    s.limit_excess = 0.0;
    std::copy(call.wrench, call.wrench + 6, s.wrench.begin());
    return code;
  }

 private:
  using By = Rules<double>;
  static constexpr int REFINEMENTS = 3;
  // Whole descents take half of it, unless they crawl along a surface.
  static constexpr int PATIENCE = Rows::has_terms ? 80 : 40;
  // the same along the central path: 40 unless hardly any force is inside
  static constexpr int LONGEST = 400;
  // factor on the part of the squeezing cost to which x is nearest
  static constexpr double AHEAD = 3.0;
  // largest balance residual of a start, as a fraction of wrench and force
  static constexpr double MISSED = 1e-8;
  Field step_, begun_, best_, centring_;

  typename System<V, B, D, Rows>::NewtonStep find_step(const Vec6& nu, const Vec6& left,
                                                       double value) {
    return system.step(cones, x, nu, left, value, step_, rows);
  }

  bool certified(const Call& call, double value, const DescentProgress& at) const {
    const double tolerance = call.stop.tolerance;
    return at.known ? at.bound > 0.0 && value - at.bound <= tolerance * at.bound
                    : By::certified(value, at.bound, tolerance);
  }

  bool assemble() {
    if constexpr (Rows::has_terms) rows.measure(x);
    return system.assemble(cones, x, rows);
  }

  void move(double alpha) {
    for (int b = 0; b < int(x.size()); ++b) x[b] += all<V>(alpha) * step_[b];
  }

  // Damped Newton from x. Digits are lost if forces exceed their distance to the cones by 1e4.
  [[gnu::noinline]] Code descend(const Call& call, const Vec6& w, DescentProgress& at,
                                 double fraction, bool leaping) {
    const double tolerance = call.stop.tolerance;
    const double tight = By::dual_precision(tolerance);
    typename System<V, B, D, Rows>::NewtonStep step{};
    const auto closed = [&] { return certified(call, at.value, at); };
    const auto find = [&](Code& code) {
      if (!assemble()) return Next::stop;
      const Vec6 left = system.applied + w;
      at.nu = system.multipliers(left);
      step = find_step(at.nu, left, at.value);
      if (leaping) {
        leaping = false;
        ++at.trials;
        at.value = step.reach < 0.99 ? cones.phi_along(x, step_, 1.0, rows) : infinity;
        if (!(at.value < infinity)) {
          code = REFUSED;
          return Next::stop;
        }
        move(1.0);
        at.bound = cones.lower_bound(at.nu, w, x, tight, rows);
        if (!closed()) return Next::repeat;
        ++at.iterations;
        code = CONVERGED;
        return Next::stop;
      }
      if (!at.known && (By::promises_tolerance(at.value, step.decrement, tolerance) ||
                        at.iterations >= call.stop.limit))
        at.bound = std::max(at.bound, cones.lower_bound(at.nu, w, rows));
      return Next::step;
    };
    const auto advance = [&](Code& code) {
      double alpha = By::longest_step(step.reach, fraction);
      const auto along = [&] { return cones.phi_along(x, step_, alpha, rows); };
      if (!search(at.value, step.decrement, alpha, at.trials, along)) {
        if (!at.known) at.bound = std::max(at.bound, cones.lower_bound(at.nu, w, rows));
        code = closed() ? CONVERGED : STALLED;
        return false;
      }
      move(alpha);
      if (!(alpha == 1.0 && By::is_small_step(at.value, step.decrement, tolerance))) return true;
      if (!at.known) at.bound = std::max(at.bound, cones.lower_bound(at.nu, w, x, tight, rows));
      if (!closed()) return true;
      if (++at.iterations < call.traced) call.trace[at.iterations] = at.value;
      code = CONVERGED;
      return false;
    };
    return run_descent(at, call, PATIENCE, find, closed, advance);
  }

  // Newton along the central path from x. Every step aims at the optimum of the barrier plus the
  // largest part of the squeezing cost for which that optimum is within reach. So forces approach
  // the cones late: near a curved surface steps are short and digits are lost.
  [[gnu::cold, gnu::noinline]] Code follow_central_path(const Call& call, const Vec6& w,
                                                        DescentProgress& at) {
    double part = 0.0;
    Vec6 left;
    const auto find = [&](Code&) {
      left = cones.wrench(x) + w;
      if (!qr_system.assemble(cones, x, left, step_, centring_)) return Next::stop;
      part = reachable_part(part);
      Vec6 nu = qr_system.multipliers(part);
      cones.scale_inside(nu);
      if (const double bound = at.known ? at.bound : cones.lower_bound(nu, w); bound >= at.bound) {
        at.bound = bound;
        at.nu = nu;
      }
      return Next::step;
    };
    const auto advance = [&](Code&) {
      for (int b = 0; b < int(x.size()); ++b) step_[b] = all<V>(part) * step_[b] + centring_[b];
      for (int round = 0; round < REFINEMENTS; ++round)
        qr_system.restore(left + cones.wrench(step_), step_);
      cones.subtract(step_, left + cones.wrench(step_));
      const double reach = cones.reach(x, step_);
      double alpha = reach > 0.0 ? std::min(1.0, LONG / reach) : 1.0;
      double merit = cones.phi_along(x, step_, 0.0, part);
      const auto along = [&] { return cones.phi_along(x, step_, alpha, part); };
      if (!search(merit, qr_system.decrement(part), alpha, at.trials, along)) return false;
      for (int b = 0; b < int(x.size()); ++b) x[b] += all<V>(alpha) * step_[b];
      at.value = cones.phi(x);
      return true;
    };
    at.value = cones.phi(x);
    at.iterations = 0;
    return run_descent(
        at, call, LONGEST, find, [&] { return certified(call, at.value, at); }, advance);
  }

  // The largest part of the squeezing cost that a full step of `follow_central_path` may aim at: at
  // least that to which x is nearest, and not far beyond, where x would crawl along a surface.
  double reachable_part(double before) const {
    const auto reach = [&](double part) {
      V most{};
      for (int b = 0; b < int(x.size()); ++b)
        most = max(most, Boundary(x[b]).per(all<V>(part) * step_[b] + centring_[b]));
      return largest(most);
    };
    const double nearest = std::max(qr_system.nearest_part(), std::max(1e-3 * before, 1e-30));
    double low = std::min(nearest, 1.0);
    double high = std::min(AHEAD * nearest, 1.0);
    if (reach(high) <= LONG) return high;
    if (reach(low) > LONG) return low;
    for (int round = 0; round < By::HALVINGS; ++round) {
      const double middle = std::sqrt(low * high);
      const double length = reach(middle);
      (length <= LONG ? low : high) = middle;
      if (length <= LONG && length > 0.8 * LONG) break;
    }
    return low;
  }

  // Restore balance; a force that rounding moved out of its cone moves back towards `safe`.
  [[gnu::cold, gnu::noinline]] void repair(const Field& safe, const Vec6& w, const Record& record) {
    cones.balance(x, w);
    for (double part = 1e-15; part < 1.0 && !(cones.margin(x) > 0.0); part *= 4.0)
      for (int b = 0; b < int(x.size()); ++b) x[b] += all<V>(part) * (safe[b] - x[b]);
    cones.certify(x, w, record);
  }

  // Halve alpha until `along` decreases; `value` follows. Return false if no step that moves x
  // decreases it.
  template <class F>
  bool search(double& value, double decrement, double& alpha, int& trials, F&& along) {
    for (int halving = 0; halving < By::HALVINGS; ++halving, alpha *= 0.5) {
      ++trials;
      const double after = along();
      const bool falls = By::decreases(after, value, alpha, decrement);
      const bool flat = By::is_within_rounding(value, decrement);
      if (falls || (flat && after <= value)) {
        // far from the optimum Phi is nearly straight and steps are long: judge how far x moves
        const bool suspect = flat || halving > 0;
        if (suspect &&
            !(alpha * cones.largest_normal(step_) > By::SHORTEST * cones.largest_normal(x)))
          return false;
        value = after;
        return true;
      }
    }
    return false;
  }
};

}  // namespace grasp
