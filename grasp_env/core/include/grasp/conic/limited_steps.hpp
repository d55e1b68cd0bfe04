// The steps of the exact problem within limits (conic/limited.hpp), in the registers.
//
// Steps are those of conic.hpp. The start may exceed the limits. Where torques are minimised, s
// begins with a cost of normal forces, which the steps drop.
#pragma once
#include <grasp/conic/limited_system.hpp>

namespace grasp {

template <class V, int B, int D, Criterion C> class LimitedSteps
    : public LimitedSystem<V, B, D, C> {
 public:
  using System = LimitedSystem<V, B, D, C>;
  using System::cones, System::limits, System::torques;
  using System::OF_LARGEST, System::OF_TORQUES;
  using typename System::Field;
  using typename System::X;
  Field inside;  // a force strictly inside the cones: the start, or an internal force

  explicit LimitedSteps(int count) : System(count), inside(cones.field()) {}

 protected:
  using System::at_, System::left_, System::dt_, System::priced_, System::preloads_;
  using System::blocks, System::each_row, System::factor, System::direct;
  using typename System::At;
  // A sum, or the largest value, over contacts and joint rows.
  struct Sum {
    V lanes{};
    double rest = 0.0;
    void add(const V& a) { lanes += a; }
    void add(double a) { rest += a; }
    double value() const { return sum(lanes) + rest; }
  };
  struct Most {
    V lanes;
    double rest;
    explicit Most(double least) : lanes(all<V>(least)), rest(least) {}
    void add(const V& a) { lanes = max(lanes, a); }
    void add(double a) { rest = std::max(rest, a); }
    double value() const { return std::max(largest(lanes), rest); }
  };
  Vec6 minus_{}, y_{};  // -w, in units of `unit_`
  double cost_ = 1.0;   // fraction of the cost in s; where no force keeps the limits, it is dropped
  double unit_ = 1.0, gap_ = 0.0, objective_ = 0.0, paid_ = 0.0, missed_ = 0.0;
  double t_ = 0.0;  // at least every c u, in units of `unit_`

  double degree() const { return 2.0 * cones.count + limits.sides; }
  double dual_value() const { return dot(minus_, y_) - paid_; }

  // Row of one contact times x and the shared variable.
  template <class Row> V along(const Row& row, const X& x, double t) const {
    const V out = dot(row.a, x);
    if constexpr (std::tuple_size_v<decltype(row.share)> > 0) return out + all<V>(t) * row.share[0];
    return out;
  }

  // c u of the largest normal force, with its preload.
  V price(int b, const X& x) const {
    return cones.blocks[b].mask * cones.blocks[b].cost * (x.u - limits.added(b).high.bound);
  }

  // x = inside, or -G^+ w + k inside; multipliers small enough for s
  void start(bool balanced) {
    V squeeze = all<V>(1e-6);
    for (int b = 0; b < blocks(); ++b) {
      at_[b].x = balanced ? X{} : cones.blocks[b].least(minus_);
      squeeze = max(squeeze, -slack(at_[b].x) / slack(inside[b]));
    }
    const V k = all<V>(balanced ? 1.0 / unit_ : 1.3 * largest(squeeze));
    V most{}, product{};
    V least_cost = all<V>(infinity);
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      At& at = at_[b];
      at.first = at.x += k * inside[b];
      most = max(most, c.mask * at.x.u);
      product += c.mask * c.cost * at.x.u;
      least_cost = min(least_cost, select(c.mask > 0.0, c.cost, all<V>(infinity)));
    }
    y_ = {};
    cost_ = 1.0;
    if constexpr (OF_TORQUES) {
      torques.scale(unit_);
      torques.each_side([](auto& side) { side.forget(); });
      cost_ = LENT * torque_square([&](int b) { return at_[b].x; }) / sum(product);
    }
    const double part = OF_LARGEST ? 1.0 / cones.count : cost_;
    const double mean = part * sum(product) / cones.count;
    const double floor = FLOOR * largest(most);
    const double share = part * SHARE / std::max(1, limits.sides);
    const double cheapest = share * least(least_cost);
    if constexpr (OF_LARGEST) {
      V dearest{};
      for (int b = 0; b < blocks(); ++b) {
        auto& side = limits.added(b).high;
        side.bound = (-1.0 / unit_) * preloads_[b];
        dearest = max(dearest, price(b, at_[b].x));
      }
      t_ = ABOVE * largest(dearest);
    }
    for (int b = 0; b < blocks(); ++b) {
      At& at = at_[b];
      const V& c = cones.blocks[b].cost;
      at.s = axis<D>(part * c);
      limits.each_own(b, [&](auto& row) {
        row.begin(along(row, at.x, t_), all<V>(floor), all<V>(mean), share * c);
        if constexpr (!OF_LARGEST) at.s += row.multiplier() * row.a;
      });
      if constexpr (OF_LARGEST) {
        limits.added(b).high.multiplier = part * c;
        limits.each_given(b, [&](const auto& row) { at.s += row.multiplier() * row.a; });
      }
    }
    for (int j = 0; j < limits.joint_rows(); ++j) {
      auto& row = limits.joints[j];
      row.begin(limits.along(j, [&](int b) { return at_[b].x; }), floor, mean, cheapest);
      for (int b = 0; b < blocks(); ++b) at_[b].s += all<V>(row.multiplier()) * limits.column(j, b);
    }
  }

  // Square of the joint torques at x(b), the forces of block b.
  template <class F> double torque_square(F&& x) const {
    Sum square;
    if constexpr (OF_TORQUES) {
      for (int b = 0; b < blocks(); ++b)
        torques.each_own(b, [&](const auto& row) {
          const V off = dot(row.a, x(b)) - row.bound;
          square.add(row.weight * off * off);
        });
      for (int j = 0; j < torques.joint_rows(); ++j) {
        const double off = torques.along(j, x) - torques.joints[j].bound;
        square.add(torques.joints[j].weight * off * off);
      }
    }
    return square.value();
  }

  // Residuals of the iterate, its gap and objective.
  void measure() {
    V total[6] = {}, objective{}, priced{};
    Sum gap, paid;
    Most missed(0.0);
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      At& at = at_[b];
      c.add_wrench(at.x, total);
      gap.add(c.mask * dot(at.x, at.s));
      objective += c.mask * c.cost * at.x.u;
      each_row(b, [&](auto& row) { row.at(along(row, at.x, t_)); });
      if constexpr (OF_LARGEST) priced += limits.added(b).high.counted() / c.cost;
    }
    const auto force = [&](int b) -> const X& { return at_[b].x; };
    for (int j = 0; j < limits.joint_rows(); ++j) limits.joints[j].at(limits.along(j, force));
    if constexpr (OF_TORQUES)
      for (int j = 0; j < torques.joint_rows(); ++j) torques.joints[j].at(torques.along(j, force));
    limits.each_side([&](const auto& side) {
      gap.add(side.counted() * side.slack);
      paid.add(side.counted() * side.bound);
      missed.add(abs(side.missed));
    });
    left_ = sums(total) - minus_;
    gap_ = gap.value();
    priced_ = cost_ - sum(priced);
    objective_ = OF_LARGEST ? t_ : OF_TORQUES ? torque_square(force) : sum(objective);
    if constexpr (OF_TORQUES)
      torques.each_side([&](const auto& side) { paid.add(side.multiplier * side.bound); });
    paid_ = paid.value();
    missed_ = missed.value();
  }

  // Step with Mehrotra's corrector, to no smaller gap than `least`. Return false if it moves
  // nothing.
  bool step(double least = 0.0) {
    forget_predictor();
    for (int b = 0; b < blocks(); ++b) at_[b].f = -(at_[b].root * at_[b].l);
    limits.each_side([](auto& side) { side.aim(0.0); });
    drop(fading());
    direct(fading());
    const Ahead ahead = predict();
    const double after = gap_ + ahead.dual * ahead.cross - ahead.primal * (gap_ + ahead.cross) -
                         ahead.primal * ahead.dual * (ahead.cross + ahead.square);
    const double part = std::clamp(after / gap_, 0.0, 1.0);
    centre(std::max(part * part * part * gap_, least) / degree());
    drop(fading());
    return move(0.9 + (STEP - 0.9) * std::min(ahead.dual, ahead.primal), fading());
  }
  // Step to this gap without a predictor, so that a whole step stays inside and keeps every row.
  // dropped: cost that s loses in a whole step, of the multipliers alone.
  bool settle(double gap, double dropped) {
    forget_predictor();
    centre(gap / degree());
    if (dropped > 0.0) {
      left_ = {};
      limits.each_side([](auto& side) { side.forgive(); });
    }
    drop(dropped + fading());
    return move(STEP, dropped + fading(), dropped > 0.0);
  }
  // Cost that every step drops.
  double fading() const { return OF_TORQUES ? cost_ : 0.0; }
  // Let the right-hand sides account for a cost that s loses.
  void drop(double dropped) {
    for (int b = 0; b < blocks() && dropped > 0.0; ++b) {
      const auto& c = cones.blocks[b];
      at_[b].f += at_[b].rooted(axis<D>(dropped * c.mask * c.cost));
    }
  }
  void forget_predictor() {
    for (auto& at : at_) at.e = X{};
    limits.each_side([](auto& side) { side.stay(); });
  }

  // Longest steps of the predictor, and its terms x . ds and ds . M ds.
  struct Ahead {
    double primal, dual, cross, square;
  };
  Ahead predict() {
    Most primal(1.0), dual(1.0);
    Sum cross, square;
    for (int b = 0; b < blocks(); ++b) {
      At& at = at_[b];
      at.e = at.m.scaled(at.ds);
      const auto way = at.boundary().way(at.e);
      dual.add(way.away - way.along);
      primal.add(1.0 + way.away + way.along);
      const V part = cones.blocks[b].mask * at.m.eta;
      cross.add(part * dot(at.l, at.e));
      square.add(part * dot(at.e, at.e));
    }
    limits.each_side([&](const auto& side) {
      const auto ratio = side.dmultiplier * side.per_multiplier;
      primal.add(1.0 + ratio);
      dual.add(-ratio);
      cross.add(side.dmultiplier * side.slack);
      square.add(ratio * side.dmultiplier * side.slack);
    });
    return {1.0 / primal.value(), 1.0 / dual.value(), cross.value(), square.value()};
  }

  // Right-hand sides towards products of `target`, with the second-order terms of the predictor.
  void centre(double target) {
    for (int b = 0; b < blocks(); ++b) {
      At& at = at_[b];
      const V square = at.m.root * at.m.root;
      const X d = corrector(at.l, at.e, target / at.m.eta, square, at.l0);
      at.d = cones.blocks[b].mask * (d - at.l);  // unused lanes do not move
      at.f = at.root * at.d;
    }
    limits.each_side([&](auto& side) { side.aim(target); });
  }

  // Take the step, at most `reach` of the way to the boundary. dual_alone: the multipliers alone.
  // Return false if it moves nothing.
  bool move(double reach, double dropped, bool dual_alone = false) {
    const Vec6 dy = direct(dropped);
    Most primal(reach), dual(reach);
    for (int b = 0; b < blocks(); ++b) {
      const At& at = at_[b];
      const X e = at.m.scaled(at.ds);
      const Boundary<V, D> edge = at.boundary();
      dual.add(edge.per(e));
      primal.add(edge.per(at.d - e));
    }
    limits.each_side([&](const auto& side) {
      primal.add(-side.dslack * side.per_slack);
      dual.add(-side.dmultiplier * side.per_multiplier);
    });
    const double along = dual_alone ? 0.0 : reach / primal.value();
    const double up = reach / dual.value();
    if (!(along + up > 1e-6)) return dual_alone;
    y_ = y_ + up * dy;
    cost_ -= up * dropped;
    t_ += along * dt_;
    if constexpr (OF_TORQUES)
      torques.each_side([&](auto& side) { side.multiplier += up * side.dmultiplier; });
    for (auto& at : at_) {
      at.x += all<V>(along) * at.dx;
      at.s += all<V>(up) * at.ds;
    }
    limits.each_side([&](auto& side) {
      side.slack += along * side.dslack;
      side.multiplier += up * side.dmultiplier;
    });
    return true;
  }

 private:
  static constexpr double STEP = 0.995;  // largest fraction of the way to the boundary
  // Start: smallest slack, of the largest force; largest multipliers together, of a contact's cost.
  static constexpr double FLOOR = 0.1, SHARE = 0.5;
  // Cost of normal forces that the torques begin with, of the square of the torques. A larger one
  // is not dropped in time, a smaller one begins too near to the boundary.
  static constexpr double LENT = 0.1;
  static constexpr double ABOVE = 1.2;  // times the largest normal force of the start: its t
};

}  // namespace grasp
