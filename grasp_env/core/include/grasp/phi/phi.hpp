// Phi = sum_i 3 omega u + lambda (1/u + 2u/d), d = u^2 - o^2 - t^2 (Eqs. 10, 30, 31). Each formula
// stands here once, per contact, for a number or for a register of contacts.
#pragma once
#include <grasp/math/vec3.hpp>

namespace grasp {

// omega and lambda: weights of squeezing, and of approaching a cone [N^2].
template <class T> struct Weights {
  T omega, lambda;
};

// Cost of a unit of u by squeezing.
template <class T> inline T squeezing_cost(const T& omega) { return 3.0 * omega; }

template <class T> inline T phi(const Vec3<T>& x, const Weights<T>& w) {
  return squeezing_cost(w.omega) * x.u + w.lambda * (1.0 / x.u + 2.0 * x.u / lorentz(x, x));
}

// Phi and its gradient, from the same two divisions.
template <class T> inline T phi(const Vec3<T>& x, const Weights<T>& w, Vec3<T>& gradient) {
  const T u2 = x.u * x.u;
  const T s2 = x.o * x.o + x.t * x.t;
  const T d = u2 - s2;
  const T i = 1.0 / d;
  const T i2 = i * i;
  const T iu = 1.0 / x.u;
  const T k = 4.0 * w.lambda * i2 * x.u;
  gradient = {squeezing_cost(w.omega) - w.lambda * (iu * iu + 2.0 * i2 * (u2 + s2)), k * x.o,
              k * x.t};
  return squeezing_cost(w.omega) * x.u + w.lambda * (iu + 2.0 * x.u * i);
}

template <class T> inline Vec3<T> gradient(const Vec3<T>& x, const Weights<T>& w) {
  Vec3<T> out;
  phi(x, w, out);
  return out;
}

// Second derivative of Phi along a move.
template <class T> inline T curvature(const Vec3<T>& x, const Vec3<T>& move, const Weights<T>& w) {
  const T u2 = x.u * x.u;
  const T s2 = x.o * x.o + x.t * x.t;
  const T along = x.o * move.o + x.t * move.t;
  const T i = 1.0 / x.u;
  const T j = 1.0 / (u2 - s2);
  const T j2 = j * j;
  return w.lambda *
         ((2.0 * i * i * i + 4.0 * x.u * (u2 + 3.0 * s2) * j2 * j) * move.u * move.u -
          8.0 * (3.0 * u2 + s2) * j2 * j * move.u * along +
          4.0 * x.u * j2 * (move.o * move.o + move.t * move.t + 4.0 * j * along * along));
}

// Inverse Hessian in closed form, without differences that cancel close to a cone. With p = u + s
// and q = u - s, the part of Phi in the plane of u and s is lambda (2/(p+q) + 1/p + 1/q), with
// Hessian diag(2/p^3, 2/q^3) + 4/(p+q)^3 (1, 1)(1, 1)^T.
template <class T> inline Sym3<T> inverse_hessian(const Vec3<T>& x, const Weights<T>& w) {
  const auto [u, o, t] = x;
  const T u2 = u * u;
  const T s2 = o * o + t * t;
  const T d = u2 - s2;
  const T iu = 1.0 / u;
  const T scale = 1.0 / (6.0 * w.lambda * (u2 + s2));
  const T along = scale * u2 * (3.0 * u2 + s2);
  const T across = d * d * iu / (4.0 * w.lambda);
  const T bend = scale * (3.0 * u2 * (u2 + s2) - 2.0 * s2 * s2) * iu;
  return {scale * u2 * u * (u2 + 3.0 * s2),
          along * o,
          along * t,
          across + bend * o * o,
          bend * o * t,
          across + bend * t * t};
}

// The same inverse as a sum of three terms a a^T, with the gradient along each a, separately for
// squeezing and for the barrier (zero along `across`). Written in p = u - s and q = u
// + s, so neither loses digits to the other. One axis lies along q, close to the force, one along
// p, towards the surface, one across both.
template <class T> struct Axes {
  Vec3<T> along, inward, across;
  struct Pull {
    T along, inward;
  } squeeze, barrier;

  Axes() = default;
  Axes(const Vec3<T>& x, const Weights<T>& w) {
    const T s = sqrt(x.o * x.o + x.t * x.t);
    const T p = x.u - s;
    const T q = x.u + s;
    const T o = s > 1e-140 ? x.o / s : all<T>(1.0);
    const T t = s > 1e-140 ? x.t / s : T{};
    const T k = 0.5 / (x.u * x.u * x.u);
    const T p3 = p * p * p;
    const T q3 = q * q * q;
    const T share = 1.0 / (2.0 + k * p3);
    const T tilt = k * p3 * share;
    const T one = sqrt(q3 * (2.0 + k * p3) / (w.lambda * (4.0 + 2.0 * k * (p3 + q3))));
    const T two = sqrt(p3 * share / w.lambda);
    along = (0.5 * one) * Vec3<T>{1.0 - tilt, (1.0 + tilt) * o, (1.0 + tilt) * t};
    inward = (0.5 * two) * Vec3<T>{all<T>(1.0), -o, -t};
    across = (0.5 * p * q / sqrt(w.lambda * x.u)) * Vec3<T>{T{}, -t, o};
    const T both = 0.5 / (x.u * x.u);
    const T near = both + 1.0 / (p * p);
    const T far = both + 1.0 / (q * q);
    squeeze = {1.5 * w.omega * one * (1.0 - tilt), 1.5 * w.omega * two};
    barrier = {-w.lambda * one * (far - tilt * near), -w.lambda * two * near};
  }
  const Vec3<T>& operator[](int k) const { return k == 0 ? along : k == 1 ? inward : across; }
};

// Distance from x inside the cone to its boundary along a ray. The parts that depend on x alone are
// computed once.
template <class T> struct Boundary {
  Vec3<T> x;
  T root, share;  // 1 / sqrt(x . J x) and 1 / (1 + u / sqrt(x . J x))

  explicit Boundary(const Vec3<T>& x)
      : x(x), root(1.0 / sqrt(lorentz(x, x))), share(1.0 / (1.0 + x.u * root)) {}
  Boundary(const Vec3<T>& x, const T& root, const T& share) : x(x), root(root), share(share) {}

  // 1 / (largest step inside the cone) is away - along for a move, and away + along for its
  // opposite.
  struct Way {
    T away, along;
  };
  [[gnu::always_inline]] Way way(const Vec3<T>& move) const {
    const T along = lorentz(x, move) * root * root;
    const T k = (move.u * root + along) * share;
    const T a = move.o - k * x.o;
    const T b = move.t - k * x.t;
    return {root * sqrt(a * a + b * b), along};
  }
  // <= 0: the whole ray is inside
  T per(const Vec3<T>& move) const {
    const Way ray = way(move);
    return ray.away - ray.along;
  }
};

// One contact's part of the Lagrangian, min_x phi(x) - y . x with y = G^T nu, as a problem in r =
// (u - s)/(u + s): minimise 2 sqrt(lambda c1 c2) over r, with c1 = (low + high r)/2, c2 = 1 + 1/r +
// 2/(1 + r), low = a - |y_t|, high = a + |y_t|, a = 3 omega - y_u. The stationary r is the root of
// high r^2 ((1 + r)^2 + 2) = low ((1 + r)^2 + 2 r^2).
template <class T> struct ContactLagrangian {
  T low, high;

  ContactLagrangian(const Vec3<T>& y, const Weights<T>& w) {
    const T a = squeezing_cost(w.omega) - y.u;
    const T t = sqrt(y.o * y.o + y.t * y.t);
    low = a - t;
    high = a + t;
  }
  // Newton step towards the root.
  T change(const T& r) const {
    const T q = 1.0 + r;
    const T p = q * q + 2.0;
    return (high * r * r * p - low * (q * q + 2.0 * r * r)) /
           (high * (2.0 * r * p + 2.0 * r * r * q) - low * (2.0 * q + 4.0 * r));
  }
  T value(const T& r, const Weights<T>& w) const {
    const T q = 1.0 + r;  // c2 = (q^2 + 2 r) / (r q)
    return sqrt(2.0 * w.lambda * (low + high * r) * (q * q + 2.0 * r) / (r * q));
  }
};

// Minimum of one contact's part of the Lagrangian at y = G^T nu. It is a bound if room = a - |y_t|
// is positive.
template <class T> inline T dual(const Vec3<T>& y, const Weights<T>& w, T& room) {
  const ContactLagrangian<T> inner(y, w);
  const T k = inner.low / inner.high;
  room = inner.low;
  T r = sqrt(k);  // two contractions (factor below 0.16), then two Newton steps; the value's error
                  // is quadratic in that of r
  for (int n = 0; n < 2; ++n) r = sqrt(k / (1.0 + 2.0 * (1.0 - k) / ((1.0 + r) * (1.0 + r))));
  for (int n = 0; n < 2; ++n) r -= inner.change(r);
  return inner.value(r, w);
}

// The same minimum, starting from the r of a nearby force x, without contraction. If the second
// Newton step is not a small fraction (`tight`) of r, no bound is claimed (room < 0). The possible
// error, of fourth order, is subtracted, since a value above the minimum is not a bound.
template <class T>
inline T dual_near(const Vec3<T>& y, const Weights<T>& w, const Vec3<T>& x, double tight, T& room) {
  const ContactLagrangian<T> inner(y, w);
  const T s = sqrt(x.o * x.o + x.t * x.t);
  T r = (x.u - s) / (x.u + s);
  r -= inner.change(r);
  const T last = inner.change(r);
  r -= last;
  const T part = last / r;
  const T part2 = part * part;
  room = select(abs(last) < tight * r, inner.low, all<T>(-1.0));
  return (1.0 - 0.25 * part2 * part2) * inner.value(r, w);  // of fourth order in `last`
}

}  // namespace grasp
