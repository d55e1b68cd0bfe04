// The controller of a torque-controlled hand: joints, contacts and a wrench go in, joint torques
// come out. It runs on a bench and in the simulation of the Python environment.
//
//     grasp::HandController controller;
//     controller.configure(grasp::TreeFile::load("my.hand"), {.friction = 0.6, .rate = 500.0});
//     controller.activate(state);
//     loop: controller.update(state, period); send(controller.commands);
//
// `configure` allocates and throws std::invalid_argument. The other functions do neither.
#pragma once
#include <chrono>
#include <numbers>
#include <grasp/hand/calibration.hpp>
#include <grasp/hand/grip_forces.hpp>
#include <grasp/hand/recording.hpp>
#include <grasp/hand/springs.hpp>

namespace grasp {

class HandController {
 public:
  enum Status {
    inactive,    // zero torque
    holding,     // forces within the margin balance the wrench
    marginal,    // nearly all of it; or forces inside the friction cones do, beyond the margin
    overloaded,  // forces that do exceed the motors' limits: those that exceed them least
    pivoting,    // they balance all but a moment that no contact resists
    slipping,    // no moderate forces balance it: those with the smallest imbalance
    coasting,    // the last forces, since joints, contacts or wrench are too old
    released,    // the hand carries itself
    given        // unchecked forces or places, which `hold` asks for
  };
  static constexpr const char* STATUSES[] = {"inactive",   "holding",  "marginal",
                                             "overloaded", "pivoting", "slipping",
                                             "coasting",   "released", "given"};
  Hold hold = Hold::optimized;
  Status status = inactive;
  std::vector<double> torques, commands;  // (M,) [N m], device units
  std::vector<double> spring_torques;     // (M,) part of all springs in wanted torques [N m]
  // (N, 3) commanded forces [N], contact frames: the optimal ones of `forces()` and the springs of
  // the grip
  std::vector<double> force;
  std::uint64_t mask = 0;         // fingers that count as in contact
  int changes = 0;                // number of changes of `mask`, except from no contact
  double peak = 0.0;              // largest |torque| since `activate` [N m]
  bool rising = false;            // torques are on their way, as fast as they may change
  double duration = 0.0;          // [s] of the last update
  int late = 0, over_budget = 0;  // number of updates after a missed deadline; longer than `budget`

  HandController() = default;
  HandController(const HandController&) = delete;

  // method: finds the forces when an agent's step begins, with one contact per finger; its contacts
  // and its margin replace those of the settings. home: (M,) [rad] posture in which the gains are
  // computed, and to which joints that the tips leave free return; empty: zero angles within the
  // ranges.
  void configure(std::shared_ptr<const Tree> hand, const HandControllerSettings& settings,
                 const Calibration& calibration, const ForceOptimizer& method,
                 std::span<const double> home = {}) {
    settings.check();
    calibration.check(hand->joints());
    std::vector<double> limits;
    for (int j = 0; j < hand->joints(); ++j) {
      const Link& link = hand->links[j];
      limits.push_back(link.coupled() ? infinity
                                      : std::min(link.torque_limit, calibration.limit(j)));
    }
    const std::vector<double> rest = posture(*hand, home);
    parts_ = std::make_unique<Parts>(std::move(hand), limits, settings, method, rest);
    status = inactive;
    settings_ = settings;
    calibration_ = calibration;
    recording_ = {};
    next_recording_.reset();
    has_own_solver_ = false;
    const Tree& tree = *parts_->model.tree;
    now_ = given_ = HandState(tree.joints(), tree.fingers());
    torques = commands = wanted_ = spring_torques = work_ = std::vector<double>(tree.joints());
    force.assign(3 * tree.fingers(), 0.0);
    friction_used_.assign(tree.fingers(), 0.0);
    updates_apart_.assign(tree.fingers(), 0);
    deactivate();
  }
  void configure(const std::shared_ptr<const Tree>& hand, const HandControllerSettings& settings,
                 const Calibration& calibration, std::span<const double> home = {}) {
    configure(hand, settings, calibration, newton(hand->fingers(), settings), home);
    has_own_solver_ = true;
  }
  void configure(const std::shared_ptr<const Tree>& hand,
                 const HandControllerSettings& settings = {}) {
    configure(hand, settings, Calibration::newton_metres(*hand));
  }

  // Record from the next `activate` on, for as many seconds at most, and until an agent's step
  // comes. Allocates. Throws std::invalid_argument for a controller with a given method: a
  // recording holds neither.
  void record(double seconds) {
    if (!parts_ || !has_own_solver_ || settings_.follow.method != Method::newton)
      throw std::invalid_argument("a controller with its own Newton solver is needed to record");
    if (!(seconds > 0.0 && seconds * settings_.rate < 1e8))
      throw std::invalid_argument("a recording needs a time above 0 s, and less than 1e8 updates");
    const Tree& tree = *parts_->model.tree;
    next_recording_ =
        HandRecording(tree.joints(), tree.fingers(), std::size_t(seconds * settings_.rate) + 2,
                      HandRecording::describe(tree, settings_, calibration_, parts_->springs.home));
  }
  // What was recorded since `activate`; it ends when it is full.
  const HandRecording& recording() const { return recording_; }

  // Start at a state, from which torques rise from zero. Return false, and stay inactive, if it
  // is not of this hand or its numbers are not finite.
  bool activate(const HandState& state) noexcept {
    deactivate();
    if (!parts_ || !is_good(state)) return false;
    for (double& number : now_[POSITIONS]) number = 0.0;
    for (double& number : now_[NORMALS]) number = 0.0;
    now_.take(state);
    std::fill(updates_apart_.begin(), updates_apart_.end(), 0);
    mask = 0;
    changes = late = over_budget = 0;
    peak = 0.0;
    blind_ = infinity;
    has_lost_force_ = false;
    parts_->forces.reset();
    parts_->springs.reset();
    status = released;
    parts_->model.look(now_, settings_.damping);
    count_contacts();
    if (next_recording_) std::swap(recording_, *next_recording_);
    next_recording_.reset();
    note(HandEvent::activate, state, 0.0);
    return true;
  }
  // The hand already presses with forces (N, 3) [N], contact frames: torques begin at theirs.
  void rest_at(std::span<const double> forces) noexcept {
    parts_->forces.rest_at(forces);
    std::ranges::copy(forces, force.begin());
    parts_->model.torques_of(mask, forces.data(), parts_->forces.torsion.data(), torques);
    for (std::size_t j = 0; j < torques.size(); ++j)
      torques[j] = std::clamp(torques[j], -parts_->model.limits[j], parts_->model.limits[j]);
  }
  // The places of the touching fingers are where they are now: call it when a grasp has settled.
  void take_hold() noexcept {
    if (status == inactive) return;
    each_finger(mask, [&](int i) { parts_->springs.land(i, now_); });
    note(HandEvent::take_hold, now_, 0.0);
  }
  void deactivate() noexcept {
    if (status != inactive) note(HandEvent::deactivate, now_, 0.0);
    status = inactive;
    std::fill(torques.begin(), torques.end(), 0.0);
    for (std::size_t j = 0; j < commands.size(); ++j) commands[j] = calibration_(int(j), 0.0, 0.0);
    command_no_forces();
  }

  // Write `torques` and `commands`. state: the newest message, of any age; one that is not of this
  // hand or not finite is ignored, and the last one ages. period: [s] since the last update. step:
  // an agent's step that begins.
  void update(const HandState& state, double period, const StepRequest* step = nullptr) noexcept {
    observe(state, period);
    act(step);
  }
  // The two halves of `update`, for callers that compute the method's start from `state()` and
  // `mask`.
  void observe(const HandState& state, double period) noexcept {
    begin_ = std::chrono::steady_clock::now();
    if (status == inactive) return;
    period_ = std::max(0.0, period);  // NaN: 0
    const double waited = period > 0.0 ? period : 1.0 / settings_.rate;
    if (!recording_.full()) {
      given_period_ = period;
      is_ours_ = state.is_like(now_);
      if (is_ours_) given_ = state;
    }
    late += period > 1.9 / settings_.rate;
    if (is_good(state))
      now_.take(state);
    else
      for (double& age : now_[AGES]) age += waited;
    // The object was in balance a moment ago, so the same forces hold it until contacts move or the
    // load changes. After that, a hand without knowledge of its contacts must not keep squeezing:
    // all but what carries the hand fades.
    blind_ = is_stale() ? blind_ + waited : 0.0;
    known_ = std::clamp(1.0 - (blind_ - settings_.grace) / settings_.fade, 0.0, 1.0);
    parts_->model.look(now_, known_ * settings_.damping);
    count_contacts();
    prepare();
  }
  void act(const StepRequest* step = nullptr) noexcept {
    if (status != inactive) {
      command(step);
      for (std::size_t j = 0; j < torques.size(); ++j)
        commands[j] = calibration_(int(j), torques[j], spring_torques[j]);
    }
    duration = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin_).count();
    over_budget += duration > settings_.budget;
    if (step) recording_.end();
    if (status != inactive)
      note(is_ours_ ? HandEvent::update : HandEvent::foreign, is_ours_ ? given_ : now_,
           given_period_);
  }

  // (N,) share of the friction that each commanded force uses; infinite without normal force
  const std::vector<double>& friction_used() const { return friction_used_; }
  // True if forces balance the wrench, or nearly all of it.
  bool closure() const { return forces().balance <= Balance::overloaded; }
  // The last valid message; a finger without contact keeps its last contact.
  const HandState& state() const { return now_; }
  const HandControllerSettings& settings() const { return settings_; }
  const HandModel& model() const { return parts_->model; }
  const GripForces& forces() const { return parts_->forces; }
  GripForces& forces() { return parts_->forces; }
  Springs& springs() { return parts_->springs; }
  // Code of the method's last solve.
  Code code() const {
    return Code(int(reinterpret_cast<const Summary*>(forces().solution.data())->code));
  }

 private:
  // rounding at a torque limit, as a fraction of it
  static constexpr double ROUNDED = 1e-9;
  // What is made anew by `configure`.
  struct Parts {
    HandModel model;
    GripForces forces;
    Springs springs;
    Parts(std::shared_ptr<const Tree> hand, const std::vector<double>& limits,
          const HandControllerSettings& settings, const ForceOptimizer& method,
          std::span<const double> home)
        : model(std::move(hand), limits, method.contacts().soft()),
          forces(model, method, settings),
          springs(model, settings, home) {}
  };
  HandControllerSettings settings_;
  Calibration calibration_;
  std::unique_ptr<Parts> parts_;
  HandState now_;
  double period_ = 0.0, blind_ = 0.0;  // [s] since the last update; without knowledge
  double known_ = 1.0;                 // share that knowledge, old as it is, leaves of the forces
  HandRecording recording_;
  std::optional<HandRecording> next_recording_;
  bool has_own_solver_ = false;
  HandState given_;  // to the update that runs, with its period [s], for the recording
  double given_period_ = 0.0;
  bool is_ours_ = true;  // that state is of this hand
  std::chrono::steady_clock::time_point begin_{};
  std::vector<int> updates_apart_;     // (N,) updates since a finger had contact
  bool has_lost_force_ = false;        // a finger that counts as in contact has none
  std::vector<double> friction_used_;  // (N,) share of the friction that each command uses
  std::vector<double> wanted_, work_;  // (M,) torques before limits, work space [N m]

  // The controller's own solver. Its contacts are placeholders: every update passes those seen.
  static ForceOptimizer newton(int fingers, const HandControllerSettings& s) {
    std::vector<double> ring(3 * fingers);
    std::vector<double> inward(ring);
    for (int i = 0; i < fingers; ++i) {
      const double angle = 2 * std::numbers::pi * i / fingers;
      inward[3 * i] = -std::cos(angle);
      inward[3 * i + 1] = -std::sin(angle);
      for (int a = 0; a < 2; ++a) ring[3 * i + a] = -0.03 * inward[3 * i + a];
    }
    const std::vector<double> soft(s.torsional_friction > 0.0 ? fingers : 0, s.torsional_friction);
    return ForceOptimizer({Contacts::from(ring, inward, std::span(&s.friction, 1), {}, {}, soft),
                           {},
                           {s.friction_margin, s.preload}},
                          s.follow);
  }
  static std::vector<double> posture(const Tree& tree, std::span<const double> home) {
    if (!std::ranges::all_of(home, [](double angle) { return std::isfinite(angle); }))
      throw std::invalid_argument("home must be finite angles");
    if (!home.empty() && int(home.size()) != tree.joints())
      throw std::invalid_argument("home must be one angle for each joint, or empty");
    std::vector<double> out(home.begin(), home.end());
    for (int j = int(out.size()); j < tree.joints(); ++j)
      out.push_back(std::clamp(0.0, tree.links[j].lower, tree.links[j].upper));
    return out;
  }

  // Add a row to the recording.
  void note(HandEvent event, const HandState& state, double period) {
    if (recording_.full()) return;
    recording_.add(int(event), int(hold), period, state.numbers(), int(status), torques, commands,
                   force, friction_used_, duration);
  }

  // --- messages

  bool is_good(const HandState& state) const { return state.is_like(now_) && state.is_sound(); }
  bool is_stale() const {
    const std::span<const double> ages = now_[AGES];
    return !(ages[0] <= settings_.stale && ages[1] <= settings_.stale &&
             ages[2] <= settings_.stale_wrench);
  }
  // Fingers count as in contact if they touch, or did within the last `release` updates.
  void count_contacts() {
    std::uint64_t touch = 0;
    for (std::size_t i = 0; i < updates_apart_.size(); ++i)
      touch |= std::uint64_t(now_.touches(i)) << i;
    if (touch == mask && !has_lost_force_) return;
    std::uint64_t next = 0;
    for (std::size_t i = 0; i < updates_apart_.size(); ++i) {
      const std::uint64_t bit = std::uint64_t(1) << i;
      updates_apart_[i] = touch & bit ? 0 : updates_apart_[i] + 1;
      if (touch & bit || (mask & bit && updates_apart_[i] <= settings_.release)) next |= bit;
      if (next & bit & ~mask) parts_->springs.land(int(i), now_);
    }
    has_lost_force_ = next != touch;
    if (next == mask) return;
    changes += mask != 0;
    mask = next;
  }

  // --- torques

  // The fingers that push with forces, and the time in which these may change [s].
  std::uint64_t pushing() const { return hold == Hold::place || hold == Hold::reach ? 0 : mask; }
  double step_time() const { return std::min(period_, 2.0 / settings_.rate); }
  // Begin the update of the forces: with those of the springs of touching fingers, and preloads.
  // Without knowledge the last ones stay.
  void prepare() {
    GripForces& forces = parts_->forces;
    const std::uint64_t gripping = hold == Hold::optimized ? mask : 0;
    if (is_stale()) return forces.keep_springs(gripping);
    each_finger(gripping, [&](int i) {
      if (!now_.touches(i)) return forces.set_spring(i, {0.0, 0.0, 0.0});  // it only counts so
      parts_->springs.settle(i, now_, step_time());
      forces.set_spring(i, parts_->model.turn.transposed(parts_->springs.grip(i, now_)));
    });
    forces.begin(gripping, step_time());
  }
  void command(const StepRequest* step) {
    HandModel& model = parts_->model;
    GripForces& forces = parts_->forces;
    const std::uint64_t pushing = this->pushing();
    if (!is_stale()) {
      forces.find(hold, now_, mask, step_time(), step);
      status = hold != Hold::optimized ? given : pushing ? status_of(forces.balance) : released;
    } else {
      status = known_ > 0.0 && pushing ? coasting : released;
    }
    model.set_bias(forces.springs().torques);
    model.torques_of(pushing, forces.force.data(), forces.torsion.data(), wanted_);
    for (std::size_t j = 0; j < wanted_.size(); ++j) {
      if (known_ < 1.0) wanted_[j] = model.carrying[j] + known_ * (wanted_[j] - model.carrying[j]);
      spring_torques[j] = known_ * forces.springs().torques[j];
    }
    set_force();
    add_free_springs(pushing);
    if (!std::ranges::all_of(wanted_, [](double torque) { return std::isfinite(torque); })) {
      forces.reset();
      wanted_ = model.carrying;
      command_no_forces();
      status = released;
    }
    limit(step_time());
  }
  void command_no_forces() {
    std::fill(force.begin(), force.end(), 0.0);
    std::fill(spring_torques.begin(), spring_torques.end(), 0.0);
    std::fill(friction_used_.begin(), friction_used_.end(), 0.0);
  }
  // The commanded forces: the optimal ones with those of the springs.
  void set_force() {
    const GripForces& forces = parts_->forces;
    for (int i = 0; i < int(updates_apart_.size()); ++i)
      for (int a = 0; a < 3; ++a) {
        const double spring = dot(forces.springs().forces[i], parts_->model.axis(i, a));
        force[3 * i + a] = known_ * (forces.force[3 * i + a] + spring);
      }
    forces.write_friction_used(force, known_, friction_used_);
  }
  static Status status_of(Balance balance) {
    constexpr Status of[] = {holding, marginal, overloaded, pivoting, slipping};
    return of[int(balance)];
  }
  // Free fingers reach for their places, and free joints for their posture, within what is left of
  // the limits.
  void add_free_springs(std::uint64_t pushing) {
    std::vector<double>& more = work_;
    for (std::size_t i = 0; i < updates_apart_.size(); ++i) {
      if (pushing >> i & 1) continue;
      std::fill(more.begin(), more.end(), 0.0);
      parts_->springs.reach(int(i), hold == Hold::place, now_, more);
      add(more);
    }
    if (parts_->springs.redundant() && parts_->springs.keep_posture(now_, mask, more)) add(more);
  }
  void add(std::vector<double>& more) {
    for (double& torque : more) torque *= known_;
    const double share = parts_->model.share_within(more, wanted_);
    for (std::size_t j = 0; j < more.size(); ++j) {
      wanted_[j] += share * more[j];
      spring_torques[j] += share * more[j];
    }
  }
  // A missed deadline does not make torques jump. All torques go the same share of their way, so
  // that forces that balance before and after do so in between.
  void limit(double period) {
    HandModel& model = parts_->model;
    Effort& effort = parts_->forces.effort;
    double share = 1.0;
    for (std::size_t j = 0; j < torques.size(); ++j) {
      const double limit = model.limits[j];
      if (model.tree->links[j].coupled()) continue;
      effort.saturated = effort.saturated || std::abs(wanted_[j]) > limit * (1.0 + ROUNDED);
      wanted_[j] = std::clamp(wanted_[j], -limit, limit);
      const double way = std::abs(wanted_[j] - torques[j]);
      const double most = settings_.torque_rate * period * limit;
      if (way > most) share = std::min(share, most / way);
    }
    rising = share < 1.0;
    for (std::size_t j = 0; j < torques.size(); ++j) {
      if (model.tree->links[j].coupled()) continue;
      torques[j] = rising ? torques[j] + share * (wanted_[j] - torques[j]) : wanted_[j];
      const double used = std::abs(torques[j]);
      peak = std::max(peak, used);
      effort.margin = std::min(effort.margin, model.limits[j] - used);
      effort.share = std::max(effort.share, used / model.limits[j]);
    }
  }
};

}  // namespace grasp
