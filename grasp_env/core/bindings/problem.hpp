// The inputs of `grasp::ForceOptimizer`, with the arrays that they refer to.
#pragma once

#include <grasp/problem.hpp>

#include "buffers.hpp"

// `grasp::Problem` with limits of its own.
struct OwnProblem {
  grasp::Contacts contacts;
  std::vector<double> min_normal{}, max_normal{}, jacobian{}, torque_limit{}, torque_bias{};

  grasp::Problem view() const {
    return {contacts, {min_normal, max_normal, jacobian, torque_limit, torque_bias}};
  }
};

// `grasp::Request` without wrench and changes; keeps its arrays alive.
struct OwnRequest {
  grasp::Request request{};
  nb::object force, previous, trace;
};
