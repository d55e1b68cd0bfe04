// Optimal forces of many problems, and their gradients, for layers of learning programs. The bits
// of an answer do not depend on the problems beside it.
#pragma once
#include <grasp/layer/gradients.hpp>
#include <grasp/layer/optima.hpp>
#include <grasp/optimizer.hpp>

namespace grasp {

// Output arrays, one row per problem.
struct BatchForces {
  double* force;        // (N, 3) [N], the frame of the positions
  double* torsion;      // (N,) [N m]
  double* multipliers;  // (6,) nu
  // (4,) `Code`, relative certified gap (inf: none), balance residual [N], unit frame; iterations
  double* facts;
  double* state;  // (4N + 7,) for the gradients
};
constexpr int layer_state_size(int contacts) { return 4 * contacts + 7; }
inline constexpr int LAYER_FACTS = 4;

// D: variables of a contact, see `Cones`.
template <int D> class LayerSolver {
 public:
  LayerSolver(const ForceBatch& batch, const StopRule& options)
      : batch_(batch), options_(options), smooth_(batch) {
    for (PosedProblem& problem : posed_) problem = PosedProblem(batch.contacts);
  }
  void solve(const BatchForces& to) {
    for (std::ptrdiff_t from = 0; from < batch_.size; from += W)
      solve(from, int(std::min<std::ptrdiff_t>(W, batch_.size - from)), to);
  }

 private:
  static constexpr int W = REGISTER;
  static constexpr int USUAL = 60;  // steps of an ordinary descent
  using Smooth = SmoothLanes<W, D>;
  using Mask = typename Smooth::Mask;
  struct CachedSolver {
    std::optional<ForceOptimizer> solver;
    std::vector<double> constants;  // the data that a call cannot change
  };
  struct LaneAnswer {
    Code code = REFUSED;
    Regime regime = Regime::none;
    double gap = infinity, iterations = 0.0;
  };
  const ForceBatch& batch_;
  StopRule options_;
  Smooth smooth_;
  PosedProblem posed_[W];
  CachedSolver within_, free_;  // with the limits; without them
  std::vector<double> row_;     // a solution of theirs

  int count() const { return batch_.contacts; }

  // Solve problems `from` on, side by side. `ForceOptimizer` solves those that need more than an
  // ordinary descent; the lanes then refine its force, or an elastic one.
  void solve(std::ptrdiff_t from, int many, const BatchForces& to) {
    LaneAnswer answers[W];
    Mask sound{};
    int filler = -1;
    for (int lane = 0; lane < many; ++lane) {
      clear(from + lane, to);
      if (posed_[lane].take(batch_, from + lane)) {
        sound[lane] = -1;
        filler = lane;
      }
    }
    if (filler < 0) return;
    const double* starts[W] = {};
    for (int lane = 0; lane < W; ++lane) {
      const int shown = sound[lane] ? lane : filler;  // the lane needs valid data
      smooth_.load(lane, from + shown, posed_[shown], Regime::optimum);
      if (sound[lane] && posed_[lane].take_start(batch_, from + lane))
        starts[lane] = posed_[lane].start.data();
    }
    const Mask full_rank = smooth_.place();
    const Mask ordinary = sound & full_rank & smooth_.begin();
    smooth_.take_starts(starts);
    const Mask close = smooth_.descend(ordinary, std::min(USUAL, options_.limit));
    smooth_.polish(close);
    const auto gaps = smooth_.gap();
    const Mask balanced = smooth_.balanced();
    Mask elastic{}, late{};
    for (int lane = 0; lane < many; ++lane) {
      if (!sound[lane]) continue;
      LaneAnswer& answer = answers[lane];
      answer = {CONVERGED, Regime::optimum, get(gaps, lane), get(smooth_.iterations, lane)};
      if (close[lane] && answer.gap <= options_.tolerance && balanced[lane]) continue;
      answer = solve_with_optimizer(from + lane, lane, full_rank[lane]);
      (is_optimum(answer.regime) ? late : elastic)[lane] = -1;
    }
    smooth_.iterations = {};
    if (any(elastic | late)) smooth_.polish(elastic | late);
    for (int lane = 0; lane < many; ++lane) {
      const bool within_reach = answers[lane].regime == Regime::within_reach;
      if (!elastic[lane] && !within_reach) continue;
      if (!within_reach) answers[lane].iterations += get(smooth_.iterations, lane);
      if (!smooth_.converged[lane]) answers[lane].regime = Regime::none;  // no gradient
    }
    for (int lane = 0; lane < many; ++lane)
      if (sound[lane]) write(lane, from + lane, answers[lane], to);
  }
  // The lane continues from the answer of `ForceOptimizer`. full_rank: the rank of G is 6 beyond
  // doubt.
  LaneAnswer solve_with_optimizer(std::ptrdiff_t k, int lane, bool full_rank) {
    const PosedProblem& posed = posed_[lane];
    LaneAnswer answer{.code = solve_alone(k, posed_[lane])};
    const bool force = Record::has_force(answer.code);
    if (!row_.empty()) answer.iterations = Record(row_.data()).summary().iterations;
    if (force && answer.code != LIMITS_EXCEEDED) answer.gap = Record(row_.data()).gap();
    answer.regime = answer.code == LIMITS_EXCEEDED ? Regime::exceeding
                    : force                        ? Regime::optimum
                                                   : Regime::unbalanced;
    const bool doubtful = answer.regime == Regime::optimum && !full_rank;
    if (doubtful && !posed.placed(batch_, k).reach.full()) answer.regime = Regime::within_reach;
    smooth_.choose(lane, answer.regime, posed);
    if (force) {
      const Record record(row_.data());
      smooth_.begin(lane, record.force(), record.torsion(), record.summary().multipliers);
    } else {
      smooth_.begin(lane);
    }
    return answer;
  }
  void write(int lane, std::ptrdiff_t k, const LaneAnswer& answer, const BatchForces& to) const {
    smooth_.write(lane, to.force + 3 * count() * k, to.torsion + count() * k,
                  to.multipliers + 6 * k);
    double* state = to.state + layer_state_size(count()) * k;
    smooth_.save(lane, state);
    state[layer_state_size(count()) - 1] = double(answer.regime);
    double* facts = to.facts + LAYER_FACTS * k;
    facts[0] = answer.code;
    facts[1] = answer.gap;
    facts[2] = get(smooth_.residual, lane);
    facts[3] = answer.iterations;
    const auto finite = [](const double* from, int many) {
      return std::all_of(from, from + many, [](double v) { return std::abs(v) < infinity; });
    };
    if (finite(to.force + 3 * count() * k, 3 * count()) &&
        finite(to.torsion + count() * k, count()) && finite(to.multipliers + 6 * k, 6) &&
        finite(state, layer_state_size(count())) && finite(facts + 2, 1))
      return;
    clear(k, to);  // numbers outside the range of double
    facts[0] = UNDECIDED;
  }
  void clear(std::ptrdiff_t k, const BatchForces& to) const {
    std::fill_n(to.force + 3 * count() * k, 3 * count(), 0.0);
    std::fill_n(to.torsion + count() * k, count(), 0.0);
    std::fill_n(to.multipliers + 6 * k, 6, 0.0);
    std::fill_n(to.state + layer_state_size(count()) * k, layer_state_size(count()), 0.0);
    double* facts = to.facts + LAYER_FACTS * k;
    facts[0] = REFUSED;
    facts[1] = infinity;
    facts[2] = facts[3] = 0.0;
  }

  // Solve by `ForceOptimizer` into row_: the optimum or, with LIMITS_EXCEEDED, that without limits.
  Code solve_alone(std::ptrdiff_t k, PosedProblem& posed) {
    Code code = prepare(within_, k, posed, batch_.limited());
    if (code == CONVERGED) code = solve_with(*within_.solver, k, posed, batch_.limited());
    if (!batch_.limited() || (code != INFEASIBLE && code != UNDECIDED)) return code;
    Code free = prepare(free_, k, posed, false);
    if (free == CONVERGED) free = solve_with(*free_.solver, k, posed, false);
    return Record::has_force(free) ? LIMITS_EXCEEDED : free;
  }
  // Make the optimiser of a problem, unless that of the last one serves. Return CONVERGED if there
  // is one.
  Code prepare(CachedSolver& cached, std::ptrdiff_t k, const PosedProblem& posed, bool limited) {
    row_.clear();
    std::vector<double> constants = this->constants(k, posed);
    if (cached.solver && constants == cached.constants) return CONVERGED;
    cached.solver.reset();
    const Contacts contacts = posed.placed(batch_, k);
    if (contacts.placing == Placing::refused || contacts.reach.rank == 0)
      return RANK_LOST;  // all at one point
    ForceLimits limits;
    if (limited) {
      limits = {slice(batch_.min_normal, k, count()), slice(batch_.max_normal, k, count()),
                jacobian(k), slice(batch_.torque_limit, k, batch_.joints),
                slice(batch_.torque_bias, k, batch_.joints)};
    }
    cached.solver.emplace(Problem{contacts, limits},
                          Options{.tolerance = options_.tolerance, .limit = options_.limit});
    cached.constants = std::move(constants);
    return CONVERGED;
  }
  Code solve_with(ForceOptimizer& solver, std::ptrdiff_t k, PosedProblem& posed, bool limited) {
    row_.assign(solver.size(), 0.0);
    Changes now{.positions = slice(batch_.positions, k, 3 * count()),
                .normals = posed.normals,
                .friction = slice(batch_.friction, k, 2 * count())};
    if (limited) {
      now.jacobian = jacobian(k);
      now.torque_bias = slice(batch_.torque_bias, k, batch_.joints);
    }
    Request request{.wrench = batch_.wrench[k], .now = now};
    if (posed.take_start(batch_, k)) {
      request.start = Start::previous;
      request.force = posed.start;
    }
    return solver.solve(request, row_.data());
  }
  static Doubles slice(const Slices& from, std::ptrdiff_t k, int size) {
    return from ? Doubles(from[k], size) : Doubles{};
  }
  Doubles jacobian(std::ptrdiff_t k) const {
    return slice(batch_.jacobian, k, count() * batch_.jacobian_rows * batch_.joints);
  }
  // The data that a call cannot change.
  std::vector<double> constants(std::ptrdiff_t k, const PosedProblem& posed) const {
    std::vector<double> out(posed.weights);
    const auto add = [&](const double* from, int size) {
      if (from) out.insert(out.end(), from, from + size);
    };
    add(posed.tangents.data(), 3 * count());
    add(batch_.torsion[k], count());
    add(batch_.min_normal[k], count());
    add(batch_.max_normal[k], count());
    add(batch_.torque_limit[k], batch_.joints);
    for (int i = 0; i < count(); ++i) out.push_back(posed.scale[3 * i + 1] > 0.0);
    return out;
  }
};

// Call f.template operator()<D>() with the variables of a contact: 4 if torsion is given, even if
// it is zero, so that the bits of an answer do not depend on the problems beside it.
template <class F> void with_variables(const ForceBatch& batch, F&& f) {
  if (batch.torsion)
    f.template operator()<4>();
  else
    f.template operator()<3>();
}

inline void optimal_forces(const ForceBatch& batch, const StopRule& options,
                           const BatchForces& to) {
  with_variables(batch, [&]<int D>() { LayerSolver<D>(batch, options).solve(to); });
}

template <int D> void layer_gradients(const ForceBatch& batch, const double* state,
                                      const BatchLosses& by, bool elastic,
                                      const BatchGradients& to) {
  constexpr int W = REGISTER;
  const int size = layer_state_size(batch.contacts);
  SmoothLanes<W, D> smooth(batch);
  PosedProblem posed[W];
  for (PosedProblem& problem : posed) problem = PosedProblem(batch.contacts);
  std::ptrdiff_t waiting[W];
  int filled = 0;
  const auto finish = [&] {
    typename SmoothLanes<W, D>::Mask chosen{};
    for (int lane = 0; lane < W; ++lane) {
      const std::ptrdiff_t k = waiting[lane < filled ? lane : 0];
      posed[lane].take(batch, k);
      smooth.load(lane, k, posed[lane], Regime(int(state[size * k + size - 1])));
      smooth.restore(lane, state + size * k);
      if (lane < filled) chosen[lane] = -1;
    }
    smooth.place();
    smooth.gradients(chosen, by, to);
    filled = 0;
  };
  for (std::ptrdiff_t k = 0; k < batch.size; ++k) {
    const Regime regime = Regime(int(state[size * k + size - 1]));
    if (regime == Regime::none || (!elastic && !is_optimum(regime))) continue;
    waiting[filled++] = k;
    if (filled == W) finish();
  }
  if (filled > 0) finish();
}

// Gradients of a loss by all inputs. elastic: also for problems without an optimum. Other rows are
// zero.
inline void optimal_forces_gradients(const ForceBatch& batch, const double* state,
                                     const BatchLosses& by, bool elastic,
                                     const BatchGradients& to) {
  with_variables(batch, [&]<int D>() { layer_gradients<D>(batch, state, by, elastic, to); });
}

}  // namespace grasp
