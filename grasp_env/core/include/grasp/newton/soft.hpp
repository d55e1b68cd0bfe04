// Newton on Phi with soft contacts, whose torsion is the fourth variable of their cones.
#pragma once
#include <grasp/newton/newton.hpp>

namespace grasp {

// Newton from a previous optimum, or from any balanced force inside the cones.
template <class V, int B> class SoftNewton {
 public:
  NewtonSolver<V, B, NoRows, 4> newton;

  explicit SoftNewton(int count) : newton(count), begun_(newton.cones.field()) {}

  // Begin at a force without torsion.
  void begin(const typename Cones<V, B>::Field& force) {
    for (int b = 0; b < int(force.size()); ++b)
      newton.x[b] = {force[b].u, force[b].o, force[b].t, V{}};
  }
  // REFUSED: numbers that are not finite, no start, or too few digits, for the general program.
  // find(w): calls `begin` and returns true if there is a start.
  template <class F> Code solve(const Call& call, const Record& record, F&& find) {
    Summary& s = record.summary();
    s.code = REFUSED;
    if (!is_valid_wrench(call.wrench)) return REFUSED;
    const Vec6 w = newton.cones.unit.of(call.wrench);
    Code code = REFUSED;
    if (call.start == From::tangent) {
      newton.cones.load_force(call.force, newton.x, 0, call.torsion);
      code = from(call, w, record, true);
    }
    if (code == REFUSED || code == STALLED) code = find(w) ? from(call, w, record, false) : REFUSED;
    if (code == STALLED) code = REFUSED;
    s.code = code;
    return code;
  }

 private:
  typename Cones<V, B, 4>::Field begun_;

  Code from(const Call& call, const Vec6& w, const Record& record, bool leaping) {
    begun_ = newton.x;
    return newton.descend_from(begun_, call, w, record, SHORT, leaping);
  }
};

}  // namespace grasp
