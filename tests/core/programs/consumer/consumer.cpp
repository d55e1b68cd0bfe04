#include <grasp/optimizer.hpp>
#include <grasp/planner/search.hpp>

#include <cstdio>

int main() {
  const double positions[] = {0, 0, -0.05, 0, 0.03, 0.05, -0.03, -0.02, 0.05, 0.03, -0.02, 0.05};
  const double normals[] = {0, 0, 1, 0, 0, -1, 0, 0, -1, 0, 0, -1};
  const double wrench[] = {1, 0.5, -0.6, -0.1, 0.2, 0};
  grasp::ForceOptimizer solver({grasp::Contacts::from(positions, normals, 0.4)},
                               {.tolerance = 1e-9});
  const grasp::Record& solution = solver.solve(wrench);
  std::printf("%d %.9f\n", solution.code(), solution.summary().objective);
}
