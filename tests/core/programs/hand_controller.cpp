// For test_hand_controller.py. `hand_controller` with the arguments of the example is that itself.
// `hand_controller HAND_FILE FRICTION` reads doubles: the home posture, the points of a
// calibration's tables, torques and units of each joint, then rows of a period and a state; period
// 0 deactivates, a negative one activates. It writes a row for each: status, late, commands,
// torques; at last the status after a message of another size, and the number of allocations.
#define main serve
#include "../../../grasp_env/core/examples/hand_controller.cpp"
#undef main

#include "../bindings/counting.hpp"

int main(int argc, char** arguments) {
  if (argc != 3) return serve(argc, arguments);
  const auto hand = grasp::TreeFile::load(arguments[1]);
  const auto read = [](std::span<double> to) {
    return std::fread(to.data(), sizeof(double), to.size(), stdin) == to.size();
  };
  const auto write = [](const std::vector<double>& from) {
    std::fwrite(from.data(), sizeof(double), from.size(), stdout);
  };
  std::vector<double> home(hand->joints());
  std::vector<double> points(1);
  read(home);
  read(points);
  grasp::Calibration calibration;
  for (auto* table : {&calibration.torques, &calibration.units})
    for (int j = 0; j < hand->joints(); ++j) read(table->emplace_back(std::size_t(points[0])));
  grasp::HandControllerSettings settings;
  settings.friction = std::atof(arguments[2]);
  grasp::HandController controller;
  controller.configure(hand, settings, calibration, home);
  grasp::HandState state(hand->joints(), hand->fingers());
  long allocated = 0;
  for (std::vector<double> period(1); read(period);) {
    read(state.numbers());
    if (period[0] == 0.0)
      controller.deactivate();
    else if (period[0] < 0.0)
      allocated += counted([&] { controller.activate(state); });
    allocated += counted([&] { controller.update(state, std::abs(period[0])); });
    write({double(controller.status), double(controller.late)});
    write(controller.commands);
    write(controller.torques);
  }
  const grasp::HandState another(hand->joints() - 1, hand->fingers());
  controller.activate(another);
  controller.update(another, 1e-3);
  write(
      {double(controller.status), double(allocated), double(std::isfinite(controller.torques[0]))});
}
