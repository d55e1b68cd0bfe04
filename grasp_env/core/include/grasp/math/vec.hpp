// Vectors per contact, such as a force in cone coordinates: (u, o, t), or (u, o, t, v) with the
// torsion v of a soft contact; and symmetric blocks. T is a number or a register.
#pragma once
#include <grasp/math/lanes.hpp>

namespace grasp {

template <class T, int D> struct Vec;
template <class T> using Vec3 = Vec<T, 3>;

template <class T> struct Vec<T, 3> {
  static constexpr int size = 3;
  T u, o, t;
  friend Vec operator+(const Vec& a, const Vec& b) { return {a.u + b.u, a.o + b.o, a.t + b.t}; }
  friend Vec operator-(const Vec& a, const Vec& b) { return {a.u - b.u, a.o - b.o, a.t - b.t}; }
  friend Vec operator-(const Vec& a) { return {-a.u, -a.o, -a.t}; }
  friend Vec operator*(const T& k, const Vec& a) { return {k * a.u, k * a.o, k * a.t}; }
  friend Vec operator/(const Vec& a, const T& k) { return {a.u / k, a.o / k, a.t / k}; }
  Vec& operator+=(const Vec& b) { return *this = *this + b; }
  Vec& operator-=(const Vec& b) { return *this = *this - b; }
  T& operator[](int a) { return a == 0 ? u : a == 1 ? o : t; }
  const T& operator[](int a) const { return a == 0 ? u : a == 1 ? o : t; }
};

template <class T> struct Vec<T, 4> {
  static constexpr int size = 4;
  T u, o, t, v;
  friend Vec operator+(const Vec& a, const Vec& b) {
    return {a.u + b.u, a.o + b.o, a.t + b.t, a.v + b.v};
  }
  friend Vec operator-(const Vec& a, const Vec& b) {
    return {a.u - b.u, a.o - b.o, a.t - b.t, a.v - b.v};
  }
  friend Vec operator-(const Vec& a) { return {-a.u, -a.o, -a.t, -a.v}; }
  friend Vec operator*(const T& k, const Vec& a) { return {k * a.u, k * a.o, k * a.t, k * a.v}; }
  friend Vec operator/(const Vec& a, const T& k) { return {a.u / k, a.o / k, a.t / k, a.v / k}; }
  Vec& operator+=(const Vec& b) { return *this = *this + b; }
  Vec& operator-=(const Vec& b) { return *this = *this - b; }
  T& operator[](int a) { return a == 0 ? u : a == 1 ? o : a == 2 ? t : v; }
  const T& operator[](int a) const { return a == 0 ? u : a == 1 ? o : a == 2 ? t : v; }
};

// The vector with this part along u and these tangential ones: k times those of x.
template <class T> inline Vec<T, 3> with_tangents(const T& u, const T& k, const Vec<T, 3>& x) {
  return {u, k * x.o, k * x.t};
}
template <class T> inline Vec<T, 4> with_tangents(const T& u, const T& k, const Vec<T, 4>& x) {
  return {u, k * x.o, k * x.t, k * x.v};
}
// The vector along u.
template <int D, class T> inline Vec<T, D> axis(const T& u) {
  Vec<T, D> out{};
  out.u = u;
  return out;
}

// Sum of products of the tangential parts.
template <class T> inline T dot_tangents(const Vec<T, 3>& a, const Vec<T, 3>& b) {
  return a.o * b.o + a.t * b.t;
}
template <class T> inline T dot_tangents(const Vec<T, 4>& a, const Vec<T, 4>& b) {
  return a.o * b.o + a.t * b.t + a.v * b.v;
}
template <class T> inline T dot(const Vec<T, 3>& a, const Vec<T, 3>& b) {
  return a.u * b.u + a.o * b.o + a.t * b.t;
}
template <class T> inline T dot(const Vec<T, 4>& a, const Vec<T, 4>& b) {
  return (a.u * b.u + a.o * b.o) + (a.t * b.t + a.v * b.v);
}
// a . J b, J = diag(1, -1, ..): > 0 for a = b inside the cone u > |(o, t, ..)|
template <class T> inline T lorentz(const Vec<T, 3>& a, const Vec<T, 3>& b) {
  return a.u * b.u - a.o * b.o - a.t * b.t;
}
template <class T> inline T lorentz(const Vec<T, 4>& a, const Vec<T, 4>& b) {
  return a.u * b.u - a.o * b.o - a.t * b.t - a.v * b.v;
}
// Length of the tangential parts.
template <class T, int D> inline T tangent_length(const Vec<T, D>& a) {
  return sqrt(dot_tangents(a, a));
}
// Distance to the cone's surface along u.
template <class T, int D> inline T slack(const Vec<T, D>& a) { return a.u - tangent_length(a); }
template <class T> inline Vec3<T> cross(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.o * b.t - a.t * b.o, a.t * b.u - a.u * b.t, a.u * b.o - a.o * b.u};
}

// Componentwise.
template <class T, class Which>
inline Vec<T, 3> select(const Which& which, const Vec<T, 3>& a, const Vec<T, 3>& b) {
  return {select(which, a.u, b.u), select(which, a.o, b.o), select(which, a.t, b.t)};
}
template <class T, class Which>
inline Vec<T, 4> select(const Which& which, const Vec<T, 4>& a, const Vec<T, 4>& b) {
  return {select(which, a.u, b.u), select(which, a.o, b.o), select(which, a.t, b.t),
          select(which, a.v, b.v)};
}

// Symmetric blocks.
template <class T, int D> struct Sym;
template <class T> using Sym3 = Sym<T, 3>;

template <class T> struct Sym<T, 3> {
  T uu, uo, ut, oo, ot, tt;
  Vec<T, 3> operator*(const Vec<T, 3>& y) const {
    return {uu * y.u + uo * y.o + ut * y.t, uo * y.u + oo * y.o + ot * y.t,
            ut * y.u + ot * y.o + tt * y.t};
  }
  // this -= k a a^T
  void subtract(const T& k, const Vec<T, 3>& a) {
    const Vec<T, 3> f = k * a;
    uu -= f.u * a.u;
    uo -= f.u * a.o;
    ut -= f.u * a.t;
    oo -= f.o * a.o;
    ot -= f.o * a.t;
    tt -= f.t * a.t;
  }
};

template <class T> struct Sym<T, 4> {
  T uu, uo, ut, uv, oo, ot, ov, tt, tv, vv;
  Vec<T, 4> operator*(const Vec<T, 4>& y) const {
    return {uu * y.u + uo * y.o + ut * y.t + uv * y.v, uo * y.u + oo * y.o + ot * y.t + ov * y.v,
            ut * y.u + ot * y.o + tt * y.t + tv * y.v, uv * y.u + ov * y.o + tv * y.t + vv * y.v};
  }
  void subtract(const T& k, const Vec<T, 4>& a) {
    const Vec<T, 4> f = k * a;
    uu -= f.u * a.u;
    uo -= f.u * a.o;
    ut -= f.u * a.t;
    uv -= f.u * a.v;
    oo -= f.o * a.o;
    ot -= f.o * a.t;
    ov -= f.o * a.v;
    tt -= f.t * a.t;
    tv -= f.t * a.v;
    vv -= f.v * a.v;
  }
};

}  // namespace grasp
