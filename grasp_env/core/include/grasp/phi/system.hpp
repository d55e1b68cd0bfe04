// The linear system of Newton on Phi under balance. H is block diagonal, so a step is one 6 x 6
// system G H^-1 G^T for any N.
#pragma once
#include <grasp/phi/cones.hpp>

namespace grasp {

template <class V, int B> class System {
 public:
  using Field = typename Cones<V, B>::Field;
  using S = Reduced<V>;
  Field gradient;
  Blocks<Sym3<V>, B> inverse;  // H^-1
  Ldl<S> schur;                // S = G H^-1 G^T, factored
  Six<S> pull{}, applied{};    // G H^-1 grad and G x

  explicit System(const Cones<V, B>& cones) : gradient(cones.field()) {
    resize(inverse, cones.blocks.size());
  }

  // Assemble everything at x. Return false if S is not positive definite in floating point.
  auto assemble(const Cones<V, B>& cones, const Field& x) {
    return assemble(cones, x, [](int, Vec3<V>&, Sym3<V>&) {});
  }
  // Assemble with further terms of the objective: more(b, gradient, inverse) adds those of block b.
  // Rows with torsion eliminate their own variables: `SoftTerms`.
  template <class F, class R = NoRows>
  auto assemble(const Cones<V, B>& cones, const Field& x, F&& more, const R& rows = {}) {
    V s[21] = {}, q[6] = {}, l[6] = {};
    for (int b = 0; b < int(cones.blocks.size()); ++b) {
      const auto& c = cones.blocks[b];
      inverse[b] = inverse_hessian(x[b], c.weights);
      // the mask keeps unused lanes unchanged
      gradient[b] = c.mask * grasp::gradient(x[b], c.weights);
      more(b, gradient[b], inverse[b]);
      const Sym3<V> h = inverse[b];
      const Vec3<V>* g = columns(cones, rows, b);
      c.add(g, h * gradient[b], q);
      c.add_wrench(x[b], l);
      if constexpr (R::has_torsion) rows.add(b, s, q, l);
#pragma GCC unroll 8
      for (int r = 0; r < 6; ++r) {
        const Vec3<V> hg = h * g[r];
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
  Six<S> direction(const Cones<V, B>& cones, const Six<S>& nu, Field& step) const {
    NoRows none;
    return direction(cones, nu, step, none);
  }
  // The same, with the step of the torsion.
  template <class R> [[gnu::always_inline]] Six<S> direction(const Cones<V, B>& cones,
                                                             const Six<S>& nu, Field& step,
                                                             R& rows) const {
    V moved[6] = {};
    for (int b = 0; b < int(cones.blocks.size()); ++b) {
      const Vec3<V>* g = columns(cones, rows, b);
      step[b] = inverse[b] * (Block<V>::combined(g, nu) - gradient[b]);
      cones.blocks[b].add_wrench(step[b], moved);
      if constexpr (R::has_torsion) rows.turn(b, nu, step[b].u, moved);
    }
    return sums(moved);
  }

  // The Newton step to balance without a wrench, and the balance residual of x. Return false if
  // there is no step.
  auto internal_step(const Cones<V, B>& cones, const Field& x, Six<S>& missed, Field& step) {
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
  template <class R> NewtonStep step(const Cones<V, B>& cones, const Field& x, const Six<S>& nu,
                                     const Six<S>& left, const S& value, Field& step,
                                     R& rows) const {
    Six<S> missed = left + moved_by(cones, nu, step, rows);
    for (int round = 0; round < REFINEMENTS; ++round) {
      const auto rough = size(missed) > MISSES * value;
      if (!any(rough)) break;
      if constexpr (many<V>) missed = select(rough, missed, Six<S>{});
      missed = left + restored_by(cones, missed, step, rows);
    }
    V decrement{}, reach{};
    for (int b = 0; b < int(x.size()); ++b) {
      const auto& c = cones.blocks[b];
      step[b] -= c.least(missed);
      if constexpr (R::has_terms) rows.predict_multipliers(b, step[b]);
      decrement -= dot(step[b], gradient[b]);
      reach = max(reach, Boundary<V>(x[b]).per(step[b]));
      if constexpr (R::has_torsion) {
        decrement -= rows.slope(b, step[b]);
        reach = max(reach, rows.reach(b, step[b]));
      }
    }
    return {sum(decrement), largest(reach)};
  }

  // x -= H^-1 G^T S^-1 missed: restore balance by the smallest change in the metric of the Hessian.
  // Return G x.
  Six<S> restore(const Cones<V, B>& cones, const Six<S>& missed, Field& x) const {
    NoRows none;
    return restore(cones, missed, x, none);
  }
  // The same for a step, with that of the torsion.
  template <class R> [[gnu::always_inline]] Six<S> restore(const Cones<V, B>& cones,
                                                           const Six<S>& missed, Field& x,
                                                           R& rows) const {
    const Six<S> n = schur.solve(missed);
    V moved[6] = {};
    for (int b = 0; b < int(cones.blocks.size()); ++b) {
      const Vec3<V> change = inverse[b] * Block<V>::combined(columns(cones, rows, b), n);
      x[b] -= change;
      cones.blocks[b].add_wrench(x[b], moved);
      if constexpr (R::has_torsion) rows.restore(b, n, change.u, moved);
    }
    return sums(moved);
  }

 private:
  // `direction` and `restore`, out of line unless there is torsion.
  template <class R> [[gnu::always_inline]] Six<S> moved_by(const Cones<V, B>& cones,
                                                            const Six<S>& nu, Field& step,
                                                            [[maybe_unused]] R& rows) const {
    if constexpr (R::has_torsion)
      return direction(cones, nu, step, rows);
    else
      return direction(cones, nu, step);
  }
  template <class R> [[gnu::always_inline]] Six<S> restored_by(const Cones<V, B>& cones,
                                                               const Six<S>& missed, Field& step,
                                                               [[maybe_unused]] R& rows) const {
    if constexpr (R::has_torsion)
      return restore(cones, missed, step, rows);
    else
      return restore(cones, missed, step);
  }

  static constexpr int REFINEMENTS = 3;
  // fraction of Phi; a step with a smaller balance residual needs no refinement
  static constexpr double MISSES = 1e-13;

  template <class R>
  [[gnu::always_inline]] static const Vec3<V>* columns(const Cones<V, B>& cones,
                                                       [[maybe_unused]] const R& rows, int b) {
    if constexpr (R::has_torsion)
      return rows.columns(b);
    else
      return cones.blocks[b].g;
  }
};

}  // namespace grasp
