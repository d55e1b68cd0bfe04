// A controller for a torque-controlled hand: joint state, contacts and a wrench go in, commands in
// units of the motors come out. It has the life cycle of robot middleware, but needs none: copy and
// adapt it. In Python: examples/hand_controller.py.
#pragma once
#include <grasp/hand/tree_file.hpp>
#include <grasp/optimizer.hpp>
#include <bit>
#include <chrono>
#include <numbers>

using Numbers = std::vector<double>;

// State message of a hand with M joints and N fingertips, in the frame of the hand's base.
struct HandState {
  Numbers angles, rates;                 // (M,) [rad], [rad/s]
  Numbers touching, positions, normals;  // (N,) 1 or 0; (N, 3) contact points [m], unit normals
                                         // into the object: anything for 0
  Numbers wrench;  // (6,) wrench to balance: the object's weight plus feedback on its pose [N, N m]
  // (3,) [m/s^2], since the hand may be on an arm; (1,) age of the contacts [s]
  Numbers gravity, age;

  explicit HandState(int m = 0, int n = 0)
      : angles(m),
        rates(m),
        touching(n),
        positions(3 * n),
        normals(3 * n),
        wrench(6),
        gravity(3),
        age(1) {}
};
constexpr Numbers HandState::* PARTS[] = {
    &HandState::angles,  &HandState::rates,  &HandState::touching, &HandState::positions,
    &HandState::normals, &HandState::wrench, &HandState::gravity,  &HandState::age};

struct HandControllerSettings {
  double friction = 0.8, rate = 1000.0;  // coefficient; [Hz] of `update`
  // share of the friction that forces may use, and normal force that does not count for it [N]:
  // they cover errors of friction and wrench
  double friction_margin = 0.75, preload = 0.5;
  int iterations = 40;   // largest number of solver steps in an update
  double budget = 1e-4;  // [s] longer updates are counted
  double damping = 0.01,
         stiffness = 0.1;  // [N m s/rad]; [N m/rad] towards the first posture, for free joints
  double push = 0.1;       // [N] force of a finger without contact, along its last normal
  double slew = 50.0;      // [1/s] fastest change of a torque relative to its limit
  double stale = 0.005;    // [s] largest age of contacts that are used
  double grace = 0.1, fade = 0.2;  // [s] time to keep the last forces without a solution; time in
                                   // which they then fade
};

// Converts torques [N m] to whole device units: piecewise linear for each joint, clipped at the
// outer points.
struct Calibration {
  // for each joint: [N m] ascending through zero; device units, as many
  std::vector<Numbers> torques, units;

  double limit(int j) const {
    return std::min(-torques[j].front(), torques[j].back());
  }  // torque available in both directions
  double operator()(int j, double torque) const {
    double out = units[j][0];
    for (std::size_t k = 1; k < torques[j].size(); ++k) {
      const double from = torques[j][k - 1];
      const double width = torques[j][k] - from;
      out += (units[j][k] - units[j][k - 1]) / width * std::clamp(torque - from, 0.0, width);
    }
    return std::nearbyint(out);
  }
};

// `configure` allocates and may throw, the other functions never do. overloaded: the forces exceed
// the motors' limits, but least; pivoting: they balance all but a moment that no contact resists,
// as that about the line through two; coasting: the last forces, since contacts are stale, numbers
// invalid or no force balances; released: the hand carries itself.
class HandController {
 public:
  enum Status { inactive, holding, overloaded, coasting, released, pivoting } status = inactive;
  Numbers torques, commands;  // (M,) [N m], device units
  double duration = 0.0;      // [s] of the last update
  int late = 0,
      over_budget = 0;  // number of updates after a missed deadline; number longer than the budget

  void configure(std::shared_ptr<const grasp::Tree> hand, const HandControllerSettings& settings,
                 const Calibration& calibration) {
    m_ = hand->joints();
    n_ = hand->fingers();
    status = inactive;
    jacobian_ = Numbers(3 * n_ * m_);
    hand_ = hand;
    s_ = settings;
    calibration_ = calibration;
    posture_.emplace(hand);
    now_ = HandState(m_, n_);
    torques = commands = home_ = limits_ = carry_ = spring_ = wanted_ = Numbers(m_);
    forces_ = pushes_ = Numbers(3 * n_);
    for (int j = 0; j < m_; ++j)
      limits_[j] = std::min(hand->links[j].torque_limit, calibration.limit(j));
    Numbers ring(3 * n_);
    Numbers inward(3 * n_);  // placeholder contacts: every call passes its own
    for (int i = 0; i < n_; ++i) {
      const double turn = 2 * std::numbers::pi * i / n_;
      inward[3 * i] = -std::cos(turn);
      inward[3 * i + 1] = -std::sin(turn);
      for (int a = 0; a < 2; ++a) ring[3 * i + a] = -0.03 * inward[3 * i + a];
    }
    solver_.emplace(
        grasp::Problem{grasp::Contacts::from(ring, inward, s_.friction),
                       {{}, {}, jacobian_, limits_, {}},
                       {s_.friction_margin, s_.preload}},
        grasp::Options{.start = grasp::Start::previous, .limit = s_.iterations, .elastic = true});
  }
  // torques rise from zero; invalid numbers leave it inactive
  void activate(const HandState& state) {
    if (good(state)) {
      now_ = state;
      home_ = state.angles;
      blind_ = grasp::infinity;
      late = over_budget = 0;
      status = released;
      for (int k = 0; k < 3 * n_; ++k)
        if (now_.touching[k / 3] == 0.0) now_.positions[k] = now_.normals[k] = 0.0;
    }
    solver_->forget();
  }
  void deactivate() {
    status = inactive;
    std::fill(torques.begin(), torques.end(), 0.0);
  }
  // Write `commands`. state: the newest message, of any age; period: [s] since the last update.
  void update(const HandState& state, double period) noexcept {
    const auto begin = std::chrono::steady_clock::now();
    if (status != inactive) {
      late += period > 1.9 / s_.rate;
      take(state, std::max(0.0, period));
      command(std::max(0.0, period));
    }
    for (int j = 0; j < m_; ++j) commands[j] = calibration_(j, torques[j]);
    duration = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
    over_budget += duration > s_.budget;
  }

 private:
  int m_ = 0, n_ = 0;
  std::shared_ptr<const grasp::Tree> hand_;
  HandControllerSettings s_;
  Calibration calibration_;
  std::optional<grasp::Posture> posture_;
  std::optional<grasp::ForceOptimizer> solver_;
  HandState now_;       // the last valid message; a finger without contact keeps its last contact
  double blind_ = 0.0;  // [s] without a solution
  Numbers home_, limits_, carry_, spring_, wanted_, forces_, pushes_, jacobian_;

  bool good(const HandState& state) const {
    for (auto part : PARTS)
      if ((state.*part).size() != (now_.*part).size()) return false;
    for (auto part : PARTS) {
      const bool place = part == &HandState::positions || part == &HandState::normals;
      for (std::size_t k = 0; k < (state.*part).size(); ++k)
        if (!std::isfinite((state.*part)[k]) && !(place && state.touching[k / 3] == 0.0))
          return false;
    }
    return true;
  }
  void take(const HandState& state, double period) {
    now_.age[0] += period;
    if (!good(state)) return;
    for (auto part : PARTS)
      if (part != &HandState::positions && part != &HandState::normals) now_.*part = state.*part;
    for (int k = 0; k < 3 * n_; ++k)
      if (now_.touching[k / 3] != 0.0) {
        now_.positions[k] = state.positions[k];
        now_.normals[k] = state.normals[k];
      }
  }
  // torques += J^T forces, (N, 3) at the fingertips
  void push(const Numbers& forces, Numbers& torques) const {
    for (int k = 0; k < 3 * n_; ++k)
      for (int j = 0; j < m_; ++j) torques[j] += jacobian_[m_ * k + j] * forces[k];
  }
  void command(double period) {
    posture_->statics(now_.angles.data(), now_.positions, grasp::point(now_.gravity.data()),
                      jacobian_, carry_);
    for (int j = 0; j < m_; ++j) {
      carry_[j] -= s_.damping * now_.rates[j];
      spring_[j] = s_.stiffness * (home_[j] - now_.angles[j]);
      wanted_[j] = carry_[j] + spring_[j];
    }
    std::uint64_t touching = 0;
    for (int i = 0; i < n_; ++i) touching |= std::uint64_t(now_.touching[i] != 0.0) << i;
    for (int k = 0; k < 3 * n_; ++k)
      pushes_[k] = now_.touching[k / 3] != 0.0 ? 0.0 : s_.push * now_.normals[k];
    push(pushes_, wanted_);
    const grasp::Changes contacts{now_.positions, now_.normals, {}, jacobian_, wanted_, touching};
    const grasp::Record* record =
        now_.age[0] <= s_.stale ? &solver_->solve(grasp::Wrench(now_.wrench), contacts) : nullptr;
    Status balance = holding;
    // a single fingertip does not stop an object from turning
    const bool several = std::popcount(touching) > 1;
    if (record && !record->has_force() && several)
      if (const auto rest = solver_->within_reach(grasp::Wrench(now_.wrench), contacts)) {
        record = &solver_->solve(*rest, contacts);
        balance = pivoting;
      }
    if (record && record->has_force()) {
      blind_ = 0.0;
      status = record->code() == grasp::LIMITS_EXCEEDED ? overloaded : balance;
      for (int i = 0; i < n_; ++i) record->object_force(i, &forces_[3 * i]);
      for (int k = 0; k < 3 * n_; ++k) forces_[k] += pushes_[k];
      std::copy_n(record->torques(), m_, wanted_.begin());
    } else {
      // The object was in balance a moment ago, so the same forces hold it until contacts move or
      // the load changes. After that, a hand without knowledge of its contacts must not keep
      // squeezing: the forces fade.
      blind_ += period;
      const double share = std::clamp(1.0 - (blind_ - s_.grace) / s_.fade, 0.0, 1.0);
      push(forces_, spring_);
      for (int j = 0; j < m_; ++j) wanted_[j] = carry_[j] + share * spring_[j];
      status = share > 0.0 ? coasting : released;
    }
    for (int j = 0; j < m_; ++j) {  // a missed deadline does not make torques jump
      const double most = s_.slew * std::min(period, 2.0 / s_.rate) * limits_[j];
      torques[j] = std::clamp(std::clamp(wanted_[j], torques[j] - most, torques[j] + most),
                              -limits_[j], limits_[j]);
    }
  }
};
