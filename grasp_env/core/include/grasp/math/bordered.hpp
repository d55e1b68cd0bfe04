// Symmetric systems of six equations with a border of any size.
#pragma once
#include <vector>
#include <grasp/math/linear6.hpp>

namespace grasp {

// L D L^T of a matrix whose first six rows are a `Packed6`. It is positive definite, but for the
// last rows, whose pivots are `negative`.
class Bordered {
 public:
  // Make `resize` free of allocations up to this border.
  void reserve(int border) {
    l_.reserve(packed(6 + border, 0));
    right_.reserve(6 + border);
  }
  void resize(int border, int negative = 0) {
    size_ = 6 + border;
    positive_ = size_ - negative;
    l_.assign(std::size_t(packed(size_, 0)), 0.0);
    right_.resize(size_);
  }
  // Entry of the lower triangle in the border, r >= 6, before `factor`.
  double& operator()(int r, int s) { return l_[packed(r, s)]; }
  // The right-hand side, then the solution.
  double& operator[](int r) { return right_[r]; }

  // Return false if a pivot has another sign in floating point.
  bool factor(const Packed6& corner) {
    if (!(first_.factor(corner) > 0.0)) return false;
    bool good = true;
    for (int j = 6; j < size_; ++j) {
      double* row = &l_[packed(j, 0)];
      for (int r = 0; r < j; ++r) {
        const double* other = r < 6 ? &first_.l[packed(r, 0)] : &l_[packed(r, 0)];
        double c = row[r];
        for (int k = 0; k < r; ++k) c -= row[k] * other[k];
        row[r] = c;  // L D until the row is done
      }
      double pivot = row[j];
      for (int r = 0; r < j; ++r) {
        const double scaled = row[r] * (r < 6 ? first_.l[packed(r, r)] : l_[packed(r, r)]);
        pivot -= row[r] * scaled;
        row[r] = scaled;
      }
      good = good && (j < positive_ ? pivot > 0.0 : pivot < 0.0);
      row[j] = 1.0 / pivot;
    }
    return good;
  }
  void solve() {
    Vec6 first;
    for (int r = 0; r < 6; ++r) first[r] = right_[r];
    if (size_ == 6) {
      first = first_.solve(first);
      for (int r = 0; r < 6; ++r) right_[r] = first[r];
      return;
    }
    const auto row = [&](int j) { return j < 6 ? &first_.l[packed(j, 0)] : &l_[packed(j, 0)]; };
    for (int j = 1; j < size_; ++j)
      for (int k = 0; k < j; ++k) right_[j] -= row(j)[k] * right_[k];
    for (int j = 0; j < size_; ++j) right_[j] *= row(j)[j];
    for (int j = size_ - 1; j >= 0; --j)
      for (int k = 0; k < j; ++k) right_[k] -= row(j)[k] * right_[j];
  }

 private:
  int size_ = 6, positive_ = 6;
  Ldl6 first_;
  std::vector<double> l_;  // packed, rows from 6 on
  std::vector<double> right_ = std::vector<double>(6);
};

}  // namespace grasp
