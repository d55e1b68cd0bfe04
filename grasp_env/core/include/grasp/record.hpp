// One solution as one row of numbers: the output of all solvers, for one problem and in a batch.
#pragma once
#include <cstddef>
#include <grasp/math/linear6.hpp>

namespace grasp {

// Outcome of a solve.
enum Code {
  CONVERGED,   // the force is optimal to the tolerance
  LIMIT,       // the iteration limit was reached
  STALLED,     // no further progress in floating point
  INFEASIBLE,  // no force within the cones and limits balances the wrench; the record holds the
               // twist that proves it
  REFUSED,     // invalid values, or a given start that is not balanced or not inside the cones
  LIMITS_EXCEEDED,  // no force satisfies all limits; this one exceeds them least
  RANK_LOST,  // no contact touches; or the contacts cannot balance wrenches of every direction,
              // which a flow needs
  UNDECIDED,  // neither a force nor a proof was found
  STARTED,    // a start alone, of `ForceOptimizer::start`: no step was taken
};

// Starting points of a solve.
enum class Start {
  // default of the method: one internal force for Newton, the linear combination for a flow, the
  // centre for conic
  standard,
  internal_force,  // -G^+ w plus enough of one internal force to lie inside the cones
  // of the 12 offline optima (the paper, Sec. III), plus the optimum at rest, which keeps it inside
  // at small wrenches
  linear_combination,
  linear_combination_printed,  // the same as printed, without the optimum at rest
  single_value,                // -G^+ w plus enough of the optimum at rest to lie inside the cones
  lagrange,                    // least weighted distance from a normal squeeze
  phase_one,                   // a balanced force inside the cones, found by an interior point
  previous,                    // the last solution, carried over to the current contacts and wrench
  given,                       // a force of the caller, used unchanged
  guess,    // a force of the caller, balanced and brought inside the cones: Phi is never above that
            // of the method's default start
  learned,  // the prediction of a trained model
  central,  // the own start of an interior-point method
};

struct Summary {
  double code = REFUSED;  // a `Code`
  double iterations = 0;  // accepted steps
  double trials = 0;      // all steps tried
  // Phi, or the sum or maximum of weighted normal forces [N]; if limits are exceeded, the excess;
  // inf without a force
  double objective = 0;
  double lower_bound = 0;  // no balanced force has a smaller objective; -inf: none; inf: INFEASIBLE
  double residual = 0;     // largest |component| of G f + w in the unit frame [N]
  // smallest u - |(o, t)| of a contact in cone coordinates [N], within the problem's margin
  double margin = 0;
  // largest excess over a limit, as a fraction of that limit; 0 within all limits
  double limit_excess = 0;
  Vec6 wrench{};               // balanced wrench [N, N m]
  Vec6 wrench_with_preload{};  // w + G s n, with the preloads s; a proof holds against it
  Vec6 multipliers{};          // nu of balance: grad objective = G^T nu (+ the cones' multipliers);
                               // INFEASIBLE: the twist
  double start = 0;            // the `Start` that was used
  double replaced = 0;  // 1: the requested start could not be used, and `start` took its place
  double outside = 0;   // 1: the wrench lies outside the range of the model's training
  double contacts = 0, joints = 0, limits = 0;  // sizes of the following data: N, J, M
};
inline constexpr int SUMMARY = sizeof(Summary) / sizeof(double);

// A row: the summary, then force (N, 3), initial force (N, 3) [N], torsion (N,) [N m]. A row of
// `ForceOptimizer` continues with frames (N, 3, 3), shares of friction (N,), joint torques (J,) [N
// m] and multipliers of limits (M,).
constexpr int record_size(int contacts) { return SUMMARY + 7 * contacts; }
constexpr int record_size(int contacts, int joints, int limits) {
  return SUMMARY + 17 * contacts + joints + limits;
}

class Record {
 public:
  Record(double* row, int count) : row_(row), count_(count) {}
  // A complete row of `ForceOptimizer`.
  explicit Record(double* row) : row_(row), count_(int(summary().contacts)) {}
  Code code() const { return Code(int(summary().code)); }
  // True if the record holds a force; otherwise the force is zero.
  bool has_force() const { return has_force(code()); }
  static bool has_force(Code code) {
    return code == CONVERGED || code == LIMIT || code == STALLED || code == LIMITS_EXCEEDED;
  }
  Summary& summary() const { return *reinterpret_cast<Summary*>(row_); }
  // (objective - lower_bound) / lower_bound, certified; inf without a positive bound.
  double gap() const {
    const Summary& s = summary();
    if (s.lower_bound > 0.0) return std::max(0.0, (s.objective - s.lower_bound) / s.lower_bound);
    return s.objective == 0.0 ? 0.0 : infinity;
  }
  int contacts() const { return count_; }
  // Numbers of a complete row.
  int size() const { return record_size(count_, int(summary().joints), int(summary().limits)); }
  double* force() const { return row_ + SUMMARY; }                // (N, 3) [N]: normal, o, t
  double* initial_force() const { return force() + 3 * count_; }  // (N, 3) [N]
  double* torsion() const { return force() + 6 * count_; }        // (N,) [N m]
  double* frames() const {
    return force() + 7 * count_;
  }  // (N, 3, 3) columns (n, o, t), the frame of the positions
  // (N,) share of the given friction that each force uses, torsion included; inf: tangential force
  // without a normal one; NaN: the contact does not touch
  double* friction_used() const { return force() + 16 * count_; }
  double* torques() const {
    return force() + 17 * count_;
  }  // (J,) [N m], including the torque bias
  // Multipliers of the limits A f <= b, (M,) >= 0. INFEASIBLE: with the twist v they are the proof:
  // G^T v + A^T limit_multipliers lies in every dual cone, and v . w > limit_multipliers . b. With
  // preloads s, w is `wrench_with_preload` and b is b - A s n.
  double* limit_multipliers() const { return torques() + int(summary().joints); }
  void clear() const { std::fill(row_, row_ + record_size(count_), 0.0); }
  // Record INFEASIBLE: no force, and the twist that proves it in place of the multipliers. missed:
  // size of the wrench in the unit frame [N], which becomes the residual.
  Code refute(const Vec6& twist, double missed) const {
    Summary& s = summary();
    s.code = INFEASIBLE;
    s.objective = s.lower_bound = infinity;
    s.margin = s.limit_excess = 0.0;
    s.residual = missed;
    s.multipliers = twist;
    std::fill(force(), row_ + record_size(count_), 0.0);
    return INFEASIBLE;
  }
  // Force on the object along the axes of the positions, (3,) [N].
  void object_force(int contact, double* out) const {
    const double* f = force() + 3 * contact;
    const double* frame = frames() + 9 * contact;
    for (int r = 0; r < 3; ++r)
      out[r] = frame[3 * r] * f[0] + frame[3 * r + 1] * f[1] + frame[3 * r + 2] * f[2];
  }

 private:
  double* row_;
  int count_;
};

}  // namespace grasp
