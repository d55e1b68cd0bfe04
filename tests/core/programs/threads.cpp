// Eight threads construct solvers of the same contacts and model and solve: all get the same bits.
#include <grasp/optimizer.hpp>

#include <cstdio>
#include <thread>

int main(int argc, char** arguments) {
  if (argc < 3) return 2;
  const int calls = std::atoi(arguments[2]);
  const double positions[] = {0, 0, -0.05, 0, 0.03, 0.05, -0.03, -0.02, 0.05, 0.03, -0.02, 0.05};
  const double normals[] = {0, 0, 1, 0, 0, -1, 0, 0, -1, 0, 0, -1};
  const auto contacts = grasp::Contacts::from(positions, normals, 0.4);
  const auto model = std::make_shared<const grasp::Model>(grasp::ModelFile::load(arguments[1]));
  const std::vector<double> most(4, 8.0);
  std::vector<std::vector<double>> forces(8);
  std::vector<std::thread> threads;
  for (auto& row : forces)
    threads.emplace_back([&] {
      grasp::ForceOptimizer newton({contacts});
      grasp::ForceOptimizer follow({contacts}, {.start = grasp::Start::previous});
      grasp::ForceOptimizer conic({contacts}, {.method = grasp::Method::conic});
      grasp::ForceOptimizer learned({contacts}, {.start = grasp::Start::learned, .model = model});
      grasp::ForceOptimizer general({contacts, {.max_normal = most}},
                                    {.method = grasp::Method::conic});
      grasp::ForceOptimizer limited({contacts, {.max_normal = most}},
                                    {.start = grasp::Start::previous});
      const auto keep = [&](const grasp::Record& r) {
        row.insert(row.end(), r.force(), r.force() + 12);
      };
      for (int k = 0; k < calls; ++k) {
        const double turn = 0.1 * k;
        const double wrench[6] = {
            std::sin(turn), std::cos(turn), -1.0, 0.02 * std::sin(turn), 0.0, 0.01};
        keep(newton.solve(wrench));
        keep(conic.solve(wrench));
        keep(learned.solve(wrench));
        keep(limited.solve(wrench));
        keep(follow.solve(wrench, {.positions = positions}));
        keep(general.solve(wrench));
      }
    });
  for (auto& thread : threads) thread.join();
  for (const auto& row : forces)
    if (row != forces[0]) return 1;
  std::printf("%zu\n", forces[0].size());
}
