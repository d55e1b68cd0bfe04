// The start of a call: a balanced force strictly inside the cones.
#pragma once
#include <grasp/optimizer/given_force.hpp>

namespace grasp::detail {

// Writes the start of one call into `newton.x` and its kind into `used`.
template <class V, int B> class Starts {
 public:
  using Field = typename Cones<V, B>::Field;

  Starts(Solvers<V, B>& on, CallState& call)
      : on_(on),
        call_(call),
        given_(on, call),
        newton_(on.newton),
        cones_(on.newton.cones),
        starter_(on.starter),
        x_(on.newton.x) {}

  // The start of the call or of the options; the default start of the method.
  Start requested() const {
    const Start start =
        call_.request.start == Start::standard ? on_.options.start : call_.request.start;
    return start == Start::standard ? default_start() : start;
  }
  Start default_start() const {
    return on_.has_flow() ? Start::linear_combination : Start::internal_force;
  }
  // True if the start of the call depends on nothing but contacts and wrench.
  bool is_default() const {
    if (on_.options.method == Method::conic) return true;
    const Start start = requested();
    return call_.request.adjustment.empty() &&
           (start == default_start() || start == Start::phase_one || start == Start::central);
  }

  // Find the requested start. Otherwise return the reason why there is none: INFEASIBLE with
  // `twist` of the call, REFUSED, UNDECIDED.
  Code find() {
    const Code code = find_requested();
    if (code != CONVERGED) return code;
    cones_.reset_unused_lanes(x_);
    return call_.request.adjustment.empty() || adjust(call_.request.adjustment) ? CONVERGED
                                                                                : REFUSED;
  }
  // Find the default start in place of one that failed.
  Code find_replacement() {
    call_.used.replaced = true;
    return find_default();
  }
  // Turn the previous solution into the current frames and balance it by the smallest change in the
  // metric of the Hessian.
  bool carry_previous() {
    if (!given_.load_previous()) return false;
    const double before = cones_.phi(x_);
    const bool follows = before < infinity && starter_.tangent(cones_, newton_.system, call_.w, x_);
    if (follows && cones_.phi(x_) <= CLOSE * before) return true;
    if (!follows) cones_.balance(x_, call_.w);
    on_.begun = x_;
    if (!on_.has_internal_force()) return follows && cones_.phi(x_) < infinity;
    grasp::begin(cones_, on_.internal_force(), call_.w, on_.work);
    x_ = on_.begun;
    return starter_.segment(cones_, on_.work, x_) > 0.0;
  }
  // Find any force inside the cones, or a proof that no balanced force touches them. Return
  // UNDECIDED if neither is found quickly.
  Code find_interior() {
    call_.used.start = Start::phase_one;
    int steps = 0;
    const auto outcome = on_.conic().find_inside(call_.w, x_, call_.twist, steps);
    using Inside = typename ConicSolver<V, B>::Inside;
    if (outcome == Inside::none) call_.twist = cones_.unit.pull_back(call_.twist);
    if (outcome == Inside::found && !(cones_.phi(x_) < infinity))
      return UNDECIDED;  // numbers out of range
    return outcome == Inside::found ? CONVERGED : outcome == Inside::none ? INFEASIBLE : UNDECIDED;
  }

 private:
  // If Phi grows by this factor over the previous solution, another start is compared with it.
  static constexpr double CLOSE = 2.0;
  Solvers<V, B>& on_;
  CallState& call_;
  GivenForce<V, B> given_;
  NewtonSolver<V, B>& newton_;
  const Cones<V, B>& cones_;
  Starter<V, B>& starter_;
  Field& x_;

  Code find_requested() {
    const Request& request = call_.request;
    const Start start = requested();
    call_.used = {.start = start};
    switch (start) {
      case Start::given:
        return given_.load_force() && newton_.is_start(call_.w) ? CONVERGED : REFUSED;
      case Start::previous:
        if (!request.previous && request.force.empty()) return find_default();
        if (carry_previous()) return CONVERGED;
        break;
      case Start::guess:
        if (request.force.size() != std::size_t(3 * on_.current.home.count)) return REFUSED;
        return find_default() == CONVERGED && guess() ? CONVERGED : UNDECIDED;
      case Start::learned:
        if (on_.prediction && predict()) return CONVERGED;
        break;
      case Start::phase_one:
        return find_interior_or_deepest();
      case Start::internal_force:
        return begin_from_internal_force();
      case Start::linear_combination:
      case Start::linear_combination_printed:
      case Start::single_value:
      case Start::lagrange:
        if (combine(start)) return CONVERGED;
        break;
      default:
        return find_default();
    }
    const Code code = find_default();
    const bool named = request.start != Start::standard || on_.options.start != Start::standard;
    call_.used.replaced =
        named ||
        call_.used.start != Start::phase_one;  // without force closure, phase one is the default
    return code;
  }
  // Find the default start, or any force inside if the contacts have no force closure.
  Code find_default() {
    if (on_.has_flow() || on_.options.start == Start::linear_combination) {
      call_.used.start = Start::linear_combination;
      if (combine(Start::linear_combination)) return CONVERGED;
    }
    return begin_from_internal_force();
  }
  Code begin_from_internal_force() {
    if (!on_.has_internal_force()) return find_interior_or_deepest();
    call_.used.start = Start::internal_force;
    grasp::begin(cones_, on_.internal_force(), call_.w, x_);
    return cones_.phi(x_) < infinity ? CONVERGED : UNDECIDED;
  }
  // If `find_interior` is undecided, find the deepest force.
  Code find_interior_or_deepest() {
    if (const Code code = find_interior(); code != UNDECIDED) return code;
    General* program = on_.placement.kind == ProblemKind::hard ? on_.general() : nullptr;
    if (!program) return UNDECIDED;
    const Deepest deep =
        program->deepest(call_.wrench.data(), 1e-7, on_.given.force.data(), nullptr);
    call_.twist = deep.twist;
    if (deep.code != CONVERGED || deep.moved)
      return deep.code == INFEASIBLE ? INFEASIBLE : UNDECIDED;
    cones_.load_point(on_.given.force.data(), x_);
    return newton_.is_start(call_.w) ? CONVERGED : UNDECIDED;
  }

  // Add a force (N, 3) along the axes of the positions to the start and take the point of least Phi
  // between the two.
  bool adjust(Doubles by) {
    const CurrentContacts& current = on_.current;
    std::vector<double>& force = on_.given.force;
    if (by.size() != std::size_t(3 * current.home.count)) return false;
    on_.work = x_;
    cones_.store_force(on_.work, force.data());
    for (int i = 0; i < current.now.count; ++i)
      for (int a = 0; a < 3; ++a)
        for (int r = 0; r < 3; ++r)
          force[3 * i + a] += current.now.frames[9 * i + 3 * r + a] * by[3 * current.chosen[i] + r];
    cones_.load_force(force.data(), x_);
    if (!cones_.is_in_range(x_)) return false;
    cones_.balance(x_, call_.w);
    starter_.segment(cones_, on_.work, x_);
    return true;
  }

  // Start from the offline optima, as the paper or by a variant.
  bool combine(Start start) {
    if (!starter_.has_basis || on_.current.now.count != on_.current.home.count) return false;
    const bool home = on_.placement.home;
    const double* wrench = call_.wrench.data();
    if (start == Start::linear_combination) {
      if (!home) return starter_.moved_combination(cones_, newton_.system, wrench, call_.w, x_);
      starter_.combine(wrench, x_);
      return true;
    }
    if (!home) return false;
    const Field& rest = starter_.basis[12];
    if (start == Start::linear_combination_printed) {
      starter_.combine(wrench, x_, true);
    } else if (start == Start::single_value) {
      least_norm(x_);
      const double least = std::max(1.1 * inside(cones_, x_, rest).low, 1.0);
      for (int b = 0; b < int(x_.size()); ++b) x_[b] += all<V>(least) * rest[b];
    } else if (!minimise_distance(rest)) {
      return false;
    }
    return newton_.is_start(call_.w);
  }
  void least_norm(Field& x) const {
    for (int b = 0; b < int(x.size()); ++b) x[b] = -cones_.blocks[b].least(call_.w);
  }

  // Start::lagrange: argmin (f - k n)^T W (f - k n) s.t. G f = -w, with W = diag(1, 10, 10) and n
  // the unit normal forces. The solution is affine in k. k moves it inside the cones: at least the
  // mean normal force at rest, at most the middle of the feasible interval.
  bool minimise_distance(const Field& rest) {
    constexpr double WEIGHT[3] = {1.0, 10.0, 10.0};
    const Contacts& now = on_.current.now;
    std::vector<double>& force = on_.given.force;
    const int size = 3 * now.count;
    Packed6 s{};
    Vec6 squeezed{};
    for (int j = 0; j < size; ++j) {
      const Vec6 wrench = column(now.force_rows.data(), size, j);
      for (int r = 0; r < 6; ++r) {
        for (int q = 0; q <= r; ++q) s[packed(r, q)] += wrench[r] * wrench[q] / WEIGHT[j % 3];
        if (j % 3 == 0) squeezed[r] += wrench[r];
      }
    }
    Ldl6 factor;
    if (!(factor.factor(s) > 0.0)) return false;
    const auto solve = [&](const Vec6& right, double normal, Field& to) {
      const Vec6 by = factor.solve(right);
      for (int j = 0; j < size; ++j) {
        const double part = dot(column(now.force_rows.data(), size, j), by) / WEIGHT[j % 3];
        force[j] = (j % 3 == 0 ? normal : 0.0) - part;
      }
      cones_.load_force(force.data(), to);
    };
    Field& squeeze = on_.work;
    solve(call_.w, 0.0, x_);
    solve(squeezed, 1.0, squeeze);
    const auto [low, high] = inside(cones_, x_, squeeze);
    if (!(low < high)) return false;
    cones_.store_force(rest, force.data());
    double floor = 0.0;
    for (int i = 0; i < now.count; ++i) floor += force[3 * i] / now.count;
    const double k = std::min(std::max(1.1 * low, floor), 0.5 * (low + high));
    for (int b = 0; b < int(x_.size()); ++b) x_[b] += all<V>(k) * squeeze[b];
    return true;
  }

  // If Phi at the balanced x exceeds Phi at the default start in `work`, take the point of least
  // Phi between them. For a guess, always do so.
  void bring_inside(Start start) {
    const double default_phi = cones_.phi(on_.work);
    double share = 1.0;
    if (start == Start::guess || !(cones_.phi(x_) <= default_phi)) {
      share = starter_.segment(cones_, on_.work, x_);
      if (!(cones_.phi(x_) <= default_phi)) {  // rounding
        x_ = on_.work;
        share = 0.0;
      }
    }
    call_.used.replaced = !(share > 0.0) && dot(call_.w, call_.w) > 0.0;
    if (!call_.used.replaced) call_.used.start = start;
  }
  bool guess() {
    on_.work = x_;
    given_.load_force();
    cones_.balance(x_, call_.w);
    bring_inside(Start::guess);
    return cones_.phi(x_) < infinity;
  }
  // Start from the model's prediction, or from the previous solution if that is better. Phi is
  // never above that of the default start.
  bool predict() {
    if (on_.current.now.count != on_.current.home.count) return false;
    UsedStart& used = call_.used;
    used.outside = !on_.prediction->covers(call_.w);
    if (find_default() != CONVERGED) return false;
    const Start fallback = used.start;
    on_.work = x_;
    if (on_.placement.home) {
      least_norm(x_);
      on_.prediction->add(call_.w, x_);
    } else {  // the predicted internal force turns with the contacts
      for (auto& v : on_.begun) v = {V{}, V{}, V{}};
      on_.prediction->add(call_.w, on_.begun);
      starter_.turn(cones_, on_.begun, on_.home_tangents, x_);
      cones_.balance(x_, call_.w);
    }
    bring_inside(Start::learned);
    if (call_.request.previous && on_.options.remembers) {
      on_.predicted = x_;
      if (carry_previous() && cones_.phi(x_) < cones_.phi(on_.predicted)) {
        used.start = Start::previous;
        used.replaced = false;
      } else {
        x_ = on_.predicted;
      }
    }
    if (used.replaced) used.start = fallback;
    return true;
  }
};

}  // namespace grasp::detail
