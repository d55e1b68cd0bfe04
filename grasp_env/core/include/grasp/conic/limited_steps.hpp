// The steps of the exact problem within limits (conic/limited.hpp), in the registers.
//
// Steps are those of conic.hpp. In the coordinates M^-1/2 dx of the scaling, a row of one contact
// is a rank-one change of the identity, and its factor is updated without a difference that
// cancels. Joint rows border the 6 x 6 system. The start may exceed the limits.
//
// The largest normal force has a variable t >= c_i u_i, which the rows of all contacts share: the
// last row of the border. Of the joint torques the half of their square is minimised, whose optimum
// is that of their norm. Each is a term of the cost with a constant bend. s begins with a cost of
// normal forces, which the steps drop.
#pragma once
#include <type_traits>
#include <grasp/conic/bounds.hpp>
#include <grasp/conic/criterion.hpp>
#include <grasp/conic/steps.hpp>
#include <grasp/math/bordered.hpp>

namespace grasp {

template <class V, int B, int D, Criterion C> class LimitedSteps {
 public:
  static constexpr bool OF_LARGEST = C == Criterion::largest, OF_TORQUES = C == Criterion::torque;
  static constexpr int T = OF_LARGEST;
  using X = Vec<V, D>;
  using Field = typename Cones<V, B, D>::Field;
  Cones<V, B, D> cones;
  Field inside;  // a force strictly inside the cones: the start, or an internal force
  ConicLimits<V, B, D, T> limits;
  struct NoTorques {};
  std::conditional_t<OF_TORQUES, ConicTorques<V, B, D>, NoTorques> torques;

  explicit LimitedSteps(int count) : cones(count), inside(cones.field()) {
    resize(at_, cones.blocks.size());
  }
  // Make solving free of allocations for up to this many rows and joints.
  void reserve(int rows, int joints) {
    limits.reserve(cones, rows + T);
    if constexpr (OF_TORQUES) torques.reserve(cones, joints);
    const int border = rows + T + (OF_TORQUES ? joints : 0);
    system_.reserve(border);
    joint_reduced_.reserve(std::size_t(border) * at_.size());
  }
  // Take over the limits of the contacts in `cones`, with a Jacobian (N, 4, J) in contact frames.
  // Return false if numbers are too large.
  bool pack(const ForceLimits& from, const Preload& preload) {
    if (!limits.pack(cones, from, preload)) return false;
    if constexpr (OF_LARGEST) {
      limits.add_each(cones.count, [&](int b) {
        const auto& c = cones.blocks[b];
        OwnRow<V, D, T, Bounds<V>> row;
        row.a = axis<D>(c.mask);
        row.share[0] = -c.mask / c.cost;
        row.high.present = c.mask;
        return row;
      });
      preloads_.assign(blocks(), V{});
      for (int i = 0; i < cones.count && preload.any; ++i) {
        const auto& c = cones.blocks[i / width<V>];
        set(preloads_[i / width<V>], i % width<V>,
            preload.each[i] * get(c.divisor.u, i % width<V>));
      }
    }
    if constexpr (OF_TORQUES) {
      if (!torques.pack_torques(cones, from, preload)) return false;
      torques.each_place([&](auto& side, int n, double size) {
        set(side.weight, n, size * size);
        set(side.per_weight, n, 1.0 / (size * size));
      });
    }
    return true;
  }

 protected:
  struct At {
    X x, s;  // primal and dual slack
    Scaling<V, D> m;
    V root;                   // sqrt(eta): M^1/2 = root * m.scaled
    X l, e, d;                // scaled point, dual direction and right-hand side
    V share, l0;              // share of the `Boundary` at l; 1 / l_0
    X f;                      // right-hand side of M^-1/2 dx
    X dx, ds;                 // the step
    RowBlock<V, D, T> block;  // I + M^1/2 (sum bend a a^T) M^1/2, factored
    Tuple<V, D> reduced[6];   // L^-1 M^1/2 g for the rows g of G
    Tuple<V, D> z;            // D^-1 L^-1 of the right-hand side
    X first;                  // first x, for the record

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
  double t_ = 0.0;         // at least every c u, in units of `unit_`
  double priced_ = 0.0;    // cost of t less the multipliers of its rows
  Blocks<V, 0> preloads_;  // preloads as u [N]

  int blocks() const { return int(at_.size()); }
  double degree() const { return 2.0 * cones.count + limits.sides; }
  double dual_value() const { return dot(minus_, y_) - paid_; }

  // Call f(row) for the rows of the contacts in block b; the same from the last to the first.
  template <class F> void each_row(int b, F&& f) {
    limits.each_own(b, f);
    if constexpr (OF_TORQUES) torques.each_own(b, f);
  }
  template <class F> void each_row_back(int b, F&& f) {
    if constexpr (OF_TORQUES) torques.each_own_back(b, f);
    limits.each_own_back(b, f);
  }
  // Call f(j, row, column) for all joint rows, where column(b) is that of block b.
  template <class F> void each_joint(F&& f) {
    for (int j = 0; j < limits.joint_rows(); ++j)
      f(j, limits.joints[j], [&, j](int b) -> const X& { return limits.column(j, b); });
    if constexpr (OF_TORQUES)
      for (int j = 0; j < torques.joint_rows(); ++j)
        f(limits.joint_rows() + j, torques.joints[j],
          [&, j](int b) -> const X& { return torques.column(j, b); });
  }
  int joint_rows() const {
    if constexpr (OF_TORQUES) return limits.joint_rows() + torques.joint_rows();
    return limits.joint_rows();
  }
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

  // Factor the system. Return false if it is not positive definite in floating point.
  bool factor() {
    V s[21] = {}, corner{};
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
      RowBlock<V, D, T> block;
      each_row(b, [&](auto& row) {
        row.update = block.update(tuple(at.rooted(row.a)), row.share, row.bend);
        if constexpr (OF_LARGEST)
          corner += row.update.weight * row.update.shared[0] * row.update.shared[0];
      });
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
    if constexpr (OF_LARGEST) border_shared(sum(corner));
    return system_.factor(lower);
  }
  Tuple<V, D>& joint_reduced(int j, int b) { return joint_reduced_[std::size_t(blocks()) * j + b]; }
  void border() {
    const int joint = joint_rows();
    system_.resize(joint + T, T);
    joint_reduced_.resize(std::size_t(joint) * blocks());
    each_joint([&](int j, const auto& row, auto&& column) {
      V side[6] = {};
      for (int b = 0; b < blocks(); ++b) {
        const At& at = at_[b];
        joint_reduced(j, b) = at.block.forward(tuple(at.rooted(column(b))));
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
      system_(6 + j, 6 + j) += 1.0 / row.bend;
    });
  }
  // The row of -t, whose pivot is negative. corner: what is left of its diagonal in the blocks.
  void border_shared(double corner) {
    const int last = 6 + joint_rows();
    V side[6] = {};
    for (int b = 0; b < blocks(); ++b)
      for (int r = 0; r < 6; ++r) side[r] += inner(at_[b].reduced[r], shared(b));
    for (int r = 0; r < 6; ++r) system_(last, r) = sum(side[r]);
    for (int j = 0; j < joint_rows(); ++j) {
      V total{};
      for (int b = 0; b < blocks(); ++b) total += inner(joint_reduced(j, b), shared(b));
      system_(last, 6 + j) = sum(total);
    }
    system_(last, last) = -corner;
  }
  // Row of t in the factor of block b.
  Tuple<V, D> shared(int b) const {
    Tuple<V, D> out;
    for (int a = 0; a < D; ++a) out[a] = at_[b].block.l[D][a];
    return out;
  }

  // Solve for the right-hand sides f, the rows' rates and the residuals: dx, dt, ds and the rows'
  // steps. dropped: cost that s loses. Return dy.
  Vec6 direct(double dropped = 0.0) {
    const int joint = joint_rows();
    V pull[6] = {}, shared_right{};
    for (int b = 0; b < blocks(); ++b) {
      At& at = at_[b];
      at.z = tuple(at.f);
      each_row(b, [&](auto& row) {
        row.take_rates();
        const V rest = row.update.forward(at.z, row.right);
        if constexpr (OF_LARGEST) shared_right += row.update.weight * row.update.shared[0] * rest;
      });
      for (int r = 0; r < 6; ++r) pull[r] += inner(at.reduced[r], at.z);
    }
    const Vec6 pulled = sums(pull);
    for (int r = 0; r < 6; ++r) system_[r] = -pulled[r] - left_[r];
    each_joint([&](int j, auto& row, auto&&) {
      V total{};
      for (int b = 0; b < blocks(); ++b) total += inner(joint_reduced(j, b), at_[b].z);
      row.take_rates();
      system_[6 + j] = row.right - sum(total);
    });
    if constexpr (OF_LARGEST) system_[6 + joint] = sum(shared_right) - priced_;
    system_.solve();
    Vec6 dy;
    for (int r = 0; r < 6; ++r) dy[r] = system_[r];
    dt_ = OF_LARGEST ? -system_[6 + joint] : 0.0;
    each_joint([&](int j, auto& row, auto&&) { row.step(-system_[6 + j] / row.bend); });
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      At& at = at_[b];
      X back = c.transposed(dy);
      each_joint([&](int j, auto&, auto&& column) { back += all<V>(system_[6 + j]) * column(b); });
      Tuple<V, D> z = tuple(at.f + at.rooted(back));
      each_row(b, [&](auto& row) {
        row.left = -row.update.forward(z, row.right);
        if constexpr (OF_LARGEST) row.left += all<V>(dt_) * row.update.shared[0];
      });
      if constexpr (OF_LARGEST) z = tuple(cone(z) - all<V>(dt_) * cone(shared(b)));
      at.block.backward(z);
      at.dx = c.mask * at.rooted(cone(z));
      at.ds = -back;
      at.ds.u -= dropped * c.cost;
      Tuple<V, D> rest{};
      each_row_back(b, [&](auto& row) {
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
  double dt_ = 0.0;
  Bordered system_;
  std::vector<Tuple<V, D>> joint_reduced_;  // (joint rows, blocks), as `reduced`
};

}  // namespace grasp
