// Limits of the motors: forces keep the torque limits, or exceed them least and report it. The same
// in Python: examples/04_torque_limits.py.
#include <grasp/optimizer.hpp>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <limits>

// A thumb below, three fingers above; metres and unit vectors INTO the object.
constexpr double POSITIONS[] = {0, 0, -0.05, 0, 0.03, 0.05, -0.03, -0.02, 0.05, 0.03, -0.02, 0.05};
constexpr double NORMALS[] = {0, 0, 1, 0, 0, -1, 0, 0, -1, 0, 0, -1};
constexpr double LEVERS[3][3] = {
    {0.05, 0, 0}, {0.01, -0.02, -0.03}, {0.06, 0.05, 0.03}};  // object frame [m]
constexpr double MOTORS[] = {0.8, 0.4, 0.4, 0.1},
                 OWN_WEIGHT[] = {0.02, 0.01, 0.005};  // [N m] per finger, per joint of a finger

int main() {
  const auto contacts = grasp::Contacts::from(POSITIONS, NORMALS, 0.4);
  // (N, 3, J) in the frame of the positions; a finger has three joints
  double jacobian[4][3][12] = {};
  double limit[12];
  double bias[12];
  double none[12];
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < 3; ++j) {
      limit[3 * i + j] = MOTORS[i];
      bias[3 * i + j] = OWN_WEIGHT[j];
      none[3 * i + j] = std::numeric_limits<double>::infinity();
      for (int a = 0; a < 3; ++a) jacobian[i][a][3 * i + j] = LEVERS[a][j];
    }
  const std::span<const double> joints(&jacobian[0][0][0], 144);
  grasp::ForceOptimizer free(
      {contacts, {.jacobian = joints, .torque_limit = none, .torque_bias = bias}});
  grasp::ForceOptimizer limited({contacts, {.jacobian = joints, .torque_limit = limit}},
                                {.elastic = true});
  // torque of a joint relative to its limit
  const auto largest = [&](const grasp::Record& solution) {
    double most = 0;
    for (int j = 0; j < 12; ++j) most = std::max(most, std::abs(solution.torques()[j]) / limit[j]);
    return most;
  };

  double naive = 0, strong = 0;
  for (int k = 0; k <= 60; ++k) {
    const double load = 0.25 * k;
    const double wrench[] = {0.7 * load, 0, 0.7 * load, 0, 0, 0};
    const double share = largest(free.solve(wrench));
    // in a control loop, Jacobian and weight change every tick: pass them with the call
    const grasp::Record& kept = limited.solve(wrench, {.jacobian = joints, .torque_bias = bias});
    if (!kept.has_force()) return 1;
    // otherwise the code is LIMITS_EXCEEDED, with this fraction
    const bool within = kept.summary().limit_excess == 0;
    if (share <= 1) naive = load;
    if (within) strong = load;
    if (k % 10 == 0)
      std::printf("%4.1f N: %4.0f%% of the limits; minding them %4.0f%%, %s\n", load, 100 * share,
                  100 * largest(kept), within ? "optimal" : "limits_exceeded");
  }
  std::printf("carried: %.1f N without minding the motors, %.1f N within their limits\n", naive,
              strong);
}
