// The rules and the loop of every descent on Phi, and the call that starts one.
#pragma once
#include <grasp/phi/start.hpp>

namespace grasp {

// Largest fraction of the way to the boundary that a step goes. The shorter one needs a fifth fewer
// steps.
inline constexpr double SHORT = 0.7, LONG = 0.95;

// Rules of a descent, for one problem and for a register of them.
template <class S> struct Rules {
  static constexpr int HALVINGS = 60;
  // a step moves x by at least this fraction of its length
  static constexpr double SHORTEST = 1e-10;
  static constexpr double ROUNDED = 1e-13;  // fraction of Phi
  static constexpr double BELOW = -1e-9;    // rounding by which Phi may lie below its bound

  // True if a lower bound certifies the value of Phi. A value far below the bound belongs to a
  // force out of balance, which further steps restore.
  static auto certified(const S& value, const S& bound, double tolerance) {
    const S above = value - bound;
    return (bound > 0.0) & (above <= tolerance * bound) & (above >= BELOW * bound);
  }
  // True if alpha of a step decreases Phi enough from `value` to `after`. is_within_rounding: the
  // expected decrease is within rounding.
  static auto decreases(const S& after, const S& value, const S& alpha, const S& decrement) {
    return after < value - 1e-4 * alpha * decrement;
  }
  static auto is_within_rounding(const S& value, const S& decrement) {
    return decrement < 1e-9 * value;
  }
  // A recomputed value of Phi: `value` itself if the two differ by rounding only.
  static S unless_rounding(const S& again, const S& value) {
    return select(abs(again - value) <= ROUNDED * value, value, again);
  }
  // True if the decrement promises the tolerance: Phi - min Phi is half of it to third order. A
  // bound costs a quarter of an iteration, so it is computed only then.
  static auto promises_tolerance(const S& value, const S& decrement, double tolerance) {
    return decrement < 4.0 * tolerance * value;
  }
  // True if a step is so small that its multipliers certify the point after a whole step, without
  // another system.
  static auto is_small_step(const S& value, const S& decrement, double tolerance) {
    return decrement < std::sqrt(tolerance) * value;
  }
  // Accuracy of an `Inner` iteration's end, see `dual_near`.
  static double dual_precision(double tolerance) {
    return std::min(1e-2, 0.1 * std::sqrt(std::sqrt(tolerance)));
  }
  // alpha of a step that goes `fraction` of the way to the boundary
  static S longest_step(const S& reach, double fraction) {
    return min(S(1.0), fraction / max(reach, S(1e-300)));
  }
};

struct StopRule {
  double tolerance = 1e-4;  // relative certified gap
  int limit = 20000;        // largest number of accepted steps
};

// One call: the wrench to balance, when to stop, the start, and what to report.
struct Call {
  const double* wrench;  // (6,) [N, N m]
  StopRule stop{};
  From start = From::combination;
  const double* force = nullptr;    // (3N,) [N], unless `start` is the combination
  const double* torsion = nullptr;  // (N,) [N m] of that force, or null
  // Known min Phi; the gap is measured against it instead of the bound.
  double optimum = std::numeric_limits<double>::quiet_NaN();
  double* trace = nullptr;  // receives Phi of iterates 0 .. traced - 1
  int traced = 0;
};

struct DescentProgress {
  double value, bound;
  bool known = false;  // true if the bound is an optimum that the caller knows
  int iterations = 0, trials = 0;
  Vec6 nu{};
};

// The loop of every descent on one problem. find(code): computes the next step and what it proves.
// closed(): true if the tolerance is reached. advance(code): takes the step; false if it cannot.
// Problems side by side use the loop of many/problems.hpp, where the next problem takes the lane of
// one that ends.
enum class Next { step, repeat, stop };
template <class At, class Find, class Closed, class Advance>
[[gnu::always_inline]] inline Code run_descent(At& at, const Call& call, int patience, Find&& find,
                                               Closed&& closed, Advance&& advance) {
  for (Code code = STALLED;; ++at.iterations) {
    if (at.iterations < call.traced) call.trace[at.iterations] = double(at.value);
    const Next next = find(code);
    if (next == Next::repeat) continue;
    if (next == Next::stop) return code;
    if (closed()) return CONVERGED;
    if (at.iterations >= call.stop.limit) return LIMIT;
    if (at.iterations >= patience) return STALLED;
    if (!advance(code)) return code;
  }
}

inline bool is_valid_wrench(const double* wrench) {
  for (int r = 0; r < 6; ++r)
    if (!(std::abs(wrench[r]) <= LARGEST)) return false;
  return true;
}

}  // namespace grasp
