// Triples per contact, such as a force (u, o, t) in cone coordinates, and symmetric 3 x 3 blocks; T
// is a number or a register.
#pragma once
#include <grasp/math/lanes.hpp>

namespace grasp {

template <class T> struct Vec3 {
  T u, o, t;
  friend Vec3 operator+(const Vec3& a, const Vec3& b) { return {a.u + b.u, a.o + b.o, a.t + b.t}; }
  friend Vec3 operator-(const Vec3& a, const Vec3& b) { return {a.u - b.u, a.o - b.o, a.t - b.t}; }
  friend Vec3 operator-(const Vec3& a) { return {-a.u, -a.o, -a.t}; }
  friend Vec3 operator*(const T& k, const Vec3& a) { return {k * a.u, k * a.o, k * a.t}; }
  friend Vec3 operator/(const Vec3& a, const T& k) { return {a.u / k, a.o / k, a.t / k}; }
  Vec3& operator+=(const Vec3& b) { return *this = *this + b; }
  Vec3& operator-=(const Vec3& b) { return *this = *this - b; }
  T& operator[](int a) { return a == 0 ? u : a == 1 ? o : t; }
  const T& operator[](int a) const { return a == 0 ? u : a == 1 ? o : t; }
};

template <class T> inline T dot(const Vec3<T>& a, const Vec3<T>& b) {
  return a.u * b.u + a.o * b.o + a.t * b.t;
}
// a . J b, J = diag(1, -1, -1): > 0 for a = b inside the cone u > |(o, t)|
template <class T> inline T lorentz(const Vec3<T>& a, const Vec3<T>& b) {
  return a.u * b.u - a.o * b.o - a.t * b.t;
}
// Distance to the cone's surface along u.
template <class T> inline T slack(const Vec3<T>& a) { return a.u - sqrt(a.o * a.o + a.t * a.t); }
template <class T> inline Vec3<T> cross(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.o * b.t - a.t * b.o, a.t * b.u - a.u * b.t, a.u * b.o - a.o * b.u};
}

// Componentwise.
template <class T, class Which>
inline Vec3<T> select(const Which& which, const Vec3<T>& a, const Vec3<T>& b) {
  return {select(which, a.u, b.u), select(which, a.o, b.o), select(which, a.t, b.t)};
}

template <class T> struct Sym3 {
  T uu, uo, ut, oo, ot, tt;
  Vec3<T> operator*(const Vec3<T>& y) const {
    return {uu * y.u + uo * y.o + ut * y.t, uo * y.u + oo * y.o + ot * y.t,
            ut * y.u + ot * y.o + tt * y.t};
  }
};

}  // namespace grasp
