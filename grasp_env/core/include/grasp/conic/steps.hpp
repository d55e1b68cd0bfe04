// The steps of the exact conic problem (conic.hpp), for one problem or a register of them.
#pragma once
#include <grasp/phi/cones.hpp>

namespace grasp {

// M = eta (2 v v^T - J) takes s to x; its square root is sqrt(eta) * `scaled`.
template <class T, int D> struct Scaling {
  using X = Vec<T, D>;
  X v;
  T eta, shrink, root;  // 1 / (1 + v_0), 1 / sqrt(s . J s)

  Scaling() = default;
  Scaling(const X& x, const X& s) {
    const T i = 1.0 / lorentz(s, s);
    eta = sqrt(lorentz(x, x) * i);
    X z = x - eta * s;
    z.u = x.u + eta * s.u;
    v = (1.0 / sqrt(lorentz(z, z))) * z;
    shrink = 1.0 / (1.0 + v.u);
    root = sqrt(i);
  }
  X scaled(const X& d) const {
    const T z = dot_tangents(v, d);
    X out = d + (d.u + z * shrink) * v;
    out.u = v.u * d.u + z;
    return out;
  }
  X unscaled(const X& d) const {  // inverse of `scaled`
    const T z = dot_tangents(v, d);
    X out = d + (z * shrink - d.u) * v;
    out.u = v.u * d.u - z;
    return out;
  }
  X twice(const X& d) const {  // M d
    const T z = 2.0 * dot(v, d);
    X out = eta * (z * v + d);
    out.u = eta * (z * v.u - d.u);
    return out;
  }
};

// Right-hand side of Mehrotra's corrector in scaled coordinates: the d for which the product of d
// and l is (aim, 0, ..) plus that of l + e and e. l: the scaled point; e: the predictor's dual
// direction; per_square: 1 / (l . J l); per_l0: 1 / l_0.
template <class T, int D>
[[gnu::always_inline]] inline Vec<T, D> corrector(const Vec<T, D>& l, const Vec<T, D>& e,
                                                  const T& aim, const T& per_square,
                                                  const T& per_l0) {
  const Vec<T, D> f = l + e;
  Vec<T, D> r = f.u * e + e.u * f;
  r.u = aim + dot(f, e);
  const T h = lorentz(l, r) * per_square;
  Vec<T, D> d = per_l0 * (r - h * l);
  d.u = h;
  return d;
}

// The iterate and its steps, for one problem or a register of them.
template <class V, int B> class ConicSteps {
 public:
  using S = Reduced<V>;
  using Field = typename Cones<V, B>::Field;
  struct At {
    Vec3<V> x, s;  // primal and dual slack
    Scaling<V, 3> m;
    Vec3<V> l, d, q;  // scaled point, (scaled) dual direction, dx
    V share, l0;      // share of the `Boundary` at l; 1 / l_0
    Vec3<V> first;    // first x, for the record

    Boundary<V, 3> boundary() const { return {l, m.root, share}; }  // l . J l = s . J s
  };
  Cones<V, B> cones;
  Field rest;  // an internal force strictly inside the cones, with which a start squeezes
  Blocks<At, B> at;
  S gap{}, objective{};
  Six<S> y{};
  Ldl<S> schur;

  explicit ConicSteps(int count) : cones(count), rest(cones.field()) {
    resize(at, cones.blocks.size());
  }
  int blocks() const { return int(at.size()); }

  // x = -G^+ w + k rest, with k larger than the triangle inequality requires; s = c
  void start(const Six<S>& minus) {
    V squeeze = all<V>(1e-6);
    V cost{};
    for (int b = 0; b < blocks(); ++b) {
      at[b].x = cones.blocks[b].least(minus);
      squeeze = max(squeeze, -slack(at[b].x) / slack(rest[b]));
    }
    const V k = all<V>(1.3 * largest(squeeze));
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      at[b].x += k * rest[b];
      at[b].first = at[b].x;
      at[b].s = {c.cost, V{}, V{}};
      cost += c.mask * c.cost * at[b].x.u;
    }
    gap = objective = sum(cost);
    y = {};
  }

  // S = sum eta (2 (G v)(G v)^T - G J G^T), factored; returns its smallest pivot
  [[gnu::always_inline]] S system() {
    V s[21] = {};
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      const auto& m = at[b].m = Scaling(at[b].x, at[b].s);
      V g[6];
#pragma GCC unroll 8
      for (int r = 0; r < 6; ++r) g[r] = dot(c.g[r], m.v);
#pragma GCC unroll 8
      for (int r = 0; r < 6; ++r) {
        const V e = 2.0 * g[r];
#pragma GCC unroll 8
        for (int k = 0; k <= r; ++k) s[packed(r, k)] += m.eta * (e * g[k] - c.gjg[packed(r, k)]);
      }
    }
    Packed<S> lower;
#pragma GCC unroll 32
    for (int k = 0; k < 21; ++k) lower[k] = sum(s[k]);
    return schur.factor(lower);
  }

  // Take a step with Mehrotra's corrector. down: the predictor's dy (dx + M ds = -x, so that S dy =
  // G x = -w). correct(pull): the whole dy. Return true if the step moves anything; otherwise it is
  // not taken. EXACT: `correct` leaves dx in q. least: smallest fraction of the gap that centring
  // keeps; 1 stays in the interior instead of heading for the optimum.
  template <bool EXACT, class F>
  [[gnu::always_inline]] auto step(const Six<S>& down, F&& correct, double least = 0.0) {
    const auto [primal, dual, cross, square] = predict(down);
    const S after = gap + dual * cross - primal * (gap + cross) - primal * dual * (cross + square);
    const S part = max(S(0.0), after) / gap;
    const S centring = max(min(part * part * part, S(1.0)), S(least));
    const S reach = 0.9 + (STEP - 0.9) * min(dual, primal);
    const Six<S> dy = correct(centre(centring * gap / (2.0 * cones.count)));
    const auto [longest_x, longest_s] = direct<EXACT>(dy, reach);
    const auto moves = longest_x + longest_s > 1e-6;
    if (!any(moves)) return moves;
    y = y + longest_s * dy;
    advance(longest_x, longest_s);
    return moves;
  }

  // The certified answer at the iterate x of a wrench of size 1: y scaled onto the boundary of its
  // set by theta, and the force [N] for a wrench of size `scale`. For any y the largest theta with
  // c - theta G^T y in every cone is min c / (g_u + |g_t|), g = G^T y, over the contacts where that
  // is positive.
  struct ConicForce {
    S theta, objective, bound;
    S gap() const { return select(bound > 0.0, (objective - bound) / bound, S(infinity)); }
  };
  ConicForce answer(const Six<S>& minus, const S& scale, Field& force) {
    V before[6] = {}, steepest{}, squeeze{};
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      c.add_wrench(at[b].x, before);
      const Vec3<V> g = c.transposed(y);
      steepest = max(steepest, (g.u + tangent_length(g)) / c.cost);
    }
    const S most = largest(steepest);
    const S theta = select(most > 0.0, 1.0 / most, S(1.0));
    const Six<S> left = sums(before) - minus;
    for (int b = 0; b < blocks(); ++b) {
      const auto& c = cones.blocks[b];
      auto& x = at[b].x;
      x -= c.least(left);
      const V outside = 1e-15 * x.u - slack(x);  // 1e-15 allows for the rounding of the next lines
      // restoring the last digits of balance may take x out of its cone; an internal force takes it
      // back
      squeeze = max(squeeze, 1.1 * c.mask * outside / slack(rest[b]));
    }
    const V k = all<V>(largest(squeeze));
    for (int b = 0; b < blocks(); ++b) force[b] = all<V>(scale) * (at[b].x + k * rest[b]);
    return {theta, objective_of(force), scale * max(theta * dot(minus, y), S(0.0))};
  }
  S objective_of(const Field& force) const {  // weighted sum of the normal forces [N]
    V objective{};
    for (int b = 0; b < blocks(); ++b)
      objective += cones.blocks[b].mask * cones.blocks[b].cost * force[b].u;
    return sum(objective);
  }

  // Take the step, and find the gap and the objective there.
  [[gnu::always_inline]] void advance(const S& primal, const S& dual) {
    V left{}, cost{};
    for (int b = 0; b < blocks(); ++b) {
      auto& here = at[b];
      const auto& c = cones.blocks[b];
      here.x += all<V>(primal) * here.q;
      here.s += all<V>(dual) * here.d;
      left += c.mask * dot(here.x, here.s);
      cost += c.mask * c.cost * here.x.u;
    }
    gap = sum(left);
    objective = sum(cost);
  }

 private:
  static constexpr double STEP = 0.995;  // largest fraction of the way to the boundary

  // Longest steps of x and s along the predictor ds = -G^T dy, and the terms s . dx and ds . ds.
  struct Predicted {
    S primal, dual, cross, square;
  };
  Predicted predict(const Six<S>& dy) {
    V primal = all<V>(1.0);
    V dual = all<V>(1.0);
    V cross{};
    V square{};
    for (int b = 0; b < blocks(); ++b) {
      auto& here = at[b];
      const auto& m = here.m;
      const Vec3<V> l = here.l = m.scaled(here.s);
      const Vec3<V> e = here.d = m.scaled(-cones.blocks[b].transposed(dy));
      const V n = l.u * m.root + 1.0;
      const V both = 1.0 / (n * l.u);  // one division for two
      here.share = both * l.u;
      here.l0 = both * n;
      const auto way = here.boundary().way(e);
      dual = max(dual, way.away - way.along);
      primal = max(primal, 1.0 + way.away + way.along);
      const V part = cones.blocks[b].mask * m.eta;
      cross += part * dot(l, e);
      square += part * dot(e, e);
    }
    return {1.0 / largest(primal), 1.0 / largest(dual), sum(cross), sum(square)};
  }

  // d = scaled right-hand side with centring and second order, q its unscaled image; returns -G q
  [[gnu::always_inline]] Six<S> centre(const S& target) {
    V out[6] = {};
    for (int b = 0; b < blocks(); ++b) {
      auto& here = at[b];
      const auto& m = here.m;
      const V square = m.root * m.root;
      // unused lanes do not move
      here.d = cones.blocks[b].mask *
               (corrector(here.l, here.d, target / m.eta, square, here.l0) - here.l);
      here.q = m.eta * m.scaled(here.d);
      cones.blocks[b].add_wrench(here.q, out);
    }
    return -1.0 * sums(out);
  }

  // d = ds, q = dx; returns the steps, `reach` of the way to the boundary of x and s
  struct Lengths {
    S primal, dual;
  };
  template <bool EXACT> [[gnu::always_inline]] Lengths direct(const Six<S>& dy, const S& reach) {
    V primal = all<V>(reach);
    V dual = all<V>(reach);
    for (int b = 0; b < blocks(); ++b) {
      auto& here = at[b];
      const Vec3<V> d = -cones.blocks[b].transposed(dy);
      if constexpr (EXACT) {  // q is dx already
        dual = max(dual, Boundary(here.s).per(d));
        primal = max(primal, Boundary(here.x).per(here.q));
      } else {
        const Vec3<V> e = here.m.scaled(d);
        const Boundary<V, 3> edge = here.boundary();
        dual = max(dual, edge.per(e));
        primal = max(primal, edge.per(here.d - e));
        here.q -= here.m.twice(d);
      }
      here.d = d;
    }
    return {reach / largest(primal), reach / largest(dual)};
  }
};

}  // namespace grasp
