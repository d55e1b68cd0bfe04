// Many wrenches: in C++ a batch is a loop, with one solver per thread. The same in Python:
// examples/08_batch.py.
#include <grasp/optimizer.hpp>

#include <chrono>
#include <cmath>
#include <cstdio>
#include <numbers>
#include <thread>

// A thumb below, three fingers above; metres and unit vectors INTO the object.
constexpr double POSITIONS[] = {0, 0, -0.05, 0, 0.03, 0.05, -0.03, -0.02, 0.05, 0.03, -0.02, 0.05};
constexpr double NORMALS[] = {0, 0, 1, 0, 0, -1, 0, 0, -1, 0, 0, -1};
constexpr int AROUND = 360, UP = 169, THREADS = 2;  // steps of one degree

int main() {
  const auto contacts = grasp::Contacts::from(POSITIONS, NORMALS, 0.4);
  std::vector<double> least(AROUND * UP);  // sum of normal forces [N] for 5 N in each direction
  const auto begin = std::chrono::steady_clock::now();
  const auto work = [&](int thread) {
    // one per thread; nothing is shared
    grasp::ForceOptimizer solver({contacts}, {.method = grasp::Method::conic});
    for (int k = thread; k < AROUND * UP; k += THREADS) {
      const double azimuth = (k % AROUND - 180) * std::numbers::pi / 180;
      const double elevation = (k / AROUND - 84) * std::numbers::pi / 180;
      const double flat = 5 * std::cos(elevation);
      const double wrench[] = {
          flat * std::cos(azimuth), flat * std::sin(azimuth), 5 * std::sin(elevation), 0, 0, 0};
      const grasp::Record& solution = solver.solve(wrench);
      least[k] = solution.code() == grasp::CONVERGED ? solution.summary().objective : INFINITY;
    }
  };
  std::vector<std::thread> threads;
  for (int thread = 0; thread < THREADS; ++thread) threads.emplace_back(work, thread);
  for (auto& thread : threads) thread.join();
  const double took =
      std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();

  double sum = 0, most = 0;
  for (double force : least) {
    sum += force;
    most = std::max(most, force);
  }
  std::printf("%zu wrenches on one grasp, %.2f million a second\n", least.size(),
              1e-6 * double(least.size()) / took);
  std::printf("they take %.3f N on average, %.3f N at most\n", sum / double(least.size()), most);
}
