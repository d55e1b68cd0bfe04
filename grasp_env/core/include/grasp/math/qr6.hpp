// Least squares in six unknowns, with rows that may differ in size by all digits of a number.
#pragma once
#include <cstring>
#include <grasp/math/linear6.hpp>

namespace grasp {

// A (n, 6) = Q R by Householder reflections, with columns and rows ordered by size. Each row keeps
// its own digits, however small it is beside the others (Cox, Higham 1998, "Stability of
// Householder QR factorization for weighted least squares problems").
class Qr6 {
 public:
  explicit Qr6(int rows) : rows_(rows), a_(6 * rows), place_(rows), work_(rows) {}

  int rows() const { return rows_; }
  double& operator()(int row, int column) { return a_[rows_ * column + row]; }

  // Factor. Return false if A does not have rank 6 in floating point.
  bool factor() {
    for (int i = 0; i < rows_; ++i) place_[i] = i;
    for (int k = 0; k < 6; ++k) order_[k] = k;
    for (int k = 0; k < 6; ++k) {
      double most = -1.0;
      int best = k;
      for (int j = k; j < 6; ++j) {
        const double square = dot(column(j), column(j), k);
        if (square > most) {
          most = square;
          best = j;
        }
      }
      std::swap(order_[k], order_[best]);
      if (best != k) std::swap_ranges(column(k), column(k) + rows_, column(best));
      double* c = column(k);
      int pivot = k;
      for (int i = k; i < rows_; ++i)
        if (std::abs(c[i]) > std::abs(c[pivot])) pivot = i;
      std::swap(place_[k], place_[pivot]);
      for (int j = 0; j < 6; ++j) std::swap(column(j)[k], column(j)[pivot]);
      const double norm = std::sqrt(most);
      if (!(norm > 0.0 && norm < infinity)) return false;
      diagonal_[k] = c[k] > 0.0 ? -norm : norm;
      scale_[k] = 1.0 / (norm * (norm + std::abs(c[k])));
      if (!(scale_[k] < infinity)) return false;
      c[k] -= diagonal_[k];
      for (int j = k + 1; j < 6; ++j) reflect(k, column(j));
    }
    return true;
  }

  // g -> g - A (A^T A)^-1 A^T g, the part orthogonal to A's columns; returns (A^T A)^-1 A^T g.
  Vec6 reject(std::vector<double>& g) {
    take(g);
    for (int k = 0; k < 6; ++k) reflect(k, work_.data());
    Vec6 n;
    for (int k = 0; k < 6; ++k) {
      n[k] = work_[k];
      work_[k] = 0.0;
    }
    give(g);
    return back(n);
  }
  // z = the least-norm z with A^T z = b; returns the n of z = A n.
  Vec6 least(const Vec6& b, std::vector<double>& z) {
    const Vec6 n = forward(b);
    std::fill(work_.begin(), work_.end(), 0.0);
    std::copy(n.begin(), n.end(), work_.begin());
    give(z);
    return back(n);
  }

 private:
  int rows_;
  std::vector<double> a_;     // columns: R above the diagonal, the reflections on and below it
  std::vector<int> place_;    // original index of each row
  std::vector<double> work_;  // (rows)
  int order_[6];              // original index of each column
  double diagonal_[6], scale_[6];

  double* column(int j) { return a_.data() + rows_ * j; }
  const double* column(int j) const { return a_.data() + rows_ * j; }
  double dot(const double* a, const double* b, int from) const {
    double total = 0.0;
    for (int i = from; i < rows_; ++i) total += a[i] * b[i];
    return total;
  }
  void reflect(int k, double* b) {
    const double* v = column(k);
    const double part = scale_[k] * dot(v, b, k);
    for (int i = k; i < rows_; ++i) b[i] -= part * v[i];
  }
  void take(const std::vector<double>& g) {
    for (int i = 0; i < rows_; ++i) work_[i] = g[place_[i]];
  }
  void give(std::vector<double>& g) {  // Q work
    for (int k = 5; k >= 0; --k) reflect(k, work_.data());
    for (int i = 0; i < rows_; ++i) g[place_[i]] = work_[i];
  }
  Vec6 forward(const Vec6& b) const {  // R^-T b, with b in the original order
    Vec6 n;
    for (int k = 0; k < 6; ++k) {
      n[k] = b[order_[k]];
      for (int j = 0; j < k; ++j) n[k] -= column(k)[j] * n[j];
      n[k] /= diagonal_[k];
    }
    return n;
  }
  Vec6 back(Vec6 n) const {  // R^-1 n, in the original order
    Vec6 out;
    for (int k = 5; k >= 0; --k) {
      for (int j = k + 1; j < 6; ++j) n[k] -= column(j)[k] * n[j];
      out[order_[k]] = n[k] /= diagonal_[k];
    }
    return out;
  }
};

// The same for contacts in lanes, D rows each: row k of all contacts of block b at once, and z with
// a number for each row.
template <class V, int D> class LaneQr6 : public Qr6 {
 public:
  explicit LaneQr6(int blocks) : Qr6(ROWS * blocks) {}

  void set(int b, int k, int column, const V& entries) {
    std::memcpy(&(*this)(first(b, k), column), &entries, sizeof(V));
  }
  static void put(std::vector<double>& z, int b, int k, const V& numbers) {
    std::memcpy(&z[first(b, k)], &numbers, sizeof(V));
  }
  static V get(const std::vector<double>& z, int b, int k) {
    V numbers;
    std::memcpy(&numbers, &z[first(b, k)], sizeof(V));
    return numbers;
  }

 private:
  static constexpr int ROWS = D * width<V>;  // rows of a block
  static constexpr int first(int b, int k) { return ROWS * b + width<V> * k; }
};

}  // namespace grasp
