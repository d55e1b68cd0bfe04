// The linear system of Newton on Phi under balance. H is block diagonal, so a step is one 6 x 6
// system G H^-1 G^T for any N.
#pragma once
#include <grasp/phi/cones.hpp>

namespace grasp {

template <class V, int B, int D = 3> class System {
 public:
  using Placed = Cones<V, B, D>;
  using X = Vec<V, D>;
  using Field = typename Placed::Field;
  using S = Reduced<V>;
  Field gradient;
  Blocks<Sym<V, D>, B> inverse;  // H^-1
  Ldl<S> schur;                  // S = G H^-1 G^T, factored
  Six<S> pull{}, applied{};      // G H^-1 grad and G x

  explicit System(const Placed& cones) : gradient(cones.field()) {
    resize(inverse, cones.blocks.size());
  }

  // Assemble everything at x. Return false if S is not positive definite in floating point.
  auto assemble(const Placed& cones, const Field& x) {
    return assemble(cones, x, [](int, X&, Sym<V, D>&) {});
  }
  // Assemble with further terms of the objective: more(b, gradient, inverse) adds those of block b.
  template <class F> auto assemble(const Placed& cones, const Field& x, F&& more) {
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
    return schur.factor(lower) > 0.0;
  }

  // Multipliers of the step from an x with the balance residual `left` = G x + w: S nu = G H^-1
  // grad - left.
  Six<S> multipliers(const Six<S>& left) const { return schur.solve(pull - left); }

  // step = H^-1 (G^T nu - grad); return G step.
  Six<S> direction(const Placed& cones, const Six<S>& nu, Field& step) const {
    V moved[6] = {};
    for (int b = 0; b < int(cones.blocks.size()); ++b) {
      step[b] = inverse[b] * (cones.blocks[b].transposed(nu) - gradient[b]);
      cones.blocks[b].add_wrench(step[b], moved);
    }
    return sums(moved);
  }

  // The Newton step to balance without a wrench, and the balance residual of x. Return false if
  // there is no step.
  auto internal_step(const Placed& cones, const Field& x, Six<S>& missed, Field& step) {
    const auto good = assemble(cones, x);
    missed = applied;
    direction(cones, multipliers(missed), step);
    return good;
  }

  struct NewtonStep {
    S decrement, reach;
  };  // squared Newton decrement, 1 / (largest step inside the cones)

  // The Newton step at x, where Phi is `value`, with multipliers nu and balance residual `left`.
  // Forces at very different depths in their cones make S ill-conditioned. The step's balance
  // residual is removed in the metric of Phi while it is large (a few digits a round), then by the
  // least-norm change.
  template <class R> NewtonStep step(const Placed& cones, const Field& x, const Six<S>& nu,
                                     const Six<S>& left, const S& value, Field& step,
                                     R& rows) const {
    Six<S> missed = left + direction(cones, nu, step);
    for (int round = 0; round < REFINEMENTS; ++round) {
      const auto rough = size(missed) > MISSES * value;
      if (!any(rough)) break;
      if constexpr (many<V>) missed = select(rough, missed, Six<S>{});
      missed = left + restore(cones, missed, step);
    }
    V decrement{}, reach{};
    for (int b = 0; b < int(x.size()); ++b) {
      const auto& c = cones.blocks[b];
      step[b] -= c.least(missed);
      if constexpr (R::has_terms) rows.predict_multipliers(b, step[b]);
      decrement -= dot(step[b], gradient[b]);
      reach = max(reach, Boundary(x[b]).per(step[b]));
    }
    return {sum(decrement), largest(reach)};
  }

  // x -= H^-1 G^T S^-1 missed: restore balance by the smallest change in the metric of the Hessian.
  // Return G x.
  Six<S> restore(const Placed& cones, const Six<S>& missed, Field& x) const {
    const Six<S> n = schur.solve(missed);
    V moved[6] = {};
    for (int b = 0; b < int(cones.blocks.size()); ++b) {
      x[b] -= inverse[b] * cones.blocks[b].transposed(n);
      cones.blocks[b].add_wrench(x[b], moved);
    }
    return sums(moved);
  }

 private:
  static constexpr int REFINEMENTS = 3;
  // fraction of Phi; a step with a smaller balance residual needs no refinement
  static constexpr double MISSES = 1e-13;
};

}  // namespace grasp
