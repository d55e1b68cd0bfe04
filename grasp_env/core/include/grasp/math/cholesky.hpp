// A symmetric positive definite system of any size; allocates only in the constructor.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

namespace grasp {

class Cholesky {
 public:
  explicit Cholesky(int size) : size_(size), lower_(std::size_t(size) * size) {}

  // Entry of the lower triangle, i >= j: of the matrix before `factor`, of the factor after it.
  double& operator()(int i, int j) { return lower_[std::size_t(size_) * i + j]; }
  double operator()(int i, int j) const { return lower_[std::size_t(size_) * i + j]; }

  // Factor. Return false if the matrix is not positive definite. floor: smallest square of a pivot;
  // smaller ones are raised to it.
  bool factor(double floor = 0.0) {
    for (int j = 0; j < size_; ++j) {
      double pivot = (*this)(j, j);
      for (int k = 0; k < j; ++k) pivot -= (*this)(j, k) * (*this)(j, k);
      pivot = std::max(pivot, floor);
      if (!(pivot > 0.0)) return false;
      (*this)(j, j) = std::sqrt(pivot);
      for (int i = j + 1; i < size_; ++i) {
        double total = (*this)(i, j);
        for (int k = 0; k < j; ++k) total -= (*this)(i, k) * (*this)(j, k);
        (*this)(i, j) = total / (*this)(j, j);
      }
    }
    return true;
  }

  void solve(double* b) const {
    for (int i = 0; i < size_; ++i) {
      for (int k = 0; k < i; ++k) b[i] -= (*this)(i, k) * b[k];
      b[i] /= (*this)(i, i);
    }
    for (int i = size_ - 1; i >= 0; --i) {
      for (int k = i + 1; k < size_; ++k) b[i] -= (*this)(k, i) * b[k];
      b[i] /= (*this)(i, i);
    }
  }

 private:
  int size_;
  std::vector<double> lower_;
};

}  // namespace grasp
