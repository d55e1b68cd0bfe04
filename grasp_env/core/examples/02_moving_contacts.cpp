// Contacts that move, at 1 kHz: four fingers with rolling tips turn a cuboid for one second. The
// same in Python: examples/02_moving_contacts.py.
#include <grasp/optimizer.hpp>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <numbers>
#include <thread>

using Clock = std::chrono::steady_clock;
// A thumb below, three fingers above; metres and unit vectors INTO the object.
constexpr double POSITIONS[] = {0, 0, -0.05, 0, 0.03, 0.05, -0.03, -0.02, 0.05, 0.03, -0.02, 0.05};
constexpr double NORMALS[] = {0, 0, 1, 0, 0, -1, 0, 0, -1, 0, 0, -1};
// Velocity of a contact point per speed of the three joints of its finger, object frame [m].
constexpr double LEVERS[3][3] = {{0.05, 0, 0}, {0.01, -0.02, -0.03}, {0.06, 0.05, 0.03}};

int main() {
  const grasp::Margin margin{.friction = 0.75, .preload = 0.5};
  grasp::ForceOptimizer solver({grasp::Contacts::from(POSITIONS, NORMALS, 0.4), {}, margin},
                               {.start = grasp::Start::previous});
  std::vector<double> took;
  double most = 0, used = 0, p[12], n[12];
  auto next = Clock::now();
  for (int tick = 0; tick < 1000; ++tick) {
    const double turn = std::numbers::pi * tick * 1e-3;
    for (int i = 0; i < 4;
         ++i) {  // current contacts: they roll by a millimetre and a hundredth of a radian
      const double roll = 6e-3 * tick + i;
      const double size = std::hypot(1, 0.01 * std::sin(roll));
      p[3 * i] = POSITIONS[3 * i] + 1e-3 * std::sin(roll);
      p[3 * i + 1] = POSITIONS[3 * i + 1] + 1e-3 * std::cos(roll);
      n[3 * i] = 0.01 * std::sin(roll) / size;
      n[3 * i + 1] = 0;
      n[3 * i + 2] = NORMALS[3 * i + 2] / size;
      p[3 * i + 2] = POSITIONS[3 * i + 2];
    }
    // the weight rotates in the object's frame
    const double x = 0.5 * 9.81 * std::sin(turn);
    const double z = -0.5 * 9.81 * std::cos(turn);
    const double wrench[] = {x, 0, z, 0, 0.01 * x - 0.005 * z, 0};

    const auto begin = Clock::now();
    const grasp::Record& solution = solver.solve(wrench, {.positions = p, .normals = n});
    took.push_back(std::chrono::duration<double, std::micro>(Clock::now() - begin).count());
    if (solution.code() != grasp::CONVERGED) return 1;
    for (int i = 0; i < 4; ++i) {
      used = std::max(used, solution.friction_used()[i]);
      double v[3],
          // the force in the object's frame [N]; J^T f of the finger's joints [N m]
          torque[3] = {};
      solution.object_force(i, v);
      for (int a = 0; a < 3; ++a)
        for (int j = 0; j < 3; ++j) torque[j] += LEVERS[a][j] * v[a];
      for (double value : torque) most = std::max(most, std::abs(value));
    }
    std::this_thread::sleep_until(next += std::chrono::milliseconds(1));
  }
  std::sort(took.begin(), took.end());
  std::printf("%zu ticks: median %.2f us, p99 %.2f us, largest %.2f us\n", took.size(), took[500],
              took[990], took.back());
  std::printf("largest joint torque %.3f N m, at most %.3f of the friction used\n", most, used);
}
