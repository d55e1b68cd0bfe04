// The largest load along a ray that contacts hold within the limits of a program.
#pragma once
#include <type_traits>
#include <grasp/general/deepest.hpp>

namespace grasp {

// The loads `wrench + k direction` that forces hold, from k = 0 on. CONVERGED: the largest k is
// `load`, to the tolerance, and all below are held. INFEASIBLE: no force holds the wrench alone, as
// `twist` proves. STALLED: neither bound nor proof; unbounded: no bound was found, and `load` is
// far above the limits.
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
        multipliers_(in.limits),
        now_(in.limits),
        mixed_(in.limits),
        of_limits_(in.limits),
        latest_(in.limits) {}

  // Write a force that holds the load into z [N].
  Payload find(const double* direction, const double* wrench, double tolerance, Field& z) {
    const Vec6 along = in_->in_frame(direction);
    const double length = size(along);
    Payload out;
    if (!(length > NOTHING && length <= LARGEST)) return out;
    load_ = in_->in_frame(wrench);
    along_ = (1.0 / length) * along;
    set_units();
    tolerance_ = tolerance;
    low_ = -infinity;
    high_ = infinity;
    has_inside_ = first_held_ = false;
    latest_.room = 0.0;
    std::fill(multipliers_.begin(), multipliers_.end(), 0.0);
    price_limits();
    const bool reached = !in_->is_out_of_reach(along_);
    out.code = STALLED;
    if (!holds_first(wrench, z, out)) return out;
    if (reached && !solve<double>(out.iterations)) {
      out.unbounded = !(of_limits_.room > 0.0) && holds_far_load(z);
      if (out.unbounded) {
        out.load = far_ / length;
        return out;
      }
      if (!has_inside_) {
        Depth<D> depth(*in_, in_->limits);
        find_inside(depth, wrench, z);
      }
      solve<DoubleDouble>(out.iterations);
    }
    if (!(low_ >= 0.0) && first_held_) low_ = 0.0;
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
  static constexpr double FAR = 1e6;    // a load this far above all limits has no bound
  static constexpr int ITERATIONS = 100;
  // Multipliers of balance (unit frame) and of the limits. room: their smallest slack of the dual
  // cones if they are kept as a point inside; 0: none.
  struct Prices {
    Vec6 y{};
    ArenaVector<double> limits;
    double room = 0.0;

    explicit Prices(int count) : limits(count) {}
  };
  const Constraints<D>* in_;
  ArenaVector<double> slacks_, slacks_inside_;
  // force of the iterate, of one strictly inside, and of the largest load so far [N]
  Field z_, inside_, best_;
  ArenaVector<double> multipliers_;  // of the best bound
  // of the iterate, mixed, of the limits alone, of the latest iterate inside
  Prices now_, mixed_, of_limits_, latest_;
  Vec6 load_{}, along_{}, y_{};                      // unit frame
  double unit_ = 1.0, far_ = 0.0, tolerance_ = 0.0;  // unit_: [N] of forces; far_ [N]
  double low_ = 0.0, high_ = 0.0, inside_load_ = 0.0;
  bool has_inside_ = false;
  bool first_held_ = false;  // a force that holds the first wrench is known

  // unit_: the larger one of the first wrench and the tightest limit. far_: beyond all limits.
  void set_units() {
    unit_ = size(load_);
    double tightest = infinity, widest = 0.0;
    for (int k = 0; k < in_->limits; ++k) {
      double lever = 0.0;
      for (int i = 0; i < in_->count; ++i)
        for (double part : in_->limit[k][i]) lever = std::max(lever, std::abs(part));
      const double force = in_->bound[k] / lever;
      if (!(std::abs(force) <= LARGEST)) continue;  // not of these contacts
      widest = std::max(widest, std::abs(force));
      if (force > NOTHING) tightest = std::min(tightest, force);
      unit_ = std::max(unit_, -force);
    }
    if (tightest < infinity) unit_ = std::max(unit_, tightest);
    if (!(unit_ > NOTHING)) unit_ = 1.0;
    far_ = FAR * std::max(unit_, widest);
  }

  // If the limits bound every force, equal prices on them are inside the dual cones.
  void price_limits() {
    for (int k = 0; k < in_->limits; ++k) of_limits_.limits[k] = in_->bound[k] > 0.0 ? 1.0 : 0.0;
    of_limits_.room = dual_slack(of_limits_).least;
  }
  // True unless a proof shows that no force holds the first wrench. `best_` is one that does, if
  // one was found.
  bool holds_first(const double* wrench, Field& z, Payload& out) {
    if (size(load_) == 0.0 && std::ranges::all_of(in_->bound, [](double b) { return b >= 0.0; })) {
      for (auto& zi : best_) zi = {};
      first_held_ = true;
      return true;
    }
    Depth<D> depth(*in_, in_->limits);
    const Deepest deepest = find_inside(depth, wrench, z);
    if (deepest.code == INFEASIBLE) {
      out.code = INFEASIBLE;
      out.twist = deepest.twist;
      multipliers_ = depth.multipliers();
      return false;
    }
    first_held_ = has_inside_;
    if (has_inside_) best_ = z;
    return true;
  }
  // Look for a force strictly inside that holds the first wrench.
  Deepest find_inside(Depth<D>& depth, const double* wrench, Field& z) {
    const Deepest deepest = depth.find(wrench, 1e-7, z);
    has_inside_ = deepest.code == CONVERGED;
    inside_load_ = 0.0;
    for (int i = 0; i < in_->count; ++i)
      for (int a = 0; a < D; ++a) inside_[i][a] = z[i][a] / unit_;
    return deepest;
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
  // True if the far load is held, by the force in z [N].
  bool holds_far_load(Field& z) {
    const Vec6 far = in_->out_of_unit(load_ + far_ * along_);
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
  DualSlack dual_slack(const Prices& at) const {
    DualSlack out;
    for (int i = 0; i < in_->count; ++i) {
      Tuple<double, D> dual{};
      for (int r = 0; r < 6; ++r) add(dual, at.y[r], in_->balance[r][i]);
      for (int k = 0; k < in_->limits; ++k) add(dual, at.limits[k], in_->limit[k][i]);
      const double here = slack(cone(dual));
      out.least = std::min(out.least, here);
      out.lacking -= std::min(here, 0.0);
    }
    return out;
  }
  // Lower the bound to that of the iterate's multipliers. If rounding left them outside the dual
  // cones, they are moved inside. Without multipliers inside there is no bound, unless it `pays`
  // for what they lack: then it holds for normal forces of up to FARTHEST times those of the
  // iterate.
  template <class R> void lower(const InteriorPoint<R, D, 1>& engine, bool pays = false) {
    in_->read_multipliers(engine, now_.limits, [&](int k) { return in_->row_scale(k, unit_); });
    Vec6 joint;
    for (int r = 0; r < 6; ++r) joint[r] = double(engine.at.joint[r]);
    now_.y = in_->solve_upper(joint);
    const DualSlack now = dual_slack(now_);
    if (now.least >= 0.0 || pays) {
      double most = 1.0;
      for (int i = 0; i < in_->count; ++i) most = std::max(most, double(engine.at.z[i][0]));
      bound_by(now_, now.lacking * in_->FARTHEST * most);
    }
    if (now.least > 0.0) {
      latest_ = now_;
      latest_.room = now.least;
    }
    if (now.least >= 0.0) return;
    for (const Prices* inside : {&of_limits_, &latest_}) {
      if (!(inside->room > 0.0)) continue;
      const double part = std::min(1.0, -1.01 * now.least / (inside->room - now.least));
      mixed_.y = now_.y + part * (inside->y - now_.y);
      for (int k = 0; k < in_->limits; ++k)
        mixed_.limits[k] = now_.limits[k] + part * (inside->limits[k] - now_.limits[k]);
      if (dual_slack(mixed_).least >= 0.0) bound_by(mixed_, 0.0);
    }
  }
  // Lower the bound to that of multipliers, plus what it pays.
  void bound_by(const Prices& prices, double paid) {
    const double per = dot(prices.y, along_);
    if (!(per > 0.0)) return;
    double bound = paid - dot(prices.y, load_) / unit_;
    for (int k = 0; k < in_->limits; ++k) bound += prices.limits[k] * in_->bound[k] / unit_;
    bound /= per;
    if (!(bound < high_)) return;
    high_ = bound;
    y_ = (1.0 / per) * prices.y;
    for (int k = 0; k < in_->limits; ++k) multipliers_[k] = prices.limits[k] / per;
  }
};

}  // namespace detail
}  // namespace grasp
