// The control loop of a hand: from a reading to joint torques in one call. The constructor
// allocates, a tick never does.
#pragma once
#include <grasp/hand/control_settings.hpp>
#include <grasp/hand/sensing.hpp>
#include <grasp/math/cholesky.hpp>
#include <grasp/optimizer.hpp>
#include <grasp/phi/elastic.hpp>

namespace grasp {

class Controller {
 public:
  const std::shared_ptr<Scene> scene;
  const std::shared_ptr<const Tree> tree;
  const ControlSettings settings;
  Sensors sensors;
  Hold hold = Hold::optimized;
  Vec6 wrench{};                // wrench to balance [N, N m], object frame
  std::vector<double> torques;  // (M,) [N m]
  std::vector<double> force;    // (N, 3) commanded [N], contact frames
  std::vector<double> frames;   // (N, 3, 3) contact frames, columns (n, o, t), object frame
  // (N,) depth below the surface [m] at which `Hold::place` keeps the tips
  std::vector<double> depths;
  std::vector<double> home;  // (M,) rest posture [rad]
  // (N,) the grasp's contact points [m] and inward normals, object frame
  std::vector<Point> goals, inwards;
  std::vector<double> solution;  // row of the method's last solve
  double peak = 0.0;             // largest |torque| since `reset` [N m]
  std::uint64_t mask = 0;        // fingers that count as in contact
  int changes = 0;               // number of changes of `mask`, except from no contact
  bool closure = true;           // the last tick with `Hold::optimized` found a balanced force
  Effort effort;

  // method: finds the forces when an agent's step begins. Throws std::invalid_argument unless it
  // has one contact per finger.
  Controller(std::shared_ptr<Scene> viewed, const ForceOptimizer& method,
             const ControlSettings& settings, const SensorSettings& sensing)
      : scene(std::move(viewed)),
        tree(scene->tree),
        settings(settings),
        sensors(scene, sensing),
        torques(tree->joints()),
        force(3 * tree->fingers()),
        frames(9 * tree->fingers()),
        depths(tree->fingers()),
        home(torques),
        goals(tree->fingers()),
        inwards(goals),
        solution(method.size()),
        method_(method),
        motors_(*tree),
        follow_({method.contacts(), {}, method.margin()}, settings.follow),
        within_(within(method.contacts())),
        least_sum_({with_weight_one(method.contacts()), {}, method.margin()},
                   {.method = Method::conic, .tolerance = 1e-4}),
        within_margin_(within_margin(method)),
        elastic_(tree->fingers()),
        follow_row_(follow_.size()),
        within_row_(within_.size()),
        least_sum_row_(least_sum_.size()),
        last_row_(within_row_),
        slid_(goals),
        ticks_apart_(tree->fingers()),
        last_force_(force),
        step_force_(force),
        direct_(force),
        squeezed_(force),
        adjustment_(force),
        torsion_(tree->fingers()),
        pull_(torques),
        extra_torques_(torques),
        trial_torques_(torques),
        tip_push_(force),
        tip_jacobian_(force.size() * torques.size()),
        gram_(int(force.size())),
        is_redundant_(is_redundant(*tree)) {
    if (method.contacts().count != tree->fingers())
      throw std::invalid_argument("the method needs one contact per finger");
  }
  Controller(const Controller&) = delete;

  // Start a new episode. Delayed measurements first show the current scene, at rest.
  void reset() {
    std::fill(torques.begin(), torques.end(), 0.0);
    std::fill(force.begin(), force.end(), 0.0);
    std::fill(frames.begin(), frames.end(), 0.0);
    std::fill(ticks_apart_.begin(), ticks_apart_.end(), 0);
    forget_solution();
    wrench = {};
    peak = 0.0;
    mask = squeezed_mask_ = 0;
    changes = 0;
    closure = true;
    begin_step();
    has_lost_force_ = has_last_ = near_limits_ = false;
    worst_ = {};
    std::fill(slid_.begin(), slid_.end(), Point{0.0, 0.0, 0.0});
    sensors.reset();
  }

  // Input of a control tick.
  struct Known {
    Doubles reading;  // see `Reading`; empty if the scene has it already
    // (6,) external wrench that a perfect sensor reports [N, N m], object frame
    const double* external;
    const double* noise;  // (3 + 3N,) standard normal numbers for noisy sensors
    Point gravity;        // [m/s^2], world
    Target target;
  };
  // An agent's step that begins at this tick. Every member is optional.
  struct StepRequest {
    // (K,) [N] along `settings.directions`: added to the start, which is then brought inside the
    // cones
    Doubles adjustment{};
    Start start = Start::standard;  // of the method: by its own rule, or `Start::given`
    // (N, 3) [N], contact frames: the start for `Start::given`, or the command for `Hold::direct`
    Doubles force{};
  };
  // Run one control tick, from a reading to `torques` within the motors' limits. step: an agent's
  // step that begins. Return false, with nothing changed, if the reading is not finite or the
  // object is farther away than `Snapshot::LOST_DISTANCE`.
  bool tick(const Known& known, const StepRequest* step = nullptr) {
    const bool good = see(known);
    if (good) act(step);
    return good;
  }
  // The two halves of `tick`, for callers that compute the method's start from the reading.
  bool see(const Known& known) {
    if (!known.reading.empty() && !scene->read(known.reading.data(), known.reading.size()))
      return false;
    sensors.see(known.external, known.noise, settings.body, known.gravity);
    target_ = known.target;
    wrench = sensors.external + settings.body.wrench(seen(), target_, known.gravity);
    count_contacts();
    for (int i = 0; i < tree->fingers(); ++i) {
      if (scene->now.touching[i] > 0.0) slid_[i] += sensors.settings.tick * scene->now.sliding[i];
      worst_.slide = std::max(worst_.slide, length(slid_[i]));
    }
    const double mass = settings.body.mass;
    load_ = std::max(length(point(known.external) + mass * scene->now.to_object(scene->gravity)),
                     STANDARD_GRAVITY * mass);
    worst_ = worst();
    return true;
  }
  void act(const StepRequest* step = nullptr) {
    last_force_ = force;  // copied, not swapped: Python holds a view of it
    std::fill(force.begin(), force.end(), 0.0);
    std::fill(torsion_.begin(), torsion_.end(), 0.0);
    write_frames();
    const bool pushes = hold != Hold::place && hold != Hold::reach && mask;
    closure = mask || hold != Hold::optimized;
    if (step) forget_solution();
    if (pushes) find_forces(step);
    store_command(pushes);
    torques_of(force.data(), torques);
    for (int i = 0; i < tree->fingers(); ++i) {
      if (pushes && mask >> i & 1) continue;
      std::fill(extra_torques_.begin(), extra_torques_.end(), 0.0);
      seen().posture.push(tree->tips[i].link, seen().tips[i], reach(i), extra_torques_.data());
      add_within();
    }
    if (is_redundant_) keep_posture();
    clip_torques();
  }
  const Snapshot& seen() const { return sensors.seen(); }

  void begin_step() {
    effort = {};
    step_force_ = force;
  }
  // Costs of the step since `begin_step`, on the contacts currently seen.
  Costs costs() {
    double total = 0.0, moved = 0.0, both = 0.0;
    for (int i = 0; i < tree->fingers(); ++i) total += force[3 * i];
    for (std::size_t j = 0; j < force.size(); ++j) {
      moved += std::abs(force[j] - step_force_[j]);
      both += std::abs(force[j]) + std::abs(step_force_[j]);
    }
    Costs out{.force = closure ? 0.0 : 1.0,
              .torque = std::min(effort.share, 1.0),
              .change = both > 0.0 ? moved / both : 0.0};
    if (closure && total > 0.0) {
      least_sum_.solve({.wrench = wrench.data(), .now = contacts()}, least_sum_row_.data());
      const Record row(least_sum_row_.data());
      out.force = row.has_force() ? std::max(0.0, 1.0 - row.summary().objective / total) : 1.0;
    }
    return out;
  }
  Code code() const { return Code(int(reinterpret_cast<const Summary*>(solution.data())->code)); }

  // Compute the contact frames, and take the measured forces as commanded ones.
  void rest() {
    write_frames();
    worst_.slide = 0.0;
    std::fill(slid_.begin(), slid_.end(), Point{0.0, 0.0, 0.0});  // the first tick counts it again
    for (int i = 0; i < tree->fingers(); ++i)
      for (int a = 0; a < 3; ++a) force[3 * i + a] = dot(axis(i, a), seen().forces[i]);
  }

  // Worst values since `reset`, from the true state.
  struct Worst {
    double slide = 0.0;    // [m] largest sliding distance of a touching tip on the object
    double overlap = 0.0;  // [m] largest penetration of a tip into the object
    // force of other parts on the object, divided by max(|external force + weight|, weight)
    double stray = 0.0;
  };
  // Quality of the hold, from the true state.
  struct Outcome {
    PoseError error;
    double drift, tilt;        // [m], [rad]: norms of the position and orientation errors
    double force_error = 0.0;  // largest component of measured - commanded force [N]
    double slip = 0.0;         // highest tangential speed of a touching tip on the object [m/s]
    double stray = 0.0;        // force of parts other than fingertips on the object [N]
    Worst worst;
  };
  // measured: receives the forces (N, 3) in the commanded contact frames [N].
  Outcome outcome(const Target& target, double* measured) const {
    const Snapshot& now = scene->now;
    const PoseError error(now, target);
    Outcome out{.error = error,
                .drift = length(error.position),
                .tilt = length(error.orientation),
                .stray = now.stray,
                .worst = worst()};
    for (int i = 0; i < tree->fingers(); ++i) {
      for (int a = 0; a < 3; ++a) {
        const int j = 3 * i + a;
        measured[j] = dot(axis(i, a), now.forces[i]);
        out.force_error = std::max(out.force_error, std::abs(measured[j] - force[j]));
      }
      if (now.touching[i] > 0.0) out.slip = std::max(out.slip, now.slip[i]);
    }
    return out;
  }

 private:
  static constexpr double STANDARD_GRAVITY = 9.81;  // [m/s^2]
  // fraction of the torque limits: below it, the next tick solves without them
  static constexpr double NEAR = 0.9;
  // smallest normal force times friction of a finger that has just landed [N]
  static constexpr double LIGHT = 1e-2;
  // rounding at a torque limit, as a fraction of it
  static constexpr double ROUNDED = 1e-9;

  // The joints that have motors, and the torques of these.
  struct Motors {
    std::vector<int> of;  // (M,) index of a joint's motor; -1: coupled
    // (J,) [N m]: limits; torques that carry the links' weight
    std::vector<double> limit, bias;
    explicit Motors(const Tree& tree) : of(tree.joints(), -1) {
      for (int j = 0; j < tree.joints(); ++j)
        if (!tree.links[j].coupled()) {
          of[j] = int(limit.size());
          limit.push_back(tree.links[j].torque_limit);
        }
      bias.resize(limit.size());
    }
  };
  ForceOptimizer method_;
  Motors motors_;
  std::vector<double> jacobian_;  // (N, 3 or 6, J) object frame; declared before its users
  // Newton from the last command on the cones; within the motors' limits
  ForceOptimizer follow_, within_;
  ForceOptimizer least_sum_;  // finds the least sum of normal forces, for `costs`
  Contacts within_margin_;    // the method's contacts with the share of friction of its margin
  ElasticBalance elastic_;
  // solution rows of these solvers, and the last command as such a row
  std::vector<double> follow_row_, within_row_, least_sum_row_, last_row_;
  bool has_last_ = false;  // there is a last command
  // near: the last command is near the torque limits; exceeds: it exceeds them least
  bool near_limits_ = false, exceeds_limits_ = false;
  std::uint64_t squeezed_mask_ = 0;  // fingers for which `squeezed_` was computed
  Worst worst_;
  double load_ = 1.0;  // [N] max(|external force + weight|, weight): a push may cancel the weight
  std::vector<Point> slid_;      // (N,) path of each tip on the object by sliding [m], object frame
  bool has_lost_force_ = false;  // a finger that counts as in contact has no force
  std::vector<int> ticks_apart_;  // (N,) ticks since a finger had force
  Target target_{};
  // (N, 3) [N], contact frames: commands of the last tick and before the agent's step; forces of
  // `Hold::direct` and `Hold::squeeze`; in the object frame: the adjustment
  std::vector<double> last_force_, step_force_, direct_, squeezed_, adjustment_;
  std::vector<double> torsion_;  // (N,) commanded moments about the normals [N m]
  // (M,) work space
  std::vector<double> pull_, extra_torques_, trial_torques_;
  std::vector<double> tip_push_, tip_jacobian_;  // work space of `keep_posture`
  Cholesky gram_;
  bool is_redundant_;

  static Contacts within_margin(const ForceOptimizer& method) {
    Contacts contacts = method.contacts();
    contacts.narrow(method.margin().friction);
    return contacts;
  }
  // The least sum counts newtons.
  static Contacts with_weight_one(Contacts contacts) {
    contacts.set_weights(Objective{});
    return contacts;
  }
  ForceOptimizer within(const Contacts& contacts) {
    jacobian_.resize((contacts.soft() ? 6 : 3) * contacts.count * motors_.limit.size());
    const auto limited = [](double limit) { return limit < infinity; };
    const bool elastic = std::any_of(motors_.limit.begin(), motors_.limit.end(), limited);
    return ForceOptimizer(
        {contacts, {.jacobian = jacobian_, .torque_limit = motors_.limit}, method_.margin()},
        {.tolerance = settings.follow.tolerance,
         .limit = settings.follow.limit,
         .elastic = elastic});
  }
  // True if a finger has more than three joints, or a joint moves no tip.
  static bool is_redundant(const Tree& tree) {
    const std::vector<int> fingers_per_motor = tree.fingers_per_motor(tree.all_fingers());
    bool free = false;
    for (int i = 0; i < tree.fingers(); ++i) free = free || tree.movers(i).size() > 3;
    for (int j = 0; j < tree.joints(); ++j)
      free = free || !(fingers_per_motor[j] || tree.links[j].coupled());
    return free;
  }

  Worst worst() const {
    Worst out = worst_;
    for (double gap : scene->now.gaps) out.overlap = std::max(out.overlap, -gap);
    out.stray = std::max(out.stray, scene->now.stray / load_);
    return out;
  }

  // --- contacts

  Point axis(int i, int a) const {
    return {frames[9 * i + a], frames[9 * i + 3 + a], frames[9 * i + 6 + a]};
  }
  template <class F> void touching(F&& f) const {
    for (int i = 0; i < tree->fingers(); ++i)
      if (mask >> i & 1) f(i);
  }
  // Fingers count as in contact if they touch, or did within the last `release` ticks.
  void count_contacts() {
    const std::uint64_t touch = seen().mask();
    if (touch == mask && !has_lost_force_) return;
    std::uint64_t next = 0;
    for (int i = 0; i < tree->fingers(); ++i) {
      const std::uint64_t bit = std::uint64_t(1) << i;
      ticks_apart_[i] = touch & bit ? 0 : ticks_apart_[i] + 1;
      if (touch & bit || (mask & bit && ticks_apart_[i] <= settings.release)) next |= bit;
    }
    has_lost_force_ = next != touch;
    if (next == mask) return;
    changes += mask != 0;
    mask = next;
  }
  void write_frames() {
    for (int i = 0; i < tree->fingers(); ++i) {
      const Frame frame(seen().normals[i], nullptr);
      for (int a = 0; a < 3; ++a)
        for (int k = 0; k < 3; ++k) frames[9 * i + 3 * k + a] = frame[a][k];
    }
  }
  Changes contacts() const {
    const std::size_t size = 3 * seen().points.size();
    return {.positions = {&seen().points[0].u, size},
            .normals = {&seen().normals[0].u, size},
            .contacts = mask};
  }
  // The contacts with the motors' Jacobian and the torques of the links' weight.
  Changes limited_contacts() {
    const Snapshot& s = seen();
    const std::size_t joints = motors_.limit.size();
    const std::size_t rows = joints ? jacobian_.size() / (joints * tree->fingers()) : 0;
    std::fill(jacobian_.begin(), jacobian_.end(), 0.0);
    touching([&](int i) {
      const auto add = [&](std::size_t row, int j, const Point& moves) {
        const Point there = s.rotation.transposed(moves);
        for (int k = 0; k < 3; ++k)
          jacobian_[joints * (rows * i + row + k) + motors_.of[j]] += there[k];
      };
      s.posture.each_moving_joint(tree->tips[i].link, s.touch[i],
                                  [&](int j, const Point& moves) { add(0, j, moves); });
      if (rows == 6)
        s.posture.each_turning_joint(tree->tips[i].link,
                                     [&](int j, const Point& turns) { add(3, j, turns); });
    });
    for (int j = 0; j < tree->joints(); ++j)
      if (motors_.of[j] >= 0) motors_.bias[motors_.of[j]] = s.gravity_torques[j];
    Changes now = contacts();
    now.jacobian = jacobian_;
    now.torque_bias = motors_.bias;
    return now;
  }

  // --- forces

  void forget_solution() { Record(solution.data(), tree->fingers()).summary() = {}; }
  void find_forces(const StepRequest* step) {
    if (hold == Hold::optimized) {
      if (has_last_) lift_landed_forces();
      if (step || !has_last_ || !near_limits_ || !keep_limits(last_row_.data())) {
        const Record first = step ? by_method(*step) : follow();
        // a flow does not solve what few contacts can balance
        const bool few = step && first.code() == RANK_LOST;
        const Record row = few ? follow() : first;
        if (!row.has_force()) return balance_elastically();
        set_force(row);
        if (motors_can_make(1.0))
          near_limits_ = false;
        else
          keep_limits(has_last_ && near_limits_ ? last_row_.data()
                                                : (step && !few ? solution : follow_row_).data());
      }
      if (has_last_) bound_change();
      return;
    }
    if (hold == Hold::direct && step)
      std::copy(step->force.begin(), step->force.end(), direct_.begin());
    if (hold == Hold::squeeze && squeezed_mask_ != mask) squeeze();
    const std::vector<double>& from = hold == Hold::direct ? direct_ : squeezed_;
    touching([&](int i) { std::copy_n(&from[3 * i], 3, &force[3 * i]); });
    if (hold == Hold::squeeze) restore_balance();
  }
  void set_force(const Record& row) {
    std::copy_n(row.force(), force.size(), force.data());
    std::copy_n(row.torsion(), torsion_.size(), torsion_.data());
  }
  Record by_method(const StepRequest& step) {
    Request request{.wrench = wrench.data(), .now = contacts(), .start = step.start};
    if (step.start == Start::given) request.force = step.force;
    if (settings.remembers && has_last_) request.previous = last_row_.data();
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
    return {.wrench = wrench.data(),
            .now = contacts(),
            .start = Start::previous,
            .previous = has_last_ ? last_row_.data() : nullptr};
  }
  // Solve by Newton within the motors' limits, from an earlier force. Return false if none was
  // found.
  bool keep_limits(const double* previous) {
    within_.solve({.wrench = wrench.data(),
                   .now = limited_contacts(),
                   .start = Start::previous,
                   .previous = previous},
                  within_row_.data());
    const Record within(within_row_.data());
    effort.limited += int(within.summary().iterations);
    exceeds_limits_ = within.code() == LIMITS_EXCEEDED;
    if (within.has_force()) set_force(within);
    near_limits_ = !motors_can_make(NEAR);
    return within.has_force();
  }
  // Minimise the balance residual, from the last forces.
  void balance_elastically() {
    closure = near_limits_ = false;
    const Record last(last_row_.data());
    touching([&](int i) {
      std::copy_n(&last_force_[3 * i], 3, &force[3 * i]);
      torsion_[i] = has_last_ ? last.torsion()[i] : 0.0;
    });
    elastic_.solve(within_margin_, mask, &seen().points[0].u, frames.data(), wrench,
                   settings.follow.limit, force.data(), torsion_.data());
    effort.followed += elastic_.iterations;
  }
  void adjust(Doubles coordinates) {
    const std::size_t columns = coordinates.size();
    for (std::size_t j = 0; j < adjustment_.size(); ++j) {
      adjustment_[j] = 0.0;
      for (std::size_t k = 0; k < columns; ++k)
        adjustment_[j] += settings.directions[columns * j + k] * coordinates[k];
    }
  }
  // Move the last command of a finger that has just landed into its cone.
  void lift_landed_forces() {
    const Record row(last_row_.data());
    touching([&](int i) {
      double* f = row.force() + 3 * i;
      const double* scale = &within_margin_.scale[3 * i];
      const double preload = method_.margin().preload[i];
      const double turning = within_margin_.torsion_scale(i) * row.torsion()[i];
      const double side = std::hypot(scale[1] * f[1], scale[2] * f[2], turning);
      if (!(scale[0] * (f[0] - preload) > side))
        f[0] = preload + std::max(1.05 * side, LIGHT) / scale[0];
    });
  }
  // Keep the command for the next tick.
  void store_command(bool pushes) {
    has_last_ = pushes;
    if (!pushes) return;
    const Record row(last_row_.data(), tree->fingers());
    row.summary().code = near_limits_ && exceeds_limits_ ? LIMITS_EXCEEDED : CONVERGED;
    row.summary().contacts = tree->fingers();
    std::copy(force.begin(), force.end(), row.force());
    std::copy(torsion_.begin(), torsion_.end(), row.torsion());
    std::copy(frames.begin(), frames.end(), row.frames());
  }
  // Move the forces towards the last command, rebalanced, until no component differs by more than
  // `most_change`.
  void bound_change() {
    const auto change = [&](const double* then) {
      double most = 0.0;
      touching([&](int i) {
        for (int j = 3 * i; j < 3 * i + 3; ++j) most = std::max(most, std::abs(force[j] - then[j]));
      });
      return most;
    };
    if (change(last_force_.data()) <= settings.most_change) return;
    if (follow_.start(from_last(), follow_row_.data()) != STARTED) return;
    const Record before(follow_row_.data());
    const double moved = change(before.force());
    if (moved <= settings.most_change) return;
    const double share = within_limits(before, settings.most_change / moved);
    for (std::size_t j = 0; j < force.size(); ++j)
      force[j] = before.force()[j] + share * (force[j] - before.force()[j]);
    for (std::size_t i = 0; i < torsion_.size(); ++i)
      torsion_[i] = before.torsion()[i] + share * (torsion_[i] - before.torsion()[i]);
  }
  // The smallest fraction >= `share` of the way from `before` to the forces that is within the
  // torque limits, if the forces are.
  double within_limits(const Record& before, double share) {
    torques_of(before.force(), trial_torques_);
    torques_of(force.data(), extra_torques_);
    for (int j = 0; j < tree->joints(); ++j) {
      const double limit = tree->links[j].torque_limit;
      const double from = trial_torques_[j];
      const double way = extra_torques_[j] - from;
      if (std::abs(extra_torques_[j]) <= limit && std::abs(from + share * way) > limit)
        share = std::min(1.0, (std::copysign(limit, from) - from) / way);
    }
    return share;
  }
  // Compute an internal force of the fingers in contact, at the method's original contacts, whose
  // normal forces sum to `settings.squeeze`.
  void squeeze() {
    const double nothing[6] = {};
    follow_.solve({.wrench = nothing, .now = {.contacts = mask}}, follow_row_.data());
    const Record row(follow_row_.data());
    double total = 0.0;
    touching([&](int i) {
      for (int a = 0; a < 3; ++a)
        squeezed_[3 * i + a] = row.has_force() ? row.force()[3 * i + a] : a == 0;
      total += squeezed_[3 * i];
    });
    for (double& f : squeezed_) f *= settings.squeeze / total;
    squeezed_mask_ = mask;
  }
  // Restore balance by the least-norm change of the forces, as far as these contacts can.
  void restore_balance() {
    // relative to the largest entry: with two contacts the matrix is singular
    constexpr double SHIFT = 1e-9;
    Packed6 gram{};
    Vec6 missed = wrench;
    const auto column = [&](int i, int a) { return unit_wrench(seen().points[i], axis(i, a)); };
    touching([&](int i) {
      for (int a = 0; a < 3; ++a) {
        missed = missed + force[3 * i + a] * column(i, a);
        add_gram(gram, column(i, a));
      }
    });
    double largest = 0.0;
    for (int r = 0; r < 6; ++r) largest = std::max(largest, gram[packed(r, r)]);
    for (int r = 0; r < 6; ++r) gram[packed(r, r)] += SHIFT * largest;
    Ldl6 factor;
    if (!(factor.factor(gram) > 0.0)) return;
    const Vec6 pull = factor.solve(missed);
    touching([&](int i) {
      for (int a = 0; a < 3; ++a) force[3 * i + a] -= dot(column(i, a), pull);
    });
  }

  // --- torques

  // out (M,) = the torques that carry the hand plus those of the touching fingers with forces (N,
  // 3) [N], contact frames, and their torsion.
  void torques_of(const double* forces, std::vector<double>& out) const {
    const Snapshot& s = seen();
    std::copy(s.gravity_torques.begin(), s.gravity_torques.end(), out.begin());
    touching([&](int i) {
      Point push{0.0, 0.0, 0.0};
      for (int k = 0; k < 3; ++k) push += forces[3 * i + k] * axis(i, k);
      s.posture.push(tree->tips[i].link, s.touch[i], s.rotation * push, out.data());
      if (torsion_[i] != 0.0)
        s.posture.twist(tree->tips[i].link, torsion_[i] * (s.rotation * axis(i, 0)), out.data());
    });
  }
  // True if the motors can do this within `part` of their limits.
  bool motors_can_make(double part) {
    torques_of(force.data(), trial_torques_);
    for (int j = 0; j < tree->joints(); ++j)
      if (!(std::abs(trial_torques_[j]) <= part * tree->links[j].torque_limit)) return false;
    return true;
  }
  // Add as much of `extra_torques_` as the limits allow.
  void add_within() {
    double share = 1.0;
    for (int j = 0; j < tree->joints(); ++j) {
      if (extra_torques_[j] == 0.0) continue;
      const double room =
          tree->links[j].torque_limit - std::copysign(torques[j], torques[j] * extra_torques_[j]);
      share = std::min(share, std::max(room, 0.0) / std::abs(extra_torques_[j]));
    }
    for (int j = 0; j < tree->joints(); ++j) torques[j] += share * extra_torques_[j];
  }
  void clip_torques() {
    for (int j = 0; j < tree->joints(); ++j) {
      if (tree->links[j].coupled()) continue;
      const double limit = tree->links[j].torque_limit;
      const double size = std::abs(torques[j]);
      effort.saturated = effort.saturated || size > limit * (1.0 + ROUNDED);
      torques[j] = std::min(std::max(torques[j], -limit), limit);
      const double used = std::abs(torques[j]);
      peak = std::max(peak, used);
      effort.margin = std::min(effort.margin, limit - used);
      effort.share = std::max(effort.share, used / limit);
    }
  }

  // Spring and damper force [N], world frame, that draws tip i to its place below the surface at
  // its goal; with `Hold::place` this moves with the target pose of the object, otherwise with its
  // current one.
  Point reach(int i) const {
    const Snapshot& s = seen();
    const bool anchored = hold == Hold::place;
    const Rotation turned = anchored ? Rotation::of_quaternion(target_.quaternion) : s.rotation;
    const Spring& spring = anchored ? settings.spring : settings.reach[i];
    const double depth = anchored ? depths[i] : settings.reach_depth;
    const Point place = turned * (goals[i] - (tree->tips[i].radius - depth) * inwards[i]);
    const Point goal = (anchored ? target_.position : s.position) + place;
    Point speed = s.posture.velocity(tree->tips[i].link, s.tips[i], s.rates.data());
    if (!anchored) speed -= s.object_velocity(s.tips[i]);
    const Point pull = spring.gain * (goal - s.tips[i]) - spring.damping * speed;
    const double size = length(pull);
    return size > spring.limit ? (spring.limit / size) * pull : pull;
  }

  // Keep a redundant hand near its rest posture without moving the tips, in the null space of their
  // Jacobians.
  void keep_posture() {
    const Snapshot& s = seen();
    const int m = tree->joints();
    const int rows = 3 * tree->fingers();
    for (int j = 0; j < m; ++j) {
      const Spring& spring = settings.posture[j];
      pull_[j] = tree->links[j].coupled()
                     ? 0.0
                     : -spring.gain * (s.angles[j] - home[j]) - spring.damping * s.rates[j];
    }
    for (int i = 0; i < tree->fingers(); ++i)
      s.posture.jacobian(tree->tips[i].link, s.tips[i], &tip_jacobian_[3 * m * i]);
    for (int a = 0; a < rows; ++a) {
      tip_push_[a] = 0.0;
      for (int j = 0; j < m; ++j) tip_push_[a] += tip_jacobian_[m * a + j] * pull_[j];
      for (int b = 0; b <= a; ++b) {
        gram_(a, b) = a == b ? 1e-10 : 0.0;
        for (int j = 0; j < m; ++j)
          gram_(a, b) += tip_jacobian_[m * a + j] * tip_jacobian_[m * b + j];
      }
    }
    if (!gram_.factor()) return;
    gram_.solve(tip_push_.data());
    for (int j = 0; j < m; ++j) {
      extra_torques_[j] = pull_[j];
      for (int a = 0; a < rows; ++a) extra_torques_[j] -= tip_jacobian_[m * a + j] * tip_push_[a];
    }
    add_within();
  }
};

}  // namespace grasp
