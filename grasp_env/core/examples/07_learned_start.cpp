// A learned start: Newton from the prediction of a network, for wrenches far from the last one. The
// same in Python: examples/07_learned_start.py, where
// `LearnedInitialForce.pretrained().export("four.model", grasp)` makes the file:
//
//     07_learned_start four.model
#include <grasp/optimizer.hpp>

#include <cstdio>
#include <exception>

// A thumb below, three fingers above; metres and unit vectors INTO the object.
constexpr double POSITIONS[] = {0, 0, -0.05, 0, 0.03, 0.05, -0.03, -0.02, 0.05, 0.03, -0.02, 0.05};
constexpr double NORMALS[] = {0, 0, 1, 0, 0, -1, 0, 0, -1, 0, 0, -1};

int main(int count, char** arguments) try {
  if (count < 2) throw std::invalid_argument("usage: 07_learned_start MODEL");
  const auto contacts = grasp::Contacts::from(POSITIONS, NORMALS, 0.4);
  // a damaged file is refused
  const auto model = std::make_shared<const grasp::Model>(grasp::ModelFile::load(arguments[1]));
  grasp::ForceOptimizer plain({contacts});
  grasp::ForceOptimizer learned({contacts}, {.start = grasp::Start::learned, .model = model});
  for (double size : {0.5, 1.0, 2.0}) {
    const double wrench[] = {size,         0.5 * size,  -0.6 * size,
                             -0.01 * size, 0.02 * size, 0};  // [N, N m]
    const double steps = plain.solve(wrench).summary().iterations;
    learned.forget();  // otherwise it would also try the last solution
    // certified like any other, for any weights
    const grasp::Record& solution = learned.solve(wrench);
    if (solution.code() != grasp::CONVERGED) return 1;
    std::printf(
        "wrench x %.1f: %.0f Newton steps from the network, %.0f from an internal force; normal "
        "forces",
        size, solution.summary().iterations, steps);
    for (int i = 0; i < 4; ++i) std::printf(" %.3f", solution.force()[3 * i]);
    std::printf(" N%s\n", solution.summary().outside > 0 ? ", outside the training range" : "");
  }
} catch (const std::exception& error) {
  std::fprintf(stderr, "%s\n", error.what());
  return 2;
}
