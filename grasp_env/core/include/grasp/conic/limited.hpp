// The exact problem within limits, in the registers: the least weighted sum of normal forces
// subject to balance, friction cones and rows (`conic/bounds.hpp`).
//
//     min sum_i c_i u_i  s.t.  G x = -w,  x_i in the cone,  A x + slack = b
//     max -w . y - b . z  s.t.  s_i = c_i e_u - G_i^T y + (A^T z)_i in the cone,  z >= 0
//
// If no force keeps the limits, y and z grow without bound and become the proof. Other criteria
// have the same steps (`conic/limited_steps.hpp`) and a bound of their own.
#pragma once
#include <grasp/conic/limited_steps.hpp>
#include <grasp/phi/descent.hpp>

namespace grasp {

template <class V, int B, int D = 3, Criterion C = Criterion::sum> class LimitedConic
    : public LimitedSteps<V, B, D, C> {
 public:
  using Steps = LimitedSteps<V, B, D, C>;
  using Steps::cones, Steps::inside, Steps::limits;
  using typename Steps::Field;
  using typename Steps::X;
  StopRule options;

  LimitedConic(int count, const StopRule& options)
      : Steps(count), options(options), force_(inside) {}

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

  // Solve for a wrench. balanced: `inside` balances it. CONVERGED: the record and `multipliers`
  // (one of each row) hold the optimum. INFEASIBLE, of the sum alone: they hold the proof.
  // Otherwise the record says nothing.
  Code solve(const double* wrench, bool balanced, const Record& record, double* multipliers) {
    if (!begin(wrench, balanced, 0.0, record)) return REFUSED;
    int iterations = 0;
    const Code code = descend(record, iterations);
    if (code == CONVERGED) limits.store(theta_, multipliers);
    return conclude(code, iterations, record, multipliers);
  }
  // Find a force x strictly inside cones and limits, near the central path, where slacks times
  // multipliers are `product`. Return CONVERGED, INFEASIBLE with the proof as `solve`, or another
  // code if neither is found.
  Code centre(const double* wrench, bool balanced, double product, Field& x, const Record& record,
              double* multipliers) {
    if (!begin(wrench, balanced, product, record)) return REFUSED;
    int iterations = 0;
    const Code code = approach(product / unit_ * this->degree(), x, iterations);
    return conclude(code, iterations, record, multipliers);
  }

 private:
  using Steps::at_, Steps::minus_, Steps::y_, Steps::left_, Steps::cost_, Steps::unit_, Steps::gap_,
      Steps::objective_, Steps::missed_;
  using Steps::blocks, Steps::dual_value, Steps::measure, Steps::factor, Steps::step, Steps::settle;
  using typename Steps::At;
  using typename Steps::Most;
  using typename Steps::Sum;
  // Signs that no force keeps the limits: they are exceeded by this much of the wrench, and the
  // dual value is this many times the objective.
  static constexpr double EXCEEDED = 1e-3, LIKELY = 2.0;
  static constexpr double MIDDLE = 0.3;  // of the allowed gap: target of a settling step
  static constexpr int SETTLINGS = 3;
  static constexpr double KEPT = 1e-14;  // limits that are missed by less are kept
  static constexpr double NEAR = 1.5;    // times the gap on the central path: near enough
  Field force_;
  double theta_ = 1.0;

  // Load a wrench and go to the start. Return false if there is none.
  bool begin(const double* wrench, bool balanced, double least_unit, const Record& record) {
    record.clear();
    Summary& out = record.summary();
    out.code = REFUSED;
    if (!is_valid_wrench(wrench) || !cones.is_in_range(inside) || !(cones.margin(inside) > 0.0))
      return false;
    std::copy(wrench, wrench + 6, out.wrench.begin());
    const Vec6 load = cones.unit.of(wrench);
    unit_ = std::max({size(load), -limits.least_bound(), least_unit});
    if (!(unit_ >= NOTHING)) return false;
    minus_ = (-1.0 / unit_) * load;
    limits.scale(unit_);
    this->start(balanced);
    return true;
  }
  Code conclude(Code code, int iterations, const Record& record, double* multipliers) const {
    Summary& out = record.summary();
    if (code == INFEASIBLE) {
      const Vec6 twist = cones.unit.pull_back(-1.0 * y_);
      const double per = 1.0 / size(twist);
      limits.store(per, multipliers);
      record.refute(per * twist, size(cones.unit.of(out.wrench.data())));
    }
    out.code = code;
    out.iterations = out.trials = iterations;
    return code;
  }

  // Descend from the start. If the gap is closed while limits are still exceeded, since shortened
  // steps never kept them, settling steps follow. Only the sum proves that there is no force: its
  // multipliers are the simplest.
  Code descend(const Record& record, int& iterations) {
    double goal = options.tolerance;
    int settled = 0;
    bool drops = false;
    for (;; ++iterations) {
      measure();
      bool settles = false;
      if (C == Criterion::sum && cost_ == 0.0 && proves_infeasible()) return INFEASIBLE;
      if ((cost_ == 1.0 || Steps::OF_TORQUES) && gap_ <= goal * objective_) {
        const double gap = certify(record);
        if (gap <= options.tolerance) return CONVERGED;
        const bool kept = missed_ <= KEPT && (cost_ == 1.0 || cost_ == 0.0);
        if (!(gap < infinity) && kept) return STALLED;  // balance has lost its digits
        settles = !(gap < infinity) && settled++ < SETTLINGS;
        if (!settles) goal *= 0.1;
        if (!(gap_ > 0.0) || goal < 1e-3 * options.tolerance) return STALLED;
      }
      if (iterations >= options.limit) return LIMIT;
      if (!factor()) return STALLED;
      drops = is_hopeless() && !drops;
      if (drops && C != Criterion::sum) return UNDECIDED;
      const double aim = std::max(gap_, MIDDLE * options.tolerance * objective_);
      if (!(drops || settles ? settle(aim, drops ? cost_ : 0.0) : step())) return STALLED;
    }
  }
  bool is_hopeless() const { return missed_ > EXCEEDED && dual_value() > LIKELY * objective_; }
  // The same towards the point of the central path with this gap. If settling there does not lead
  // inside the limits, steps go on towards the optimum or the proof.
  Code approach(double target, Field& x, int& iterations) {
    int settled = 0;
    bool drops = false;
    for (;; ++iterations) {
      measure();
      const bool near = gap_ <= NEAR * target;
      if (cost_ == 0.0 && proves_infeasible()) return INFEASIBLE;
      if (cost_ == 1.0 && near && is_inside(x)) return CONVERGED;
      if (iterations >= options.limit) return LIMIT;
      if (!factor()) return STALLED;
      drops = is_hopeless() && !drops;
      const bool settles = near && (missed_ <= EXCEEDED || settled++ < SETTLINGS);
      const bool moved = drops     ? settle(gap_, cost_)
                         : settles ? settle(target, 0.0)
                                   : step(near ? 0.0 : target);
      if (!moved) return STALLED;
    }
  }
  // Write the balanced force at the iterate into x. Return true if it is strictly inside.
  bool is_inside(Field& x) const {
    if (!(missed_ <= EXCEEDED)) return false;
    Most outside(-infinity);
    for (int b = 0; b < blocks(); ++b) {
      x[b] = at_[b].x - cones.blocks[b].least(left_);
      each_limit(b, [&](const auto& row) { outside.add(row.outside(dot(row.a, x[b]))); });
    }
    for (int j = 0; j < limits.joint_rows(); ++j)
      outside.add(limits.joints[j].outside(limits.along(j, [&](int b) { return x[b]; })));
    for (auto& force : x) force = all<V>(unit_) * force;
    return outside.value() < 0.0 && cones.margin(x) > 0.0;
  }

  // Call f(row) for the limits of the contacts in block b.
  template <class F> void each_limit(int b, F&& f) const {
    if constexpr (Steps::OF_LARGEST)
      limits.each_given(b, f);
    else
      limits.each_own(b, f);
  }
  // s from its equation, without the cost and the rows of t
  X dual_slack(int b) const {
    X q = -cones.blocks[b].transposed(y_);
    each_limit(b, [&](const auto& row) { q += row.multiplier() * row.a; });
    for (int j = 0; j < limits.joint_rows(); ++j)
      q += all<V>(limits.joints[j].multiplier()) * limits.column(j, b);
    if constexpr (Steps::OF_TORQUES) {
      this->torques.each_own(b, [&](const auto& row) { q += row.multiplier * row.a; });
      for (int j = 0; j < this->torques.joint_rows(); ++j)
        q += all<V>(this->torques.joints[j].multiplier) * this->torques.column(j, b);
    }
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

  // Write force and certificate. Return the gap; inf: the force is not within the limits, or the
  // multipliers prove nothing.
  double certify(const Record& record) {
    Most outside(0.0), most(0.0);
    V objective{};
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      At& at = at_[b];
      at.d = at.x - c.least(left_);
      each_limit(b, [&](const auto& row) { outside.add(row.outside(dot(row.a, at.d))); });
      objective += c.mask * c.cost * at.d.u;
      if constexpr (Steps::OF_LARGEST) most.add(this->price(b, at.d));
      force_[b] = all<V>(unit_) * at.first;
    }
    const auto force = [&](int b) -> const X& { return at_[b].d; };
    for (int j = 0; j < limits.joint_rows(); ++j)
      outside.add(limits.joints[j].outside(limits.along(j, force)));
    const double value = Steps::OF_LARGEST   ? most.value()
                         : Steps::OF_TORQUES ? std::sqrt(this->torque_square(force))
                                             : sum(objective);
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
    const double bound = lower_bound();
    Summary& out = record.summary();
    out.margin = unit_ * margin;
    out.residual = unit_ * residual;
    out.objective = unit_ * value;
    out.lower_bound = std::max(0.0, unit_ * bound);
    out.multipliers = cones.unit.pull_back(theta_ * y_);
    const bool good =
        !(outside.value() > 0.0) && margin >= 0.0 && out.lower_bound > 0.0 && balanced;
    return good ? (out.objective - out.lower_bound) / out.lower_bound : infinity;
  }
  // Scale the multipliers by theta so that they bound the objective. Return the bound; -inf: they
  // prove nothing.
  double lower_bound() {
    if constexpr (Steps::OF_LARGEST) return bound_of_largest();
    if constexpr (Steps::OF_TORQUES) return bound_of_torques();
    V per{};
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      const X safe = axis<D>(c.cost);
      const X toward = dual_slack(b);
      const V beyond = c.mask * Boundary(safe).per(toward);
      per = max(per, select(slack(safe + toward) >= 0.0, V{}, beyond));
    }
    theta_ = 1.0 / std::max(1.0, largest(per));
    return theta_ * dual_value();
  }
  // The rows of t get the least multipliers that take the dual slacks into their cones. The shares
  // of t add up to one: what is left goes to the largest preload.
  double bound_of_largest()
    requires(Steps::OF_LARGEST)
  {
    V shares{}, paid{}, preload{};
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      const auto& side = limits.added(b).high;
      const V needed = c.mask * max(V{}, -slack(dual_slack(b)));
      shares += needed / c.cost;
      paid += (needed - side.counted()) * side.bound;
      preload = max(preload, -c.cost * side.bound);
    }
    const double share = sum(shares);
    theta_ = 1.0 / std::max(1.0, share);
    return theta_ * (dual_value() - sum(paid)) + (1.0 - theta_ * share) * largest(preload);
  }
  // The multipliers of the torques get length one. What the dual slacks lack in their cones, for
  // the cost that is not yet dropped, counts with normal forces FARTHEST_FORCE times the largest.
  double bound_of_torques()
    requires(Steps::OF_TORQUES)
  {
    V lacking{}, most{};
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      lacking += c.mask * max(V{}, -slack(dual_slack(b)));
      most = max(most, c.mask * at_[b].x.u);
    }
    Sum square;
    this->torques.each_side(
        [&](const auto& side) { square.add(side.multiplier * side.multiplier * side.per_weight); });
    theta_ = 1.0 / std::sqrt(square.value());
    const double value = dual_value() - FARTHEST_FORCE * largest(most) * sum(lacking);
    return theta_ < infinity ? theta_ * value : -infinity;
  }
};

}  // namespace grasp
