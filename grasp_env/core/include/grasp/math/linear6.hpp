// Systems of six equations, for any number of contacts: packed lower triangles and their factors L
// D L^T.
#pragma once
#include <algorithm>
#include <cmath>
#include <grasp/math/lanes.hpp>

namespace grasp {

template <class S> using Six = std::array<S, 6>;
using Vec6 = Six<double>;

template <class S> inline Six<S> operator+(Six<S> a, const Six<S>& b) {
  for (int r = 0; r < 6; ++r) a[r] += b[r];
  return a;
}
template <class S> inline Six<S> operator-(Six<S> a, const Six<S>& b) {
  for (int r = 0; r < 6; ++r) a[r] -= b[r];
  return a;
}
template <class S> inline Six<S> operator*(const std::type_identity_t<S>& k, Six<S> a) {
  for (int r = 0; r < 6; ++r) a[r] *= k;
  return a;
}
template <class S> inline S dot(const Six<S>& a, const Six<S>& b) {
  S total{};
  for (int r = 0; r < 6; ++r) total += a[r] * b[r];
  return total;
}
// Largest magnitude.
template <class S> inline S size(const Six<S>& a) {
  S most{};
  for (const S& v : a) most = select(abs(v) <= most, most, abs(v));  // keeps nan
  return most;
}

// Sum of magnitudes: an inner product is at most this times the other vector's `size`.
inline double sum_of_sizes(const Vec6& a) {
  double total = 0.0;
  for (double v : a) total += std::abs(v);
  return total;
}

// Componentwise.
template <class S, class Which>
inline Six<S> select(const Which& which, Six<S> a, const Six<S>& b) {
  for (int r = 0; r < 6; ++r) a[r] = select(which, a[r], b[r]);
  return a;
}

constexpr int packed(int r, int s) { return r * (r + 1) / 2 + s; }
template <class S> using Packed = std::array<S, 21>;
using Packed6 = Packed<double>;

template <class S> struct Ldl {
  Packed<S> l;  // L below, 1 / D on the diagonal

  // Factor a packed lower triangle. Return the smallest pivot, which is positive if the matrix is
  // positive definite.
  S factor(const Packed<S>& s) {
    S smallest = infinity;
#pragma GCC unroll 8
    for (int j = 0; j < 6; ++j) {
      S c[6];
      S d = s[packed(j, j)];
#pragma GCC unroll 8
      for (int k = 0; k < j; ++k) {
        c[k] = s[packed(j, k)];
#pragma GCC unroll 8
        for (int m = 0; m < k; ++m) c[k] -= c[m] * l[packed(k, m)];
        l[packed(j, k)] = c[k] * l[packed(k, k)];
        d -= c[k] * l[packed(j, k)];
      }
      l[packed(j, j)] = 1.0 / d;
      smallest = select((d < smallest) | (d != d), d, smallest);
    }
    return smallest;
  }

  [[gnu::always_inline]] Six<S> solve(Six<S> b) const {
#pragma GCC unroll 8
    for (int j = 1; j < 6; ++j)
#pragma GCC unroll 8
      for (int k = 0; k < j; ++k) b[j] -= l[packed(j, k)] * b[k];
#pragma GCC unroll 8
    for (int j = 5; j >= 0; --j) {
      b[j] *= l[packed(j, j)];
#pragma GCC unroll 8
      for (int k = j + 1; k < 6; ++k) b[j] -= l[packed(k, j)] * b[k];
    }
    return b;
  }
};
using Ldl6 = Ldl<double>;

}  // namespace grasp
