// How far forces accelerate the tips and joints of a hand, and the springs that are stable there.
#pragma once
#include <grasp/hand/hand_settings.hpp>
#include <grasp/hand/tree.hpp>
#include <grasp/math/cholesky.hpp>

namespace grasp {

// The largest eigenvalue of a symmetric matrix (n, n), which is overwritten, by Jacobi's rotations.
inline double largest_eigenvalue(std::vector<double>& a, int n) {
  constexpr int SWEEPS = 60;
  for (int sweep = 0, again = 1; again && sweep < SWEEPS; ++sweep) {
    again = 0;
    for (int p = 0; p < n; ++p)
      for (int q = p + 1; q < n; ++q) {
        const double off = a[n * p + q];
        if (!(std::abs(off) > 1e-16 * std::sqrt(std::abs(a[n * p + p] * a[n * q + q])))) continue;
        again = 1;
        const double zeta = (a[n * q + q] - a[n * p + p]) / (2.0 * off);
        const double t = std::copysign(1.0, zeta) / (std::abs(zeta) + std::sqrt(1.0 + zeta * zeta));
        const double c = 1.0 / std::sqrt(1.0 + t * t);
        const double s = c * t;
        for (int k = 0; k < n; ++k) {
          const double x = a[n * k + p];
          const double y = a[n * k + q];
          a[n * k + p] = c * x - s * y;
          a[n * k + q] = s * x + c * y;
        }
        for (int k = 0; k < n; ++k) {
          const double x = a[n * p + k];
          const double y = a[n * q + k];
          a[n * p + k] = c * x - s * y;
          a[n * q + k] = s * x + c * y;
        }
      }
  }
  double most = 0.0;
  for (int k = 0; k < n; ++k) most = std::max(most, a[n * k + k]);
  return most;
}

// At angles (M,) [rad]: the largest acceleration of each tip per force on it, (N,) [1/kg]; an upper
// bound on the acceleration of each joint per torque if all joints have springs, (M,) [1/(kg m^2)],
// 0 for coupled joints.
struct Mobility {
  std::vector<double> tips, joints;

  Mobility(const std::shared_ptr<const Tree>& tree, const double* angles)
      : tips(tree->fingers()), joints(tree->joints()) {
    const int m = tree->joints();
    std::vector<int> motors;
    for (int j = 0; j < m; ++j)
      if (!tree->links[j].coupled()) motors.push_back(j);
    const int n = int(motors.size());
    Posture posture(tree);
    posture.trace(angles);
    std::vector<double> mass(m * m);
    posture.mass_matrix(mass.data());
    Cholesky factor(n);
    for (int a = 0; a < n; ++a)
      for (int b = 0; b <= a; ++b) factor(a, b) = mass[m * motors[a] + motors[b]];
    if (!factor.factor()) return;  // links without mass have no springs
    std::vector<double> inverse(n * n);
    for (int a = 0; a < n; ++a) {
      inverse[n * a + a] = 1.0;
      factor.solve(&inverse[n * a]);
    }
    std::vector<double> scaled(inverse);
    for (int a = 0; a < n; ++a)
      for (int b = 0; b < n; ++b)
        scaled[n * a + b] /= std::sqrt(inverse[n * a + a] * inverse[n * b + b]);
    const double coupling = largest_eigenvalue(scaled, n);
    for (int a = 0; a < n; ++a) joints[motors[a]] = coupling * inverse[n * a + a];
    std::vector<double> jacobian(3 * m);
    for (int i = 0; i < tree->fingers(); ++i) {
      posture.jacobian(tree->tips[i].link, posture.tip(i), jacobian.data());
      std::vector<double> product(9);
      for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c)
          for (int a = 0; a < n; ++a)
            for (int b = 0; b < n; ++b)
              product[3 * r + c] +=
                  jacobian[m * r + motors[a]] * inverse[n * a + b] * jacobian[m * c + motors[b]];
      tips[i] = largest_eigenvalue(product, 3);
    }
  }
};

// The spring nearest to the wanted one that is stable; mobility: [1/kg] or [1/(kg m^2)], tick: [s]
// between two samples, delay: [s] their age.
inline Spring stable_spring(const Spring& wanted, double mobility, double tick, double delay) {
  // largest stiffness * time^2 / mass and damping * time / mass; sampled control without delay
  // diverges from 4 and 2
  constexpr double STIFFNESS = 0.5;
  constexpr double DAMPING = 1.0;
  // Delay costs a spring more than a damper: otherwise tips ring that slip under torque noise, and
  // creep half as far again.
  constexpr double COST = 1.5;
  if (!(mobility > 0.0)) return {0.0, 0.0, wanted.limit};
  const double longer = tick + COST * delay;
  return {std::min(wanted.gain, STIFFNESS / (mobility * longer * longer)),
          std::min(wanted.damping, DAMPING / (mobility * (tick + delay))), wanted.limit};
}

}  // namespace grasp
