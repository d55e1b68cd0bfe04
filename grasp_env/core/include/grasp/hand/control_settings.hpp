// Settings of the control loop of a hand, and what it reports of an agent's step.
#pragma once
#include <grasp/hand/balance.hpp>
#include <grasp/problem.hpp>

namespace grasp {

// A spring and damper that draws a tip to its place.
struct Spring {
  double gain = 0.0, damping = 0.0, limit = infinity;  // [N/m], [N s/m], largest force [N]
};

struct ControlSettings {
  Body body;
  std::vector<Spring> reach;    // (N,) for fingers without contact, on their way
  Spring spring;                // for all fingers while nothing is optimised
  double reach_depth = 0.0;     // [m] below the surface: goal of reaching fingers
  std::vector<Spring> posture;  // (M,) [N m/rad], [N m s/rad]: for joints that the tips leave free
  // for the solves that start from the last command, and within torque limits
  Options follow{.tolerance = 1e-4, .limit = 200};
  bool remembers = true;  // the method gets the last command, for starts that use it
  // (N, 3, K) [1], object frame: internal forces that an adjustment combines
  std::vector<double> directions;
  double squeeze = 0.0;  // [N] total normal force for `Hold::squeeze`
  // [N] largest change of a force in one tick beyond what balance requires
  double most_change = infinity;
  int release = 2;  // ticks without force until a finger no longer counts as in contact
};

// Effort of solvers and motors since `begin_step`.
struct Effort {
  int iterations = 0, trials = 0;  // of the method: accepted steps, and all steps tried
  int followed = 0;  // iterations of the control ticks between two solves of the method
  int limited = 0;   // iterations of Newton within the torque limits, when a force exceeded them
  bool saturated = false;    // torques were cut: no force within the limits was found
  double margin = infinity;  // smallest distance of a torque from its limit [N m]
  double share = 0.0;        // largest torque as a fraction of its limit
};

// Costs of an agent's step, each from 0 to 1.
struct Costs {
  // fraction of the commanded normal forces above the smallest that balance the wrench; 1: none
  // does
  double force;
  double torque;  // largest torque of the step as a fraction of its limit
  double
      change;  // of the commanded forces, relative to those before and after: sums of |components|
};

// Behaviour of the fingers in contact.
enum class Hold {
  optimized,  // the force found by the method, continued by Newton
  squeeze,    // a constant internal force plus the balancing force
  place,      // no force: every finger holds its place
  direct,     // given forces
  reach,      // no force: every finger is drawn to its contact
};

}  // namespace grasp
