// The springs of a hand: from each fingertip to its place, and towards the home posture.
#pragma once
#include <grasp/hand/hand_model.hpp>
#include <grasp/hand/mobility.hpp>

namespace grasp {

class Springs {
 public:
  // (N,) the contacts to which free fingers reach [m], and their inward normals, object frame; not
  // finite: where the finger lands first. Later places would wander with each loss of contact.
  std::vector<Point> goals, inwards;
  std::vector<double> depths;  // (N,) below the surface [m]: where `Hold::place` keeps the tips
  std::vector<double> home;    // (M,) posture of the joints that the tips leave free [rad]

  // home: (M,) [rad], where the gains are computed
  Springs(const HandModel& model, const HandControllerSettings& settings,
          std::span<const double> home)
      : goals(model.tips.size(), NOWHERE),
        inwards(goals),
        depths(goals.size()),
        home(home.begin(), home.end()),
        model_(model),
        place_(settings.place),
        places_(goals.size()),
        learned_(goals.size()),
        pull_(home.size()),
        tip_push_(3 * goals.size()),
        tip_jacobian_(3 * goals.size() * home.size()),
        gram_(int(3 * goals.size())),
        is_redundant_(is_redundant(*model.tree)) {
    constexpr double LIGHTEST = 0.03;  // [kg] tip for which reaching is critically damped
    const Mobility mobility(model.tree, home.data());
    const auto stable = [&](const Spring& wanted, double of) {
      return stable_spring(wanted, of, 1.0 / settings.rate, settings.joint_delay);
    };
    for (double of : mobility.tips) {
      grip_.push_back(stable(settings.grip, of));
      const double damping =
          2.0 * std::sqrt(settings.reach_stiffness * std::max(LIGHTEST, 1.0 / of));
      reach_.push_back(stable({settings.reach_stiffness, damping, settings.reach_limit}, of));
    }
    const std::vector<int> fingers = model.tree->fingers_per_motor(model.tree->all_fingers());
    for (std::size_t j = 0; j < home.size(); ++j) {
      const double of = mobility.joints[j];
      const double gain = (fingers[j] > 1 ? SHARED : 1.0) * settings.posture_stiffness;
      const double roll = ROLL * settings.posture_stiffness;
      // critical for the springs of posture and rolling together
      const double damping =
          std::max(settings.posture_damping, 2.0 * std::sqrt((gain + roll) / std::max(of, 1.0)));
      posture_.push_back(stable({gain, damping}, of));
      range_.push_back(stable({END * settings.posture_stiffness, 0.0}, of));
      roll_.push_back(stable({roll, 0.0}, of));
    }
    reach_depth_ = settings.reach_force / settings.reach_stiffness;
    for (int i = 0; i < model.tree->fingers(); ++i) movers_.push_back(model.tree->movers(i));
    if (place_.gain > 0.0)
      for (double& depth : depths) depth = settings.squeeze / depths.size() / place_.gain;
  }
  // Forget where fingers landed.
  void reset() {
    for (std::size_t i = 0; i < goals.size(); ++i)
      if (learned_[i]) goals[i] = NOWHERE;
    std::fill(learned_.begin(), learned_.end(), 0);
  }

  // A finger lands: its place on the object is where it is.
  void land(int i, const HandState& state) {
    places_[i] = {model_.turn.transposed(model_.tips[i] - state.object().position),
                  model_.turn.transposed() * link_frame(i), state.normal(i)};
    if (!std::isfinite(goals[i].u)) {
      learned_[i] = true;
      goals[i] = state.position(i);
      inwards[i] = state.normal(i);
    }
  }

  // Force [N], base frame, of the spring of a touching fingertip, to its place on the target.
  Point grip(int i, const HandState& state) const {
    const BodyRow& target = state.target();
    const Rotation turn = Rotation::of_quaternion(target.quaternion);
    return pull(i, grip_[i], target.position + turn * place(i, turn), target, state);
  }
  // Let the place of a touching fingertip follow, within SETTLING seconds, where it is on the
  // object: what has slid is not drawn back for ever. time: [s]
  void settle(int i, const HandState& state, double time) {
    const Point now = model_.turn.transposed(model_.tips[i] - state.object().position);
    const Point way = now - place(i, model_.turn);
    const double share = FARTHEST / std::max(length(way), FARTHEST);
    places_[i].tip += time / (time + SETTLING) * share * way;
  }
  // torques (M,) += those that draw a free finger to its goal on the object; kept: to its place on
  // the target.
  void reach(int i, bool kept, const HandState& state, std::vector<double>& torques) const {
    if (!std::isfinite(goals[i].u)) return;
    const BodyRow& body = kept ? state.target() : state.object();
    const Rotation turn = kept ? Rotation::of_quaternion(body.quaternion) : model_.turn;
    const double depth = kept ? depths[i] : reach_depth_;
    const Point place = goals[i] - (model_.tree->tips[i].radius - depth) * inwards[i];
    const Point force =
        pull(i, kept ? place_ : reach_[i], body.position + turn * place, body, state);
    model_.posture.push(model_.tree->tips[i].link, model_.tips[i], force, torques.data());
  }

  // True if `keep_posture` has something to do.
  bool redundant() const { return is_redundant_; }
  // torques (M,) = those that keep the hand near its home posture without moving free tips or
  // pushing with those in contact (bits of a mask): in the null space of the Jacobians of their
  // centres and contact points. Return false, with nothing written, if there are none.
  bool keep_posture(const HandState& state, std::uint64_t touching, std::vector<double>& torques) {
    const Tree& tree = *model_.tree;
    const int m = tree.joints();
    const int rows = 3 * tree.fingers();
    for (int j = 0; j < m; ++j) {
      const Link& link = tree.links[j];
      const double angle = state[ANGLES][j];
      const double room = std::min(NEAR_END, 0.25 * (link.upper - link.lower));
      // a home posture near an end is one that the fingers need
      const double low = std::min(link.lower + room, home[j]);
      const double high = std::max(link.upper - room, home[j]);
      const double beyond = std::clamp(angle, low, high) - angle;
      pull_[j] = link.coupled() ? 0.0
                                : posture_[j].gain * (home[j] - angle) + range_[j].gain * beyond -
                                      posture_[j].damping * state[RATES][j];
    }
    each_finger(touching, [&](int i) { keep_from_rolling(i, state); });
    for (int i = 0; i < tree.fingers(); ++i)
      model_.posture.jacobian(tree.tips[i].link,
                              touching >> i & 1 ? model_.touch[i] : model_.tips[i],
                              &tip_jacobian_[3 * m * i]);
    for (int a = 0; a < rows; ++a) {
      const double* moves = &tip_jacobian_[m * a];
      const std::vector<int>& joints = movers_[a / 3];
      tip_push_[a] = 0.0;
      for (int j : joints) tip_push_[a] += moves[j] * pull_[j];
      for (int b = 0; b <= a; ++b) {
        gram_(a, b) = a == b ? 1e-10 : 0.0;
        for (int j : joints) gram_(a, b) += moves[j] * tip_jacobian_[m * b + j];
      }
    }
    if (!gram_.factor()) return false;
    gram_.solve(tip_push_.data());
    torques = pull_;
    for (int a = 0; a < rows; ++a)
      for (int j : movers_[a / 3]) torques[j] -= tip_jacobian_[m * a + j] * tip_push_[a];
    return true;
  }

 private:
  static constexpr Point NOWHERE{infinity, infinity, infinity};
  static constexpr double SETTLING = 1.0;  // [s]
  // [m] a place follows what is farther no faster than this within `SETTLING`: one wrong pose of
  // the object hardly moves it
  static constexpr double FARTHEST = 5e-3;
  // A joint that the tips leave free is drawn back near its ends, the link of a touching tip turned
  // back, and a joint that moves several tips, such as a wrist, kept, by so many times the
  // stiffness of the posture.
  static constexpr double END = 100.0, ROLL = 30.0, SHARED = 100.0;
  static constexpr double NEAR_END = 0.2;  // [rad]
  const HandModel& model_;
  std::vector<Spring> grip_, reach_;  // (N,)
  // (M,) towards the home posture, away from the ends of a joint, against rolling [N m/rad], [N m
  // s/rad]
  std::vector<Spring> posture_, range_, roll_;
  Spring place_;
  double reach_depth_ = 0.0;  // [m] below the surface: goal of free fingers
  // A touching finger as it landed, object frame: centre of its tip [m], frame of its link, inward
  // normal.
  struct Place {
    Point tip;
    Rotation link;
    Point normal;
  };
  std::vector<Place> places_;             // (N,)
  std::vector<char> learned_;             // (N,) the goal is where the finger landed
  std::vector<std::vector<int>> movers_;  // (N,) joints that move each tip
  std::vector<double> pull_, tip_push_, tip_jacobian_;
  Cholesky gram_;
  bool is_redundant_;

  // True if a finger has more than three joints, or a joint moves no tip.
  static bool is_redundant(const Tree& tree) {
    const std::vector<int> fingers_per_motor = tree.fingers_per_motor(tree.all_fingers());
    bool free = false;
    for (int i = 0; i < tree.fingers(); ++i) free = free || tree.movers(i).size() > 3;
    for (int j = 0; j < tree.joints(); ++j)
      free = free || !(fingers_per_motor[j] || tree.links[j].coupled());
    return free;
  }
  // How far the link of a touching tip has turned since it landed, against a body of some
  // orientation, in its frame [rad].
  Point turned(int i, const Rotation& turn) const {
    return (turn.transposed() * link_frame(i) * places_[i].link.transposed()).vector();
  }
  // The place of a tip on such a body. A tip that turns against the object rolls on it: its place
  // is where it would roll without sliding.
  Point place(int i, const Rotation& turn) const {
    return places_[i].tip + model_.tree->tips[i].radius * cross(places_[i].normal, turned(i, turn));
  }
  // Add to `pull_` a spring that turns the link of a touching tip back: what rolls comes to edges.
  void keep_from_rolling(int i, const HandState& state) {
    const int link = model_.tree->tips[i].link;
    const Rotation turn = Rotation::of_quaternion(state.target().quaternion);
    const Point back = -(turn * turned(i, turn));
    model_.posture.each_turning_joint(
        link, [&](int j, const Point& turns) { pull_[j] += roll_[j].gain * dot(turns, back); });
  }
  const Rotation& link_frame(int i) const {
    return model_.posture.frames[model_.tree->tips[i].link];
  }
  // Force of a spring and damper from tip i to a goal that moves with a body, base frame.
  Point pull(int i, const Spring& spring, const Point& goal, const BodyRow& body,
             const HandState& state) const {
    const Point& tip = model_.tips[i];
    const Point speed =
        model_.posture.velocity(model_.tree->tips[i].link, tip, state[RATES].data()) -
        body.velocity(tip);
    const Point force = spring.gain * (goal - tip) - spring.damping * speed;
    const double size = length(force);
    return size > spring.limit ? (spring.limit / size) * force : force;
  }
};

}  // namespace grasp
