// The linear system of a step of the exact problem within limits (conic/limited_steps.hpp).
//
// In the coordinates M^-1/2 dx of the scaling, a row of one contact is a rank-one change of the
// identity, and its factor is updated without a difference that cancels. Joint rows border the 6 x
// 6 system.
//
// The largest normal force has a variable t >= c_i u_i, which the rows of all contacts share: the
// last row of the border. Of the joint torques the half of their square is minimised, whose optimum
// is that of their norm. Each is a term of the cost with a constant bend.
#pragma once
#include <type_traits>
#include <grasp/conic/bounds.hpp>
#include <grasp/conic/criterion.hpp>
#include <grasp/conic/steps.hpp>
#include <grasp/math/bordered.hpp>

namespace grasp {

template <class V, int B, int D, Criterion C> class LimitedSystem {
 public:
  static constexpr bool OF_LARGEST = C == Criterion::largest, OF_TORQUES = C == Criterion::torque;
  static constexpr int T = OF_LARGEST;
  using X = Vec<V, D>;
  using Field = typename Cones<V, B, D>::Field;
  Cones<V, B, D> cones;
  ConicLimits<V, B, D, T> limits;
  struct NoTorques {};
  std::conditional_t<OF_TORQUES, ConicTorques<V, B, D>, NoTorques> torques;

  explicit LimitedSystem(int count) : cones(count) { resize(at_, cones.blocks.size()); }
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
      torques.each_place([](auto& side, int n, const auto& row) {
        set(side.weight, n, row.size * row.size);
        set(side.per_weight, n, 1.0 / (row.size * row.size));
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
  Blocks<At, B> at_;
  Vec6 left_{};            // G x + w
  double dt_ = 0.0;        // the step of t
  double priced_ = 0.0;    // cost of t less the multipliers of its rows
  Blocks<V, 0> preloads_;  // preloads as u [N]

  int blocks() const { return int(at_.size()); }

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

 private:
  Bordered system_;
  std::vector<Tuple<V, D>> joint_reduced_;  // (joint rows, blocks), as `reduced`

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
};

}  // namespace grasp
