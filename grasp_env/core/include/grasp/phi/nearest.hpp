// The balanced forces inside the cones that are nearest to given ones; any number of contacts up
// to 64.
#pragma once
#include <grasp/phi/touching.hpp>

namespace grasp {

// argmin |x - y|^2 / 2 with G x + w = 0 and x in cones, by Newton on its dual: with multipliers nu
// of the balance, x(nu) is the projection of y - G^T nu on the cones, and the gradient G x(nu) + w
// is zero at the optimum (Zhao, Sun and Toh 2010, for semidefinite cones). Distances are newtons; a
// torsion counts as the tangential force that uses as much of the friction.
class NearestForces {
 public:
  int iterations = 0;  // of the last solve

  explicit NearestForces(int count) : touching_(count), given_(count), x_(count), slopes_(count) {}

  // contacts: gives the cones; the current places are positions (N, 3) [m] and frames (N, 3, 3)
  // with columns (n, o, t). preload: (N,) [N], or empty. force: (N, 3) [N], contact frames,
  // torsion: (N,) [N m]; for the contacts that touch (bits) the given forces on entry and the
  // answer on return. Positions, frames and the wrench [N, N m] share one frame. Return false, with
  // nothing changed, if no such forces were found.
  bool solve(const Contacts& contacts, std::uint64_t touching, const double* positions,
             const double* frames, const Vec6& wrench, std::span<const double> preload,
             double* force, double* torsion) {
    touching_.gather(contacts, touching, positions, frames);
    Vec6 w = touching_.unit.of(wrench);
    for (int k = 0; k < touching_.count; ++k) {
      const int i = touching_.index[k];
      place(contacts, k, force, torsion);
      const double before = preload.empty() ? 0.0 : preload[i];
      given_[k].u -= before;
      w = w + before * touching_.columns[k][0];
    }
    if (!find(w)) return false;
    for (int k = 0; k < touching_.count; ++k) {
      const int i = touching_.index[k];
      force[3 * i] = x_[k].u + (preload.empty() ? 0.0 : preload[i]);
      for (int a = 1; a < 3; ++a) force[3 * i + a] = x_[k][a] / contacts.divisor[3 * i + a];
      torsion[i] = x_[k].v / divisor_of(contacts.torsion_scale(i));
    }
    return true;
  }

 private:
  using X = Vec<double, 4>;
  static constexpr int MOST = 60;  // iterations
  static constexpr int HALVINGS = 40;
  static constexpr double EXACT = 1e-11;  // imbalance, relative to forces and wrench
  static constexpr double SHIFT = 1e-9;   // of the system's diagonal, relative to its trace
  // of the dual's value, relative to the largest of its terms
  static constexpr double ROUNDING_OF_SQUARES = 1e-14;
  // The projection on a cone at a point: the answer is `inside` there, its derivative is
  //     along * (1, mu e)(1, mu e)^T + across * (I - e e^T) in the tangential plane,
  // or the identity.
  struct Slope {
    bool inside = false;
    double along = 0.0, across = 0.0;
    X direction{};  // (1, mu e)
  };
  Touching touching_;  // columns of newtons along the normals
  double friction_[64];
  std::vector<X> given_, x_;  // (n, o, t, v): |(o, t, v)| <= friction n
  std::vector<Slope> slopes_;

  void place(const Contacts& contacts, int k, const double* force, const double* torsion) {
    const int i = touching_.index[k];
    const double* scale = &contacts.scale[3 * i];
    const double* f = force + 3 * i;
    const double turning = contacts.torsion_scale(i);
    touching_.columns[k][0] = scale[0] * touching_.columns[k][0];  // of newtons
    friction_[k] = scale[1] > 0.0 || turning > 0.0 ? scale[0] : 0.0;
    given_[k] = {f[0], scale[1] * f[1], scale[2] * f[2], turning * torsion[i]};
  }
  // Project y on the cone of a contact.
  void project(int k, const X& y) {
    const double mu = friction_[k];
    const double side = std::sqrt(y.o * y.o + y.t * y.t + y.v * y.v);
    Slope& slope = slopes_[k];
    slope = {};
    if (side <= mu * y.u) {
      slope.inside = true;
      x_[k] = y;
    } else if (mu * side <= -y.u) {
      x_[k] = {};
    } else {
      const double normal = (y.u + mu * side) / (1.0 + mu * mu);
      const double part = mu * normal / side;
      x_[k] = {normal, part * y.o, part * y.t, part * y.v};
      slope.along = 1.0 / (1.0 + mu * mu);
      slope.across = part;
      const double per = mu / side;
      slope.direction = {1.0, per * y.o, per * y.t, per * y.v};
    }
  }
  // Value of the dual, less that of nu = 0 without forces; sets forces and slopes, and `missed` to
  // its gradient's opposite, G x + w.
  double dual(const Vec6& nu, const Vec6& w, Vec6& missed) {
    missed = w;
    double value = -dot(nu, w);
    for (int k = 0; k < touching_.count; ++k) {
      X y = given_[k];
      for (int a = 0; a < 4; ++a) y[a] -= dot(touching_.columns[k][a], nu);
      project(k, y);
      value += 0.5 * dot(x_[k], x_[k]);
      missed = missed + touching_.wrench_of(k, x_[k]);
    }
    return value;
  }
  // Product of the derivative of a projection with a vector.
  X sloped(int k, const X& from) const {
    const Slope& slope = slopes_[k];
    if (slope.inside) return from;
    const X& d = slope.direction;
    const double mu = friction_[k];
    X out = (slope.along * dot(d, from)) * d;
    if (!(slope.across > 0.0)) return out;
    // e = the tangential part of `direction` / mu
    const double along = (d.o * from.o + d.t * from.t + d.v * from.v) / (mu * mu);
    out.o += slope.across * (from.o - along * d.o);
    out.t += slope.across * (from.t - along * d.t);
    out.v += slope.across * (from.v - along * d.v);
    return out;
  }
  // At least 1 N, the wrench, and the largest force, given or at hand.
  double largest(const Vec6& w) const {
    double square = 0.0;
    for (int k = 0; k < touching_.count; ++k)
      square = std::max({square, dot(given_[k], given_[k]), dot(x_[k], x_[k])});
    return std::max(1.0 + size(w), std::sqrt(square));
  }
  bool find(const Vec6& w) {
    Vec6 nu{};
    Vec6 missed;
    double value = dual(nu, w, missed);
    for (iterations = 0; iterations < MOST; ++iterations) {
      const double most = largest(w);
      if (size(missed) <= EXACT * most) return true;
      const double rounding = ROUNDING_OF_SQUARES * most * (most + size(nu));
      Packed6 system{};
      for (int k = 0; k < touching_.count; ++k)
        for (int r = 0; r < 6; ++r) {
          const auto& c = touching_.columns[k];
          const Vec6 row = touching_.wrench_of(k, sloped(k, X{c[0][r], c[1][r], c[2][r], c[3][r]}));
          for (int q = 0; q <= r; ++q) system[packed(r, q)] += row[q];
        }
      double trace = 0.0;
      for (int r = 0; r < 6; ++r) trace += system[packed(r, r)];
      for (int r = 0; r < 6; ++r) system[packed(r, r)] += SHIFT * (trace + 1.0);
      Ldl6 factor;
      if (!(factor.factor(system) > 0.0)) return false;
      const Vec6 step = factor.solve(missed);
      const double descent = dot(step, missed);
      double part = 1.0;
      const Vec6 from = nu;
      double after = dual(nu = from + step, w, missed);
      for (int halving = 0;
           halving < HALVINGS && !(after <= value - 1e-4 * part * descent + rounding); ++halving)
        after = dual(nu = from + (part *= 0.5) * step, w, missed);
      value = after;
    }
    return false;
  }
};

}  // namespace grasp
