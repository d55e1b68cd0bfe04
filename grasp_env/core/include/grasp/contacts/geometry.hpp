// Contact frames, the grasp matrix G and the unit frame, which makes wrenches comparable in size;
// for one grasp or a register of them. Arrays are row-major.
#pragma once
#include <grasp/math/linear6.hpp>
#include <grasp/math/vec.hpp>

namespace grasp {

using Point = Vec3<double>;  // x, y, z in the object frame

inline constexpr double TANGENT_SWITCH = 0.9;
// Allowed deviation of a normal from unit length, as rounded data have it; normals are then made
// exact.
inline constexpr double UNIT_TOLERANCE = 0.01;
// Directions closer to unit length and orthogonality than this keep their bits.
inline constexpr double ROUNDING = 1e-15;

inline Point point(const double* a) { return {a[0], a[1], a[2]}; }
template <class T> inline T length(const Vec3<T>& a) { return sqrt(dot(a, a)); }
template <class T> inline Vec3<T> normalised(const Vec3<T>& a) {
  const T size = length(a);
  return select(abs(size - 1.0) > ROUNDING, (1.0 / size) * a, a);
}

// Cone coordinates = scale * force: (mu, o mu / mu_o, t mu / mu_t), mu = sqrt(mu_o mu_t), in which
// friction cones are round with slope one. Without friction only the normal force is transmitted.
inline Point cone_scale(double mu_o, double mu_t) {
  if (!(mu_o > 0.0 && mu_t > 0.0)) return {1.0, 0.0, 0.0};
  if (mu_o == mu_t) return {mu_o, 1.0, 1.0};
  const double mu = std::sqrt(mu_o * mu_t);
  return {mu, mu / mu_o, mu / mu_t};
}

// (n, o, t), with o the projection of `along` onto the tangent plane; the default is e_x, or e_y if
// |n . e_x| > 0.9.
template <class T> struct FrameOf {
  Vec3<T> n, o, t;

  explicit FrameOf(const Vec3<T>& normal) : n(normal) {
    const Vec3<T> x{1.0 - n.u * n.u, -n.u * n.o, -n.u * n.t};
    const Vec3<T> y{-n.o * n.u, 1.0 - n.o * n.o, -n.o * n.t};
    o = normalised(select(abs(n.u) > TANGENT_SWITCH, y, x));
    t = cross(n, o);
  }
  FrameOf(const Vec3<T>& normal, const Vec3<T>& along) : n(normal), o(along) {
    // the second pass removes the rounding of o . n for a tangent close to n
    for (int pass = 0; pass < 2; ++pass) {
      const T off = dot(o, n);
      o = normalised(select(abs(off) > ROUNDING, o - off * n, o));
    }
    o = normalised(o);
    t = cross(n, o);
  }
  FrameOf(const Point& normal, const double* along)
    requires std::is_same_v<T, double>
      : FrameOf(along ? FrameOf(normal, point(along)) : FrameOf(normal)) {}
  const Vec3<T>& operator[](int a) const { return a == 0 ? n : a == 1 ? o : t; }
};
using Frame = FrameOf<double>;

// The unit frame: a wrench as (force, moment about the contacts' centre / their length) [N],
// independent of origin and size.
template <class T> struct UnitFrameOf {
  Vec3<T> centre{};
  T length{};  // [m] root mean square distance of the contacts from their centre

  UnitFrameOf() = default;
  // at(i): position of contact i
  template <class F> UnitFrameOf(int count, F&& at) {
    const T share = 1.0 / std::max(count, 1);
    for (int i = 0; i < count; ++i) centre += share * at(i);
    T square{};
    for (int i = 0; i < count; ++i) {
      const Vec3<T> arm = at(i) - centre;
      square += dot(arm, arm);
    }
    length = sqrt(square * share);
  }
  UnitFrameOf(const double* positions, int count)
    requires std::is_same_v<T, double>
      : UnitFrameOf(count, [&](int i) { return point(positions + 3 * i); }) {}
  template <class O>
  explicit UnitFrameOf(const UnitFrameOf<O>& one)  // for all problems of a register
    requires many<T> && std::is_same_v<O, double>
      : centre{one.centre.u, one.centre.o, one.centre.t}, length(one.length) {}
  T scale() const { return select(length > 0.0, 1.0 / length, T(1.0)); }

  Six<T> of(const Six<T>& w) const {
    const Vec3<T> force{w[0], w[1], w[2]};
    const Vec3<T> moment = scale() * (Vec3<T>{w[3], w[4], w[5]} - cross(centre, force));
    return {force.u, force.o, force.t, moment.u, moment.o, moment.t};
  }
  Vec6 of(const double* w) const
    requires std::is_same_v<T, double>
  {
    return of(Vec6{w[0], w[1], w[2], w[3], w[4], w[5]});
  }
  // The wrench that has these components in this frame.
  Six<T> out_of(const Six<T>& w) const {
    const Vec3<T> force{w[0], w[1], w[2]};
    const Vec3<T> moment = (1.0 / scale()) * Vec3<T>{w[3], w[4], w[5]} + cross(centre, force);
    return {force.u, force.o, force.t, moment.u, moment.o, moment.t};
  }
  // Multipliers of the given wrench from those in this frame: the transposed map.
  Six<T> pull_back(const Six<T>& n) const {
    const Vec3<T> moment = scale() * Vec3<T>{n[3], n[4], n[5]};
    const Vec3<T> force = Vec3<T>{n[0], n[1], n[2]} - cross(moment, centre);
    return {force.u, force.o, force.t, moment.u, moment.o, moment.t};
  }
  // Write the map, (6, 6).
  void write(double* out) const
    requires std::is_same_v<T, double>
  {
    for (int c = 0; c < 6; ++c) {
      double unit[6] = {};
      unit[c] = 1.0;
      const Vec6 column = of(unit);
      for (int r = 0; r < 6; ++r) out[6 * r + c] = column[r] + 0.0;  // + 0: no negative zeros
    }
  }
};

using UnitFrame = UnitFrameOf<double>;

inline Vec6 column(const double* matrix, int columns, int j) {
  Vec6 out;
  for (int r = 0; r < 6; ++r) out[r] = matrix[columns * r + j];
  return out;
}
inline void set_column(double* matrix, int columns, int j, const Vec6& a) {
  for (int r = 0; r < 6; ++r) matrix[columns * r + j] = a[r];
}
// Add a column of six rows to their Gram matrix.
template <class T> [[gnu::always_inline]] inline void add_gram(Packed<T>& s, const Six<T>& column) {
#pragma GCC unroll 8
  for (int r = 0; r < 6; ++r)
#pragma GCC unroll 8
    for (int q = 0; q <= r; ++q) s[packed(r, q)] += column[r] * column[q];
}
inline Packed6 gram(const double* rows, int columns) {
  Packed6 s;
  for (int r = 0; r < 6; ++r)
    for (int q = 0; q <= r; ++q) {
      double total = 0.0;
      for (int j = 0; j < columns; ++j) total += rows[columns * r + j] * rows[columns * q + j];
      s[packed(r, q)] = total;
    }
  return s;
}

// Lower bound of the smallest eigenvalue of a 6 x 6 Gram matrix s over its trace, from its factors;
// 0 if rounding may have caused it. Above CLEAR_RANK the rank is 6 beyond doubt; below it only
// singular values can tell. det S <= smallest eigenvalue * (trace / 5)^5, so the pivots bound it.
inline constexpr double CLEAR_RANK = 1e-10;
template <class T> inline T rank_bound(const Packed<T>& s, const Ldl<T>& factor) {
  constexpr double LOST = 1e-13;  // of the trace: largest pivot that rounding may cause
  T trace{}, bound = 1.0;
  for (int r = 0; r < 6; ++r) trace += s[packed(r, r)];
  auto clear = trace > 0.0;
  for (int r = 0; r < 6; ++r) {
    const T pivot = 1.0 / factor.l[packed(r, r)];
    clear = clear & (pivot > LOST * trace);
    bound *= pivot * (5.0 / trace);
  }
  return select(clear, 0.2 * bound, T(0.0));
}

// The wrench of a unit force along an axis at the end of an arm.
template <class T> inline Six<T> unit_wrench(const Vec3<T>& arm, const Vec3<T>& axis) {
  const Vec3<T> moment = cross(arm, axis);
  return {axis.u, axis.o, axis.t, moment.u, moment.o, moment.t};
}

}  // namespace grasp
