// Orthogonal factors of a tall matrix whose rows differ by many orders of magnitude.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

namespace grasp {

// Householder's Q R with the largest column and, in it, the largest row first. So the error of a
// row is relative to that row (Cox and Higham, Stability of Householder QR factorization for
// weighted least squares problems, 1998).
class PivotedQr {
 public:
  // Make the matrix zero, rows >= columns.
  void resize(int rows, int columns) {
    rows_ = rows;
    columns_ = columns;
    a_.assign(std::size_t(rows * columns), 0.0);
    beta_.resize(columns);
    diagonal_.resize(columns);
    row_.resize(columns);
    column_.resize(columns);
    along_.resize(columns);
  }
  double& operator()(int r, int c) { return a_[std::size_t(rows_ * c + r)]; }

  // Factor. Return false if the columns are dependent or not finite.
  bool factor() {
    for (int k = 0; k < columns_; ++k) {
      int best = k;
      double square = 0.0;
      for (int c = k; c < columns_; ++c) {
        const double total = product(rows_ - k, &at(k, c), &at(k, c));
        if (!(total <= square)) {
          square = total;
          best = c;
        }
      }
      if (!(square > 0.0 && square < 1e300)) return false;
      column_[k] = best;
      if (best != k) std::swap_ranges(&at(0, k), &at(0, k) + rows_, &at(0, best));
      int most = k;
      for (int r = k; r < rows_; ++r)
        if (std::abs(at(r, k)) > std::abs(at(most, k))) most = r;
      row_[k] = most;
      if (most != k)
        for (int c = k; c < columns_; ++c) std::swap(at(k, c), at(most, c));
      const double head = at(k, k);
      const double size = std::copysign(std::sqrt(square), head);
      diagonal_[k] = -size;
      beta_[k] = 1.0 / (size * (head + size));
      at(k, k) = head + size;
      for (int c = k + 1; c < columns_; ++c) reflect(k, &at(0, c));
    }
    return true;
  }
  // For K = (Q R)^T: y = argmin |y - c| with K y = b, c - K^T m = y. c (rows,) becomes y, b
  // (columns,) becomes m.
  void nearest(double* c, double* b) {
    for (int k = 0; k < columns_; ++k) {
      std::swap(c[k], c[row_[k]]);
      reflect(k, c);
    }
    for (int k = 0; k < columns_; ++k) std::swap(b[k], b[column_[k]]);
    for (int k = 0; k < columns_; ++k) {  // R^T d = b
      double left = b[k];
      for (int j = 0; j < k; ++j) left -= at(j, k) * along_[j];
      along_[k] = left / diagonal_[k];
    }
    for (int k = columns_ - 1; k >= 0; --k) {  // R m = Q^T c - d
      double left = c[k] - along_[k];
      for (int j = k + 1; j < columns_; ++j) left -= at(k, j) * b[j];
      b[k] = left / diagonal_[k];
    }
    for (int k = 0; k < columns_; ++k) c[k] = along_[k];
    for (int k = columns_ - 1; k >= 0; --k) {
      reflect(k, c);
      std::swap(c[k], c[row_[k]]);
      std::swap(b[k], b[column_[k]]);
    }
  }

 private:
  int rows_ = 0, columns_ = 0;
  // a_: R above the diagonal, the reflections from it down
  std::vector<double> a_, beta_, diagonal_, along_;
  std::vector<int> row_, column_;  // row and column that each step swapped with its index

  // a . b in four sums, which run side by side.
  static double product(int size, const double* a, const double* b) {
    double sums[4] = {};
    int r = 0;
    for (; r + 4 <= size; r += 4)
      for (int k = 0; k < 4; ++k) sums[k] += a[r + k] * b[r + k];
    for (; r < size; ++r) sums[0] += a[r] * b[r];
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
  }
  double& at(int r, int c) { return a_[std::size_t(rows_ * c + r)]; }
  void reflect(int k, double* v) {
    const double* w = &at(0, k);
    const double along = beta_[k] * product(rows_ - k, w + k, v + k);
    for (int r = k; r < rows_; ++r) v[r] -= along * w[r];
  }
};

}  // namespace grasp
