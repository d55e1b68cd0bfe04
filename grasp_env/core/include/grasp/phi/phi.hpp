// Phi = sum_i 3 omega u + lambda ((k - 1)/u + 2u/d), d = u^2 - |y|^2 with y the k tangential parts
// of x: 0 without friction, 2 of hard and elliptic contacts (Eqs. 10, 30, 31), 3 with torsion. The
// barrier is lambda tr P^-1, P the arrow matrix with u on its diagonal and y beside it. Each
// formula stands here once, per contact, for a number or for a register of contacts.
#pragma once
#include <grasp/math/vec.hpp>

namespace grasp {

// Weights of a contact with D variables: omega of squeezing, lambda of approaching its cone [N^2],
// and axial = k - 1, which all contacts with three variables share.
template <class T, int D> struct Weights;
template <class T> struct Weights<T, 3> {
  T omega, lambda;
  static constexpr double axial = 1.0;
};
template <class T> struct Weights<T, 4> {
  T omega, lambda, axial;
};
// The same weights for D variables. Without tangential force the barrier is (axial + 2)/u: where
// axial is always 1, a part of lambda gives the barrier of a contact without friction.
template <int D, class T> inline Weights<T, D> fitted(const Weights<T, 4>& w) {
  if constexpr (D == 4)
    return w;
  else
    return {w.omega, (w.axial + 2.0) / 3.0 * w.lambda};
}

// Cost of a unit of u by squeezing, for all kinds of contacts.
template <class T> inline T squeezing_cost(const T& omega) { return 3.0 * omega; }

template <class T, int D> inline T phi(const Vec<T, D>& x, const Weights<T, D>& w) {
  return squeezing_cost(w.omega) * x.u + w.lambda * (w.axial / x.u + 2.0 * x.u / lorentz(x, x));
}

// Phi and its gradient, from the same two divisions.
template <class T, int D>
inline T phi(const Vec<T, D>& x, const Weights<T, D>& w, Vec<T, D>& gradient) {
  const T u2 = x.u * x.u;
  const T s2 = dot_tangents(x, x);
  const T d = u2 - s2;
  const T i = 1.0 / d;
  const T i2 = i * i;
  const T iu = 1.0 / x.u;
  const T barrier = w.axial * iu;
  const T k = 4.0 * w.lambda * i2 * x.u;
  gradient = with_tangents(
      squeezing_cost(w.omega) - w.lambda * (barrier * iu + 2.0 * i2 * (u2 + s2)), k, x);
  return squeezing_cost(w.omega) * x.u + w.lambda * (barrier + 2.0 * x.u * i);
}

template <class T, int D> inline Vec<T, D> gradient(const Vec<T, D>& x, const Weights<T, D>& w) {
  Vec<T, D> out;
  phi(x, w, out);
  return out;
}

// Second derivative of Phi along a move.
template <class T, int D>
inline T curvature(const Vec<T, D>& x, const Vec<T, D>& move, const Weights<T, D>& w) {
  const T u2 = x.u * x.u;
  const T s2 = dot_tangents(x, x);
  const T along = dot_tangents(x, move);
  const T i = 1.0 / x.u;
  const T j = 1.0 / (u2 - s2);
  const T j2 = j * j;
  return w.lambda *
         ((2.0 * w.axial * i * i * i + 4.0 * x.u * (u2 + 3.0 * s2) * j2 * j) * move.u * move.u -
          8.0 * (3.0 * u2 + s2) * j2 * j * move.u * along +
          4.0 * x.u * j2 * (dot_tangents(move, move) + 4.0 * j * along * along));
}

// Inverse Hessian in closed form, without differences that cancel close to a cone. With p = u + s
// and q = u - s, the part of Phi in the plane of u and s is lambda (2 axial/(p+q) + 1/p + 1/q),
// with Hessian diag(2/p^3, 2/q^3) + 4 axial/(p+q)^3 (1, 1)(1, 1)^T.
template <class T, int D>
inline Sym<T, D> inverse_hessian(const Vec<T, D>& x, const Weights<T, D>& w) {
  const T u = x.u;
  const T u2 = u * u;
  const T s2 = dot_tangents(x, x);
  const T d = u2 - s2;
  const T iu = 1.0 / u;
  const auto twice = 2.0 * w.axial;
  const T scale = 0.5 / (w.lambda * (2.0 * u2 + w.axial * (u2 + 3.0 * s2)));
  const T along = scale * u2 * (3.0 * u2 + s2);
  const T across = d * d * iu / (4.0 * w.lambda);
  const T bend =
      scale * ((5.0 - twice) * u2 * u2 + s2 * ((2.0 * twice - 1.0) * u2 - twice * s2)) * iu;
  const T up = scale * u2 * u * (u2 + 3.0 * s2);
  const T bo = bend * x.o;
  const T bt = bend * x.t;
  if constexpr (D == 3) {
    return {up, along * x.o, along * x.t, across + bo * x.o, bo * x.t, across + bt * x.t};
  } else {
    const T bv = bend * x.v;
    return {up,       along * x.o, along * x.t,       along * x.v, across + bo * x.o,
            bo * x.t, bo * x.v,    across + bt * x.t, bt * x.v,    across + bv * x.v};
  }
}

// Unit vectors in tangential directions: along that of x (any, if it is zero), and across it.
template <class T, int D> struct TangentAxes {
  Vec<T, D> along, across[D - 2];

  TangentAxes(const Vec<T, D>& x, const T& length) {
    const auto there = length > 1e-140;
    along = x / select(there, length, all<T>(1.0));
    along.u = T{};
    along.o = select(there, along.o, all<T>(1.0));
    along.t = select(there, along.t, T{});
    if constexpr (D == 3) {
      across[0] = {T{}, -along.t, along.o};
    } else {  // Duff et al. 2017, "Building an orthonormal basis, revisited"
      along.v = select(there, along.v, T{});
      const T sign = select(along.v < 0.0, all<T>(-1.0), all<T>(1.0));
      const T a = -1.0 / (sign + along.v);
      const T b = a * along.o * along.t;
      across[0] = {T{}, 1.0 + sign * a * along.o * along.o, sign * b, -sign * along.o};
      across[1] = {T{}, b, sign + a * along.t * along.t, -along.t};
    }
  }
};

// The same inverse as a sum of D terms a a^T, with the gradient along each a, separately for
// squeezing and for the barrier (zero across). Written in p = u - s and q = u + s, so neither loses
// digits to the other. One axis lies along q, close to the force, one along p, towards the surface,
// the others across both.
template <class T, int D> struct Axes {
  Vec<T, D> axis[D];
  // along axis 0 and 1
  struct Pull {
    T along, inward;
  } squeeze, barrier;

  Axes() = default;
  Axes(const Vec<T, D>& x, const Weights<T, D>& w) {
    const T s = tangent_length(x);
    const T p = x.u - s;
    const T q = x.u + s;
    const TangentAxes<T, D> tangents(x, s);
    const auto half = 0.5 * w.axial;
    const T k = half / (x.u * x.u * x.u);
    const T p3 = p * p * p;
    const T q3 = q * q * q;
    const T share = 1.0 / (2.0 + k * p3);
    const T tilt = k * p3 * share;
    const T one = sqrt(q3 * (2.0 + k * p3) / (w.lambda * (4.0 + 2.0 * k * (p3 + q3))));
    const T two = sqrt(p3 * share / w.lambda);
    axis[0] = (0.5 * one) * with_tangents<T>(1.0 - tilt, 1.0 + tilt, tangents.along);
    axis[1] = (0.5 * two) * with_tangents<T>(all<T>(1.0), all<T>(-1.0), tangents.along);
    const T across = 0.5 * p * q / sqrt(w.lambda * x.u);
    for (int j = 0; j < D - 2; ++j) axis[2 + j] = across * tangents.across[j];
    const T both = half / (x.u * x.u);
    const T near = both + 1.0 / (p * p);
    const T far = both + 1.0 / (q * q);
    squeeze = {1.5 * w.omega * one * (1.0 - tilt), 1.5 * w.omega * two};
    barrier = {-w.lambda * one * (far - tilt * near), -w.lambda * two * near};
  }
  const Vec<T, D>& operator[](int k) const { return axis[k]; }
};

// Distance from x inside the cone to its boundary along a ray. The parts that depend on x alone are
// computed once.
template <class T, int D> struct Boundary {
  Vec<T, D> x;
  T root, share;  // 1 / sqrt(x . J x) and 1 / (1 + u / sqrt(x . J x))

  explicit Boundary(const Vec<T, D>& x)
      : x(x), root(1.0 / sqrt(lorentz(x, x))), share(1.0 / (1.0 + x.u * root)) {}
  Boundary(const Vec<T, D>& x, const T& root, const T& share) : x(x), root(root), share(share) {}

  // 1 / (largest step inside the cone) is away - along for a move, and away + along for its
  // opposite.
  struct Way {
    T away, along;
  };
  [[gnu::always_inline]] Way way(const Vec<T, D>& move) const {
    const T along = lorentz(x, move) * root * root;
    const T k = (move.u * root + along) * share;
    return {root * tangent_length(move - k * x), along};
  }
  // <= 0: the whole ray is inside
  T per(const Vec<T, D>& move) const {
    const Way ray = way(move);
    return ray.away - ray.along;
  }
};

// One contact's part of the Lagrangian, min_x phi(x) - y . x with y = G^T nu, as a problem in r =
// (u - s)/(u + s): minimise 2 sqrt(lambda c1 c2) over r, with c1 = (low + high r)/2, c2 = 1 + 1/r +
// m/(1 + r), low = a - |y_t|, high = a + |y_t|, a = 3 omega - y_u, m = 2 axial. The stationary r is
// the root of high r^2 ((1 + r)^2 + m) = low ((1 + r)^2 + m r^2).
template <class T, int D> struct ContactLagrangian {
  T low, high;
  decltype(2.0 * Weights<T, D>().axial) twice;

  ContactLagrangian(const Vec<T, D>& y, const Weights<T, D>& w) {
    const T a = squeezing_cost(w.omega) - y.u;
    const T t = tangent_length(y);
    low = a - t;
    high = a + t;
    twice = 2.0 * w.axial;
  }
  // Newton step towards the root.
  T change(const T& r) const {
    const T q = 1.0 + r;
    const T p = q * q + twice;
    return (high * r * r * p - low * (q * q + twice * r * r)) /
           (high * (2.0 * r * p + 2.0 * r * r * q) - low * (2.0 * q + 2.0 * twice * r));
  }
  T value(const T& r, const Weights<T, D>& w) const {
    const T q = 1.0 + r;  // c2 = (q^2 + m r) / (r q)
    return sqrt(2.0 * w.lambda * (low + high * r) * (q * q + twice * r) / (r * q));
  }
};

// Minimum of one contact's part of the Lagrangian at y = G^T nu. It is a bound if room = a - |y_t|
// is positive.
template <class T, int D> inline T dual(const Vec<T, D>& y, const Weights<T, D>& w, T& room) {
  const ContactLagrangian<T, D> inner(y, w);
  const T k = inner.low / inner.high;
  room = inner.low;
  T r = sqrt(k);  // two contractions, then two Newton steps: r to 1e-8, and the value's error is
                  // quadratic in that of r
  for (int n = 0; n < 2; ++n)
    r = sqrt(k / (1.0 + inner.twice * (1.0 - k) / ((1.0 + r) * (1.0 + r))));
  for (int n = 0; n < 2; ++n) r -= inner.change(r);
  return inner.value(r, w);
}

// The same minimum, starting from the r of a nearby force x, without contraction. If the second
// Newton step is not a small fraction (`tight`) of r, no bound is claimed (room < 0). The possible
// error, of fourth order, is subtracted, since a value above the minimum is not a bound.
template <class T, int D> inline T dual_near(const Vec<T, D>& y, const Weights<T, D>& w,
                                             const Vec<T, D>& x, double tight, T& room) {
  const ContactLagrangian<T, D> inner(y, w);
  const T s = tangent_length(x);
  T r = (x.u - s) / (x.u + s);
  r -= inner.change(r);
  const T last = inner.change(r);
  r -= last;
  const T part = last / r;
  const T part2 = part * part;
  room = select(abs(last) < tight * r, inner.low, all<T>(-1.0));
  // of fourth order in `last`: at most 0.19 of it, or 0.29 with axial 0
  constexpr double LOST = D == 3 ? 0.25 : 0.3;
  return (1.0 - LOST * part2 * part2) * inner.value(r, w);
}

}  // namespace grasp
