// Newton on Phi with soft contacts.
#pragma once
#include <grasp/newton/newton.hpp>
#include <grasp/soft/terms.hpp>

namespace grasp {

// Newton from a previous optimum, or from any balanced force inside the cones.
template <class V, int B> class SoftNewton {
 public:
  NewtonSolver<V, B, SoftTerms<V, B>> newton;

  SoftNewton(const Contacts& contacts, const double* divisor)
      : newton(contacts.count), begun_(newton.cones.field()) {
    newton.cones.pack(contacts);
    newton.rows = SoftTerms<V, B>(contacts.count);
    newton.rows.pack(newton.cones, contacts, divisor);
  }

  // REFUSED: numbers that are not finite, no start, or too few digits, for the general program.
  // begin(w): writes the start into newton.x and newton.rows; returns true if there is one.
  template <class F> Code solve(const Call& call, const Record& record, F&& begin) {
    Summary& s = record.summary();
    s.code = REFUSED;
    if (!is_valid_wrench(call.wrench)) return REFUSED;
    const Vec6 w = newton.cones.unit.of(call.wrench);
    Code code = REFUSED;
    if (call.start == From::tangent) {
      newton.cones.load_force(call.force, newton.x);
      newton.rows.load(newton.cones, call.torsion);
      code = from(call, w, record, true);
    }
    if (code == REFUSED || code == STALLED) {
      newton.rows.load(newton.cones, call.start == From::given ? call.torsion : nullptr);
      code = begin(w) ? from(call, w, record, false) : REFUSED;
    }
    if (code == STALLED) code = REFUSED;
    s.code = code;
    return code;
  }

 private:
  typename Cones<V, B>::Field begun_;

  Code from(const Call& call, const Vec6& w, const Record& record, bool leaping) {
    begun_ = newton.x;
    return newton.descend_from(begun_, call, w, record, SHORT, leaping);
  }
};

}  // namespace grasp
