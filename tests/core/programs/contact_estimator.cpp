// For test_contact_estimator.py. `contact_estimator HAND_FILE` updates an estimator with moving
// joints, once with normals, once with a surface. It prints the number of allocations, and whether
// what it refuses is refused.
#include <grasp/hand/contact_estimator.hpp>
#include <grasp/hand/tree_file.hpp>

#include <cstdio>

#include "../bindings/counting.hpp"

int main(int, char** arguments) {
  const auto hand = grasp::TreeFile::load(arguments[1]);
  grasp::ContactEstimator estimator(hand, {.touch = 0.3, .release = 0.2});
  grasp::HandState state(hand->joints(), hand->fingers());
  std::vector<double> torques(hand->joints());
  std::vector<double> normals(3 * hand->fingers());
  for (std::size_t k = 0; k < normals.size(); k += 3) normals[k] = 1.0;

  const bool nothing_known = !estimator.update(state, torques, 1e-3);
  long allocated = 0;
  bool finite = true;
  const auto move = [&](int tick) {
    for (int j = 0; j < hand->joints(); ++j) {
      state[grasp::ANGLES][j] = 0.3 * std::sin(0.1 * tick + j);
      state[grasp::RATES][j] = 30.0 * std::cos(0.1 * tick + j);
      torques[j] = 0.01 * (tick % 7);
    }
    allocated += counted([&] { estimator.update(state, torques, 1e-3); });
    for (double number : state[grasp::POSITIONS]) finite = finite && std::isfinite(number);
  };
  estimator.set_normals(normals);
  for (int tick = 0; tick < 100; ++tick) move(tick);
  estimator.set_surface({grasp::Capsule{0.03, 0.0}});
  allocated += counted([&] { estimator.reset(); });
  for (int tick = 0; tick < 100; ++tick) move(tick);
  std::printf("allocations: %ld, finite: %d, nothing known: %d\n", allocated, finite,
              nothing_known);

  grasp::HandState other(hand->joints() + 1, hand->fingers());
  std::printf("another hand: %d\n", estimator.update(other, torques, 1e-3));
  try {
    grasp::ContactEstimator(hand, {.touch = 0.1, .release = 0.1});
  } catch (const std::invalid_argument& error) {
    std::printf("%s\n", error.what());
  }
}
