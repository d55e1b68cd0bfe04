// Newton on Phi within limits, whose terms stand in `limits/terms.hpp`: the optimum, a proof that
// no force exists, or the force of least excess.
#pragma once
#include <grasp/newton/excess.hpp>
#include <grasp/newton/newton.hpp>

namespace grasp {

template <class V, int B> class LimitedNewton {
 public:
  NewtonSolver<V, B, LimitTerms<V, B>> newton;
  bool elastic = false;  // if no force keeps the limits, find the one that exceeds them least
  // factor from the multipliers in `newton.rows` of a proof to its twist
  double proof_scale = 0.0;

  explicit LimitedNewton(int count)
      : newton(count), begun_(newton.cones.field()), least_(newton.cones) {}

  // Solve from a previous optimum, or from any balanced force inside the cones. REFUSED: numbers
  // that are not finite, no start, or a problem for the general program: nearly infeasible, or out
  // of digits. INFEASIBLE: the multipliers are a twist v, -nu of `LimitTerms::farkas`: v . w > max
  // -v . G f within the limits. LIMITS_EXCEEDED: objective and bound are those of the excess.
  // begin(w, previous): writes the start into newton.x, or if `previous` the balanced optimum of
  // another wrench; returns true if there is one.
  template <class F> Code solve(const Call& call, const Record& record, F&& begin) {
    Summary& s = record.summary();
    s.code = REFUSED;
    if (!is_valid_wrench(call.wrench)) return REFUSED;
    const Vec6 w = newton.cones.unit.of(call.wrench);
    if (elastic && call.exceeding && begin(w, true) && follow_excess(call, w, record))
      return LIMITS_EXCEEDED;
    Code code = call.start == From::tangent ? descend_from_previous(call, w, record) : REFUSED;
    if (is_unusable(code)) code = begin(w, false) ? descend(call, w, record) : REFUSED;
    if (code == INFEASIBLE) {
      proof_scale = 1.0 / size(s.multipliers);
      code = elastic ? minimise_excess(w, record)
                     : record.refute(-proof_scale * s.multipliers, size(w));
    }
    if (is_unusable(code)) code = REFUSED;
    s.code = code;
    return code;
  }

 private:
  // edge of the parabola, as a fraction of the least slack of a previous force
  static constexpr double FIRM = 0.5;
  typename Cones<V, B>::Field begun_;
  LeastExcess<V, B> least_;

  bool is_unusable(Code code) const {
    return code == REFUSED || code == STALLED || (code == LIMIT && !newton.rows.within(newton.x));
  }

  Code descend_from_previous(const Call& call, const Vec6& w, const Record& record) {
    newton.cones.load_force(call.force, newton.x);
    const double room = newton.rows.least_slack(newton.x);
    newton.rows.set_edge(room > 0.0 ? std::min(newton.rows.LARGEST_EDGE, FIRM * room)
                                    : newton.rows.LARGEST_EDGE);
    begun_ = newton.x;
    return newton.descend_from(begun_, call, w, record, SHORT, true);
  }

  Code descend(const Call& call, const Vec6& w, const Record& record) {
    begun_ = newton.x;
    Code code = STALLED;
    for (double fraction : {SHORT, LONG}) {
      newton.x = begun_;
      newton.rows.set_edge(newton.rows.LARGEST_EDGE);
      code = newton.descend_from(begun_, call, w, record, fraction);
      if (code != STALLED) break;
    }
    return code;
  }

  // True if the least excess follows from a previous one in newton.x, without a proof.
  bool follow_excess(const Call& call, const Vec6& w, const Record& record) {
    if (!(newton.rows.excess(newton.x) > EXCESS_FLOOR)) return false;
    newton.cones.store_force(newton.x, record.initial_force());
    std::fill(record.torsion(), record.torsion() + newton.cones.count, 0.0);
    Summary& s = record.summary();
    s.iterations = s.trials = 0.0;
    std::copy(call.wrench, call.wrench + 6, s.wrench.begin());
    const bool exceeded =
        minimise_excess(w, record) == LIMITS_EXCEEDED && s.lower_bound > EXCESS_FLOOR;
    s.code = exceeded ? LIMITS_EXCEEDED : REFUSED;
    return exceeded;
  }

  Code minimise_excess(const Vec6& w, const Record& record) {
    const auto& cones = newton.cones;
    const auto force = least_.solve(cones, newton.rows, newton.system, w, newton.x);
    cones.balance(newton.x, w);
    cones.certify(newton.x, w, record);
    Summary& s = record.summary();
    s.iterations += force.iterations;
    s.trials += force.iterations;
    s.objective = s.limit_excess = newton.rows.excess(newton.x);
    s.lower_bound = force.bound;
    s.multipliers = cones.unit.pull_back(force.multipliers);
    return force.certified && s.margin > 0.0 ? LIMITS_EXCEEDED : STALLED;
  }
};

}  // namespace grasp
