// The largest load along a ray that contacts hold within the limits of a program.
#pragma once
#include <type_traits>
#include <grasp/general/deepest.hpp>

namespace grasp {

// The loads `wrench + k direction` that forces hold, k >= 0. CONVERGED: the largest k is `load`, to
// the tolerance. INFEASIBLE: no force holds the wrench alone, as `twist` proves. STALLED: neither
// bound nor proof; unbounded: no bound was found, and `load` is far above the limits.
struct Payload {
  Code code = REFUSED;
  int iterations = 0;
  bool unbounded = false;
  double load = 0.0, bound = infinity;  // k that a force holds; no force holds a larger one
  // [linear; angular] of the bound, v . direction = 1: with the multipliers y >= 0 of the limits,
  // G^T v + A^T y lies in every dual cone, and k <= y . b - v . wrench
  Vec6 twist{};
};

namespace detail {

// max t with G z + w + t d = 0, z in all cones and limits.
template <int D> class LargestLoad {
 public:
  using Field = typename Constraints<D>::Field;

  explicit LargestLoad(const Constraints<D>& in)
      : in_(&in),
        slacks_(in.slacks()),
        slacks_inside_(in.slacks()),
        z_(in.count),
        inside_(in.count),
        best_(in.count),
        trial_(in.limits),
        trial_inside_(in.limits),
        multipliers_(in.limits) {}

  // Write a force that holds the load into z [N].
  Payload find(const double* direction, const double* wrench, double tolerance, Field& z) {
    const Vec6 along = in_->in_frame(direction);
    const double length = size(along);
    Payload out;
    if (!(length > NOTHING && length <= LARGEST)) return out;
    load_ = in_->in_frame(wrench);
    along_ = (1.0 / length) * along;
    unit_ = unit_of_forces();
    tolerance_ = tolerance;
    low_ = -infinity;
    high_ = infinity;
    has_inside_ = false;
    std::fill(multipliers_.begin(), multipliers_.end(), 0.0);
    begin_inside();
    const bool reached = !in_->is_out_of_reach(along_);
    out.code = STALLED;
    if (reached && !solve<double>(out.iterations)) {
      out.unbounded = holds_far_load(z);
      if (out.unbounded) {
        out.load = unit_ * FAR / length;
        return out;
      }
      if (!has_inside_ && !holds_first(wrench, z, out)) return out;
      solve<DoubleDouble>(out.iterations);
    }
    if (!(low_ >= 0.0) && !holds_first(wrench, z, out)) return out;  // at most the first wrench
    if (!(high_ < infinity)) prove_by_cones(direction, reached);
    z = best_;
    const double scale = unit_ / length;
    out.load = scale * std::max(low_, 0.0);
    out.bound = scale * std::max(high_, 0.0) + 0.0;  // no negative zero
    if (low_ >= 0.0 && high_ - low_ <= tolerance * high_ + TINY && high_ < infinity)
      out.code = CONVERGED;
    out.twist = (1.0 / length) * in_->out_of_frame(y_);
    for (double& price : multipliers_) price /= length;
    return out;
  }
  // Multipliers of the limits, for the bound or the proof.
  const ArenaVector<double>& multipliers() const { return multipliers_; }

 private:
  static constexpr double TINY = 1e-9;  // loads below, in units of forces, count as none
  static constexpr double FAR = 1e6;    // a load held above this, without a bound, has none
  static constexpr int ITERATIONS = 100;
  const Constraints<D>* in_;
  ArenaVector<double> slacks_, slacks_inside_;
  // force of the iterate, of one strictly inside, and of the largest load so far [N]
  Field z_, inside_, best_;
  // multipliers of the limits: of the iterate, of a strictly feasible one, of the best bound
  ArenaVector<double> trial_, trial_inside_, multipliers_;
  Vec6 load_{}, along_{}, y_{}, dual_{}, dual_inside_{};  // unit frame
  double unit_ = 1.0, tolerance_ = 0.0;                   // unit_: [N] of forces
  double low_ = 0.0, high_ = 0.0, inside_load_ = 0.0;
  // `dual_inside_` is of the largest forces alone, not of an iterate
  bool has_inside_ = false, has_dual_inside_ = false, bounds_all_ = false;

  // The size of the first wrench, or that of the tightest limit.
  double unit_of_forces() const {
    double unit = size(load_);
    for (double bound : in_->bound) unit = std::max(unit, -bound);
    if (unit > NOTHING) return unit;
    unit = infinity;
    for (double bound : in_->bound)
      if (bound > NOTHING) unit = std::min(unit, bound);
    return unit < infinity ? unit : 1.0;
  }

  // If the limits bound every force, equal prices on them are strictly feasible multipliers.
  void begin_inside() {
    dual_inside_ = {};
    for (int k = 0; k < in_->limits; ++k) trial_inside_[k] = in_->bound[k] > 0.0 ? 1.0 : 0.0;
    has_dual_inside_ = bounds_all_ = dual_slack(dual_inside_, trial_inside_).least > 0.0;
  }
  // True if forces hold the first wrench. `best_` is one unless it holds more, and so is `inside_`
  // if one is strictly inside. If not, write the proof.
  bool holds_first(const double* wrench, Field& z, Payload& out) {
    Depth<D> depth(*in_, in_->limits);
    const Deepest deepest = depth.find(wrench, 1e-7, z);
    const bool found = deepest.code == CONVERGED;
    // no force at all keeps the limits and holds no wrench
    const bool rests =
        size(load_) == 0.0 && std::ranges::all_of(in_->bound, [](double b) { return b >= 0.0; });
    if (!found && rests)
      for (auto& zi : z) zi = {};
    if (found || rests) {
      if (!(low_ >= 0.0)) best_ = z;
      low_ = std::max(low_, 0.0);
      has_inside_ = found;
      inside_load_ = 0.0;
      for (int i = 0; i < in_->count; ++i)
        for (int a = 0; a < D; ++a) inside_[i][a] = z[i][a] / unit_;
      return true;
    }
    out.code = deepest.code == INFEASIBLE ? INFEASIBLE : STALLED;
    multipliers_ = depth.multipliers();
    out.twist = deepest.twist;
    return false;
  }
  // If a twist proves that the cones alone hold no wrench along the direction, it is the bound.
  void prove_by_cones(const double* direction, bool reached) {
    if (reached) {
      const Deepest deepest = Depth<D>(*in_, 0).find(direction, 1e-7, z_);
      if (deepest.code != INFEASIBLE) return;
      for (int r = 0; r < 6; ++r) {
        Vec6 axis{};
        axis[r] = 1.0;
        y_[r] = dot(deepest.twist, in_->out_of_unit(axis));
      }
    } else {
      y_ = in_->reach.beyond(along_);
    }
    y_ = (1.0 / dot(y_, along_)) * y_;
    high_ = -dot(y_, load_) / unit_;
    std::fill(multipliers_.begin(), multipliers_.end(), 0.0);
  }
  // True if a load of FAR is held, by the force in z [N].
  bool holds_far_load(Field& z) {
    const Vec6 far = in_->out_of_unit(load_ + unit_ * FAR * along_);
    return Depth<D>(*in_, in_->limits).find(far.data(), 1e-7, z).code == CONVERGED;
  }

  // Narrow the loads between `low_` and `high_`. Return true if they agree to the tolerance.
  template <class R> bool solve(int& iterations) {
    const Arena::Scope scope;
    auto engine = in_->template engine<R, 1>(in_->limits, Criterion::load);
    set_up(engine);
    const auto gap = [&] {
      return high_ < infinity && low_ >= 0.0 ? (high_ - low_) / std::max(high_, TINY) : infinity;
    };
    engine.run(tolerance_, TINY * tolerance_, 0.3, ITERATIONS, [&] {
      raise(engine);
      lower(engine);
      return gap();
    });
    if (!(gap() <= tolerance_)) {  // the last iterate
      raise(engine);
      lower(engine);
      const bool last = std::is_same_v<R, DoubleDouble>;
      if (last && !(high_ < infinity)) lower(engine, true);
    }
    iterations += engine.iterations;
    return gap() <= tolerance_ || high_ < TINY;
  }

  template <class R> void set_up(InteriorPoint<R, D, 1>& engine) const {
    engine.shared_cost = {R(-1.0)};
    const Vec6 turned = in_->solve_lower(along_);
    const Vec6 first = in_->solve_lower((1.0 / unit_) * load_);
    auto& at = engine.at;
    auto& rows = engine.rows;
    const auto bound = [&](int k) { return in_->row_scale(k, unit_) * in_->bound[k] / unit_; };
    for (int r = 0; r < rows.joint; ++r) {
      at.joint[r] = r < 6 ? 0.0 : 1.0;
      at.joint_slack[r] = 1.0;
      if (r < 6) rows.coupling[r] = {R(turned[r])};
      rows.right[r] = r < 6 ? -first[r] : bound(rows.label[r]);
    }
    for (int k = 0; k < int(rows.own.size()); ++k) {
      rows.own[k].right = bound(rows.own[k].label);
      at.own[k] = at.own_slack[k] = 1.0;
    }
    in_->scale_rows(rows, unit_);
    at.t = {};
    for (int i = 0; i < in_->count; ++i) at.z[i] = at.s[i] = wide<R>(in_->inwards());
  }

  void write_slacks(const Field& z, ArenaVector<double>& to) const {
    in_->write_slacks(z, in_->limits, to, [&](int k) { return in_->bound[k] / unit_; });
  }
  // Raise the load that is held to that of the iterate, moved inside if rounding left it outside.
  template <class R> void raise(const InteriorPoint<R, D, 1>& engine) {
    double load = double(engine.at.t[0]);
    for (int i = 0; i < in_->count; ++i) z_[i] = narrow(engine.at.z[i]);
    const auto wrench = [&] { return (1.0 / unit_) * load_ + load * along_; };
    double missed = in_->rebalance(z_, wrench());
    write_slacks(z_, slacks_);
    if (least_of(slacks_) < 0.0 && has_inside_) {
      write_slacks(inside_, slacks_inside_);
      const double part = in_->part_inside(slacks_, slacks_inside_);
      load += part * (inside_load_ - load);
      for (int i = 0; i < in_->count; ++i)
        for (int a = 0; a < D; ++a) z_[i][a] += part * (inside_[i][a] - z_[i][a]);
      missed = size(in_->wrench_of(z_) + wrench());
      write_slacks(z_, slacks_);
    }
    double force = 0.0;
    for (const auto& zi : z_) force = std::max(force, zi[0]);
    const double allowed = BALANCED * size(wrench()) + in_->reach.rounding * force;
    const double least = least_of(slacks_);
    if (!(least >= 0.0 && missed <= allowed + 1e-15 * force)) return;
    if (least > 0.0) {
      inside_ = z_;
      inside_load_ = load;
      has_inside_ = true;
    }
    if (load <= low_) return;
    low_ = load;
    for (int i = 0; i < in_->count; ++i)
      for (int a = 0; a < D; ++a) best_[i][a] = unit_ * z_[i][a];
  }

  // Slacks of the dual cones at multipliers of balance (unit frame) and limits: the smallest, and
  // the sum of those below zero.
  struct DualSlack {
    double least = infinity, lacking = 0.0;
  };
  DualSlack dual_slack(const Vec6& y, const ArenaVector<double>& prices) const {
    DualSlack out;
    for (int i = 0; i < in_->count; ++i) {
      Tuple<double, D> dual{};
      for (int r = 0; r < 6; ++r) add(dual, y[r], in_->balance[r][i]);
      for (int k = 0; k < in_->limits; ++k) add(dual, prices[k], in_->limit[k][i]);
      const double here = slack(cone(dual));
      out.least = std::min(out.least, here);
      out.lacking -= std::min(here, 0.0);
    }
    return out;
  }
  // Lower the bound to that of the iterate's multipliers. If rounding left them outside the dual
  // cones, they are moved inside. Without multipliers inside there is no bound, unless it `pays` for
  // what they lack: then it holds for normal forces of up to FARTHEST times those of the iterate.
  template <class R> void lower(const InteriorPoint<R, D, 1>& engine, bool pays = false) {
    in_->read_multipliers(engine, trial_, [&](int k) { return in_->row_scale(k, unit_); });
    Vec6 joint;
    for (int r = 0; r < 6; ++r) joint[r] = double(engine.at.joint[r]);
    dual_ = in_->solve_upper(joint);
    DualSlack now = dual_slack(dual_, trial_);
    if (now.least < 0.0 && has_dual_inside_) {
      const double room = dual_slack(dual_inside_, trial_inside_).least;
      const double part = std::min(1.0, -1.01 * now.least / (room - now.least));
      dual_ = dual_ + part * (dual_inside_ - dual_);
      for (int k = 0; k < in_->limits; ++k) trial_[k] += part * (trial_inside_[k] - trial_[k]);
      now = dual_slack(dual_, trial_);
    } else if (now.least > 0.0 && !bounds_all_) {
      dual_inside_ = dual_;
      trial_inside_ = trial_;
      has_dual_inside_ = true;
    }
    double most = 1.0;
    for (int i = 0; i < in_->count; ++i) most = std::max(most, double(engine.at.z[i][0]));
    if (!(now.least >= 0.0 || pays)) return;
    const double per = dot(dual_, along_);
    if (!(per > 0.0)) return;
    double bound = now.lacking * in_->FARTHEST * most - dot(dual_, load_) / unit_;
    for (int k = 0; k < in_->limits; ++k) bound += trial_[k] * in_->bound[k] / unit_;
    bound /= per;
    if (!(bound < high_)) return;
    high_ = bound;
    y_ = (1.0 / per) * dual_;
    for (int k = 0; k < in_->limits; ++k) multipliers_[k] = trial_[k] / per;
  }
};

}  // namespace detail
}  // namespace grasp
