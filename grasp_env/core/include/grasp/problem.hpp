// The inputs of `ForceOptimizer`: a problem, options, and the data of one call.
#pragma once
#include <memory>
#include <optional>
#include <grasp/conic/criterion.hpp>
#include <grasp/flow/step_rule.hpp>
#include <grasp/learned/learned.hpp>
#include <grasp/limits/force_limits.hpp>

namespace grasp {

// external wrench on the object: force [N], moment [N m]
using Wrench = std::span<const double, 6>;
using Doubles = std::span<const double>;

enum class Method {
  newton,        // minimise Phi by Newton: about six steps
  reduced_flow,  // minimise Phi by the paper's gradient flow, in its cheapest form
  full_flow,     // the same flow as printed, dense: up to FULL_CONTACTS contacts
  conic,  // minimise the sum or the maximum of omega times normal force; the optimum may lie on the
          // cones; lambda has no effect
};

// Contacts with the weights of Phi, limits besides friction, and the margin that forces keep.
// Positions, normals, wrenches and the Jacobian share ONE frame of the caller's choice.
struct Problem {
  Contacts contacts;
  // jacobian: (N, 3, J), or (N, 6, J) with the angular velocities of the fingertips
  ForceLimits limits{};
  Margin margin{};
};

// Cost of a newton of normal force in Phi or in the sum of `conic`. scale: u for that newton.
inline double cost_of_normal_force(Method method, double omega, double scale) {
  return method == Method::conic ? omega : squeezing_cost(omega) * scale;
}

struct Options {
  Method method = Method::newton;
  // Method::conic: sum or largest of omega times normal force, or the norm of the joint torques
  Criterion criterion = Criterion::sum;
  Start start = Start::standard;
  double tolerance = 0.0;  // relative certified gap, at most 1; 0: 1e-4, or 1e-6 for Method::conic
  int limit = 20000;       // largest number of accepted steps
  // if no force satisfies the limits, return the one that exceeds them least instead of a proof;
  // `limit` does not count its steps
  bool elastic = false;
  StepRule step_rule{};  // for the flows
  // for Start::learned; without a model the default start replaces it
  std::shared_ptr<const Model> model{};
  // Start::learned: take the previous solution where its Phi is below the prediction's
  bool remembers = true;

  double gap() const { return tolerance > 0.0 ? tolerance : method == Method::conic ? 1e-6 : 1e-4; }
};

// Changes of the problem by a call or an update. Empty spans mean no change; `contacts` with all
// bits set means all contacts touch.
struct Changes {
  Doubles positions{}, normals{};  // (N, 3) [m], inward unit normals
  Doubles friction{};              // one coefficient, N coefficients, or two for each contact
  Doubles jacobian{};              // same shape as in the limits
  Doubles torque_bias{};  // (J,) tau_0 [N m]: torques that the motors supply in addition to J^T f
  // bit i: contact i touches; for solvers of up to 64 contacts
  std::uint64_t contacts = ~std::uint64_t(0);
  std::optional<Margin> margin{};

  // True if nothing changes but, perhaps, which contacts touch.
  bool keeps_problem() const {
    return positions.empty() && normals.empty() && friction.empty() && jacobian.empty() &&
           torque_bias.empty() && !margin;
  }
};

// One call: the wrench to balance, the changes of the problem, and the start. Start::standard means
// the start of the options. Start::previous uses `previous` if it is set, otherwise `force`, and
// the default start if neither is. `ForceOptimizer::solve` sets an unset `previous` to its last
// solution.
struct Request {
  const double* wrench;
  Changes now{};
  Start start = Start::standard;
  // For Start::given, guess and previous: (N, 3) [N], current contact frames; for Start::given also
  // (N,) [N m], empty: zero.
  Doubles force{}, torsion{};
  // for Start::previous and learned: row of a solution with N contacts
  const double* previous = nullptr;
  // The optimal Phi, if known; the gap is measured against it instead of the bound.
  double optimum = std::numeric_limits<double>::quiet_NaN();
  std::span<double> trace{};  // receives Phi of the first iterates
  // (N, 3) [N], frame of the positions: a force to add to the start. The sum of start and
  // adjustment is first balanced against the wrench. The solve then starts from the point of least
  // Phi on the segment from the start to that sum.
  Doubles adjustment{};
};

}  // namespace grasp
