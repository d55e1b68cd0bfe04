// The linear system of Newton on Phi under balance. H is block diagonal, so a step is one 6 x 6
// system G H^-1 G^T for any N. Rows of several contacts (`Barriers`) border it.
#pragma once
#include <type_traits>
#include <grasp/math/bordered.hpp>
#include <grasp/phi/cones.hpp>

namespace grasp {

// S with the joint rows A: [G; A] H^-1 [G; A]^T + diag(0, 1 / bend), where H has no joint rows.
// pull: A H^-1 grad; force: what the rows push against a step, besides nu.
struct JointSystem {
  Bordered system;
  std::vector<double> pull, force;

  void reserve(int rows) {
    system.reserve(rows);
    pull.reserve(rows);
    force.reserve(rows);
  }
};

template <class V, int B, int D = 3, class Rows = NoRows> class System {
 public:
  using Placed = Cones<V, B, D>;
  using X = Vec<V, D>;
  using Field = typename Placed::Field;
  using S = Reduced<V>;
  Field gradient;
  Blocks<Sym<V, D>, B> inverse;  // H^-1
  Ldl<S> schur;                  // S = G H^-1 G^T, factored, if there are no `Rows`
  std::conditional_t<Rows::has_terms, JointSystem, NoRows> joint;
  Six<S> pull{}, applied{};  // G H^-1 grad and G x

  explicit System(const Placed& cones) : gradient(cones.field()) {
    resize(inverse, cones.blocks.size());
  }

  // Assemble everything at x. Return false if S is not positive definite in floating point.
  auto assemble(const Placed& cones, const Field& x, const Rows& rows = {}) {
    return assemble(cones, x, rows, [&](int b, X& gradient, Sym<V, D>& inverse) {
      if constexpr (Rows::has_terms) rows.add_to_gradient_and_hessian(b, gradient, inverse);
    });
  }
  // Assemble with further terms of the objective: more(b, gradient, inverse) adds those of block b.
  template <class F>
  auto assemble(const Placed& cones, const Field& x, [[maybe_unused]] const Rows& rows, F&& more) {
    V s[21] = {}, q[6] = {}, l[6] = {};
    for (int b = 0; b < int(cones.blocks.size()); ++b) {
      const auto& c = cones.blocks[b];
      inverse[b] = inverse_hessian(x[b], c.weights);
      // the mask keeps unused lanes unchanged
      gradient[b] = c.mask * grasp::gradient(x[b], c.weights);
      more(b, gradient[b], inverse[b]);
      const Sym<V, D> h = inverse[b];
      const X* g = c.g;
      c.add_wrench(h * gradient[b], q);
      c.add_wrench(x[b], l);
#pragma GCC unroll 8
      for (int r = 0; r < 6; ++r) {
        const X hg = h * g[r];
#pragma GCC unroll 8
        for (int k = 0; k <= r; ++k) s[packed(r, k)] += dot(hg, g[k]);
      }
    }
    Packed<S> lower;
#pragma GCC unroll 32
    for (int k = 0; k < 21; ++k) lower[k] = sum(s[k]);
    pull = sums(q);
    applied = sums(l);
    if constexpr (Rows::has_terms)
      return border(cones, rows, lower);
    else
      return schur.factor(lower) > 0.0;
  }

  // Multipliers of the step from an x with the balance residual `left` = G x + w: S nu = G H^-1
  // grad - left.
  Six<S> multipliers(const Six<S>& left) { return solve(pull - left, true); }

  // step = H^-1 (G^T nu - grad); return G step.
  Six<S> direction(const Placed& cones, const Rows& rows, const Six<S>& nu, Field& step) const {
    V moved[6] = {};
    for (int b = 0; b < int(cones.blocks.size()); ++b) {
      step[b] = inverse[b] * (pushed(cones, rows, b, nu) - gradient[b]);
      cones.blocks[b].add_wrench(step[b], moved);
    }
    return sums(moved);
  }

  // The Newton step to balance without a wrench, and the balance residual of x. Return false if
  // there is no step.
  auto internal_step(const Placed& cones, const Field& x, Six<S>& missed, Field& step) {
    const auto good = assemble(cones, x);
    missed = applied;
    direction(cones, {}, multipliers(missed), step);
    return good;
  }

  struct NewtonStep {
    S decrement, reach;
  };  // squared Newton decrement, 1 / (largest step inside the cones)

  // The Newton step at x, where Phi is `value`, with multipliers nu and balance residual `left`.
  // Forces at very different depths in their cones make S ill-conditioned. The step's balance
  // residual is removed in the metric of Phi while it is large (a few digits a round), then by the
  // least-norm change.
  NewtonStep step(const Placed& cones, const Field& x, const Six<S>& nu, const Six<S>& left,
                  const S& value, Field& step, Rows& rows) {
    Six<S> missed = left + direction(cones, rows, nu, step);
    for (int round = 0; round < REFINEMENTS; ++round) {
      const auto rough = size(missed) > MISSES * value;
      if (!any(rough)) break;
      if constexpr (many<V>) missed = select(rough, missed, Six<S>{});
      missed = left + restore(cones, rows, missed, step);
    }
    V decrement{}, reach{};
    for (int b = 0; b < int(x.size()); ++b) {
      const auto& c = cones.blocks[b];
      step[b] -= c.least(missed);
      if constexpr (Rows::has_terms) reach = max(reach, rows.predict(b, step[b]));
      decrement -= dot(step[b], gradient[b]);
      reach = max(reach, Boundary(x[b]).per(step[b]));
    }
    S most = largest(reach);
    if constexpr (Rows::has_terms) most = std::max(most, rows.predict_joint(step));
    return {sum(decrement), most};
  }

  // x -= H^-1 G^T S^-1 missed: restore balance by the smallest change in the metric of the Hessian.
  // Return G x.
  Six<S> restore(const Placed& cones, const Rows& rows, const Six<S>& missed, Field& x) {
    const Six<S> n = solve(missed, false);
    V moved[6] = {};
    for (int b = 0; b < int(cones.blocks.size()); ++b) {
      x[b] -= inverse[b] * pushed(cones, rows, b, n);
      cones.blocks[b].add_wrench(x[b], moved);
    }
    return sums(moved);
  }

 private:
  static constexpr int REFINEMENTS = 3;
  // fraction of Phi; a step with a smaller balance residual needs no refinement
  static constexpr double MISSES = 1e-13;

  // Solve S n = right. pulled: the joint rows have the right-hand side A H^-1 grad, otherwise 0.
  Six<S> solve(const Six<S>& right, [[maybe_unused]] bool pulled) {
    if constexpr (Rows::has_terms) {
      for (int r = 0; r < 6; ++r) joint.system[r] = right[r];
      const int many = int(joint.pull.size());
      for (int j = 0; j < many; ++j) joint.system[6 + j] = pulled ? joint.pull[j] : 0.0;
      joint.system.solve();
      for (int j = 0; j < many; ++j) joint.force[j] = joint.system[6 + j];
      Six<S> out;
      for (int r = 0; r < 6; ++r) out[r] = joint.system[r];
      return out;
    } else {
      return schur.solve(right);
    }
  }
  // G^T n of block b, with the joint rows' part.
  X pushed(const Placed& cones, [[maybe_unused]] const Rows& rows, int b, const Six<S>& n) const {
    X out = cones.blocks[b].transposed(n);
    if constexpr (Rows::has_terms)
      for (int j = 0; j < rows.joint_rows(); ++j) out += all<V>(joint.force[j]) * rows.column(j, b);
    return out;
  }
  // Factor S, `corner`, with the joint rows' border. Return false if it is not positive definite.
  bool border(const Placed& cones, const Rows& rows, const Packed6& corner) {
    const int many = rows.joint_rows();
    joint.system.resize(many);
    joint.pull.resize(many);
    joint.force.resize(many);
    for (int j = 0; j < many; ++j) {
      V side[6] = {}, pulled{};
      for (int b = 0; b < int(cones.blocks.size()); ++b) {
        const X h = inverse[b] * rows.column(j, b);
        cones.blocks[b].add_wrench(h, side);
        pulled += dot(h, gradient[b]);
      }
      joint.pull[j] = sum(pulled);
      for (int r = 0; r < 6; ++r) joint.system(6 + j, r) = sum(side[r]);
      for (int k = 0; k <= j; ++k) {
        V total{};
        for (int b = 0; b < int(cones.blocks.size()); ++b)
          total += dot(inverse[b] * rows.column(j, b), rows.column(k, b));
        joint.system(6 + j, 6 + k) = sum(total);
      }
      joint.system(6 + j, 6 + j) += 1.0 / rows.joints[j].bend();
    }
    return joint.system.factor(corner);
  }
};

}  // namespace grasp
