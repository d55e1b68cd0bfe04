// A hand of four fingers around a cube, without a simulator: control ticks as a loop makes them.
#include <grasp/hand/simulated_hand.hpp>

#include "allocations.hpp"
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "module.hpp"

using namespace grasp;

namespace {

// Three joints a finger, across the links; `more` joints besides, for the rest posture. shared: one
// joint carries all fingers.
std::shared_ptr<Tree> tree_of(int more, double torque_limit = 3.0, bool shared = false) {
  auto tree = std::make_shared<Tree>();
  if (shared)
    tree->links.push_back({-1, {}, {}, {0.0, 1.0, 0.0}, 0.02, {}, -2.0, 2.0, torque_limit});
  for (int finger = 0; finger < 4; ++finger)
    for (int j = 0; j < 3 + more; ++j) {
      const Point offset = j ? Point{0.0, -0.05, 0.0}
                             : Point{finger % 2 ? 0.09 : -0.09, 0.12, finger < 2 ? 0.03 : -0.03};
      const Point axis = j == 0 ? Point{1.0, 0.0, 0.0} : Point{0.0, 0.0, 1.0};
      const int parent = j ? tree->joints() - 1 : shared - 1;
      tree->links.push_back(
          {parent, offset, {}, axis, 0.02, {0.0, -0.02, 0.0}, -2.0, 2.0, torque_limit});
      if (j == 2 + more) tree->tips.push_back({tree->joints() - 1, {0.0, -0.03, 0.0}, 0.01});
    }
  return tree;
}

struct Case {
  int more = 0;                       // joints of each finger
  bool late = false;                  // sensors
  bool soft = false, shared = false;  // contacts; a joint
  double torque_limit = 3.0;          // [N m]
  Method method = Method::reduced_flow;
};

struct Trial {
  std::shared_ptr<Tree> tree;
  std::shared_ptr<Scene> scene;
  std::shared_ptr<HandController> controller = std::make_shared<HandController>();
  std::unique_ptr<SimulatedHand> hand;
  std::vector<double> reading, noise, measured;
  int ticks = 0;
  double sum = 0.0;  // of all torques, so that nothing is left out

  explicit Trial(const Case& variant)
      : tree(tree_of(variant.more, variant.torque_limit, variant.shared)) {
    scene = std::make_shared<Scene>(tree, Surface{Cuboid{{0.05, 0.05, 0.05}}},
                                    Point{0.0, -9.81, 0.0}, 0.2);
    std::vector<double> places, inwards;
    for (int i = 0; i < 4; ++i) {
      const double side = i % 2 ? 0.05 : -0.05;
      const double z = i < 2 ? 0.03 : -0.03;
      for (double value : {side, i == 3 ? 0.02 : 0.0, z}) places.push_back(value);
      for (double value : {-side / 0.05, 0.0, 0.0}) inwards.push_back(value);
    }
    const double friction[] = {0.6};
    const double torsion[] = {0.01, 0.01, 0.01, 0.01};
    const Contacts contacts = variant.soft
                                  ? Contacts::from(places, inwards, friction, {}, {}, torsion)
                                  : Contacts::from(places, inwards, friction);
    const ForceOptimizer method({contacts},
                                {.method = variant.method, .tolerance = 1e-6, .limit = 5000});
    HandControllerSettings settings;
    settings.rate = 250.0;
    settings.force_rate = 12.5;
    settings.squeeze = 20.0;
    Body object;
    object.mass = 0.2;
    object.position_gain = 100.0;
    object.position_damping = 8.0;
    object.rotation_gain = 400.0;
    object.rotation_damping = 40.0;
    for (int k = 0; k < 3; ++k)
      object.inertia.rows[k] = Point{k == 0 ? 1e-4 : 0.0, k == 1 ? 1e-4 : 0.0, k == 2 ? 1e-4 : 0.0};
    settings.directions.resize(12 * 2);
    for (int j = 0; j < 12; ++j) {
      settings.directions[2 * j] = inwards[j];
      settings.directions[2 * j + 1] = j % 3 == 2 ? 0.1 : 0.0;
    }
    SensorSettings sensors;
    sensors.tick = 0.004;
    sensors.keep = 0.5;
    if (variant.late) {
      sensors.wrench = WrenchSource::estimated;
      sensors.joint_delay = 1;
      sensors.delay = 2;
      sensors.pose_noise = 1e-5;
      sensors.tactile_noise = 0.02;
    }
    controller->configure(tree, settings, Calibration::newton_metres(*tree), method);
    hand = std::make_unique<SimulatedHand>(scene, controller, method, 1.0, object, sensors);
    for (int i = 0; i < 4; ++i) {
      controller->springs().goals[i] = point(&places[3 * i]);
      controller->springs().inwards[i] = point(&inwards[3 * i]);
    }
    reading.resize(Reading::size(tree->joints(), 4));
    noise.resize(15);
    measured.resize(12);
    read();
    hand->reset();
  }

  // The next of a sequence: all wander a little, and now and then a finger loses its force.
  void read() {
    const int m = tree->joints();
    for (int j = 0; j < m; ++j) {
      reading[j] = 0.3 * std::sin(0.1 * ticks + j);
      reading[m + j] = 0.1 * std::cos(0.1 * ticks + j);
    }
    BodyRow body{{1e-3 * std::sin(0.03 * ticks), 0.0, 0.0},
                 {0.0, 0.0, 0.0, 1.0},
                 {0.01, 0.0, 0.0},
                 {0.0, 0.1, 0.0}};
    const double turn = 0.02 * std::sin(0.05 * ticks);
    body.quaternion[2] = std::sin(turn);
    body.quaternion[3] = std::cos(turn);
    std::memcpy(&reading[2 * m], &body, sizeof body);
    for (int i = 0; i < 4; ++i) {
      const Point touch = scene->now.touch[i];
      const double force = ticks % 50 > 40 && i > 1 ? 0.0 : 2.0;
      const ContactRow row{
          double(tree->tips[i].link), touch, {i % 2 ? -force : force, 0.1 * force, 0.0}};
      std::memcpy(&reading[2 * m + Reading::BODY + Reading::CONTACT * i], &row, sizeof row);
    }
    scene->read(reading.data(), reading.size());
  }

  // A step of the method every fifth tick, with an adjustment, a residual or another margin now and
  // then, all ways to hold in turn; fingers come and go.
  void tick() {
    read();
    const Target target;
    const double wrench[] = {0.5, -0.2, 0.1, 0.01, 0.0, -0.01};
    const double adjustment[] = {0.5, -0.3};
    const double forces[12] = {2.0, 0.1, 0.0, 2.0, 0.0, 0.1, 2.0, 0.0, 0.0, 2.0, 0.1, 0.0};
    ++ticks;
    for (std::size_t j = 0; j < noise.size(); ++j) noise[j] = std::sin(1.7 * ticks + double(j));
    constexpr Hold KINDS[] = {Hold::optimized, Hold::optimized, Hold::squeeze,
                              Hold::direct,    Hold::place,     Hold::reach};
    controller->hold = KINDS[ticks / 50 % 6];
    StepRequest step;
    if (controller->hold == Hold::direct)
      step.force = forces;
    else if (ticks % 3 == 0)
      step.adjustment = adjustment;
    else
      step.residual = forces;
    if (ticks % 7 == 0) step.margin = {0.5 + 0.4 * (ticks % 2), 0.3};
    if (!hand->see({reading, wrench, noise.data(), {0.0, -9.81, 0.0}, target}))
      throw std::runtime_error("a bad reading");
    controller->act(ticks % 5 == 0 ? &step : nullptr);
    for (double torque : controller->torques) sum += torque;
    sum += hand->outcome(target, measured.data()).drift;
  }
};

nb::tuple ticks(int count, int more, bool late, bool soft, bool shared, double torque_limit,
                bool flow) {
  Trial trial(
      {more, late, soft, shared, torque_limit, flow ? Method::reduced_flow : Method::newton});
  for (int k = 0; k < 10; ++k) trial.tick();
  const long allocated = counted([&] {
    for (int k = 0; k < count; ++k) trial.tick();
  });
  const HandController& c = *trial.controller;
  const Effort& effort = c.forces().effort;
  return nb::make_tuple(allocated, trial.sum, effort.followed + effort.limited, c.changes, c.peak);
}

}  // namespace

void bind_hand(nb::module_& m) {
  m.def("ticks", &ticks, "count"_a, "more"_a, "late"_a, "soft"_a, "shared"_a, "torque_limit"_a,
        "flow"_a,
        "Control ticks of a hand with 3 + `more` joints a finger: allocations, the sum of all "
        "torques, iterations within the "
        "torque limits, changes of the contacts, the largest torque.");
}
