// Symmetric positive definite systems of any size, for a register of problems.
#pragma once
#include <vector>
#include <grasp/math/linear6.hpp>

namespace grasp {

// Factors L D L^T of a matrix.
template <class V> class AnyLdl {
 public:
  void resize(int size) {
    size_ = size;
    l_.assign(std::size_t(size * (size + 1) / 2), V{});
  }
  V& operator()(int r, int s) { return l_[packed(r, s)]; }  // the lower triangle, before `factor`
  void clear() { std::fill(l_.begin(), l_.end(), V{}); }
  void factor() {
    for (int j = 0; j < size_; ++j) {
      for (int r = 0; r < j; ++r) {
        V c = l_[packed(j, r)];
        for (int k = 0; k < r; ++k) c -= l_[packed(j, k)] * l_[packed(r, k)];
        l_[packed(j, r)] = c;  // L D until the row is done
      }
      V pivot = l_[packed(j, j)];
      for (int r = 0; r < j; ++r) {
        const V scaled = l_[packed(j, r)] * l_[packed(r, r)];
        pivot -= l_[packed(j, r)] * scaled;
        l_[packed(j, r)] = scaled;
      }
      l_[packed(j, j)] = 1.0 / pivot;
    }
  }
  void solve(std::vector<V>& b) const {
    for (int j = 0; j < size_; ++j)
      for (int k = 0; k < j; ++k) b[j] -= l_[packed(j, k)] * b[k];
    for (int j = 0; j < size_; ++j) b[j] *= l_[packed(j, j)];
    for (int j = size_ - 1; j >= 0; --j)
      for (int k = 0; k < j; ++k) b[k] -= l_[packed(j, k)] * b[j];
  }

 private:
  int size_ = 0;
  std::vector<V> l_;  // 1 / D on the diagonal
};

}  // namespace grasp
