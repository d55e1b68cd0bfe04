// For test_hand_controller.py. `lifecycle SMALL LARGE`: configures a controller for one hand, then
// for another, and ends with 0 if nothing of the first is left.
#include <grasp/hand/hand_controller.hpp>
#include <grasp/hand/tree_file.hpp>

#include <cstdio>

namespace {

int faults = 0;
void expect(bool good, const char* what) {
  if (!good) std::printf("%s\n", what);
  faults += !good;
}

grasp::HandState at_rest(const grasp::Tree& hand) {
  grasp::HandState state(hand.joints(), hand.fingers());
  for (int j = 0; j < hand.joints(); ++j)
    state[grasp::ANGLES][j] = std::clamp(0.0, hand.links[j].lower, hand.links[j].upper);
  return state;
}

}  // namespace

int main(int, char** arguments) {
  const auto small = grasp::TreeFile::load(arguments[1]);
  const auto large = grasp::TreeFile::load(arguments[2]);
  grasp::HandController controller;
  controller.configure(small);
  controller.record(1.0);
  controller.configure(large);  // the recording was for the other hand
  expect(controller.activate(at_rest(*large)), "the larger hand is not activated");
  controller.update(at_rest(*large), 1e-3);
  expect(controller.recording().rows() == 0, "a recording of another hand is kept");

  const std::vector<double> wrong(3);
  bool refused = false;
  try {
    controller.configure(small, {}, grasp::Calibration::newton_metres(*small), wrong);
  } catch (const std::invalid_argument&) {
    refused = true;
  }
  expect(refused, "a wrong posture is taken");
  controller.update(at_rest(*large), 1e-3);
  expect(controller.status == grasp::HandController::released, "the first hand is lost");
  expect(int(controller.commands.size()) == large->joints(), "half of a hand was configured");

  controller.deactivate();
  controller.record(1.0);
  controller.activate(at_rest(*large));
  {
    const grasp::HandState brief = at_rest(*large);
    controller.observe(brief, 1e-3);
  }  // the message ends before the second half of the update
  controller.act();
  expect(controller.recording().rows() == 2, "an update is not recorded");

  try {
    controller.record(1e300);
    expect(false, "a recording that fits no memory is begun");
  } catch (const std::invalid_argument&) {
  }
  return faults;
}
