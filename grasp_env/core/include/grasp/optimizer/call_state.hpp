// A call while it is solved.
#pragma once
#include <grasp/problem.hpp>

namespace grasp::detail {

// The start that a solve used.
struct UsedStart {
  Start start = Start::standard;
  bool replaced = false;  // it took the place of the requested start
  bool outside = false;   // the wrench lies outside the range of the model's training
};

// What a call asks for, and what is known of it so far. Made for one call.
struct CallState {
  const Request& ask;
  StopRule stop;  // steps that are left
  Vec6 w{};       // the wrench in the unit frame of the current contacts
  UsedStart used{};
  Vec6 twist{};  // the last twist that the cones alone prove, see `ConicSolver::find_inside`

  // True if the call follows the descent: a known optimum, or a trace.
  bool is_study() const { return ask.optimum == ask.optimum || !ask.trace.empty(); }
  // The call of a solver, from a force that it is given or finds in its own `x`.
  Call from(From start = From::given) const {
    return {.wrench = ask.wrench,
            .stop = stop,
            .start = start,
            .optimum = ask.optimum,
            .trace = ask.trace.data(),
            .traced = int(ask.trace.size())};
  }
};

}  // namespace grasp::detail
