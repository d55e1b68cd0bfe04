// The forces of the fingers in contact at an update, and what is done where none balance.
#pragma once
#include <grasp/hand/given_forces.hpp>
#include <grasp/hand/grip_springs.hpp>
#include <grasp/hand/residual_forces.hpp>
#include <grasp/optimizer.hpp>
#include <grasp/phi/elastic.hpp>

namespace grasp {

class GripForces {
 public:
  std::vector<double> force;     // (N, 3) [N], contact frames
  std::vector<double> torsion;   // (N,) moments about the normals [N m]
  std::vector<double> solution;  // row of the method's last solve
  Balance balance = Balance::within_margin;
  Effort effort;

  // The model must outlive this object. Throws std::invalid_argument unless the method has one
  // contact per finger.
  GripForces(HandModel& model, const ForceOptimizer& method, const HandControllerSettings& settings)
      : force(3 * model.tree->fingers()),
        torsion(model.tree->fingers()),
        solution(method.size()),
        model_(model),
        settings_(settings),
        method_(checked(method, model)),
        follow_({method.contacts(), {}, method.margin()}, settings.follow),
        within_(within(model, method, settings)),
        given_(model, method, settings),
        cones_(model, method),
        springs_(model, cones_, method.margin(), settings),
        elastic_(model.tree->fingers()),
        residual_(model),
        follow_row_(follow_.size()),
        within_row_(within_.size()),
        last_row_(within_row_),
        last_force_(force),
        adjustment_(force),
        too_large_{force, torsion},
        nearest_(too_large_),
        torques_(model.tree->joints()),
        more_torques_(torques_) {}
  GripForces(const GripForces&) = delete;

  void reset() {
    std::fill(force.begin(), force.end(), 0.0);
    std::fill(torsion.begin(), torsion.end(), 0.0);
    cones_.reset();
    springs_.set_own_preloads(method_.margin().preload);
    springs_.reset();
    residual_.reset();
    given_.reset();
    Record(last_row_.data(), model_.tree->fingers()).summary() = {};
    forget_solution();
    has_last_ = near_limits_ = exceeds_limits_ = false;
    nearest_mask_ = 0;
    balance = Balance::within_margin;
    effort = {};
  }
  // Of touching fingers; motors that cannot give both forces and springs leave these less.
  const GripSprings& springs() const { return springs_; }
  // The forces are those of a hand at rest, (N, 3) [N], contact frames.
  void rest_at(std::span<const double> forces) {
    std::copy(forces.begin(), forces.end(), force.begin());
  }

  // The spring of a touching finger pulls with a force [N], object frame.
  void set_spring(int i, const Point& pull) { springs_.set(i, pull, &force[3 * i], torsion[i]); }
  // Fingers of a mask go on to pull with the last springs, in the posture at hand.
  void keep_springs(std::uint64_t mask) { springs_.push(mask); }
  // Begin an update with the springs of the fingers of a mask. period: [s] since the last one.
  void begin(std::uint64_t mask, double period) {
    springs_.begin(mask, period, !has_last_);
    use_preload(mask);
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
    if (step) begin_step(*step);
    model_.set_bias(springs_.torques);
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
  // smallest normal force times friction of a finger that just landed [N]
  static constexpr double LIGHT = 1e-2;
  // A wrench is nearly balanced if less than this is missing [N], and less than this share of it.
  static constexpr double LITTLE = 0.3, LITTLE_SHARE = 0.2;
  struct Forces {
    std::vector<double> force, torsion;
  };
  HandModel& model_;
  const HandControllerSettings settings_;
  ForceOptimizer method_;
  // Newton from the last command on the cones; within the motors' limits
  ForceOptimizer follow_, within_;
  GivenForces given_;
  MarginCones cones_;
  GripSprings springs_;
  ElasticBalance elastic_;
  ResidualForces residual_;
  // solution rows of these solvers, and the last command as such a row
  std::vector<double> follow_row_, within_row_, last_row_;
  const HandState* state_ = nullptr;  // of this update
  std::uint64_t mask_ = 0;
  double most_change_ = 0.0;  // [N]
  Vec6 asked_{};              // wrench that the forces of this update balance
  UnitFrame unit_;            // of the touching contacts
  double load_ = 0.0;         // [N] largest component of the wrench, unit frame
  double most_normal_ = 0.0;  // [N] largest sum of moderate normal forces
  // margin of this update, if not the method's
  std::optional<Margin> margin_;
  bool has_last_ = false;  // there is a last command
  bool near_limits_ = false, exceeds_limits_ = false;
  // (N, 3) [N]: the last command, contact frames; the adjustment, object frame
  std::vector<double> last_force_, adjustment_;
  Forces too_large_, nearest_;      // beyond the motors' limits; those with the smallest imbalance
  std::uint64_t nearest_mask_ = 0;  // fingers for which the latter were found
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

  void begin_step(const StepRequest& step) {
    forget_solution();
    residual_.set(step.residual);
    if (!step.margin || !step.margin->is_sound()) return;
    cones_.replace(step.margin->friction);
    springs_.set_own_preloads(step.margin->preload);
    use_preload(mask_);
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
    weigh();
    if (has_last_) lift_landed_forces();
    const bool found = find_within_margin(step) || give_up_raised_preloads();
    if (found && !is_overloaded())
      springs_.recover(period);
    else if (!found || !make_springs_give_way())
      return find_less(found);
    if (residual_.asked())
      residual_.add(cones_, mask_, positions(), asked_, springs_.preload, force, torsion);
    bound_change();
    nearest_mask_ = 0;
  }
  // Set the load, and the largest sum of normal forces that are moderate: not far above what wrench
  // and preloads call for. Close to the limit of what contacts can balance, forces grow beyond all
  // bounds, and crush or shoot away the object.
  void weigh() {
    constexpr double MUCH = 4.0, MUCH_PRELOAD = 2.0;
    constexpr double FEW = 1.0;  // [N]
    double preloads = 0.0;
    double friction = infinity;
    int fingers = 0;
    Point places[64];
    each_finger(mask_, [&](int i) {
      preloads += springs_.own_preload(i);
      friction = std::min(friction, cones_.friction(i));
      places[fingers++] = state_->position(i);
    });
    unit_ = UnitFrame(fingers, [&](int k) { return places[k]; });
    load_ = size(unit_.of(asked_));
    most_normal_ = MUCH_PRELOAD * preloads + MUCH * (FEW + load_ / friction);
  }
  double normal(const double* forces) const {
    double total = 0.0;
    each_finger(mask_, [&](int i) { total += forces[3 * i]; });
    return total;
  }
  bool is_moderate(const Record& row) const {
    return row.has_force() && normal(row.force()) <= most_normal_;
  }
  bool is_overloaded() { return exceeds_limits_ || !can_give(force.data(), 1.0 + 1e-9); }
  // Find moderate forces within the margin, if possible also within the motors' limits. Return
  // false if there are none.
  bool find_within_margin(const StepRequest* step) {
    if (!step && has_last_ && near_limits_ && keep_limits(last_row_)) return true;
    if (!step) return take(follow());
    std::vector<double>& first = by_method(*step);
    // a flow does not solve what few contacts can balance
    return take(Record(first.data()).code() == RANK_LOST ? follow() : first);
  }
  // Take the forces of a solver's row, moved within the motors' limits if possible. Return false
  // if they are not moderate.
  bool take(std::vector<double>& numbers) {
    const Record row(numbers.data());
    if (!is_moderate(row)) return false;
    set_force(row);
    exceeds_limits_ = false;
    if (can_give(force.data(), 1.0))
      near_limits_ = false;
    else
      keep_limits(has_last_ && near_limits_ ? last_row_ : numbers);
    return true;
  }
  // Preloads that carry springs stand in the way of moderate forces: take those of the margin.
  // Return true if there are forces then.
  bool give_up_raised_preloads() {
    if (!springs_.raise_preloads(mask_)) return false;
    springs_.keep_own_preloads(mask_);
    use_preload(mask_);
    return take(follow());
  }
  // The motors cannot give forces and springs, and the forces come first: from this update on, less
  // of the springs and of the preloads that carry them. Return true if the rest is within the
  // limits.
  bool make_springs_give_way() {
    if (!springs_.any_pulls(mask_)) return false;
    for (double share : {0.98, 0.9, 0.7, 0.5, 0.0}) {
      springs_.leave(mask_, share);
      use_preload(mask_);
      model_.set_bias(springs_.torques);
      if (!keep_limits(has_last_ ? last_row_ : follow_row_) || is_overloaded()) continue;
      springs_.give_way(share);
      return true;
    }
    return false;
  }
  void set_force(const Record& row) {
    std::copy_n(row.force(), force.size(), force.data());
    std::copy_n(row.torsion(), torsion.size(), torsion.data());
  }
  std::vector<double>& by_method(const StepRequest& step) {
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
    return solution;
  }
  std::vector<double>& follow() {
    follow_.solve(from_last(), follow_row_.data());
    effort.followed += int(Record(follow_row_.data()).summary().iterations);
    return follow_row_;
  }
  Request from_last() const {
    return {.wrench = asked_.data(),
            .now = contacts(),
            .start = Start::previous,
            .previous = has_last_ ? last_row_.data() : nullptr};
  }
  // Solve by Newton within the motors' limits, from an earlier force. Return false if none was
  // found.
  bool keep_limits(const std::vector<double>& previous) {
    within_.solve({.wrench = asked_.data(),
                   .now = model_.limited(contacts()),
                   .start = Start::previous,
                   .previous = previous.data()},
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

  // Set this update's margin.
  void use_preload(std::uint64_t mask) {
    margin_.reset();
    if (cones_.replaced() || springs_.changes_preload(mask))
      margin_ = Margin{cones_.share(), springs_.preload};
  }
  // Move the last command of a finger that has just landed into its cone.
  void lift_landed_forces() {
    const Record row(last_row_.data());
    each_finger(mask_, [&](int i) {
      double* f = row.force() + 3 * i;
      const double side = cones_.side(i, f, row.torsion()[i]);
      if (!(cones_.friction(i) * (f[0] - springs_.preload[i]) > side))
        f[0] = springs_.preload[i] + std::max(1.05 * side, LIGHT) / cones_.friction(i);
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
  // Largest difference of a component from forces (N, 3) [N].
  double change(const double* from) const {
    double most = 0.0;
    each_finger(mask_, [&](int i) {
      for (int j = 3 * i; j < 3 * i + 3; ++j) most = std::max(most, std::abs(force[j] - from[j]));
    });
    return most;
  }
  // Go a share of the way from other forces to these.
  void move_from(double share, const double* from, const double* from_torsion) {
    each_finger(mask_, [&](int i) {
      for (int j = 3 * i; j < 3 * i + 3; ++j) force[j] = from[j] + share * (force[j] - from[j]);
      torsion[i] = from_torsion[i] + share * (torsion[i] - from_torsion[i]);
    });
  }
  // Move the forces towards the last command until no component differs by more than
  // `most_change_`.
  void bound_plainly() {
    const double moved = has_last_ ? change(last_force_.data()) : 0.0;
    if (moved > most_change_)
      move_from(most_change_ / moved, last_force_.data(), Record(last_row_.data()).torsion());
  }
  // The same towards the last command rebalanced, if that balances and is as near as the command
  // itself: balance comes first, and close to the limit of what contacts can balance, rebalanced
  // forces grow beyond all bounds.
  void bound_change() {
    const double wanted = has_last_ ? change(last_force_.data()) : 0.0;
    if (wanted <= most_change_) return;
    const Record before(follow_row_.data(), int(torsion.size()));
    if (follow_.start(from_last(), follow_row_.data()) != STARTED ||
        !(before.summary().residual <= ROUNDED * (1.0 + size(asked_))))
      return;
    const double moved = change(before.force());
    if (moved <= most_change_ || moved > wanted + 0.5 * most_change_) return;
    move_from(within_limits(before, most_change_ / moved), before.force(), before.torsion());
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

  // --- where no moderate forces within the margin and the motors' limits balance

  // found: forces within the margin are moderate, and exceed the motors' limits
  void find_less(bool found) {
    springs_.leave(mask_, 1.0);
    model_.bias = model_.carrying;  // the forces come first
    balance = balance_less(found);
    model_.torques_of(mask_, force.data(), torsion.data(), torques_);
    springs_.leave(mask_, model_.share_within(springs_.torques, torques_));
  }
  Balance balance_less(bool found) {
    if (found)
      keep(too_large_);
    else if (turns_freely())
      return Balance::pivoting;
    balance_elastically();
    keep(nearest_);
    nearest_mask_ = mask_;
    if (is_nearly_balanced()) {
      near_limits_ = exceeds_limits_ = false;
      bound_plainly();
      return is_nearly_balanced() ? Balance::marginal : Balance::none;
    }
    if (has_margin()) {
      margin_ = Margin{};
      const bool taken = take(follow());
      if (taken && !is_overloaded()) {
        bound_change();
        return Balance::marginal;
      }
      if (taken) {
        found = true;
        keep(too_large_);
      }
    }
    near_limits_ = exceeds_limits_ = found;
    restore(found ? too_large_ : nearest_);
    if (!found) {
      bound_plainly();
      return Balance::none;
    }
    bound_change();
    return Balance::overloaded;
  }
  // Contacts that resist all but a moment balance the rest within the margin.
  bool turns_freely() {
    // a single fingertip does not stop an object from turning
    if (std::popcount(mask_) < 2) return false;
    const std::optional<Vec6> rest =
        follow_.within_reach(std::span<const double, 6>(asked_), contacts());
    if (!rest) return false;
    asked_ = *rest;
    if (!take(follow())) {
      asked_ = state_->wrench();
      return false;
    }
    bound_change();
    return true;
  }
  // True if the motors can give the forces, and these balance nearly all of the wrench. A single
  // fingertip does not stop an object from turning, however little.
  bool is_nearly_balanced() {
    return std::popcount(mask_) > 1 && missing() <= std::min(LITTLE, LITTLE_SHARE * load_) &&
           can_give(force.data(), 1.0);
  }
  // Largest component [N] of what the forces leave of the wrench, unit frame.
  double missing() const {
    Vec6 left = asked_;
    each_finger(mask_, [&](int i) {
      for (int a = 0; a < 3; ++a) left = left + force[3 * i + a] * column(i, a);
      const Point turn = torsion[i] * model_.axis(i, 0);
      left = left + Vec6{0.0, 0.0, 0.0, turn.u, turn.o, turn.t};
    });
    return size(unit_.of(left));
  }
  bool has_margin() const {
    return cones_.share() < 1.0 ||
           std::ranges::any_of(springs_.preload, [](double s) { return s > 0.0; });
  }
  // Minimise the imbalance within the margin, from the forces that did so last, or from the last
  // ones.
  void balance_elastically() {
    Vec6 load = asked_;
    const Record last(last_row_.data());
    const bool again = has_last_ && nearest_mask_ == mask_;
    // in addition to the preload of the margin: more, for springs, would push an object away that
    // is not held from all sides
    each_finger(mask_, [&](int i) {
      std::copy_n(&(again ? nearest_.force : last_force_)[3 * i], 3, &force[3 * i]);
      torsion[i] = again ? nearest_.torsion[i] : has_last_ ? last.torsion()[i] : 0.0;
      force[3 * i] -= springs_.own_preload(i);
      load = load + springs_.own_preload(i) * column(i, 0);
    });
    elastic_.solve(cones_.contacts, mask_, positions(), model_.frames.data(), load,
                   settings_.follow.limit, force.data(), torsion.data());
    each_finger(mask_, [&](int i) { force[3 * i] += springs_.own_preload(i); });
    effort.followed += elastic_.iterations;
  }
  void keep(Forces& kept) const {
    kept.force = force;
    kept.torsion = torsion;
  }
  void restore(const Forces& kept) {
    std::ranges::copy(kept.force, force.begin());
    std::ranges::copy(kept.torsion, torsion.begin());
  }

  Vec6 column(int i, int a) const { return unit_wrench(state_->position(i), model_.axis(i, a)); }
};

}  // namespace grasp
