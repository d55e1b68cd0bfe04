// The hand of a simulation beside its controller: what imperfect sensors tell the controller, and
// what is true of the hold. The controller knows nothing of it.
#pragma once
#include <grasp/hand/hand_controller.hpp>
#include <grasp/hand/sensing.hpp>

namespace grasp {

// Costs of an agent's step, each from 0 to 1.
struct Costs {
  // fraction of the commanded normal forces above the smallest that balance the wrench with all of
  // the true friction; 1: none does
  double force;
  double torque;  // largest torque of the step as a fraction of its limit
  // of the commanded forces, relative to those before and after: sums of |components|
  double change;
};

class SimulatedHand {
 public:
  const std::shared_ptr<Scene> scene;
  const std::shared_ptr<HandController> controller;
  const Body body;  // the model of the object in the feedback on its pose
  Sensors sensors;
  HandState state;  // what the controller gets

  // method: its contacts are those of all fingers. friction: the true one, over that of the method
  SimulatedHand(std::shared_ptr<Scene> viewed, std::shared_ptr<HandController> controls,
                const ForceOptimizer& method, double friction, const Body& body,
                const SensorSettings& sensing)
      : scene(std::move(viewed)),
        controller(std::move(controls)),
        body(body),
        sensors(scene, sensing),
        state(scene->tree->joints(), scene->tree->fingers()),
        least_sum_({true_contacts(method.contacts(), friction)},
                   {.method = Method::conic, .tolerance = 1e-4}),
        least_sum_row_(least_sum_.size()),
        slides_(scene->tree->fingers()),
        step_force_(3 * scene->tree->fingers()) {
    std::ranges::copy(std::array{late(sensing.joint_delay), late(sensing.delay),
                                 late(sensing.delay + sensing.wrench_delay)},
                      state[AGES].begin());
  }
  SimulatedHand(const SimulatedHand&) = delete;

  // Start a new episode. Delayed measurements first show the current scene, at rest.
  void reset() {
    slides_.reset();
    worst_ = {};
    sensors.reset();
    tell(scene->gravity, Target{});
    controller->activate(state);
    begin_step();
  }

  // What is known at a tick.
  struct Known {
    Doubles reading;  // see `Reading`; empty if the scene has it already
    // (6,) external wrench that a perfect sensor reports [N, N m], object frame
    const double* external;
    const double* noise;  // (3 + 3N,) standard normal numbers for noisy sensors
    Point gravity;        // [m/s^2], world
    Target target;
  };
  // First half of a tick: read the scene, and let the controller observe it. Return false, with
  // nothing changed, if the reading is not finite or the object is farther away than
  // `Snapshot::LOST_DISTANCE`. The second half is `HandController::act`.
  bool see(const Known& known) {
    if (!measure(known)) return false;
    controller->observe(state, sensors.settings.tick);
    return true;
  }
  // The hand is at rest: the measured forces become the commanded ones.
  void rest(const Known& known) {
    measure(known);
    has_tick_ = false;
    worst_.slide = 0.0;
    slides_.reset();  // the first tick counts it again
    controller->activate(state);
    std::vector<double> forces(step_force_.size());
    for (int i = 0; i < int(slides_.size()); ++i)
      for (int a = 0; a < 3; ++a)
        forces[3 * i + a] = dot(controller->model().axis(i, a), seen().forces[i]);
    controller->rest_at(forces);
    sensors.reset();
  }
  const Snapshot& seen() const { return sensors.seen(); }

  void begin_step() {
    controller->forces().effort = {};
    step_force_ = controller->force;
    unbalanced_ = {0.0, 0.0, 0.0};
    ticks_ = 0;
    pushed_ = 0;
    has_tick_ = false;
  }
  // Costs of the step since `begin_step`, on the contacts currently seen.
  Costs costs() {
    const std::vector<double>& force = controller->force;
    const bool closure = controller->closure();
    double total = 0.0;
    double moved = 0.0;
    double both = 0.0;
    for (std::size_t i = 0; i < slides_.size(); ++i) total += force[3 * i];
    for (std::size_t j = 0; j < force.size(); ++j) {
      moved += std::abs(force[j] - step_force_[j]);
      both += std::abs(force[j]) + std::abs(step_force_[j]);
    }
    Costs out{.force = closure ? 0.0 : 1.0,
              .torque = std::min(controller->forces().effort.share, 1.0),
              .change = both > 0.0 ? moved / both : 0.0};
    if (closure && total > 0.0) {
      const std::size_t size = 3 * slides_.size();
      least_sum_.solve({.wrench = controller->state()[WRENCH].data(),
                        .now = {.positions = {&seen().points[0].u, size},
                                .normals = {&seen().normals[0].u, size},
                                .contacts = controller->mask}},
                       least_sum_row_.data());
      const Record row(least_sum_row_.data());
      out.force = row.has_force() ? std::max(0.0, 1.0 - row.summary().objective / total) : 1.0;
    }
    return out;
  }

  // Worst values since `reset`, from the true state.
  struct Worst {
    double slide = 0.0;    // [m] largest sliding distance of a touching tip on the object
    double overlap = 0.0;  // [m] largest penetration of a tip into the object
    // force of other parts on the object, divided by max(|external force + weight|, weight)
    double stray = 0.0;
    double force = 0.0;  // [N] largest force of a tip on the object
  };
  // Quality of the hold, from the true state.
  struct Outcome {
    PoseError error;
    double drift, tilt;        // [m], [rad]: norms of the position and orientation errors
    double force_error = 0.0;  // largest component of measured - commanded force [N]
    double slip = 0.0;         // highest tangential speed of a touching tip on the object [m/s]
    double stray = 0.0;        // force of parts other than fingertips on the object [N]
    // force that the fingertips lack to move the object as the target moves, a mean over the
    // agent's step, as a fraction of the load; 0 before the first
    double imbalance = 0.0;
    double speed = 0.0;  // bound on the speed of the contacts against the target motion [m/s]
    Worst worst;
  };
  // measured: receives the forces (N, 3) in the commanded contact frames [N].
  Outcome outcome(const Target& target, double* measured) const {
    const Snapshot& now = scene->now;
    const std::vector<double>& force = controller->force;
    const PoseError error(now, target);
    Outcome out{.error = error,
                .drift = length(error.position),
                .tilt = length(error.orientation),
                .stray = now.stray,
                .imbalance = imbalance(),
                .worst = worst()};
    double radius = 0.0;
    for (int i = 0; i < int(slides_.size()); ++i) {
      for (int a = 0; a < 3; ++a) {
        const int j = 3 * i + a;
        measured[j] = dot(controller->model().axis(i, a), now.forces[i]);
        out.force_error = std::max(out.force_error, std::abs(measured[j] - force[j]));
      }
      if (now.touching[i] > 0.0) out.slip = std::max(out.slip, now.slip[i]);
      radius = std::max(radius, length(now.points[i]));
    }
    out.speed = length(error.linear) + radius * length(error.angular);
    return out;
  }

 private:
  static constexpr double STANDARD_GRAVITY = 9.81;  // [m/s^2]
  ForceOptimizer least_sum_;                        // finds the least sum of normal forces
  std::vector<double> least_sum_row_;
  Worst worst_;
  double load_ = 1.0;  // [N] max(|external force + weight|, weight): a push may cancel the weight
  // [N] world frame: what must be balanced during the tick that runs, and the sum of what was not
  // in the earlier ticks of the agent's step
  Point asked_{}, unbalanced_{};
  int ticks_ = 0;                   // number of these
  std::uint64_t pushed_ = 0;        // fingers that pushed in them
  bool has_tick_ = false;           // a tick of the step runs, or has just ended
  Slides slides_;                   // the true ones
  std::vector<double> step_force_;  // (N, 3) [N] commanded when the agent's step began

  // The least sum counts newtons.
  static Contacts true_contacts(Contacts contacts, double friction) {
    contacts.set_weights(Objective{});
    contacts.narrow(friction);
    return contacts;
  }
  double late(int ticks) const { return ticks * sensors.settings.tick; }
  bool measure(const Known& known) {
    if (!known.reading.empty() && !scene->read(known.reading.data(), known.reading.size()))
      return false;
    sensors.see(known.external, known.noise, body, known.gravity);
    tell(known.gravity, known.target);
    if (has_tick_) {
      unbalanced_ += left();
      pushed_ |= scene->now.mask();
      ++ticks_;
    }
    const Snapshot& now = scene->now;
    const Point external = now.rotation * point(known.external);
    asked_ = external + scene->mass * (scene->gravity - known.target.linear_acceleration);
    has_tick_ = true;
    slides_.add(now, sensors.settings.tick);
    for (std::size_t i = 0; i < slides_.size(); ++i)
      worst_.slide = std::max(worst_.slide, slides_[i]);
    load_ =
        std::max(length(external + scene->mass * scene->gravity), STANDARD_GRAVITY * scene->mass);
    worst_ = worst();
    return true;
  }
  // What the forces of the last reading left unbalanced [N], world frame.
  Point left() const {
    Point total{0.0, 0.0, 0.0};
    for (const Point& force : scene->now.forces) total += force;
    return scene->now.rotation * total + asked_;
  }
  // Fewer than two fingertips carry nothing, also without a load.
  double imbalance() const {
    if (!has_tick_) return 0.0;
    const double share = length(unbalanced_ + left()) / ((ticks_ + 1) * load_);
    return std::popcount(pushed_ | scene->now.mask()) > 1 ? share : std::max(share, 1.0);
  }
  // Write the message of the sensors.
  void tell(const Point& gravity, const Target& target) {
    const Snapshot& s = seen();
    std::ranges::copy(s.angles, state[ANGLES].begin());
    std::ranges::copy(s.rates, state[RATES].begin());
    std::ranges::copy(s.touching, state[TOUCHING].begin());
    std::copy_n(&s.points[0].u, 3 * s.points.size(), state[POSITIONS].begin());
    std::copy_n(&s.normals[0].u, 3 * s.normals.size(), state[NORMALS].begin());
    const Vec6 wrench = sensors.external + body.wrench(s, target, gravity);
    std::ranges::copy(wrench, state[WRENCH].begin());
    std::copy_n(&scene->gravity.u, 3, state[GRAVITY].begin());
    BodyRow& object = state.object();
    object = {s.position, {}, s.linear, s.angular};
    s.rotation.quaternion(object.quaternion);
    state.target() = target.body;
  }
  Worst worst() const {
    Worst out = worst_;
    for (double gap : scene->now.gaps) out.overlap = std::max(out.overlap, -gap);
    for (const Point& force : scene->now.forces) out.force = std::max(out.force, length(force));
    out.stray = std::max(out.stray, scene->now.stray / load_);
    return out;
  }
};

}  // namespace grasp
