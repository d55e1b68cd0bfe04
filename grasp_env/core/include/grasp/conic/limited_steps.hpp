// The steps of the exact problem within limits (conic/limited.hpp), in the registers.
//
// Steps are those of conic.hpp. In the coordinates M^-1/2 dx of the scaling, a row of one contact
// is a rank-one change of the identity, and its factor is updated without a difference that
// cancels. Joint rows border the 6 x 6 system. The start may exceed the limits.
#pragma once
#include <grasp/conic/bounds.hpp>
#include <grasp/conic/steps.hpp>
#include <grasp/math/bordered.hpp>

namespace grasp {

template <class V, int B, int D> class LimitedSteps {
 public:
  using X = Vec<V, D>;
  using Field = typename Cones<V, B, D>::Field;
  Cones<V, B, D> cones;
  Field inside;  // a force strictly inside the cones: the start, or an internal force
  ConicLimits<V, B, D> limits;

  explicit LimitedSteps(int count) : cones(count), inside(cones.field()) {
    resize(at_, cones.blocks.size());
  }
  // Make solving free of allocations for up to this many rows.
  void reserve(int rows) {
    limits.reserve(cones, rows);
    system_.reserve(rows);
    joint_reduced_.reserve(std::size_t(rows) * at_.size());
  }

 protected:
  struct At {
    X x, s;  // primal and dual slack
    Scaling<V, D> m;
    V root;                  // sqrt(eta): M^1/2 = root * m.scaled
    X l, e, d;               // scaled point, dual direction and right-hand side
    V share, l0;             // share of the `Boundary` at l; 1 / l_0
    X f;                     // right-hand side of M^-1/2 dx
    X dx, ds;                // the step
    RowBlock<V, D> block;    // I + M^1/2 (sum bend a a^T) M^1/2, factored
    Tuple<V, D> reduced[6];  // L^-1 M^1/2 g for the rows g of G
    Tuple<V, D> z;           // D^-1 L^-1 of the right-hand side
    X first;                 // first x, for the record

    Boundary<V, D> boundary() const { return {l, m.root, share}; }
    X rooted(const X& a) const { return root * m.scaled(a); }
  };
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
  Blocks<At, B> at_;
  Vec6 minus_{}, y_{}, left_{};  // -w, and G x + w, in units of `unit_`
  double cost_ = 1.0;  // fraction of the cost in s; where no force keeps the limits, it is dropped
  double unit_ = 1.0, gap_ = 0.0, objective_ = 0.0, paid_ = 0.0, missed_ = 0.0;

  int blocks() const { return int(at_.size()); }
  double degree() const { return 2.0 * cones.count + limits.sides; }
  double dual_value() const { return dot(minus_, y_) - paid_; }

  // x = inside, or -G^+ w + k inside; multipliers small enough for s
  void start(bool balanced) {
    V squeeze = all<V>(1e-6);
    for (int b = 0; b < blocks(); ++b) {
      at_[b].x = balanced ? X{} : cones.blocks[b].least(minus_);
      squeeze = max(squeeze, -slack(at_[b].x) / slack(inside[b]));
    }
    const V k = all<V>(balanced ? 1.0 / unit_ : 1.3 * largest(squeeze));
    V most{}, product{};
    V price = all<V>(infinity);
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      At& at = at_[b];
      at.first = at.x += k * inside[b];
      at.s = axis<D>(c.cost);
      most = max(most, c.mask * at.x.u);
      product += c.mask * c.cost * at.x.u;
      price = min(price, select(c.mask > 0.0, c.cost, all<V>(infinity)));
    }
    y_ = {};
    cost_ = 1.0;
    const double mean = sum(product) / cones.count;
    const double floor = FLOOR * largest(most);
    const double share = SHARE / std::max(1, limits.sides);
    const double cheapest = share * least(price);
    for (int b = 0; b < blocks(); ++b) {
      At& at = at_[b];
      limits.each_own(b, [&](auto& row) {
        row.begin(dot(row.a, at.x), all<V>(floor), all<V>(mean), share * cones.blocks[b].cost);
        at.s += row.multiplier() * row.a;
      });
    }
    for (int j = 0; j < limits.joint_rows(); ++j) {
      auto& row = limits.joints[j];
      row.begin(limits.along(j, [&](int b) { return at_[b].x; }), floor, mean, cheapest);
      for (int b = 0; b < blocks(); ++b) at_[b].s += all<V>(row.multiplier()) * limits.column(j, b);
    }
  }

  // Residuals of the iterate, its gap and objective.
  void measure() {
    V total[6] = {}, objective{};
    Sum gap, paid;
    Most missed(0.0);
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      At& at = at_[b];
      c.add_wrench(at.x, total);
      gap.add(c.mask * dot(at.x, at.s));
      objective += c.mask * c.cost * at.x.u;
      limits.each_own(b, [&](auto& row) { row.at(dot(row.a, at.x)); });
    }
    for (int j = 0; j < limits.joint_rows(); ++j)
      limits.joints[j].at(limits.along(j, [&](int b) { return at_[b].x; }));
    limits.each_side([&](const auto& side) {
      gap.add(side.counted() * side.slack);
      paid.add(side.counted() * side.bound);
      missed.add(abs(side.missed));
    });
    left_ = sums(total) - minus_;
    gap_ = gap.value();
    objective_ = sum(objective);
    paid_ = paid.value();
    missed_ = missed.value();
  }

  // Factor the system. Return false if it is not positive definite in floating point.
  bool factor() {
    V s[21] = {};
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      At& at = at_[b];
      at.m = Scaling<V, D>(at.x, at.s);
      at.root = sqrt(at.m.eta);
      at.l = at.m.scaled(at.s);
      const V n = at.l.u * at.m.root + 1.0;
      const V both = 1.0 / (n * at.l.u);  // one division for two
      at.share = both * at.l.u;
      at.l0 = both * n;
      RowBlock<V, D> block;
      limits.each_own(
          b, [&](auto& row) { row.update = block.update(tuple(at.rooted(row.a)), {}, row.bend); });
      block.finish();
      at.block = block;
#pragma GCC unroll 8
      for (int r = 0; r < 6; ++r) {
        at.reduced[r] = block.forward(tuple(at.rooted(c.g[r])));
        const Tuple<V, D> weighed = block.weighed(at.reduced[r]);
#pragma GCC unroll 8
        for (int k = 0; k <= r; ++k) s[packed(r, k)] += inner(weighed, at.reduced[k]);
      }
    }
    Packed6 lower;
#pragma GCC unroll 32
    for (int k = 0; k < 21; ++k) lower[k] = sum(s[k]);
    border();
    return system_.factor(lower);
  }
  Tuple<V, D>& joint_reduced(int j, int b) { return joint_reduced_[std::size_t(blocks()) * j + b]; }
  void border() {
    const int joint = limits.joint_rows();
    system_.resize(joint);
    joint_reduced_.resize(std::size_t(joint) * blocks());
    for (int j = 0; j < joint; ++j) {
      V side[6] = {};
      for (int b = 0; b < blocks(); ++b) {
        const At& at = at_[b];
        joint_reduced(j, b) = at.block.forward(tuple(at.rooted(limits.column(j, b))));
        const Tuple<V, D> weighed = at.block.weighed(joint_reduced(j, b));
        for (int r = 0; r < 6; ++r) side[r] += inner(weighed, at.reduced[r]);
      }
      for (int r = 0; r < 6; ++r) system_(6 + j, r) = sum(side[r]);
      for (int k = 0; k <= j; ++k) {
        V total{};
        for (int b = 0; b < blocks(); ++b)
          total += inner(at_[b].block.weighed(joint_reduced(j, b)), joint_reduced(k, b));
        system_(6 + j, 6 + k) = sum(total);
      }
      system_(6 + j, 6 + j) += 1.0 / limits.joints[j].bend;
    }
  }

  // Solve for the right-hand sides f, the rows' rates and the residuals: dx, ds and the rows'
  // steps. dropped: cost that s loses. Return dy.
  Vec6 direct(double dropped = 0.0) {
    const int joint = limits.joint_rows();
    V pull[6] = {};
    for (int b = 0; b < blocks(); ++b) {
      At& at = at_[b];
      at.z = tuple(at.f);
      limits.each_own(b, [&](auto& row) {
        row.take_rates();
        row.update.forward(at.z, row.right);
      });
      for (int r = 0; r < 6; ++r) pull[r] += inner(at.reduced[r], at.z);
    }
    const Vec6 pulled = sums(pull);
    for (int r = 0; r < 6; ++r) system_[r] = -pulled[r] - left_[r];
    for (int j = 0; j < joint; ++j) {
      V total{};
      for (int b = 0; b < blocks(); ++b) total += inner(joint_reduced(j, b), at_[b].z);
      limits.joints[j].take_rates();
      system_[6 + j] = limits.joints[j].right - sum(total);
    }
    system_.solve();
    Vec6 dy;
    for (int r = 0; r < 6; ++r) dy[r] = system_[r];
    for (int j = 0; j < joint; ++j) limits.joints[j].step(-system_[6 + j] / limits.joints[j].bend);
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      At& at = at_[b];
      X back = c.transposed(dy);
      for (int j = 0; j < joint; ++j) back += all<V>(system_[6 + j]) * limits.column(j, b);
      Tuple<V, D> z = tuple(at.f + at.rooted(back));
      limits.each_own(b, [&](auto& row) { row.left = -row.update.forward(z, row.right); });
      at.block.backward(z);
      at.dx = c.mask * at.rooted(cone(z));
      at.ds = -back;
      at.ds.u -= dropped * c.cost;
      Tuple<V, D> rest{};
      limits.each_own_back(b, [&](auto& row) {
        row.step(row.update.backward(rest, row.left));
        at.ds += row.change() * row.a;
      });
      at.ds = c.mask * at.ds;
    }
    return dy;
  }

  // Step with Mehrotra's corrector, to no smaller gap than `least`. Return false if it moves
  // nothing.
  bool step(double least = 0.0) {
    forget_predictor();
    for (int b = 0; b < blocks(); ++b) at_[b].f = -(at_[b].root * at_[b].l);
    limits.each_side([](auto& side) { side.aim(0.0); });
    direct();
    const Ahead ahead = predict();
    const double after = gap_ + ahead.dual * ahead.cross - ahead.primal * (gap_ + ahead.cross) -
                         ahead.primal * ahead.dual * (ahead.cross + ahead.square);
    const double part = std::clamp(after / gap_, 0.0, 1.0);
    centre(std::max(part * part * part * gap_, least) / degree());
    return move(0.9 + (STEP - 0.9) * std::min(ahead.dual, ahead.primal));
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
    for (int b = 0; b < blocks() && dropped > 0.0; ++b) {
      const auto& c = cones.blocks[b];
      at_[b].f += at_[b].rooted(axis<D>(dropped * c.mask * c.cost));
    }
    return move(STEP, dropped);
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

  // Take the step, at most `reach` of the way to the boundary. Return false if it moves nothing.
  bool move(double reach, double dropped = 0.0) {
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
    const double along = dropped > 0.0 ? 0.0 : reach / primal.value();
    const double up = reach / dual.value();
    if (!(along + up > 1e-6)) return dropped > 0.0;
    y_ = y_ + up * dy;
    cost_ -= up * dropped;
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
  Bordered system_;
  std::vector<Tuple<V, D>> joint_reduced_;  // (joint rows, blocks), as `reduced`
};

}  // namespace grasp
