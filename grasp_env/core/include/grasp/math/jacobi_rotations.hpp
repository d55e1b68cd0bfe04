// Singular values of six rows.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>
#include <grasp/math/lanes.hpp>

namespace grasp {

// Jacobi's one-sided rotations: singular values to full relative accuracy, for contacts that hardly
// span the wrenches.
struct JacobiRotations {
  // smallest ratio of singular values of G in the unit frame that counts as rank 6
  static constexpr double RANK = 1e-8;
  std::vector<double>& rows;  // rotated in place: `turn` times the matrix
  int size;
  double turn[6][6] = {}, value[6] = {}, most = 0.0, fewest = infinity;

  JacobiRotations(std::vector<double>& matrix, int columns) : rows(matrix), size(columns) {
    for (int r = 0; r < 6; ++r) turn[r][r] = 1.0;
    for (int sweep = 0, again = 1; again && sweep < 60; ++sweep) {
      again = 0;
      for (int p = 0; p < 6; ++p)
        for (int q = p + 1; q < 6; ++q) again |= rotate(p, q);
    }
    for (int r = 0; r < 6; ++r) {
      double square = 0.0;
      for (int j = 0; j < size; ++j) square += rows[size * r + j] * rows[size * r + j];
      value[r] = std::sqrt(square);
      most = std::max(most, value[r]);
      fewest = std::min(fewest, value[r]);
    }
  }
  bool spans() const { return fewest >= RANK * most && fewest > 0.0; }
  void normalise() {
    for (int r = 0; r < 6; ++r)
      for (int j = 0; j < size; ++j) rows[size * r + j] /= value[r];
  }

 private:
  bool rotate(int p, int q) {
    double* a = rows.data() + size * p;
    double* b = rows.data() + size * q;
    double pp = 0.0;
    double qq = 0.0;
    double pq = 0.0;
    for (int j = 0; j < size; ++j) {
      pp += a[j] * a[j];
      qq += b[j] * b[j];
      pq += a[j] * b[j];
    }
    if (!(std::abs(pq) > 1e-16 * std::sqrt(pp * qq))) return false;
    const double zeta = (qq - pp) / (2.0 * pq);
    const double t = (zeta < 0.0 ? -1.0 : 1.0) / (std::abs(zeta) + std::sqrt(1.0 + zeta * zeta));
    const double c = 1.0 / std::sqrt(1.0 + t * t);
    const double s = c * t;
    const auto mix = [&](double* first, double* second, int items) {
      for (int j = 0; j < items; ++j) {
        const double x = first[j];
        const double y = second[j];
        first[j] = c * x - s * y;
        second[j] = s * x + c * y;
      }
    };
    mix(a, b, size);
    mix(turn[p], turn[q], 6);
    return true;
  }
};

}  // namespace grasp
