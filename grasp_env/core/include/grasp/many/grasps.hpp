// Problems on many grasps. A grasp with many problems is solved alone. For all others a register
// holds W problems on W grasps, from placing the contacts to the record. Those that need more than
// an ordinary descent are solved again alone. Lanes are independent.
#pragma once
#include <grasp/many/basis.hpp>
#include <grasp/math/dispatch.hpp>
#include <grasp/many/problems.hpp>

namespace grasp {

// The contacts of one problem, (N, 3) each; weights (N, 2) omega and lambda. apart: stride of the
// coordinates of a tangent. torsion: (N,) gamma [m], 0: hard; null: all are hard.
struct ContactArrays {
  const double *positions, *normals, *scale, *tangents, *weights;
  int apart = 1;
  const double* torsion = nullptr;
};
struct LaneProblem {
  ContactArrays at;
  std::ptrdiff_t number;
};

// Hard contacts of U grasps, N each; grasp u has the problems first[u] to first[u + 1] - 1.
class Grasps {
 public:
  int contacts;
  std::ptrdiff_t count;
  const double *weights, *first;  // (N, 2) omega, lambda; (U + 1,)

  // placed: (U,) contacts, whose weights are ignored; soft ones are not solved.
  Grasps(int contacts, std::ptrdiff_t count, const Contacts* const* placed, const double* weights,
         const double* first)
      : contacts(contacts), count(count), weights(weights), first(first), placed_(placed) {}

  bool is_solvable(std::ptrdiff_t u) const {
    return placed_[u]->placing == Placing::good && !placed_[u]->soft();
  }
  LaneProblem problem(std::ptrdiff_t u, std::ptrdiff_t k) const {
    const Contacts& at = *placed_[u];
    return {
        {at.positions.data(), at.normals.data(), at.scale.data(), at.frames.data() + 1, weights, 3},
        k};
  }
  Contacts with_weights(std::ptrdiff_t u) const {
    Contacts contacts = *placed_[u];
    contacts.set_weights(weights);
    return contacts;
  }

 private:
  const Contacts* const* placed_;
};

// The contacts of W grasps, one lane each, placed as by `Contacts`. D: variables of a contact, see
// `Cones`.
template <int W, int D = 3> class PlacedLanes {
 public:
  using V = Each<W>;
  using Mask = typename V::Mask;
  using Field = typename Cones<V, 0, D>::Field;

  explicit PlacedLanes(int count)
      : points_(count),
        normals_(count),
        scales_(count),
        tangents_(count),
        torsions_(count),
        x_(count),
        step_(count),
        system_(Cones<V, 0, D>(count)) {}

  // Return the ordinary lanes: finite numbers, normals of unit length, rank 6 beyond doubt and
  // without torsion.
  Mask place(const LaneProblem (&problems)[W], Cones<V, 0, D>& cones) {
    const int count = cones.count;
    for (int lane = 0; lane < W; ++lane) {
      const ContactArrays& at = problems[lane].at;
      gather(at.positions, 1, lane, points_);
      gather(at.normals, 1, lane, normals_);
      gather(at.scale, 1, lane, scales_);
      gather(at.tangents, at.apart, lane, tangents_);
      for (int i = 0; i < count; ++i) {
        auto& weights = cones.blocks[i].weights;
        set(weights.omega, lane, at.weights[2 * i]);
        set(weights.lambda, lane, at.weights[2 * i + 1]);
        if constexpr (D == 4) set(torsions_[i], lane, at.torsion ? at.torsion[i] : 0.0);
      }
    }
    V total{}, off{};
    for (int i = 0; i < count; ++i) {
      total += abs(points_[i].u) + abs(points_[i].o) + abs(points_[i].t);
      off += select(abs(length(normals_[i]) - 1.0) <= UNIT_TOLERANCE, V(0.0), V(1.0));
    }
    cones.unit = UnitFrameOf<V>(count, [&](int i) { return points_[i]; });
    const V per_length = cones.unit.scale();
    Packed<V> s{};
    for (int i = 0; i < count; ++i) {
      auto& block = cones.blocks[i];
      const Vec3<V> normal = normalised(normals_[i]);
      const Vec3<V> arm = per_length * (points_[i] - cones.unit.centre);
      const FrameOf<V> frame(normal, tangents_[i]);
      for (int a = 0; a < 3; ++a) {
        const V scale = block.scale[a] = taken_scale(scales_[i][a]);
        const V divisor = block.divisor[a] = divisor_of(scale);
        const Six<V> row = select(scale > 0.0, V(1.0), V(0.0)) * unit_wrench(arm, frame[a]);
        add_gram(s, row);
        const V per = 1.0 / divisor;
        for (int r = 0; r < 6; ++r) {
          block.g[r][a] = per * row[r];
          block.inverse[r][a] = row[r];
        }
      }
      const Mask grips = block.scale.o > 0.0;
      if constexpr (D == 4) {
        block.weights.axial = select(grips, V(1.0), V(-1.0));
        place_torsion(torsions_[i], per_length * normal, block);
      } else {  // see `fitted`
        block.weights.lambda *= select(grips, V(1.0), V(1.0 / 3.0));
      }
      block.cost = block.weights.omega / block.divisor.u;
      block.mask = V(1.0);
      block.bind_gjg();
    }
    Ldl<V> factor;
    factor.factor(s);
    for (auto& block : cones.blocks)
      for (int a = 0; a < 3; ++a) {
        Six<V> row;
        for (int r = 0; r < 6; ++r) row[r] = block.inverse[r][a];
        row = factor.solve(row);
        for (int r = 0; r < 6; ++r) block.inverse[r][a] = block.scale[a] * row[r];
      }
    return (total < infinity) & (off == 0.0) & (rank_bound(s, factor) > Contacts::WELL_CONDITIONED);
  }

  // As `NewtonSolver::internal_force`, where a few plain steps find one.
  Mask internal_force(const Cones<V, 0, D>& cones, Field& rest) {
    return balance_inside(cones, x_, step_, rest, FEW_STEPS, [&](Six<V>& missed) {
      return system_.internal_step(cones, x_, missed, step_);
    });
  }

 private:
  std::vector<Vec3<V>> points_, normals_, scales_, tangents_;
  std::vector<V> torsions_;
  Field x_, step_;
  System<V, 0, D> system_;

  // The column of v, as in `Cones::pack`. moment: the wrench of a unit torsion.
  static void place_torsion(const V& gamma, const Vec3<V>& moment, Block<V, 4>& block) {
    const Mask soft = gamma > 0.0;
    block.scale.v = taken_scale(select(soft, block.scale.u / gamma, V(0.0)));
    block.divisor.v = divisor_of(block.scale.v);
    block.weights.axial += select(soft, V(1.0), V(0.0));
    for (int r = 0; r < 6; ++r) {
      block.g[r].v = r < 3 ? V(0.0) : moment[r - 3] / block.divisor.v;
      block.inverse[r].v = V(0.0);
    }
  }
  // stride: distance between the coordinates of a triple
  static void gather(const double* from, int stride, int lane, std::vector<Vec3<V>>& to) {
    for (auto& triple : to) {
      set(triple.u, lane, from[0]);
      set(triple.o, lane, from[stride]);
      set(triple.t, lane, from[2 * stride]);
      from += 3 * stride;
    }
  }
};

// Inputs and results of W problems, each on its own grasp.
template <int W> struct GraspLanes {
  using V = Each<W>;
  using Mask = typename V::Mask;
  using Field = typename Cones<V, 0>::Field;

  const SolveBatch& many;
  PlacedLanes<W> placed;
  Six<V> w{}, nu{};          // wrenches and multipliers, unit frame
  Field rest, first, force;  // internal force, start, answer: cone coordinates
  V iterations{}, trials{}, objective{}, bound{}, residual{}, margin{};

  GraspLanes(int contacts, const SolveBatch& many)
      : many(many), placed(contacts), rest(contacts), first(rest), force(rest) {}

  // Return a mask of the problems without degenerate contacts.
  Mask place(const LaneProblem (&problems)[W], Cones<V, 0>& cones) {
    const Mask good = placed.place(problems, cones) & placed.internal_force(cones, rest);
    for (int lane = 0; lane < W; ++lane)
      for (int r = 0; r < 6; ++r) set(w[r], lane, many.wrench(problems[lane].number)[r]);
    const Mask is_in_range = size(w) <= LARGEST;
    w = cones.unit.of(w);
    return good & is_in_range;
  }

  // Compute residuals and margins of the answers. Return the balanced ones.
  Mask check(const Cones<V, 0>& cones) {
    residual = cones.residual(force, w);
    margin = cones.margin(force);
    return cones.balanced(force, w, residual);
  }

  // Write the records of those that converged.
  void write(const LaneProblem (&problems)[W], const Mask& good, const Cones<V, 0>& cones) {
    nu = cones.unit.pull_back(nu);
    cones.to_force(first);
    cones.to_force(force);
    for (int lane = 0; lane < W; ++lane) {
      if (!good[lane]) continue;
      const Record record = many.record(problems[lane].number, cones.count);
      record.clear();
      Summary& s = record.summary();
      s.code = CONVERGED;
      s.iterations = get(iterations, lane);
      s.trials = get(trials, lane);
      s.objective = get(objective, lane);
      s.lower_bound = get(bound, lane);
      s.residual = get(residual, lane);
      s.margin = get(margin, lane);
      s.multipliers = of(nu, lane);
      std::copy_n(many.wrench(problems[lane].number), 6, s.wrench.begin());
      cones.store(force, record.force(), lane);
      cones.store(first, record.initial_force(), lane);
    }
  }
};

template <int W> class NewtonGrasps {
 public:
  using V = Each<W>;
  using Mask = typename V::Mask;

  NewtonGrasps(int contacts, const StopRule& options, const SolveBatch& many)
      : group_(contacts, many), lanes_(contacts, options) {}

  // Solve the problems that are `chosen` and ordinary. Return the solved ones.
  Mask solve(const LaneProblem (&problems)[W], const Mask& chosen) {
    auto& g = group_;
    Mask live = chosen & g.place(problems, lanes_.cones);
    const auto& cones = lanes_.cones;
    const V scale = best_scale(cones, g.rest);
    for (auto& x : g.rest) x = scale * x;
    begin(cones, g.rest, g.w, g.first);
    live &= lanes_.begin(g.first, g.w);
    Mask good{};
    while (any(live)) {
      const auto [closed, alone] = lanes_.step(live);
      live &= ~(closed | alone);
      good |= closed;
      if (!any(closed)) continue;
      copy_where(closed, lanes_.x, g.force);
      g.nu = select(closed, lanes_.nu, g.nu);
      g.objective = select(closed, lanes_.value, g.objective);
      g.bound = select(closed, lanes_.bound, g.bound);
      g.iterations = select(closed, lanes_.iterations, g.iterations);
      g.trials = select(closed, lanes_.trials, g.trials);
    }
    lanes_.x = g.force;
    cones.balance(lanes_.x, g.w);  // rounding of G x + w
    copy_where(g.iterations > 0.0, lanes_.x, g.force);
    good &= g.check(cones) & (g.margin > 0.0);
    g.objective = Rules<V>::unless_rounding(cones.phi(g.force), g.objective);
    good &= Rules<V>::certified(g.objective, g.bound, lanes_.options.tolerance);
    g.write(problems, good, cones);
    return good;
  }

 private:
  GraspLanes<W> group_;
  NewtonLanes<W> lanes_;
};

template <int W> class ConicGrasps {
 public:
  using V = Each<W>;
  using Mask = typename V::Mask;

  ConicGrasps(int contacts, const StopRule& options, const SolveBatch& many)
      : group_(contacts, many), lanes_(contacts, options) {}

  Mask solve(const LaneProblem (&problems)[W], const Mask& chosen) {
    auto& g = group_;
    auto& steps = lanes_.steps;
    Mask live = chosen & g.place(problems, steps.cones);
    const auto& cones = steps.cones;
    const V scale = size(g.w);
    live &= (scale >= NOTHING) & cones.is_in_range(g.rest) & (cones.margin(g.rest) > 0.0);
    steps.rest = g.rest;
    lanes_.minus = (-1.0 / scale) * g.w;
    live &= lanes_.begin();
    for (int b = 0; b < cones.count; ++b) g.first[b] = scale * steps.at[b].x;
    Mask good{};
    while (any(live)) {
      const auto [closed, alone] = lanes_.step(live);
      live &= ~(closed | alone);
      good |= closed;
      if (!any(closed)) continue;
      for (int b = 0; b < cones.count; ++b) g.force[b] = select(closed, steps.at[b].x, g.force[b]);
      g.nu = select(closed, steps.y, g.nu);
      g.iterations = select(closed, lanes_.iterations, g.iterations);
    }
    for (int b = 0; b < cones.count; ++b) steps.at[b].x = g.force[b];
    steps.y = g.nu;
    const auto answer = steps.answer(lanes_.minus, scale, g.force);
    g.nu = answer.theta * g.nu;
    g.bound = answer.bound;
    g.objective = answer.objective;
    g.trials = g.iterations;
    good &= g.check(cones) & (g.margin >= 0.0) & (answer.gap() <= lanes_.options.tolerance);
    g.write(problems, good, cones);
    return good;
  }

 private:
  GraspLanes<W> group_;
  ConicLanes<W> lanes_;
};

// Solve all problems. one(contacts, problems) solves a grasp that has many; false: no internal
// force was found quickly. The remaining records are REFUSED, for `ForceOptimizer`.
template <class Group, class F>
void solve_grasps(const Grasps& grasps, const SolveBatch& many, Group& group, F&& one) {
  constexpr int W = REGISTER;
  const auto refuse = [&](std::ptrdiff_t k) {
    many.record(k, grasps.contacts).summary().code = REFUSED;
  };
  LaneProblem problems[W];
  int waiting = 0;
  const auto solve = [&] {
    typename Group::Mask chosen{};
    for (int lane = 0; lane < W; ++lane) {
      if (lane < waiting)
        chosen[lane] = -1;
      else
        problems[lane] = problems[0];  // the lane needs valid data
    }
    const auto good = group.solve(problems, chosen);
    for (int lane = 0; lane < waiting; ++lane)
      if (!good[lane]) refuse(problems[lane].number);
    waiting = 0;
  };
  for (std::ptrdiff_t u = 0; u < grasps.count; ++u) {
    const auto from = std::ptrdiff_t(grasps.first[u]);
    const auto until = std::ptrdiff_t(grasps.first[u + 1]);
    if (until - from >= W || !grasps.is_solvable(u)) {
      const SolveBatch batch{until - from, many.wrench(from),
                             many.rows + record_size(grasps.contacts) * from};
      if (!grasps.is_solvable(u) || !one(grasps.with_weights(u), batch))
        for (std::ptrdiff_t k = from; k < until; ++k) refuse(k);
      continue;
    }
    for (std::ptrdiff_t k = from; k < until; ++k) {
      problems[waiting++] = grasps.problem(u, k);
      if (waiting == W) solve();
    }
  }
  if (waiting > 0) solve();
  for (std::ptrdiff_t k = 0; k < many.count; ++k) {
    const Record record = many.record(k, grasps.contacts);
    if (record.code() == REFUSED) {
      record.summary().objective = infinity;
      record.summary().lower_bound = -infinity;
    }
  }
}

// Newton, each grasp from its own internal force. REFUSED: no force closure in floating point.
inline void newton_grasps(const Grasps& grasps, const StopRule& options, const SolveBatch& many) {
  NewtonGrasps<REGISTER> group(grasps.contacts, options, many);
  dispatch(grasps.contacts, [&]<class V, int B>() {
    NewtonSolver<V, B> one(grasps.contacts);
    auto rest = one.cones.field();
    solve_grasps(grasps, many, group, [&](const Contacts& contacts, const SolveBatch& batch) {
      one.cones.pack(contacts);
      const bool closes = one.find_rest(rest);
      if (closes) newton_many(one, rest, options, batch);
      return closes;
    });
  });
}

inline void conic_grasps(const Grasps& grasps, const StopRule& options, const SolveBatch& many) {
  ConicGrasps<REGISTER> group(grasps.contacts, options, many);
  dispatch(grasps.contacts, [&]<class V, int B>() {
    NewtonSolver<V, B> newton(grasps.contacts);
    ConicSolver<V, B> one(grasps.contacts, options);
    solve_grasps(grasps, many, group, [&](const Contacts& contacts, const SolveBatch& batch) {
      newton.cones.pack(contacts);
      one.cones.pack(contacts);
      if (!newton.find_rest(one.rest)) return false;
      conic_many(one, batch);
      return true;
    });
  });
}

}  // namespace grasp
