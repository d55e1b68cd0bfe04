// A force inside the cones for contacts that cannot balance the wrench; any number of contacts,
// even one.
#pragma once
#include <grasp/phi/cones.hpp>
#include <grasp/phi/touching.hpp>

namespace grasp {

// argmin Phi(x) + |G x + w|^2 / (2 SOFTNESS) by damped Newton, in the unit frame. With nu = -(G x +
// w) / SOFTNESS at the optimum, the step is Newton's under balance with SOFTNESS on the diagonal of
// its 6 x 6 system: (G H^-1 G^T + SOFTNESS I) nu = G H^-1 grad
// - (G x + w).
class ElasticBalance {
 public:
  // [N^2] per unit of Phi: roughly the balance residual where a balanced force exists
  static constexpr double SOFTNESS = 1e-2;
  int iterations = 0;  // of the last solve

  explicit ElasticBalance(int count)
      : touching_(count), x_(count), step_(count), gradient_(count), inverse_(count) {}

  // contacts: gives cones and weights; the current places are positions (N, 3) [m] and frames (N,
  // 3, 3) with columns (n, o, t). force: (N, 3) [N], contact frames, torsion: (N,) [N m]; for the
  // contacts that touch (bits) a guess on entry and the answer on return. Positions, frames and the
  // wrench [N, N m] share one frame.
  void solve(const Contacts& contacts, std::uint64_t touching, const double* positions,
             const double* frames, const Vec6& wrench, int limit, double* force, double* torsion) {
    touching_.gather(contacts, touching, positions, frames);
    for (int k = 0; k < touching_.count; ++k) place(contacts, k, force, torsion);
    const Vec6 w = touching_.unit.of(wrench);
    double value = merit(w, 0.0);
    for (iterations = 0; iterations < limit; ++iterations) {
      const double decrement = find_step(w);
      double alpha = std::min(1.0, LONG / reach());
      if (!(decrement > PRECISION * value)) break;
      double after = merit(w, alpha);
      for (int halving = 0; halving < HALVINGS && !(after <= value - 1e-4 * alpha * decrement);
           ++halving)
        after = merit(w, alpha *= 0.5);
      if (!(after < value)) break;
      for (int k = 0; k < touching_.count; ++k) x_[k] += alpha * step_[k];
      value = after;
    }
    for (int k = 0; k < touching_.count; ++k) {
      const int i = touching_.index[k];
      for (int a = 0; a < 3; ++a) force[3 * i + a] = x_[k][a] / contacts.divisor[3 * i + a];
      torsion[i] = x_[k].v / divisor_of(contacts.torsion_scale(i));
    }
  }

 private:
  using X = Vec<double, 4>;
  static constexpr double LONG = 0.9;        // fraction of the way to a cone's surface
  static constexpr double PRECISION = 1e-9;  // squared decrement over the value
  static constexpr double LEAST = 0.1;       // [N] smallest normal force of the guess
  static constexpr int HALVINGS = 40;
  Touching touching_;
  Weights<double, 4> weights_[64];
  std::vector<X> x_, step_, gradient_;   // cone coordinates
  std::vector<Sym<double, 4>> inverse_;  // H^-1

  void place(const Contacts& contacts, int k, const double* force, const double* torsion) {
    const int i = touching_.index[k];
    const double* f = force + 3 * i;
    const double* scale = &contacts.scale[3 * i];
    weights_[k] = weights_of(contacts, i);
    X x{scale[0] * f[0], scale[1] * f[1], scale[2] * f[2], contacts.torsion_scale(i) * torsion[i]};
    x.u = std::max({x.u, 1.05 * tangent_length(x), LEAST * scale[0]});
    x_[k] = x;
  }
  // Product of the columns with nu.
  X pulled(int k, const Vec6& nu) const {
    X out;
    for (int a = 0; a < 4; ++a) out[a] = dot(touching_.columns[k][a], nu);
    return out;
  }

  double merit(const Vec6& w, double alpha) const {
    double total = 0.0;
    Vec6 missed = w;
    for (int k = 0; k < touching_.count; ++k) {
      const X x = x_[k] + alpha * step_[k];
      if (alpha > 0.0 && !(x.u > 0.0 && lorentz(x, x) > 0.0)) return infinity;
      total += phi(x, weights_[k]);
      missed = missed + touching_.wrench_of(k, x);
    }
    return total + dot(missed, missed) / (2.0 * SOFTNESS);
  }
  // 1 / (largest step inside the cones)
  double reach() const {
    double most = 1e-300;
    for (int k = 0; k < touching_.count; ++k) most = std::max(most, Boundary(x_[k]).per(step_[k]));
    return most;
  }
  // Compute the Newton step; return its squared decrement.
  double find_step(const Vec6& w) {
    Packed6 schur{};
    Vec6 missed = w, pull{};
    for (int r = 0; r < 6; ++r) schur[packed(r, r)] = SOFTNESS;
    for (int k = 0; k < touching_.count; ++k) {
      inverse_[k] = inverse_hessian(x_[k], weights_[k]);
      gradient_[k] = gradient(x_[k], weights_[k]);
      missed = missed + touching_.wrench_of(k, x_[k]);
      pull = pull + touching_.wrench_of(k, inverse_[k] * gradient_[k]);
      for (int r = 0; r < 6; ++r) {
        const auto& c = touching_.columns[k];
        const Vec6 row =
            touching_.wrench_of(k, inverse_[k] * X{c[0][r], c[1][r], c[2][r], c[3][r]});
        for (int q = 0; q <= r; ++q) schur[packed(r, q)] += row[q];
      }
    }
    Ldl6 factor;
    if (!(factor.factor(schur) > 0.0)) return 0.0;
    const Vec6 nu = factor.solve(pull - missed);
    double decrement = 0.0;
    for (int k = 0; k < touching_.count; ++k) {
      step_[k] = inverse_[k] * (pulled(k, nu) - gradient_[k]);
      // gradient of the merit: grad Phi + G^T (G x + w) / SOFTNESS
      decrement -= dot(step_[k], gradient_[k] + pulled(k, (1.0 / SOFTNESS) * missed));
    }
    return decrement;
  }
};

}  // namespace grasp
