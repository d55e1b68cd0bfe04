// The forces of the fingers in contact at an update, and what is done where none balance.
#pragma once
#include <grasp/hand/given_forces.hpp>
#include <grasp/hand/margin_cones.hpp>
#include <grasp/optimizer.hpp>
#include <grasp/phi/elastic.hpp>

namespace grasp {

class GripForces {
 public:
  std::vector<double> force;     // (N, 3) [N], contact frames
  std::vector<double> torsion;   // (N,) moments about the normals [N m]
  std::vector<double> solution;  // row of the method's last solve
  std::vector<double> preload;   // (N,) [N] of the margin
  // (N,) [N], object frame: forces of the springs of touching fingers, less where they give way
  std::vector<Point> springs;
  std::vector<double> spring_torques;  // (M,) of these [N m]
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
        spring_torques(model.tree->joints()),
        model_(model),
        settings_(settings),
        method_(checked(method, model)),
        follow_({method.contacts(), {}, method.margin()}, settings.follow),
        within_(within(model, method, settings)),
        given_(model, method, settings),
        cones_(model, method),
        elastic_(model.tree->fingers()),
        follow_row_(follow_.size()),
        within_row_(within_.size()),
        last_row_(within_row_),
        last_force_(force),
        adjustment_(force),
        lasting_(springs),
        torques_(model.tree->joints()),
        more_torques_(torques_) {}
  GripForces(const GripForces&) = delete;

  void reset() {
    std::fill(force.begin(), force.end(), 0.0);
    std::fill(torsion.begin(), torsion.end(), 0.0);
    std::fill(preload.begin(), preload.end(), 0.0);
    std::fill(spring_torques.begin(), spring_torques.end(), 0.0);
    share_ = 1.0;
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
  // normal force of its finger. Where forces do not balance, the two stay inside the cone; where
  // they do, a spring may leave it, to balance errors of the motors and pushes.
  Point keeping_contact(int i, const Point& spring) const {
    const Point inward = model_.axis(i, 0);
    const double pull = dot(spring, inward) + 0.5 * force[3 * i];
    const Point kept = pull < 0.0 ? spring - pull * inward : spring;
    if (balance <= Balance::within_cones) return kept;
    const double beyond = cones_.beyond(i, kept);
    const double room = std::max(-cones_.beyond(i, &force[3 * i], torsion[i]), 0.0);
    return beyond > room ? room / beyond * kept : kept;
  }
  // Begin an update with the forces `springs` of the fingers of a mask, and set their preloads, for
  // forces within the margin. The preload of a finger is that of the margin, and what keeps the
  // lasting force of its spring inside the cone: |t + t'| <= mu (n - p + n') wherever |t| <= mu (n
  // - p). It grows as fast as a force may, from zero when a finger lands. period: [s] since the
  // last update.
  void begin(std::uint64_t mask, double period) {
    const double most = settings_.force_rate * period;
    const double part = period / (period + LASTING);
    for (std::size_t i = 0; i < preload.size(); ++i) {
      const bool on = mask >> i & 1;
      springs[i] = on ? share_ * springs[i] : Point{0.0, 0.0, 0.0};
      lasting_[i] = on ? lasting_[i] + part * (springs[i] - lasting_[i]) : Point{0.0, 0.0, 0.0};
      const double whole = on ? std::max(given_preload(int(i)), carrying(int(i))) : 0.0;
      preload[i] = !on ? 0.0 : has_last_ ? std::min(whole, preload[i] + most) : whole;
    }
    use_preload(mask);
    push_springs(mask);
  }
  // `spring_torques` are those of `springs`, in the posture at hand.
  void push_springs(std::uint64_t mask) {
    std::fill(spring_torques.begin(), spring_torques.end(), 0.0);
    each_finger(mask, [&](int i) {
      model_.posture.push(model_.tree->tips[i].link, model_.touch[i], model_.turn * springs[i],
                          spring_torques.data());
    });
  }
  // Find the forces of the fingers of a mask with these preloads; the motors' limits are those less
  // the torques of the springs, which give way to the forces. period: [s] since the last update.
  // step: an agent's step that begins.
  void find(Hold hold, const HandState& state, std::uint64_t mask, double period,
            const StepRequest* step) {
    state_ = &state;
    mask_ = mask;
    most_change_ = settings_.force_rate * period;
    last_force_ = force;  // copied, not swapped: views of it stay valid
    std::fill(force.begin(), force.end(), 0.0);
    std::fill(torsion.begin(), torsion.end(), 0.0);
    balance = mask || hold != Hold::optimized ? Balance::within_margin : Balance::none;
    if (step) forget_solution();
    model_.set_bias(spring_torques);
    const bool pushes = mask && hold != Hold::place && hold != Hold::reach;
    if (!pushes || hold != Hold::optimized) near_limits_ = exceeds_limits_ = false;
    if (pushes && hold == Hold::optimized)
      optimise(period, step);
    else if (pushes)
      given_.find(hold, state, mask, step, force);
    store(pushes);
  }
  // Write the share of the friction that commanded forces (N, 3) [N] use, with their torsion times
  // `part`, to (N,).
  void write_friction_used(const std::vector<double>& commanded, double part,
                           std::vector<double>& used) const {
    for (int i = 0; i < int(used.size()); ++i)
      used[i] = cones_.used(i, &commanded[3 * i], part * torsion[i]);
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
  // [s] in which springs that gave way return, and the least share of them
  static constexpr double RETURNING = 1.0, LEAST_SHARE = 1e-3;
  HandModel& model_;
  const HandControllerSettings settings_;
  ForceOptimizer method_;
  // Newton from the last command on the cones; within the motors' limits
  ForceOptimizer follow_, within_;
  GivenForces given_;
  MarginCones cones_;
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
  double share_ = 1.0;          // of the springs: less where the motors cannot give all
  std::vector<double> torques_, more_torques_;  // (M,) work space

  static const ForceOptimizer& checked(const ForceOptimizer& method, const HandModel& model) {
    if (method.contacts().count != model.tree->fingers())
      throw std::invalid_argument("the method needs one contact per finger");
    return method;
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

  void optimise(double period, const StepRequest* step) {
    asked_ = state_->wrench();
    exceeds_limits_ = false;
    if (has_last_) lift_landed_forces();
    if (step || !has_last_ || !near_limits_ || !keep_limits(last_row_.data())) {
      const Record first = step ? by_method(*step) : follow();
      // a flow does not solve what few contacts can balance
      const bool few = step && first.code() == RANK_LOST;
      const Record row = few ? follow() : first;
      const bool solved = is_moderate(row);
      if (solved)
        set_force(row);
      else if (!balance_less())
        balance_elastically();
      const bool by_step = solved && step && !few;
      if (balance == Balance::none || can_give(force.data(), 1.0))
        near_limits_ = false;
      else
        keep_limits(has_last_ && near_limits_ ? last_row_.data()
                                              : (by_step ? solution : follow_row_).data());
    }
    if (balance == Balance::none || !is_overloaded())
      share_ = std::min(1.0, share_ + period / RETURNING);
    else if (share_ > 0.0)
      give_way();
    if (has_last_ && balance != Balance::none) bound_change();
    if (is_overloaded()) balance = std::max(balance, Balance::overloaded);
  }
  bool is_overloaded() { return exceeds_limits_ || !can_give(force.data(), 1.0 + 1e-9); }
  // The forces come first: less of the springs and of the preload that carries them, from this
  // update on; if half of them is too much, none in this one.
  void give_way() {
    double left = 1.0;
    for (double share : {0.98, 0.9, 0.7, 0.5, 0.0}) {
      const double part = share / left;
      each_finger(mask_, [&](int i) {
        springs[i] = part * springs[i];
        preload[i] = std::min(preload[i], std::max(given_preload(i), part * preload[i]));
      });
      left = share;
      if (balance == Balance::within_margin) use_preload(mask_);
      push_springs(mask_);
      model_.set_bias(spring_torques);
      keep_limits((has_last_ ? last_row_ : follow_row_).data());
      if (!is_overloaded()) break;
    }
    share_ *= left > 0.0 ? left : share_ > LEAST_SHARE ? 0.5 : 0.0;
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
    const bool found = is_moderate(row);
    exceeds_limits_ = found && row.code() == LIMITS_EXCEEDED;
    if (found) set_force(row);
    near_limits_ = !can_give(force.data(), NEAR);
    return found;
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
  // Normal force [N] that keeps the lasting force of a spring inside the cone.
  double carrying(int i) const {
    const double friction = cones_.friction(i);
    return friction > 0.0 ? std::max(cones_.beyond(i, lasting_[i]) / friction, 0.0) : 0.0;
  }
  // Move the last command of a finger that has just landed into its cone.
  void lift_landed_forces() {
    const Record row(last_row_.data());
    each_finger(mask_, [&](int i) {
      double* f = row.force() + 3 * i;
      const double side = cones_.side(i, f, row.torsion()[i]);
      if (!(cones_.friction(i) * (f[0] - preload[i]) > side))
        f[0] = preload[i] + std::max(1.05 * side, LIGHT) / cones_.friction(i);
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
    const auto change = [&](const double* then, const double* now) {
      double most = 0.0;
      each_finger(mask_, [&](int i) {
        for (int j = 3 * i; j < 3 * i + 3; ++j) most = std::max(most, std::abs(now[j] - then[j]));
      });
      return most;
    };
    const double wanted = change(last_force_.data(), force.data());
    if (wanted <= most_change_) return;
    const Record before(follow_row_.data(), int(torsion.size()));
    if (follow_.start(from_last(), follow_row_.data()) != STARTED ||
        !(before.summary().residual <= ROUNDED * (1.0 + size(asked_)))) {
      if (balance != Balance::none && !is_overloaded()) return;  // balance comes first
      std::copy(last_force_.begin(), last_force_.end(), before.force());
      std::copy_n(Record(last_row_.data()).torsion(), torsion.size(), before.torsion());
    }
    const double moved = change(before.force(), force.data());
    if (moved <= most_change_) return;
    // forces that motors cannot give may grow when they are rebalanced
    if (moved > wanted && is_overloaded()) return;
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
  // True for a force that, without the preload, is not far above what wrench and preload call for,
  // and the last one: close to the limit of what contacts can balance, forces grow beyond all
  // bounds, and crush or shoot away the object.
  bool is_moderate(const Record& row) const {
    constexpr double MUCH = 5.0;
    constexpr double FEW = 1.0;  // [N]
    if (!row.has_force()) return false;
    const Margin& margin = margin_ ? *margin_ : method_.margin();
    double last = 0.0;
    double now = 0.0;
    double friction = infinity;
    Vec6 load = asked_;
    int fingers = 0;
    Point places[64];
    each_finger(mask_, [&](int i) {
      last += last_force_[3 * i];
      now += row.force()[3 * i] - margin.preload[i];
      load = load + margin.preload[i] * column(i, 0);
      friction = std::min(friction, cones_.friction(i));
      places[fingers++] = state_->position(i);
    });
    const UnitFrame unit(fingers, [&](int k) { return places[k]; });
    const double called = FEW + size(unit.of(load)) / friction;
    const bool exceeds = row.code() == LIMITS_EXCEEDED;
    return now <= MUCH * (called + (exceeds ? 0.0 : std::min(last, MUCH * called)));
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
    elastic_.solve(cones_.contacts, mask_, positions(), model_.frames.data(), load,
                   settings_.follow.limit, force.data(), torsion.data());
    each_finger(mask_, [&](int i) { force[3 * i] += margin(i); });
    effort.followed += elastic_.iterations;
  }

  Vec6 column(int i, int a) const { return unit_wrench(state_->position(i), model_.axis(i, a)); }
};

}  // namespace grasp
