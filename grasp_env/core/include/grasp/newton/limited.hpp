// Newton on Phi within limits, whose terms stand in `limits/barriers.hpp`.
#pragma once
#include <grasp/limits/barriers.hpp>
#include <grasp/newton/newton.hpp>

namespace grasp {

// Newton from a force strictly inside cones and limits.
template <class V, int B, int D = 3> class LimitedNewton {
 public:
  NewtonSolver<V, B, Barriers<V, B, D>, D> newton;

  explicit LimitedNewton(int count) : newton(count), begun_(newton.cones.field()) {}
  // Make solving free of allocations for up to this many rows.
  void reserve(int rows) {
    newton.rows.reserve(newton.cones, rows);
    newton.system.joint.reserve(rows);
  }

  // Set x to a force without torsion. Return true if it is well inside the limits.
  bool begin(const typename Cones<V, B>::Field& force) {
    for (int b = 0; b < int(force.size()); ++b)
      for (int a = 0; a < 3; ++a) newton.x[b][a] = force[b][a];
    if constexpr (D == 4)
      for (auto& x : newton.x) x.v = V{};
    return newton.cones.phi(newton.x, newton.rows) <= CLOSE * newton.cones.phi(newton.x);
  }
  // Solve from a previous optimum. REFUSED: it is of no use.
  Code follow(const Call& call, const Vec6& w, const Record& record) {
    newton.cones.load_force(call.force, newton.x, 0, call.torsion);
    newton.cones.reset_unused_lanes(newton.x);
    return descend(call, w, record, true);
  }
  // Solve from x. REFUSED: numbers are not finite, or out of digits.
  Code descend(const Call& call, const Vec6& w, const Record& record) {
    return descend(call, w, record, false);
  }
  // Write the multipliers of the rows at x.
  void store_multipliers(double* to) {
    newton.rows.measure(newton.x);
    newton.rows.store(1.0, to);
  }

 private:
  // largest factor of the limits on Phi at a start: otherwise steps would be short
  static constexpr double CLOSE = 2.0;
  typename Cones<V, B, D>::Field begun_;

  Code descend(const Call& call, const Vec6& w, const Record& record, bool leaping) {
    begun_ = newton.x;
    const Code code = newton.descend_from(begun_, call, w, record, SHORT, leaping);
    return code == STALLED ? REFUSED : code;
  }
};

}  // namespace grasp
