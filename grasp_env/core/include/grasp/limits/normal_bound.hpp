// The largest force of a contact within the rows of limits on it.
#pragma once
#include <initializer_list>
#include <vector>
#include <grasp/math/linear6.hpp>
#include <grasp/math/vec.hpp>

namespace grasp {

// [N] bound of what no row bounds; finite, so that 0 times it is 0
inline constexpr double UNBOUNDED = 1e30;

// Rows that each act on the force of one contact, cone coordinates.
struct LimitRows {
  int count = 0;
  const double* normal = nullptr;  // (M, 3) of length one; zero: independent of the forces
  const double* bound = nullptr;   // (M,) b [N]
  const double* share = nullptr;   // (M,) growth of b if the limit doubles [N]
  const int* contact = nullptr;    // (M,)
};

// The rows of a pair of opposite limits; -1: none.
struct RowPair {
  int high, low;
};

// Largest u within the rows of a contact and its cone, and its growth with the limits: u <= sum z b
// for any z >= 0 with sum z a - e_u in the dual cone. Tries one, two and three pairs.
class NormalBound {
 public:
  double most = UNBOUNDED, more = 0.0;

  NormalBound(const LimitRows& rows, const std::vector<RowPair>& pairs) : rows_(rows) {
    const int count = std::min(int(pairs.size()), MAX_PAIRS);
    for (int i = 0; i < count; ++i) {
      try_one(pairs[i]);
      for (int j = 0; j < i; ++j) {
        try_two(pairs[i], pairs[j]);
        for (int k = 0; k < j; ++k) try_three(pairs[i], pairs[j], pairs[k]);
      }
    }
  }

 private:
  static constexpr int MAX_PAIRS = 8;
  static constexpr double CLEAR = 1e-3;  // threshold above rounding for a combination
  const LimitRows& rows_;

  Vec3<double> normal(const RowPair& p) const {
    const double* a = rows_.normal + 3 * p.high;
    return {a[0], a[1], a[2]};
  }
  // z of either sign, for the pair's first row
  void consider(std::initializer_list<RowPair> pairs, std::initializer_list<double> z) {
    double bound = 0.0, share = 0.0;
    auto part = z.begin();
    for (const RowPair& p : pairs) {
      const int m = *part > 0.0 ? p.high : p.low;
      if (m < 0 && *part != 0.0) return;
      if (m >= 0) {
        bound += std::abs(*part) * std::max(rows_.bound[m], 0.0);
        share += std::abs(*part) * rows_.share[m];
      }
      ++part;
    }
    if (bound < most) {
      most = bound;
      more = share;
    }
  }
  void try_one(const RowPair& p) {
    const Vec3<double> a = normal(p);
    if (slack(a) > CLEAR) consider({p}, {1.0 / slack(a)});
    if (slack(-a) > CLEAR) consider({p}, {-1.0 / slack(-a)});
  }
  // e_u + r in the plane of a and b, with r on the dual cone, if the plane's normal lies outside
  // the cone
  void try_two(const RowPair& p, const RowPair& q) {
    const Vec3<double> a = normal(p);
    const Vec3<double> b = normal(q);
    const Vec3<double> n = cross(a, b);
    const double across = std::sqrt(n.o * n.o + n.t * n.t);
    const double clear = across - std::abs(n.u);
    const double square = dot(n, n);
    if (!(clear > CLEAR * across && square > CLEAR * CLEAR)) return;
    const double size = std::abs(n.u) / clear;
    const double turn = (n.u > 0.0 ? -size : size) / across;
    const Vec3<double> e{1.0 + size, turn * n.o, turn * n.t};
    consider({p, q}, {dot(cross(e, b), n) / square, dot(cross(a, e), n) / square});
  }
  void try_three(const RowPair& p, const RowPair& q, const RowPair& r) {  // e_u itself
    const Vec3<double> a = normal(p);
    const Vec3<double> b = normal(q);
    const Vec3<double> c = normal(r);
    const Vec3<double> bc = cross(b, c);
    const Vec3<double> ca = cross(c, a);
    const Vec3<double> ab = cross(a, b);
    const double volume = dot(a, bc);
    if (std::abs(volume) > CLEAR * CLEAR)
      consider({p, q, r}, {bc.u / volume, ca.u / volume, ab.u / volume});
  }
};

}  // namespace grasp
