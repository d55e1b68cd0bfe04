// The exact problem within limits, in the registers: the least weighted sum of normal forces
// subject to balance, friction cones and rows (`conic/bounds.hpp`).
//
//     min sum_i c_i u_i  s.t.  G x = -w,  x_i in the cone,  A x + slack = b
//     max -w . y - b . z  s.t.  s_i = c_i e_u - G_i^T y + (A^T z)_i in the cone,  z >= 0
//
// Steps are those of conic.hpp. In the coordinates M^-1/2 dx of the scaling, a row of one contact
// is a rank-one change of the identity, and its factor is updated without a difference that
// cancels. Joint rows border the 6 x 6 system. The start may exceed the limits. If no force keeps
// them, y and z grow without bound and become the proof.
#pragma once
#include <grasp/conic/bounds.hpp>
#include <grasp/conic/steps.hpp>
#include <grasp/math/bordered.hpp>
#include <grasp/phi/descent.hpp>

namespace grasp {

template <class V, int B, int D = 3> class LimitedConic {
 public:
  using X = Vec<V, D>;
  using Field = typename Cones<V, B, D>::Field;
  Cones<V, B, D> cones;
  Field inside;  // a force strictly inside the cones: the start, or an internal force
  ConicLimits<V, B, D> limits;
  StopRule options;

  LimitedConic(int count, const StopRule& options)
      : cones(count), inside(cones.field()), options(options), force_(inside) {
    resize(at_, cones.blocks.size());
  }

  // Write the last iterate into the solver without limits.
  void store_iterate(ConicSteps<V, B>& to) const
    requires(D == 3)
  {
    for (int b = 0; b < blocks(); ++b) {
      to.at[b].x = at_[b].x;
      to.at[b].s = at_[b].s;
      to.at[b].first = at_[b].first;
      to.at[b].q = to.at[b].d = X{};
    }
    to.y = y_;
  }
  // Make solving free of allocations for up to this many rows.
  void reserve(int rows) {
    limits.reserve(cones, rows);
    system_.reserve(rows);
    joint_reduced_.reserve(std::size_t(rows) * at_.size());
  }

  // Solve for a wrench. balanced: `inside` balances it. CONVERGED: the record and `multipliers`
  // (one of each row) hold the optimum. INFEASIBLE: they hold the proof. Otherwise the record says
  // nothing.
  Code solve(const double* wrench, bool balanced, const Record& record, double* multipliers) {
    record.clear();
    Summary& out = record.summary();
    out.code = REFUSED;
    if (!is_valid_wrench(wrench) || !cones.is_in_range(inside) || !(cones.margin(inside) > 0.0))
      return REFUSED;
    std::copy(wrench, wrench + 6, out.wrench.begin());
    const Vec6 load = cones.unit.of(wrench);
    unit_ = std::max(size(load), -limits.least_bound());
    if (!(unit_ >= NOTHING)) return REFUSED;
    minus_ = (-1.0 / unit_) * load;
    limits.scale(unit_);
    start(balanced);
    int iterations = 0;
    const Code code = descend(record, iterations);
    if (code == CONVERGED) {
      limits.store(theta_, multipliers);
    } else if (code == INFEASIBLE) {
      const Vec6 twist = cones.unit.pull_back(-1.0 * y_);
      const double per = 1.0 / size(twist);
      limits.store(per, multipliers);
      record.refute(per * twist, size(load));
    }
    out.code = code;
    out.iterations = out.trials = iterations;
    return code;
  }

 private:
  static constexpr double STEP = 0.995;  // largest fraction of the way to the boundary
  // Start: smallest slack, of the largest force; largest multipliers together, of a contact's cost.
  static constexpr double FLOOR = 0.1, SHARE = 0.5;
  // Signs that no force keeps the limits: they are exceeded by this much of the wrench, and the
  // dual value is this many times the objective.
  static constexpr double EXCEEDED = 1e-3, LIKELY = 2.0;
  static constexpr double MIDDLE = 0.3;  // of the allowed gap: target of a settling step
  static constexpr int SETTLINGS = 3;
  static constexpr double KEPT = 1e-14;  // limits that are missed by less are kept

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
  Field force_;
  Bordered system_;
  std::vector<Tuple<V, D>> joint_reduced_;  // (joint rows, blocks), as `reduced`
  Vec6 minus_{}, y_{}, left_{};             // -w, and G x + w, in units of `unit_`
  double cost_ = 1.0;  // fraction of the cost in s; where no force keeps the limits, it is dropped
  double unit_ = 1.0, gap_ = 0.0, objective_ = 0.0, paid_ = 0.0, missed_ = 0.0, theta_ = 1.0;

  int blocks() const { return int(at_.size()); }
  double degree() const { return 2.0 * cones.count + limits.sides; }
  double dual_value() const { return dot(minus_, y_) - paid_; }
  template <class F> double along_joint(int j, F&& x) const {
    V total{};
    for (int b = 0; b < blocks(); ++b) total += dot(limits.column(j, b), x(b));
    return sum(total);
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
      row.begin(along_joint(j, [&](int b) { return at_[b].x; }), floor, mean, cheapest);
      for (int b = 0; b < blocks(); ++b) at_[b].s += all<V>(row.multiplier()) * limits.column(j, b);
    }
  }

  // Descend from the start. If the gap is closed while limits are still exceeded, since shortened
  // steps never kept them, settling steps follow.
  Code descend(const Record& record, int& iterations) {
    double goal = options.tolerance;
    int settled = 0;
    bool drops = false;
    for (;; ++iterations) {
      measure();
      bool settles = false;
      if (cost_ == 0.0 && proves_infeasible()) return INFEASIBLE;
      if (cost_ == 1.0 && gap_ <= goal * objective_) {
        const double gap = certify(record);
        if (gap <= options.tolerance) return CONVERGED;
        if (!(gap < infinity) && missed_ <= KEPT) return STALLED;  // balance has lost its digits
        settles = !(gap < infinity) && settled++ < SETTLINGS;
        if (!settles) goal *= 0.1;
        if (!(gap_ > 0.0) || goal < 1e-3 * options.tolerance) return STALLED;
      }
      if (iterations >= options.limit) return LIMIT;
      if (!factor()) return STALLED;
      const bool hopeless = missed_ > EXCEEDED && dual_value() > LIKELY * objective_;
      drops = hopeless && !drops;
      const double aim = std::max(gap_, MIDDLE * options.tolerance * objective_);
      if (!(drops || settles ? settle(aim, drops ? cost_ : 0.0) : step())) return STALLED;
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
      limits.joints[j].at(along_joint(j, [&](int b) { return at_[b].x; }));
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

  // Step with Mehrotra's corrector. Return false if it moves nothing.
  bool step() {
    forget_predictor();
    for (int b = 0; b < blocks(); ++b) at_[b].f = -(at_[b].root * at_[b].l);
    limits.each_side([](auto& side) { side.aim(0.0); });
    direct();
    const Ahead ahead = predict();
    const double after = gap_ + ahead.dual * ahead.cross - ahead.primal * (gap_ + ahead.cross) -
                         ahead.primal * ahead.dual * (ahead.cross + ahead.square);
    const double part = std::clamp(after / gap_, 0.0, 1.0);
    centre(part * part * part * gap_ / degree());
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

  // s from its equation, without the cost
  X dual_slack(int b) const {
    X q = -cones.blocks[b].transposed(y_);
    limits.each_own(b, [&](const auto& row) { q += row.multiplier() * row.a; });
    for (int j = 0; j < limits.joint_rows(); ++j)
      q += all<V>(limits.joints[j].multiplier()) * limits.column(j, b);
    return q;
  }
  // True if -y and the multipliers prove beyond rounding that no force keeps the limits: -G^T y +
  // A^T z lies in every cone, and -w . y > b . z.
  bool proves_infeasible() const {
    Sum multipliers, costs;
    limits.each_side([&](const auto& side) {
      multipliers.add(side.counted());
      costs.add(side.counted() * abs(side.bound));
    });
    const double terms = sum_of_sizes(y_) * size(minus_) + costs.value();
    if (!(dual_value() > PROOF_ROUNDING * (8 + limits.sides) * terms)) return false;
    V room = all<V>(infinity);
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      V lost = all<V>(multipliers.value());  // rows have length one
      for (int r = 0; r < 6; ++r)
        lost += std::abs(y_[r]) * (abs(c.g[r].u) + tangent_length(c.g[r]));
      const V inside = slack(dual_slack(b)) - SUM_ROUNDING * lost;
      room = min(room, select(c.mask > 0.0, inside, all<V>(infinity)));
    }
    return least(room) > 0.0;
  }

  // Write force and certificate. Return the gap; inf: the force is not within the limits.
  double certify(const Record& record) {
    Most outside(0.0);
    V per{}, objective{};
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      At& at = at_[b];
      at.d = at.x - c.least(left_);
      limits.each_own(b, [&](const auto& row) { outside.add(row.outside(dot(row.a, at.d))); });
      const X safe = axis<D>(c.cost);
      const X toward = dual_slack(b);
      const V beyond = c.mask * Boundary(safe).per(toward);
      per = max(per, select(slack(safe + toward) >= 0.0, V{}, beyond));
      objective += c.mask * c.cost * at.d.u;
      force_[b] = all<V>(unit_) * at.first;
    }
    for (int j = 0; j < limits.joint_rows(); ++j)
      outside.add(limits.joints[j].outside(along_joint(j, [&](int b) { return at_[b].d; })));
    cones.store_force(force_, record.initial_force());
    for (int b = 0; b < blocks(); ++b) force_[b] = at_[b].d;
    // in units of the wrench: squares of tiny forces would be zero
    const Vec6 load = -1.0 * minus_;
    const double margin = cones.margin(force_);
    const double residual = cones.residual(force_, load);
    const bool balanced = cones.balanced(force_, load, residual);
    for (auto& x : force_) x = all<V>(unit_) * x;
    cones.store_force(force_, record.force());
    cones.store_torsion(force_, record.torsion());
    const double steepest = largest(per);
    theta_ = steepest > 1.0 ? 1.0 / steepest : 1.0;
    Summary& out = record.summary();
    out.margin = unit_ * margin;
    out.residual = unit_ * residual;
    out.objective = unit_ * sum(objective);
    out.lower_bound = std::max(0.0, theta_ * unit_ * dual_value());
    out.multipliers = cones.unit.pull_back(theta_ * y_);
    const bool good =
        !(outside.value() > 0.0) && margin >= 0.0 && out.lower_bound > 0.0 && balanced;
    return good ? (out.objective - out.lower_bound) / out.lower_bound : infinity;
  }
};

}  // namespace grasp
