// Solve your own contacts: three fingertips carry a mug of 0.3 kg. The same in Python:
// examples/01_first_solve.py.
#include <grasp/optimizer.hpp>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <numbers>

int main() {
  double positions[9] = {},
         normals[9] = {};  // contact by contact: metres, and unit vectors INTO the object
  const double degrees[] = {0, 130, 230};  // around the mug, 80 mm across
  for (int i = 0; i < 3; ++i) {
    const double angle = degrees[i] * std::numbers::pi / 180;
    normals[3 * i] = -std::cos(angle);
    normals[3 * i + 1] = -std::sin(angle);
    for (int a = 0; a < 2; ++a) positions[3 * i + a] = -0.04 * normals[3 * i + a];
  }
  const double weight[] = {0, 0, -0.3 * 9.81,
                           0, 0, 0};  // force [N] and moment [N m] that act ON the mug

  // throws if they make no grasp
  const auto contacts = grasp::Contacts::from(positions, normals, 0.6);
  // forces use at most 75 % of the friction
  grasp::ForceOptimizer solver({.contacts = contacts, .margin = {.friction = 0.75}});
  const grasp::Record& solution = solver.solve(weight);
  if (solution.code() != grasp::CONVERGED) return 1;

  const double* force = solution.force();  // (normal, o, t) of each contact, in its own frame
  std::printf("in metres, inward: optimal, squeezes with %.2f N in all\n",
              force[0] + force[3] + force[6]);
  std::printf("contact   normal        o        t   [N]\n");
  for (int i = 0; i < 3; ++i)
    std::printf("%7d %8.3f %8.3f %8.3f\n", i, force[3 * i], force[3 * i + 1], force[3 * i + 2]);
  const double* used = solution.friction_used();
  std::printf("uses at most %.3f of the friction\n", std::max({used[0], used[1], used[2]}));
}
