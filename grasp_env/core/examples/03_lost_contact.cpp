// A contact is lost and comes back: a bit mask in each call marks the touching contacts. The same
// in Python: examples/03_lost_contact.py.
#include <grasp/optimizer.hpp>

#include <cmath>
#include <cstdio>
#include <map>
#include <numbers>

// A thumb below, three fingers above; metres and unit vectors INTO the object.
constexpr double POSITIONS[] = {0, 0, -0.05, 0, 0.03, 0.05, -0.03, -0.02, 0.05, 0.03, -0.02, 0.05};
constexpr double NORMALS[] = {0, 0, 1, 0, 0, -1, 0, 0, -1, 0, 0, -1};

int main() {
  grasp::ForceOptimizer solver({grasp::Contacts::from(POSITIONS, NORMALS, 0.4)},
                               {.start = grasp::Start::previous});
  const std::map<int, const char*> events{{399, "four hold"},
                                          {400, "one is lost"},
                                          {401, "three hold"},
                                          {600, "it is back"},
                                          {601, "four hold"}};
  for (int tick = 0; tick < 1000; ++tick) {
    const bool lost = 400 <= tick && tick < 600;
    const double turn = 2 * std::numbers::pi * 1e-3 * tick;
    const double wrench[] = {3 * std::sin(turn), 2 * std::cos(turn), 2, 0, 0, 0.02};  // [N, N m]
    const grasp::Record& solution = solver.solve(wrench, {.contacts = lost ? 0b0111u : 0b1111u});
    if (solution.code() != grasp::CONVERGED) return 1;

    const auto event = events.find(tick);
    if (event == events.end()) continue;
    std::printf("%d ms, %-11s %.0f iterations, normal forces [", tick, event->second,
                solution.summary().iterations);
    for (int i = 0; i < 4; ++i) std::printf("%s%.3f", i ? " " : "", solution.force()[3 * i]);
    std::printf("] N\n");
  }
  const double push[] = {0, 0, 2, 0, 0, 0};
  const double turn[] = {0, 0, 2, 0, 0, 0.02};
  const grasp::Record& two = solver.solve(push, {.contacts = 0b0011});
  std::printf("two hold, normal forces [%.3f %.3f] N\n", two.force()[0], two.force()[3]);
  // but not against a moment about the line through them: without a force the result is a code and
  // zeros, not an exception
  if (solver.solve(turn, {.contacts = 0b0011}).code() == grasp::INFEASIBLE)
    std::printf("two cannot hold %g N m\n", turn[5]);
}
