// A call while it is solved.
#pragma once
#include <grasp/problem.hpp>

namespace grasp::detail {

// The start that a solve used.
struct UsedStart {
  Start start = Start::standard;
  bool replaced = false;  // `start` took the place of the requested one
  bool outside = false;   // the wrench lies outside the range of the model's training
};

// One call, and what is known of it so far. Solvers see the shifted problem of `Preload`.
struct CallState {
  const Request& request;
  StopRule stop;    // steps that are left
  Vec6 wrench{};    // the wrench, with that of the preloads
  Vec6 w{};         // the same in the unit frame of the current contacts
  double offset{};  // what the objective has more than that of the shifted problem
  UsedStart used{};
  Vec6 twist{};  // the last twist that the cones alone prove, see `ConicSolver::find_inside`

  // True if the call follows the descent: a known optimum, or a trace.
  bool is_study() const { return request.optimum == request.optimum || !request.trace.empty(); }
  // The call of a solver, from a force of the call or from its `x`.
  Call from(From start = From::given) const {
    return {.wrench = wrench.data(),
            .stop = stop,
            .start = start,
            .optimum = request.optimum - offset,
            .trace = request.trace.data(),
            .traced = int(request.trace.size())};
  }
};

}  // namespace grasp::detail
