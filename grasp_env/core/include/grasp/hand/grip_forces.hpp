// The forces of the fingers in contact at an update, and what is done where none balance.
#pragma once
#include <grasp/hand/given_forces.hpp>
#include <grasp/optimizer.hpp>
#include <grasp/phi/elastic.hpp>

namespace grasp {

// How the forces of an update balance the wrench, the best first.
enum class Balance {
  within_margin,
  within_cones,  // with less than the margin
  overloaded,    // beyond the motors' limits, but least
  pivoting,      // all but a moment that no contact resists, as that about the line through two
  none           // the forces inside the cones with the smallest imbalance
};

class GripForces {
 public:
  std::vector<double> force;     // (N, 3) [N], contact frames
  std::vector<double> torsion;   // (N,) moments about the normals [N m]
  std::vector<double> solution;  // row of the method's last solve
  std::vector<double> preload;   // (N,) [N] of the margin
  // (N,) [N], object frame: forces of the springs of touching fingers, which are given
  std::vector<Point> springs;
  Balance balance = Balance::within_margin;
  Effort effort;

  // The model must outlive this object. Throws std::invalid_argument unless the method has one
  // contact per finger.
  GripForces(HandModel& model, const ForceOptimizer& method, const HandControllerSettings& settings)
      : force(3 * model.tree->fingers()),
        torsion(model.tree->fingers()),
        solution(method.size()),
        preload(torsion),
        springs(model.tree->fingers()),
        model_(model),
        settings_(settings),
        method_(checked(method, model)),
        follow_({method.contacts(), {}, method.margin()}, settings.follow),
        within_(within(model, method, settings)),
        given_(model, method, settings),
        within_margin_(narrowed(method)),
        elastic_(model.tree->fingers()),
        follow_row_(follow_.size()),
        within_row_(within_.size()),
        last_row_(within_row_),
        last_force_(force),
        adjustment_(force),
        lasting_(springs),
        grown_(preload),
        torques_(model.tree->joints()),
        more_torques_(torques_) {}
  GripForces(const GripForces&) = delete;

  void reset() {
    std::fill(force.begin(), force.end(), 0.0);
    std::fill(torsion.begin(), torsion.end(), 0.0);
    for (auto* each : {&preload, &grown_}) std::fill(each->begin(), each->end(), 0.0);
    given_.reset();
    Record(last_row_.data(), model_.tree->fingers()).summary() = {};
    forget_solution();
    std::fill(springs.begin(), springs.end(), Point{0.0, 0.0, 0.0});
    std::fill(lasting_.begin(), lasting_.end(), Point{0.0, 0.0, 0.0});
    has_last_ = near_limits_ = exceeds_limits_ = false;
    balance = Balance::within_margin;
    effort = {};
  }
  // The forces are those of a hand at rest, (N, 3) [N], contact frames.
  void rest_at(std::span<const double> forces) {
    std::copy(forces.begin(), forces.end(), force.begin());
  }

  // The force of a spring [N], object frame, without what would take more than half of the last
  // normal force of its finger.
  Point keeping_contact(int i, const Point& spring) const {
    const Point inward = model_.axis(i, 0);
    const double pull = dot(spring, inward) + 0.5 * force[3 * i];
    return pull < 0.0 ? spring - pull * inward : spring;
  }
  // Set the preloads of the fingers of a mask, for forces within the margin. The preload of a
  // finger is that of the margin, and what keeps the lasting force of its spring inside the cone:
  // |t + t'| <= mu (n - p + n') wherever |t| <= mu (n - p). It grows as fast as a force may, from
  // zero when a finger lands. period: [s] since the last update.
  void set_preload(std::uint64_t mask, double period) {
    const double most = settings_.force_rate * period;
    const double share = period / (period + LASTING);
    for (std::size_t i = 0; i < preload.size(); ++i) {
      const bool on = mask >> i & 1;
      lasting_[i] = on ? lasting_[i] + share * (springs[i] - lasting_[i]) : Point{0.0, 0.0, 0.0};
      const double whole = on ? std::max(given_preload(int(i)), carrying(int(i))) : 0.0;
      grown_[i] = !on ? 0.0 : has_last_ ? std::min(whole, grown_[i] + most) : whole;
    }
    preload = grown_;
    use_preload(mask);
  }
  // Find the forces of the fingers of a mask with these preloads. period: [s] since the last
  // update. spring_torques: (M,) [N m]; the balanced part has the motors' limits less these. step:
  // an agent's step that begins. Return the share of the springs that is left where forces or
  // motors cannot carry them.
  double find(Hold hold, const HandState& state, std::uint64_t mask, double period,
              const std::vector<double>& spring_torques, const StepRequest* step) {
    state_ = &state;
    mask_ = mask;
    most_change_ = settings_.force_rate * period;
    last_force_ = force;  // copied, not swapped: views of it stay valid
    std::fill(force.begin(), force.end(), 0.0);
    std::fill(torsion.begin(), torsion.end(), 0.0);
    balance = mask || hold != Hold::optimized ? Balance::within_margin : Balance::none;
    if (step) forget_solution();
    model_.set_bias(spring_torques, 1.0);
    const bool pushes = mask && hold != Hold::place && hold != Hold::reach;
    double share = 1.0;
    if (pushes && hold == Hold::optimized)
      share = optimise(spring_torques, step);
    else if (pushes)
      given_.find(hold, state, mask, step, force);
    store(pushes);
    return share;
  }
  // Write the share of the method's friction that commanded forces (N, 3) [N] use, with their
  // torsion times `part`, to (N,).
  void write_friction_used(const std::vector<double>& commanded, double part,
                           std::vector<double>& used) const {
    for (std::size_t i = 0; i < used.size(); ++i) {
      const double* scale = &within_margin_.scale[3 * i];
      const double* f = &commanded[3 * i];
      const double turning = within_margin_.torsion_scale(int(i)) * part * torsion[i];
      const double side = std::hypot(scale[1] * f[1], scale[2] * f[2], turning);
      const double room = std::max(scale[0] * f[0], 0.0);
      used[i] = side > 0.0 ? method_.margin().friction * side / room : 0.0;
    }
  }

 private:
  // fraction of the torque limits: below it, the next update solves without them
  static constexpr double NEAR = 0.9;
  // rounding of a balance, relative to the wrench
  static constexpr double ROUNDED = 1e-6;
  // smallest normal force times friction of a finger that has just landed [N]
  static constexpr double LIGHT = 1e-2;
  // [s] forces of springs that last longer need normal force; errors of the motors are shorter
  static constexpr double LASTING = 0.03;
  HandModel& model_;
  const HandControllerSettings settings_;
  ForceOptimizer method_;
  // Newton from the last command on the cones; within the motors' limits
  ForceOptimizer follow_, within_;
  GivenForces given_;
  Contacts within_margin_;  // the method's contacts with the share of friction of its margin
  ElasticBalance elastic_;
  // solution rows of these solvers, and the last command as such a row
  std::vector<double> follow_row_, within_row_, last_row_;
  const HandState* state_ = nullptr;  // of this update
  std::uint64_t mask_ = 0;
  double most_change_ = 0.0;  // [N]
  Vec6 asked_{};              // wrench that the forces of this update balance
  // margin of this update, if it is another one than the method's
  std::optional<Margin> margin_;
  bool has_last_ = false;  // there is a last command
  bool near_limits_ = false, exceeds_limits_ = false;
  // (N, 3) [N]: the last command, contact frames; the adjustment, object frame
  std::vector<double> last_force_, adjustment_;
  std::vector<Point> lasting_;  // (N,) filtered forces of the springs [N], object frame
  std::vector<double> grown_;   // (N,) preloads, with what carries the springs [N]
  std::vector<double> torques_, more_torques_;  // (M,) work space

  static const ForceOptimizer& checked(const ForceOptimizer& method, const HandModel& model) {
    if (method.contacts().count != model.tree->fingers())
      throw std::invalid_argument("the method needs one contact per finger");
    return method;
  }
  static Contacts narrowed(const ForceOptimizer& method) {
    Contacts contacts = method.contacts();
    contacts.narrow(method.margin().friction);
    return contacts;
  }
  static ForceOptimizer within(const HandModel& model, const ForceOptimizer& method,
                               const HandControllerSettings& settings) {
    const auto limited = [](double limit) { return limit < infinity; };
    return ForceOptimizer({method.contacts(),
                           {.jacobian = model.jacobian(), .torque_limit = model.motor_limits()},
                           method.margin()},
                          {.tolerance = settings.follow.tolerance,
                           .limit = settings.follow.limit,
                           .elastic = std::ranges::any_of(model.motor_limits(), limited)});
  }

  void forget_solution() { Record(solution.data(), model_.tree->fingers()).summary() = {}; }
  const double* positions() const { return (*state_)[POSITIONS].data(); }
  Changes contacts() const {
    return {.positions = (*state_)[POSITIONS],
            .normals = (*state_)[NORMALS],
            .contacts = mask_,
            .margin = margin_};
  }
  bool can_give(const double* forces, double part) {
    model_.torques_of(mask_, forces, torsion.data(), torques_);
    return model_.can_give(torques_, part);
  }

  // --- optimal forces

  // Return the share of the springs.
  double optimise(const std::vector<double>& spring_torques, const StepRequest* step) {
    asked_ = state_->wrench();
    exceeds_limits_ = false;
    if (has_last_) lift_landed_forces();
    if (step || !has_last_ || !near_limits_ || !keep_limits(last_row_.data())) {
      const Record first = step ? by_method(*step) : follow();
      // a flow does not solve what few contacts can balance
      const bool few = step && first.code() == RANK_LOST;
      const Record row = few ? follow() : first;
      const bool solved = is_moderate(row);
      if (!solved && !balance_less()) {
        balance_elastically();
        return 1.0;
      }
      if (solved) set_force(row);
      const bool by_step = solved && step && !few;
      if (can_give(force.data(), 1.0))
        near_limits_ = false;
      else
        keep_limits(has_last_ && near_limits_ ? last_row_.data()
                                              : (by_step ? solution : follow_row_).data());
    }
    const auto pulls = [](double torque) { return torque != 0.0; };
    const bool gives_way = is_overloaded() && std::ranges::any_of(spring_torques, pulls);
    if (gives_way) {
      // the forces come first: without the springs, and without the preload that carries them
      model_.set_bias(spring_torques, 0.0);
      for (std::size_t i = 0; i < preload.size(); ++i)
        preload[i] = std::min(preload[i], given_preload(int(i)));
      if (balance == Balance::within_margin) use_preload(mask_);
      keep_limits((has_last_ ? last_row_ : follow_row_).data());
    }
    if (has_last_) bound_change();
    double share = 1.0;
    if (gives_way) {
      share = share_of_springs(spring_torques);
      model_.set_bias(spring_torques, share);
    }
    if (is_overloaded()) balance = std::max(balance, Balance::overloaded);
    return share;
  }
  bool is_overloaded() { return exceeds_limits_ || !can_give(force.data(), 1.0 + 1e-9); }
  // The largest share of all springs, with torques (M,) [N m], that leaves the forces within the
  // margin and the motors within their limits.
  double share_of_springs(const std::vector<double>& spring_torques) {
    model_.torques_of(mask_, force.data(), torsion.data(), torques_);
    double share = model_.share_within(spring_torques, torques_);
    each_finger(mask_, [&](int i) {
      const double* f = &force[3 * i];
      const double* scale = &within_margin_.scale[3 * i];
      const double turning = within_margin_.torsion_scale(i) * torsion[i];
      const double room = scale[0] * f[0] - std::hypot(scale[1] * f[1], scale[2] * f[2], turning);
      const double need = beyond_cone(i, springs[i]);
      if (need > 0.0) share = std::min(share, std::max(room, 0.0) / need);
    });
    return share;
  }
  void set_force(const Record& row) {
    std::copy_n(row.force(), force.size(), force.data());
    std::copy_n(row.torsion(), torsion.size(), torsion.data());
  }
  Record by_method(const StepRequest& step) {
    Request request{.wrench = asked_.data(), .now = contacts(), .start = step.start};
    if (step.start == Start::given) request.force = step.force;
    if (settings_.remembers && has_last_) request.previous = last_row_.data();
    if (!step.adjustment.empty()) {
      adjust(step.adjustment);
      request.adjustment = adjustment_;
    }
    method_.solve(request, solution.data());
    const Record row(solution.data());
    if (row.has_force()) {
      effort.iterations += int(row.summary().iterations);
      effort.trials += int(row.summary().trials);
    }
    return row;
  }
  Record follow() {
    follow_.solve(from_last(), follow_row_.data());
    const Record row(follow_row_.data());
    effort.followed += int(row.summary().iterations);
    return row;
  }
  Request from_last() const {
    return {.wrench = asked_.data(),
            .now = contacts(),
            .start = Start::previous,
            .previous = has_last_ ? last_row_.data() : nullptr};
  }
  // Solve by Newton within the motors' limits, from an earlier force. Return false if none was
  // found.
  bool keep_limits(const double* previous) {
    within_.solve({.wrench = asked_.data(),
                   .now = model_.limited(contacts()),
                   .start = Start::previous,
                   .previous = previous},
                  within_row_.data());
    const Record row(within_row_.data());
    effort.limited += int(row.summary().iterations);
    exceeds_limits_ = row.code() == LIMITS_EXCEEDED;
    if (row.has_force()) set_force(row);
    near_limits_ = !can_give(force.data(), NEAR);
    return row.has_force();
  }
  void adjust(Doubles coordinates) {
    const std::size_t columns = coordinates.size();
    for (std::size_t j = 0; j < adjustment_.size(); ++j) {
      adjustment_[j] = 0.0;
      for (std::size_t k = 0; k < columns; ++k)
        adjustment_[j] += settings_.directions[columns * j + k] * coordinates[k];
    }
  }

  // --- preloads

  double given_preload(int i) const { return method_.margin().preload[i]; }
  // The margin of this update is the method's with these preloads.
  void use_preload(std::uint64_t mask) {
    bool differs = false;
    each_finger(mask, [&](int i) { differs = differs || preload[i] != given_preload(i); });
    margin_.reset();
    if (differs) margin_ = Margin{method_.margin().friction, preload};
  }
  // How far a force [N], object frame, is outside the cone of a finger within the margin: friction
  // times the normal force that is missing; below 0 inside.
  double beyond_cone(int i, const Point& push) const {
    const double* scale = &within_margin_.scale[3 * i];
    return std::hypot(scale[1] * dot(push, model_.axis(i, 1)),
                      scale[2] * dot(push, model_.axis(i, 2))) -
           scale[0] * dot(push, model_.axis(i, 0));
  }
  // Normal force [N] that keeps the lasting force of a spring inside the cone.
  double carrying(int i) const {
    const double scale = within_margin_.scale[3 * i];
    return scale > 0.0 ? std::max(beyond_cone(i, lasting_[i]) / scale, 0.0) : 0.0;
  }
  // Move the last command of a finger that has just landed into its cone.
  void lift_landed_forces() {
    const Record row(last_row_.data());
    each_finger(mask_, [&](int i) {
      double* f = row.force() + 3 * i;
      const double* scale = &within_margin_.scale[3 * i];
      const double turning = within_margin_.torsion_scale(i) * row.torsion()[i];
      const double side = std::hypot(scale[1] * f[1], scale[2] * f[2], turning);
      if (!(scale[0] * (f[0] - preload[i]) > side))
        f[0] = preload[i] + std::max(1.05 * side, LIGHT) / scale[0];
    });
  }
  // Keep the command for the next update.
  void store(bool pushes) {
    has_last_ = pushes;
    if (!pushes) return;
    const Record row(last_row_.data(), model_.tree->fingers());
    row.summary().code = near_limits_ && exceeds_limits_ ? LIMITS_EXCEEDED : CONVERGED;
    row.summary().contacts = model_.tree->fingers();
    std::copy(force.begin(), force.end(), row.force());
    std::copy(torsion.begin(), torsion.end(), row.torsion());
    std::copy(model_.frames.begin(), model_.frames.end(), row.frames());
  }
  // Move the forces towards the last command, rebalanced, until no component differs by more than
  // `most_change_`.
  void bound_change() {
    const auto change = [&](const double* then) {
      double most = 0.0;
      each_finger(mask_, [&](int i) {
        for (int j = 3 * i; j < 3 * i + 3; ++j) most = std::max(most, std::abs(force[j] - then[j]));
      });
      return most;
    };
    if (change(last_force_.data()) <= most_change_) return;
    if (follow_.start(from_last(), follow_row_.data()) != STARTED) return;
    const Record before(follow_row_.data());
    if (!(before.summary().residual <= ROUNDED * (1.0 + size(asked_)))) return;
    const double moved = change(before.force());
    if (moved <= most_change_) return;
    const double share = within_limits(before, most_change_ / moved);
    for (std::size_t j = 0; j < force.size(); ++j)
      force[j] = before.force()[j] + share * (force[j] - before.force()[j]);
    for (std::size_t i = 0; i < torsion.size(); ++i)
      torsion[i] = before.torsion()[i] + share * (torsion[i] - before.torsion()[i]);
  }
  // The smallest fraction >= `share` of the way from `before` to the forces that is within the
  // torque limits, if the forces are.
  double within_limits(const Record& before, double share) {
    model_.torques_of(mask_, before.force(), before.torsion(), torques_);
    model_.torques_of(mask_, force.data(), torsion.data(), more_torques_);
    for (int j = 0; j < model_.tree->joints(); ++j) {
      const double limit = model_.limits[j];
      const double from = torques_[j];
      const double way = more_torques_[j] - from;
      if (std::abs(more_torques_[j]) <= limit && std::abs(from + share * way) > limit)
        share = std::min(1.0, (std::copysign(limit, from) - from) / way);
    }
    return share;
  }

  // --- where no force within the margin balances

  // Balance with less than the margin; if several contacts cannot resist a moment, all but that.
  // Return false if that is impossible, too.
  bool balance_less() {
    const std::optional<Margin> wanted = margin_;
    const bool has_margin = method_.margin().friction < 1.0 ||
                            std::ranges::any_of(preload, [](double s) { return s > 0.0; });
    if (has_margin) {
      margin_ = Margin{};
      if (const Record row = follow(); is_moderate(row)) {
        balance = Balance::within_cones;
        set_force(row);
        return true;
      }
      margin_ = wanted;
    }
    // a single fingertip does not stop an object from turning
    if (std::popcount(mask_) < 2) return false;
    const std::optional<Vec6> rest =
        follow_.within_reach(std::span<const double, 6>(asked_), contacts());
    if (!rest) return false;
    asked_ = *rest;
    const Record row = follow();
    if (!is_moderate(row)) return false;
    balance = Balance::pivoting;
    set_force(row);
    return true;
  }
  // True for a force that, without the preload, is not far above the last one and what the wrench
  // calls for: close to the limit of what contacts can balance, forces grow beyond all bounds, and
  // crush or shoot away the object.
  bool is_moderate(const Record& row) const {
    constexpr double MUCH = 5.0;
    constexpr double FEW = 1.0;  // [N]
    if (!row.has_force()) return false;
    const Margin& margin = margin_ ? *margin_ : method_.margin();
    double before = FEW;
    double now = 0.0;
    double friction = infinity;
    int fingers = 0;
    Point places[64];
    each_finger(mask_, [&](int i) {
      before += last_force_[3 * i];
      now += row.force()[3 * i] - margin.preload[i];
      friction = std::min(friction, within_margin_.scale[3 * i]);
      places[fingers++] = state_->position(i);
    });
    const UnitFrame unit(fingers, [&](int k) { return places[k]; });
    return now <= MUCH * (before + size(unit.of(asked_)) / friction);
  }
  // Minimise the imbalance within the margin, from the last forces.
  void balance_elastically() {
    balance = Balance::none;
    near_limits_ = false;
    Vec6 load = state_->wrench();
    const Record last(last_row_.data());
    // in addition to the preload of the margin: more, for springs, would push an object away that
    // is not held from all sides
    const auto margin = [&](int i) { return std::min(preload[i], method_.margin().preload[i]); };
    each_finger(mask_, [&](int i) {
      std::copy_n(&last_force_[3 * i], 3, &force[3 * i]);
      force[3 * i] -= margin(i);
      torsion[i] = has_last_ ? last.torsion()[i] : 0.0;
      load = load + margin(i) * column(i, 0);
    });
    elastic_.solve(within_margin_, mask_, positions(), model_.frames.data(), load,
                   settings_.follow.limit, force.data(), torsion.data());
    each_finger(mask_, [&](int i) { force[3 * i] += margin(i); });
    effort.followed += elastic_.iterations;
  }

  Vec6 column(int i, int a) const { return unit_wrench(state_->position(i), model_.axis(i, a)); }
};

}  // namespace grasp
