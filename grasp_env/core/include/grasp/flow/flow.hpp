// The paper's gradient flow, x_{k+1} = x_k + alpha_k d_k (Eqs. 12, 26): every x_k is balanced and
// inside the cones, and Phi decreases.
#pragma once
#include <grasp/newton/newton.hpp>
#include <grasp/flow/projection.hpp>
#include <grasp/flow/step_rule.hpp>

namespace grasp {

template <class V, int B> class FlowSolver {
 public:
  using Field = typename Cones<V, B>::Field;
  StepRule rule;

  FlowSolver(const Cones<V, B>& cones, const StepRule& rule, Form form)
      : rule(rule),
        projection_(cones, form),
        next_(cones.field()),
        gradient_(cones.field()),
        there_(cones.field()),
        step_(cones.field()),
        past_(cones.field()) {}

  // Prepare for the current contacts. Return false if G has lost rank.
  bool place(const Cones<V, B>& cones) { return projection_.place(cones); }

  // Compute the step at x `times` times; return its last number. For benchmarks.
  double repeat(const Cones<V, B>& cones, Field& x, int times) {
    for (int b = 0; b < int(x.size()); ++b) gradient_[b] = gradient(x[b], cones.blocks[b].weights);
    for (int k = 0; k < times; ++k) {
      projection_.apply(cones, x, gradient_, step_);
      const V little = all<V>(1e-30) * step_[0].u;  // makes each step depend on the one before
      x[0].u += little;
      gradient_[0].u += little;
    }
    return get(step_[0].u, 0);
  }

  // Descend from the start in on.x, balanced and strictly inside, and write the record.
  Code descend(NewtonSolver<V, B>& on, const Call& call, const Vec6& w, const Record& record) {
    const auto& cones = on.cones;
    const int blocks = int(cones.blocks.size());
    cones.store_force(on.x, record.initial_force());
    // x_k, the gradient there, d_k; x_k + alpha d_k, the gradient there; d_{k-1}: in registers if
    // the number of contacts is fixed
    Local x = on.x;
    Local gradient = gradient_;
    Local step = step_;
    Local next = next_;
    Local there = there_;
    Local past = past_;
    for (int b = 0; b < blocks; ++b) step[b] = past[b] = {V{}, V{}, V{}};
    // Phi at x + alpha step, written to `next`, with its gradient in `there`; +inf outside
    const auto ahead = [&](double alpha) {
      V total{};
      V room = all<V>(infinity);
      for (int b = 0; b < blocks; ++b) {
        const auto& c = cones.blocks[b];
        const Vec3<V> at = next[b] = x[b] + all<V>(alpha) * step[b];
        total += c.mask * phi(at, c.weights, there[b]);
        room = min(room, min(at.u, lorentz(at, at)));
      }
      const double value = sum(total);
      return least(room) > 0.0 && value == value ? value : infinity;
    };
    // its first and second derivatives with respect to alpha
    const auto slope = [&] { return total_of([&](int b) { return dot(there[b], step[b]); }); };
    const auto bend = [&] {
      return total_of([&](int b) {
        return cones.blocks[b].mask * curvature(next[b], step[b], cones.blocks[b].weights);
      });
    };
    const auto mixed = [&] {  // <d_k, d_{k-1}>; then stores d_k as the past step
      const double product = total_of([&](int b) { return inner(step[b], past[b]); });
      for (int b = 0; b < blocks; ++b) past[b] = step[b];
      return product;
    };
    FlowProgress at{.alpha = rule.first, .value = ahead(0.0)};
    if (!(at.value < infinity)) return REFUSED;
    Proof proof(call, call.stop.tolerance);
    const auto look = [&] {
      if (proof.known) return;
      on.x = x;
      proof.take(bound_at(on, w), at);
    };
    Code code = LIMIT;
    for (;; ++at.k) {
      for (int b = 0; b < blocks; ++b) {
        x[b] = next[b];
        gradient[b] = there[b];
      }
      if (at.k < call.traced) call.trace[at.k] = at.value;
      const bool last = at.k >= call.stop.limit;
      if (last || proof.due(at)) look();
      if (proof.closes(at.value)) code = CONVERGED;
      if (last || code == CONVERGED) break;
      projection_.apply(cones, x, gradient, step);  // d_k
      at.length = total_of([&](int b) { return squared(step[b]); });
      at.size = total_of([&](int b) { return cones.blocks[b].mask * squared(x[b]); });
      propose(at, mixed, bend);
      if (!accept(at, ahead, slope, bend)) {  // x_{k+1}
        look();
        code = proof.closes(at.value) ? CONVERGED : STALLED;
        break;
      }
    }
    on.x = x;
    Summary& s = record.summary();
    s.iterations = at.k;
    s.trials = at.trials;
    s.objective = at.value;
    s.lower_bound = proof.best.value;
    s.multipliers =
        cones.unit.pull_back(proof.known ? bound_at(on, w).multipliers : proof.best.multipliers);
    std::copy(call.wrench, call.wrench + 6, s.wrench.begin());
    return finish(on, call, w, code, record);
  }

 private:
  using Local = std::conditional_t<B == 0, Field&, Field>;
  // the first trial of an iteration moves x by at least this fraction of its length
  static constexpr double SHORTEST = 1e-10;
  static constexpr double ROUNDED = 1e-16;  // no trial moves x by less than this
  static constexpr double LONGEST = 1e300;
  // if <s, y> is below this fraction of <s, s> / alpha, Phi is straight to rounding,
  static constexpr double FLAT = 1e-12;
  static constexpr double LEAP = 10.0;  // and alpha grows by this factor
  // trials of the search for the exact minimum before any decrease is accepted
  static constexpr int SEARCHES = 60;
  // trials of an iteration after which steps are at least halved, so that they end
  static constexpr int PATIENCE = 100;
  Projection<V, B> projection_;
  Field next_, gradient_, there_, step_, past_;

  struct FlowProgress {
    double alpha, value;                            // alpha_k; Phi at x_k
    double gained = 0.0;                            // decrease of Phi by the last step
    double length = 0.0, before = 0.0, size = 0.0;  // |d_k|^2, |d_{k-1}|^2, |x_k|^2
    int k = 0, trials = 0;

    bool moves(double fraction) const {
      return alpha * alpha * length > fraction * fraction * size;
    }  // x moves by more than this fraction of it
  };
  struct Bound {
    double value;
    Vec6 multipliers;
  };

  // Bounds of min Phi, and the time of the next bound, which costs as much as several iterations.
  // No bound is computed while steps gain more than the tolerance allows. Once a bound is close,
  // the next one waits until it can certify. A bound falls short of min Phi by up to SHORT times
  // the square of the relative gap.
  struct Proof {
    bool known;        // true if the caller knows the optimum
    double tolerance;  // required relative gap
    Bound best;
    int next = 0;             // iteration of the next bound at the latest
    double goal = -infinity;  // value of Phi at which the next bound is due

    Proof(const Call& call, double tolerance)
        : known(call.optimum == call.optimum),
          tolerance(tolerance),
          best{known ? call.optimum : -infinity, {}} {}

    bool closes(double value) const {
      return best.value > 0.0 && value - best.value <= tolerance * best.value;
    }
    bool due(const FlowProgress& at) const {
      return (at.k >= next || at.value <= goal) && at.gained <= tolerance * at.value;
    }
    void take(const Bound& candidate, const FlowProgress& at) {
      if (candidate.value >= best.value) best = candidate;
      const double bound = best.value;
      const double gap = at.value - bound;
      const bool close = bound > 0.0 && gap < CLOSE * bound;
      next = at.k + std::max(1, at.k / (close ? 2 : 8));
      goal =
          close ? bound + tolerance * bound + std::min(0.5, SHORT * gap / bound) * gap : -infinity;
    }
    static constexpr double CLOSE = 1e-2, SHORT = 300.0;
  };

  template <class F> double total_of(F&& term) const {
    V total{};
    for (int b = 0; b < int(step_.size()); ++b) total += term(b);
    return sum(total);
  }

  // The first trial of alpha_k by the rule.
  template <class Mixed, class Bend>
  void propose(FlowProgress& at, Mixed&& mixed, Bend&& bend) const {
    if (rule.kind == StepRule::BARZILAI_BORWEIN) {
      const double product = mixed();
      if (at.k > 0) at.alpha *= inverse_curvature(at.before, at.length, product, at.k);
      at.before = at.length;
    } else if (rule.kind == StepRule::EXACT) {
      const double here = bend();
      at.alpha = here > 0.0 ? at.length / here : rule.first;
    } else if (rule.kind == StepRule::ADAPTIVE) {
      if (at.k > 0) at.alpha *= rule.grow;
    } else {
      at.alpha = rule.first;
    }
    at.alpha = std::min(at.alpha, LONGEST);
    // a step far shorter than x, left from a start near the apex, would stall
    if (at.alpha * at.alpha * at.length < SHORTEST * SHORTEST * at.size && at.length > 0.0)
      at.alpha = SHORTEST * std::sqrt(at.size / at.length);
  }

  // Try alpha_k until Phi decreases as the rule requires. Return false if no step that moves x
  // does.
  template <class Ahead, class Slope, class Bend>
  bool accept(FlowProgress& at, Ahead&& ahead, Slope&& slope, Bend&& bend) const {
    const double decrease = rule.kind == StepRule::ARMIJO ? rule.decrease * at.length : 0.0;
    double trial = rule.kind == StepRule::EXACT ? search(at, ahead, slope, bend) : infinity;
    bool accepted = trial < at.value;
    for (int tried = 0; !accepted && at.moves(ROUNDED); ++tried) {
      ++at.trials;
      trial = ahead(at.alpha);
      accepted = trial < at.value && trial <= at.value - decrease * at.alpha;
      if (!accepted) at.alpha *= tried < PATIENCE ? rule.shrink : std::min(rule.shrink, 0.5);
    }
    if (accepted) {
      at.gained = at.value - trial;
      at.value = trial;
    }
    return accepted;
  }

  // Lower bound of min Phi from the Newton multipliers at on.x; -inf: no bound.
  [[gnu::noinline]] static Bound bound_at(NewtonSolver<V, B>& on, const Vec6& w) {
    if (!on.system.assemble(on.cones, on.x)) return {-infinity, {}};
    const Vec6 nu = on.system.multipliers(on.system.applied + w);
    return {on.cones.lower_bound(nu, w), nu};
  }

  // Barzilai and Borwein (1988) in the metric of P, relative to alpha. With s the previous step and
  // y the change of the projected gradient: <s, s> / <s, y> or <s, y> / <y, y>.
  double inverse_curvature(double before, double now, double mixed, int iterations) const {
    const double s_y = before - mixed;
    const double y_y = (before - mixed) + (now - mixed);
    if (!(s_y > FLAT * before && y_y > 0.0)) return LEAP;
    const bool alternate = rule.grow == StepRule::ALTERNATE;
    const bool only = rule.grow == StepRule::LONG_ONLY;
    return only || (alternate && iterations % 2 == 0) ? before / s_y : s_y / y_y;
  }

  // Phi at a point along the step where its slope is as small as the rule requires: Newton on the
  // slope, kept in a bracket; inf: none.
  template <class Ahead, class Slope, class Bend>
  double search(FlowProgress& at, Ahead&& ahead, Slope&& slope, Bend&& bend) const {
    double low = 0.0, high = infinity;
    for (int n = 0; n < SEARCHES; ++n) {
      ++at.trials;
      const double trial = ahead(at.alpha);
      const double down = slope();
      double guess = -1.0;
      if (trial < infinity) {
        if (std::abs(down) <= rule.decrease * at.length) return trial;
        guess = at.alpha - down / bend();
      }
      (trial < infinity && down < 0.0 ? low : high) = at.alpha;
      if (!(low < guess && guess < high))
        guess = high < infinity ? 0.5 * (low + high) : 2.0 * at.alpha;
      at.alpha = guess;
    }
    return infinity;
  }

  // Remove rounding from the balance and write the certificates, which CONVERGED requires.
  Code finish(NewtonSolver<V, B>& on, const Call& call, const Vec6& w, Code code,
              const Record& record) {
    const auto& cones = on.cones;
    Summary& s = record.summary();
    if (s.iterations > 0.0) {
      next_ = on.x;
      cones.balance(on.x, w);
      if (!(cones.phi(on.x) < infinity)) on.x = next_;
    }
    cones.certify(on.x, w, record);
    const double reached = cones.phi(on.x);
    const bool consistent = std::abs(reached - s.objective) <= OBJECTIVE_ROUNDING * s.objective;
    if (!consistent) s.objective = reached;
    // the force misses balance
    const bool known = call.optimum == call.optimum;
    const bool below = !known && s.objective - s.lower_bound < -OBJECTIVE_ROUNDING * s.lower_bound;
    const bool near = s.objective - s.lower_bound <= call.stop.tolerance * s.lower_bound;
    if (code == CONVERGED &&
        !(near && !below && cones.balanced(on.x, w, s.residual) && s.margin > 0.0))
      code = STALLED;
    s.code = code;
    s.limit_excess = 0.0;
    std::fill(record.torsion(), record.torsion() + cones.count, 0.0);
    return code;
  }
  // fraction of Phi that may be lost to rounding
  static constexpr double OBJECTIVE_ROUNDING = 1e-9;
};

}  // namespace grasp
