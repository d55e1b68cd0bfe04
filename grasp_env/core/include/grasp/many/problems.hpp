// Many problems side by side: a register holds one contact of W problems, and the next problem
// takes the lane of one that ends. An answer does not depend on the problems beside it. Problems
// start and finish alone, by `NewtonSolver` and `ConicSolver`, which also solve those that need
// more than an ordinary descent.
#pragma once
#include <grasp/conic/conic.hpp>
#include <grasp/newton/newton.hpp>

namespace grasp {

template <int W> inline Vec6 of(const Six<Each<W>>& a, int lane) {
  Vec6 out;
  for (int r = 0; r < 6; ++r) out[r] = get(a[r], lane);
  return out;
}

// Problems that have reached their tolerance; problems that must be solved alone.
template <class Mask> struct LaneOutcome {
  Mask closed, alone;
};

template <int W> class NewtonLanes {
 public:
  using V = Each<W>;
  using Mask = typename V::Mask;
  using Field = typename Cones<V, 0>::Field;
  StopRule options;
  Cones<V, 0> cones;
  Field x;  // the iterates
  V value{}, bound{}, iterations{}, trials{};
  Six<V> wrench{}, nu{};  // unit frame: the wrench to balance; the multipliers

  NewtonLanes(int count, const StopRule& options, double fraction = SHORT)
      : options(options),
        cones(count),
        x(cones.field()),
        fraction_(fraction),
        system_(cones),
        step_(cones.field()) {}
  // All lanes on the contacts of one grasp.
  template <class C, int B>
  NewtonLanes(const Cones<C, B>& contacts, const StopRule& options, double fraction = SHORT)
      : NewtonLanes(contacts.count, options, fraction) {
    cones.spread(contacts);
  }

  // Load a problem: its start (3N,) in cone coordinates, balanced and strictly inside, its wrench,
  // Phi.
  void begin(int lane, const double* start, const Vec6& w, double phi) {
    cones.load(start, x, lane);
    for (int r = 0; r < 6; ++r) set(wrench[r], lane, w[r]);
    set(value, lane, phi);
    set(bound, lane, -infinity);
    set(iterations, lane, 0.0);
    set(trials, lane, 0.0);
  }

  // Load all lanes. Return those with a valid start.
  Mask begin(const Field& start, const Six<V>& w) {
    x = start;
    wrench = w;
    value = cones.phi(x);
    bound = V(-infinity);
    iterations = trials = V{};
    return value < infinity;
  }

  Vec6 wrench_of(int lane) const { return of(wrench, lane); }
  DescentProgress progress(int lane) const {
    return {.value = get(value, lane),
            .bound = get(bound, lane),
            .iterations = int(get(iterations, lane)),
            .trials = int(get(trials, lane)),
            .nu = of(nu, lane)};
  }

  // Step the `live` lanes, as in `NewtonSolver::descend`. Flat: a call for a part of it costs a
  // tenth of the time.
  [[gnu::flatten]] LaneOutcome<Mask> step(const Mask& live) {
    const double tolerance = options.tolerance;
    Mask open = live & system_.assemble(cones, x) &
                (iterations < double(std::min(options.limit, PATIENCE)));
    const Six<V> left = system_.applied + wrench;
    nu = system_.multipliers(left);
    NoRows none;
    const auto [decrement, reach] = system_.step(cones, x, nu, left, value, step_, none);
    if (const Mask look = open & By::promises_tolerance(value, decrement, tolerance); any(look))
      raise(look, cones.lower_bound(nu, wrench));
    Mask certified = open & By::certified(value, bound, tolerance);
    open &= ~certified;
    if (!any(open)) return {certified, live & ~certified};

    V alpha = By::longest_step(reach, fraction_);
    const Mask moved = search(open, decrement, alpha);
    for (int b = 0; b < int(x.size()); ++b) x[b] += alpha * step_[b];
    iterations += select(moved, V(1.0), V(0.0));
    const Mask look = moved & (alpha == V(1.0)) & By::is_small_step(value, decrement, tolerance);
    if (any(look)) {
      raise(look, cones.lower_bound(nu, wrench, x, By::dual_precision(tolerance)));
      certified |= look & By::certified(value, bound, tolerance);
    }
    return {certified, live & ~(certified | moved)};
  }

 private:
  using By = Rules<V>;
  static constexpr int PATIENCE = 40;  // steps; ordinary descents take fewer
  double fraction_;                    // largest fraction of the way to the boundary
  System<V, 0> system_;
  Field step_;

  void raise(const Mask& which, const V& next) { bound = select(which, max(bound, next), bound); }

  // Halve alpha in the open lanes until Phi decreases; `value` follows, alpha becomes 0 elsewhere.
  // Return the lanes that moved.
  Mask search(Mask open, const V& decrement, V& alpha) {
    const Mask flat = By::is_within_rounding(value, decrement);
    Mask moved{};
    V taken{};
    for (int halving = 0; halving < By::HALVINGS; ++halving, alpha = 0.5 * alpha) {
      trials += select(open, V(1.0), V(0.0));
      const V after = cones.phi_along(x, step_, alpha);
      Mask good =
          open & (By::decreases(after, value, alpha, decrement) | (flat & (after <= value)));
      if (const Mask suspect = halving > 0 ? good : good & flat; any(suspect)) {
        const Mask far =
            alpha * cones.largest_normal(step_) > By::SHORTEST * cones.largest_normal(x);
        open &= ~(suspect & ~far);
        good &= ~(suspect & ~far);
      }
      value = select(good, after, value);
      taken = select(good, alpha, taken);
      moved |= good;
      open &= ~good;
      if (!any(open)) break;
    }
    alpha = taken;
    return moved;
  }
};

template <int W> class ConicLanes {
 public:
  using V = Each<W>;
  using Mask = typename V::Mask;
  StopRule options;
  ConicSteps<V, 0> steps;
  V iterations{};
  Six<V> minus{};  // minus the wrenches, unit frame, size 1

  ConicLanes(int count, const StopRule& options) : options(options), steps(count) {}
  template <class C, int B> ConicLanes(const Cones<C, B>& contacts, const StopRule& options)
      : ConicLanes(contacts.count, options) {
    steps.cones.spread(contacts);
  }

  // Start all lanes, each from its own internal force. Return those not yet solved.
  Mask begin() {
    steps.start(minus);
    iterations = V{};
    return steps.gap > options.tolerance * steps.objective;
  }

  // Load the start of a problem; write back its last iterate and return its number of iterations.
  template <class C, int B> void begin(int lane, const ConicSteps<C, B>& from, const Vec6& w) {
    for_each(from, [&](int b, int c, int n, int a) {
      set(steps.at[c].x[a], lane, get(from.at[b].x[a], n));
      set(steps.at[c].s[a], lane, get(from.at[b].s[a], n));
    });
    for (int r = 0; r < 6; ++r) {
      set(steps.y[r], lane, from.y[r]);
      set(minus[r], lane, w[r]);
    }
    set(steps.gap, lane, from.gap);
    set(steps.objective, lane, from.objective);
    set(iterations, lane, 0.0);
  }
  template <class C, int B> int end(int lane, ConicSteps<C, B>& to) const {
    for_each(to, [&](int b, int c, int n, int a) {
      set(to.at[b].x[a], n, get(steps.at[c].x[a], lane));
    });
    to.y = of(steps.y, lane);
    return int(get(iterations, lane));
  }

  [[gnu::flatten]] LaneOutcome<Mask> step(const Mask& live) {
    const Mask sound = live & (steps.system() > 0.0) & (iterations < double(options.limit));
    const auto solve = [&](const Six<V>& pull) { return steps.schur.solve(pull); };
    const Mask moved = sound & steps.template step<false>(solve(minus), solve);
    iterations += 1.0;
    return {moved & (steps.gap <= options.tolerance * steps.objective), live & ~moved};
  }

 private:
  // Call f(block, contact, its lane there, coordinate).
  template <class C, int B, class F> static void for_each(const ConicSteps<C, B>& one, F&& f) {
    for (int c = 0; c < one.cones.count; ++c)
      for (int a = 0; a < 3; ++a) f(c / width<C>, c, c % width<C>, a);
  }
};

// Solve problems 0 .. many - 1 in the lanes. begin(lane, k): loads problem k, or returns false if
// it needs no lane. end(lane, k, closed): takes it out.
template <class SolveBatch, class Begin, class End>
void run(SolveBatch& lanes, std::ptrdiff_t many, Begin&& begin, End&& end) {
  constexpr int W = sizeof(typename SolveBatch::V) / sizeof(double);
  std::ptrdiff_t next = 0, problem[W] = {};
  typename SolveBatch::Mask live{};
  const auto fill = [&](int lane) {
    live[lane] = 0;
    while (next < many && !live[lane])
      if (begin(lane, problem[lane] = next++)) live[lane] = -1;
  };
  for (int lane = 0; lane < W; ++lane) fill(lane);
  while (any(live)) {
    const auto [closed, alone] = lanes.step(live);
    if (!any(closed | alone)) continue;
    for (int lane = 0; lane < W; ++lane)
      if (closed[lane] || alone[lane]) {
        end(lane, problem[lane], bool(closed[lane]));
        fill(lane);
      }
  }
}

inline constexpr int FEW_PROBLEMS = REGISTER / 2;  // fewer problems are solved one by one

struct SolveBatch {
  std::ptrdiff_t count;
  const double* wrenches;  // (M, 6) [N, N m]
  double* rows;            // (M, record_size(N))
  const double* wrench(std::ptrdiff_t k) const { return wrenches + 6 * k; }
  Record record(std::ptrdiff_t k, int contacts) const {
    return {rows + record_size(contacts) * k, contacts};
  }
};

// Solve many wrenches of one grasp by Newton, from an internal force strictly inside the cones.
template <class V, int B> void newton_many(NewtonSolver<V, B>& one,
                                           const typename Cones<V, B>::Field& rest,
                                           const StopRule& stop, const SolveBatch& many) {
  auto& cones = one.cones;
  const int count = cones.count;
  const auto alone = [&](std::ptrdiff_t k, const Record& record) {
    one.solve_from(rest, {.wrench = many.wrench(k), .stop = stop}, record);
  };
  if (many.count < FEW_PROBLEMS) {
    for (std::ptrdiff_t k = 0; k < many.count; ++k) alone(k, many.record(k, count));
    return;
  }
  NewtonLanes<REGISTER> lanes(cones, stop);
  std::vector<double> x(3 * count);
  const auto enter = [&](int lane, std::ptrdiff_t k) {
    const Record record = many.record(k, count);
    const Vec6 w = cones.unit.of(many.wrench(k));
    if (!is_valid_wrench(many.wrench(k))) {
      record.summary().code = REFUSED;
      return false;
    }
    begin(cones, rest, w, one.x);
    cones.store_force(one.x, record.initial_force());
    cones.store(one.x, x.data());
    const double value = cones.phi(one.x);
    if (!(value < infinity)) {
      alone(k, record);
      return false;
    }
    lanes.begin(lane, x.data(), w, value);
    return true;
  };
  const auto leave = [&](int lane, std::ptrdiff_t k, bool closed) {
    const Record record = many.record(k, count);
    if (closed) {
      lanes.cones.store(lanes.x, x.data(), lane);
      cones.load(x.data(), one.x);
      const Call call{.wrench = many.wrench(k), .stop = stop, .start = From::given};
      closed = one.finish(CONVERGED, one.x, call, lanes.wrench_of(lane), lanes.progress(lane),
                          record) == CONVERGED;
    }
    if (!closed) alone(k, record);
  };
  run(lanes, many.count, enter, leave);
}

// Minimise the weighted sum of normal forces for many wrenches of one grasp.
template <class V, int B> void conic_many(ConicSolver<V, B>& one, const SolveBatch& many) {
  const int count = one.cones.count;
  if (many.count < FEW_PROBLEMS) {
    for (std::ptrdiff_t k = 0; k < many.count; ++k)
      one.solve(many.wrench(k), many.record(k, count));
    return;
  }
  ConicLanes<REGISTER> lanes(one.cones, one.options);
  typename ConicSolver<V, B>::UnitWrench posed[REGISTER];
  const auto enter = [&](int lane, std::ptrdiff_t k) {
    const Record record = many.record(k, count);
    if (!one.begin_record(many.wrench(k), posed[lane], record)) return false;
    one.start(posed[lane].minus);
    if (one.gap <= one.options.tolerance * one.objective) {  // the start is good enough
      one.solve(many.wrench(k), record);
      return false;
    }
    lanes.begin(lane, one, posed[lane].minus);
    return true;
  };
  const auto leave = [&](int lane, std::ptrdiff_t k, bool closed) {
    const Record record = many.record(k, count);
    if (closed) {
      one.start(posed[lane].minus);  // restores what the record needs
      const int iterations = lanes.end(lane, one);
      closed = one.conclude(posed[lane], iterations, record) <= one.options.tolerance;
    }
    if (!closed) one.solve(many.wrench(k), record);
  };
  run(lanes, many.count, enter, leave);
}

}  // namespace grasp
