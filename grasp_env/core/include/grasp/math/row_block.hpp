// A block of a system, the identity plus rank-one terms, with a border. R is a number or a
// register.
#pragma once
#include <array>
#include <cstddef>
#include <grasp/math/vec.hpp>

namespace grasp {

template <class R, int K> using Tuple = std::array<R, K>;
template <class R, std::size_t K>
inline R inner(const std::array<R, K>& a, const std::array<R, K>& b) {
  R total{};
  for (std::size_t k = 0; k < K; ++k) total += a[k] * b[k];
  return total;
}

// A row as an update of its block's factor, column by column, and its effect on right-hand sides
// and solutions. No difference cancels, however large the row is.
template <class R, int D, int T = 0> struct RowUpdate {
  // entries of the row, its part of the block's row, old over new pivot
  Tuple<R, D> p, beta, ratio;
  Tuple<R, T> shared;  // remainder for the shared variables, and its weight
  R weight;

  // b: D^-1 L^-1 of the block's right-hand side, without and then with `right` of this row.
  // Return the remainder of `right`.
  [[gnu::always_inline]] R forward(Tuple<R, D>& b, R right) const {
#pragma GCC unroll 8
    for (int j = 0; j < D; ++j) {
      right -= p[j] * b[j];
      b[j] += beta[j] * right;
    }
    return right;
  }
  // row . e + shared . t - right, from its remainder. rest: residual of the block's rows with
  // this row, then without.
  [[gnu::always_inline]] R backward(Tuple<R, D>& rest, R left) const {
#pragma GCC unroll 8
    for (int j = D - 1; j >= 0; --j) {
      const R before = left;
      left = ratio[j] * before + p[j] * rest[j];
      rest[j] -= beta[j] * before;
    }
    return left;
  }
};
// L diag(d) L^T of the identity plus the rows' rank-one terms, bordered by T shared variables.
template <class R, int D, int T = 0> struct RowBlock {
  static constexpr int K = D + T;
  R l[K][D] = {}, d[D], inverse[D];

  RowBlock() {
    for (int j = 0; j < D; ++j) d[j] = R{} + 1.0;
  }
  [[gnu::always_inline]] RowUpdate<R, D, T> update(const Tuple<R, D>& row,
                                                   const Tuple<R, T>& shared, R weight) {
    RowUpdate<R, D, T> own;
    R w[K];
    for (int j = 0; j < D; ++j) w[j] = row[j];
    for (int k = 0; k < T; ++k) w[D + k] = shared[k];
#pragma GCC unroll 8
    for (int j = 0; j < D; ++j) {
      const R p = w[j];
      const R more = d[j] + weight * p * p;
      const R per = 1.0 / more;
      own.p[j] = p;
      own.beta[j] = weight * p * per;
      own.ratio[j] = d[j] * per;
      weight *= own.ratio[j];
      d[j] = more;
#pragma GCC unroll 8
      for (int r = j + 1; r < K; ++r) {
        w[r] -= p * l[r][j];
        l[r][j] += own.beta[j] * w[r];
      }
    }
    for (int k = 0; k < T; ++k) own.shared[k] = w[D + k];
    own.weight = weight;
    return own;
  }
  // Call it after the last row.
  void finish() {
    for (int j = 0; j < D; ++j) inverse[j] = 1.0 / d[j];
  }
  // D^-1 b
  [[gnu::always_inline]] Tuple<R, D> weighed(Tuple<R, D> b) const {
    for (int j = 0; j < D; ++j) b[j] *= inverse[j];
    return b;
  }
  [[gnu::always_inline]] Tuple<R, D> forward(Tuple<R, D> b) const {  // L^-1 b
#pragma GCC unroll 8
    for (int j = 1; j < D; ++j)
#pragma GCC unroll 8
      for (int k = 0; k < j; ++k) b[j] -= l[j][k] * b[k];
    return b;
  }
  [[gnu::always_inline]] void backward(Tuple<R, D>& b) const {  // L^-T b
#pragma GCC unroll 8
    for (int j = D - 2; j >= 0; --j)
#pragma GCC unroll 8
      for (int k = j + 1; k < D; ++k) b[j] -= l[k][j] * b[k];
  }
};

// A tuple as a vector in cone coordinates, and back.
template <class R> inline Vec<R, 3> cone(const std::array<R, 3>& z) { return {z[0], z[1], z[2]}; }
template <class R> inline Vec<R, 4> cone(const std::array<R, 4>& z) {
  return {z[0], z[1], z[2], z[3]};
}
template <class R, int D> inline Tuple<R, D> tuple(const Vec<R, D>& x) {
  Tuple<R, D> out;
  for (int a = 0; a < D; ++a) out[a] = x[a];
  return out;
}

}  // namespace grasp
