// The inputs of `grasp::ForceOptimizer`, with the arrays that they refer to.
#pragma once

#include <grasp/problem.hpp>

#include "buffers.hpp"

// `grasp::Problem` with limits and a margin of its own.
struct OwnProblem {
  grasp::Contacts contacts;
  std::vector<double> min_normal{}, max_normal{}, jacobian{}, torque_limit{}, torque_bias{};
  double friction_margin = 1.0;
  std::vector<double> preload{};

  grasp::Problem view() const {
    return {contacts,
            {min_normal, max_normal, jacobian, torque_limit, torque_bias},
            {friction_margin, preload}};
  }
};

// Read a margin in place: None, the share of friction as a float, or an object with `friction`, a
// float, and `preload`, a float or a float64 array (N,). Return false if it cannot be read.
bool read_margin(PyObject* object, int count, std::optional<grasp::Margin>& to);
// The same, or no margin for None; throws a TypeError for what cannot be read.
grasp::Margin margin_of(nb::handle margin, int count);

// `grasp::Request` without wrench and changes; keeps its arrays alive.
struct OwnRequest {
  grasp::Request request{};
  nb::object force, previous, trace;
};
