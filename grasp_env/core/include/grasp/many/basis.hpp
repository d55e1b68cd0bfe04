// The offline part: the optima of Phi for the 12 unit wrenches and for the zero wrench (paper, Sec.
// III).
#pragma once
#include <grasp/many/problems.hpp>

namespace grasp {

inline constexpr StopRule BASIS_STOP{.tolerance = 1e-10, .limit = 200};
// Basis forces serve as starts: if floating point stops short of 1e-10 (tiny lambda), a hundredth
// is good enough.
inline constexpr double ACCEPTED_GAP = 1e-2;

// Computes the basis for the contacts of a `NewtonSolver`: first the optimum at rest (12), from
// which the others start.
template <class V, int B> class BasisMaker {
 public:
  BasisMaker(NewtonSolver<V, B>& newton, Starter<V, B>& starter)
      : newton_(newton), starter_(starter) {}

  // Start from the basis of nearby contacts. Return the worst relative gap; inf: failed.
  double warm() {
    for (int k = 12; k >= 0 && worst_ < infinity; --k) {
      if (begin_warm(k))
        descend(k);
      else if (k < 12)
        solve_alone(k);
      else
        worst_ = infinity;
    }
    return finish();
  }
  // Start from newton.x, an internal force strictly inside. Allocates.
  double cold() {
    auto& x = newton_.x;
    const double scale = best_scale(newton_.cones, x);
    for (auto& v : x) v = all<V>(scale) * v;
    descend(12);
    if (!(worst_ < infinity)) return finish();
    NewtonLanes<REGISTER> lanes(newton_.cones, BASIS_STOP, LONG);
    std::vector<double> flat(3 * newton_.cones.count);
    const auto enter = [&](int lane, std::ptrdiff_t k) {
      begin(int(k));
      newton_.cones.store(x, flat.data());
      const double value = newton_.cones.phi(x);
      if (value < infinity)
        lanes.begin(lane, flat.data(), w_, value);
      else
        worst_ = infinity;
      return value < infinity;
    };
    const auto leave = [&](int lane, std::ptrdiff_t k, bool closed) {
      if (!closed) return solve_alone(int(k));
      w_ = lanes.wrench_of(lane);
      lanes.cones.store(lanes.x, flat.data(), lane);
      newton_.cones.load(flat.data(), x);
      const DescentProgress at = lanes.progress(lane);
      store_optimum(int(k), at.value, at.bound);
    };
    run(lanes, 12, enter, leave);
    return finish();
  }

 private:
  NewtonSolver<V, B>& newton_;
  Starter<V, B>& starter_;
  double worst_ = 0.0;
  double wrench_[6];
  Vec6 w_;  // the wrench of an optimum; in the unit frame

  void set_wrench(int k) {
    std::fill(wrench_, wrench_ + 6, 0.0);
    if (k < 12) wrench_[k % 6] = k < 6 ? 1.0 : -1.0;
    w_ = newton_.cones.unit.of(wrench_);
  }
  // Write the start of optimum k < 12 into x: the least-norm force plus as much of the optimum at
  // rest as it needs.
  void begin(int k) {
    set_wrench(k);
    grasp::begin(newton_.cones, starter_.basis[12], w_, newton_.x);
  }
  // the second correction removes the rounding that the first left in the balance
  bool begin_warm(int k) {
    set_wrench(k);
    newton_.x = starter_.basis[k];
    const auto follows = [&] {
      return starter_.tangent(newton_.cones, newton_.system, w_, newton_.x) &&
             newton_.cones.phi(newton_.x) < infinity;
    };
    return follows() && follows();
  }
  void solve_alone(int k) {
    begin(k);
    descend(k);
  }
  void descend(int k) {
    set_wrench(k);
    const Record record(newton_.row.data(), newton_.cones.count);
    if (!(newton_.cones.phi(newton_.x) < infinity)) {
      worst_ = infinity;
      return;
    }
    starter_.safe() = newton_.x;
    const Call call{.wrench = wrench_, .stop = BASIS_STOP, .start = From::given};
    newton_.descend_from(starter_.safe(), call, w_, record, LONG);
    store_optimum(k, record.summary().objective, record.summary().lower_bound);
  }
  void store_optimum(int k, double value, double bound) {
    newton_.polish(w_);
    newton_.cones.balance(newton_.x, w_);
    starter_.basis[k] = newton_.x;
    worst_ = bound > 0.0 ? std::max(worst_, (value - bound) / bound) : infinity;
  }
  double finish() {
    starter_.has_basis = worst_ < ACCEPTED_GAP;
    starter_.basis_tangents = starter_.tangents;
    return worst_;
  }
};

// Fill the basis of `starter`. Return the worst relative gap; inf: failed. warm: the basis holds
// the optima of nearby contacts; else newton.x is an internal force strictly inside.
template <class V, int B>
double make_basis(NewtonSolver<V, B>& newton, Starter<V, B>& starter, bool warm) {
  BasisMaker<V, B> maker(newton, starter);
  return warm ? maker.warm() : maker.cold();
}

}  // namespace grasp
