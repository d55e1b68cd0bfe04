// A hand at an update: where its links and contacts are, and the joint torques of forces.
#pragma once
#include <grasp/hand/hand_state.hpp>
#include <grasp/hand/tree.hpp>
#include <grasp/problem.hpp>

namespace grasp {

// Call f for each finger of a mask.
template <class F> void each_finger(std::uint64_t mask, F&& f) {
  for (; mask; mask &= mask - 1) f(std::countr_zero(mask));
}

// N fingertips, M joints. The constructor allocates.
class HandModel {
 public:
  const std::shared_ptr<const Tree> tree;
  const std::vector<double> limits;  // (M,) torques that the motors give [N m]
  Posture posture;                   // base frame
  Rotation turn;                     // object frame to base frame
  // (N,) centres of the tips, contact points [m], base frame
  std::vector<Point> tips, touch;
  std::vector<double> frames;    // (N, 3, 3) contact frames, columns (n, o, t), object frame
  std::vector<double> carrying;  // (M,) torques that carry the hand's links, with damping [N m]
  // (M,) all torques besides those of contact forces: `carrying`, and springs that come first
  std::vector<double> bias;

  HandModel(std::shared_ptr<const Tree> hand, std::vector<double> motors, bool soft)
      : tree(std::move(hand)),
        limits(std::move(motors)),
        posture(tree),
        tips(tree->fingers()),
        touch(tips),
        frames(9 * tree->fingers()),
        carrying(tree->joints()),
        bias(carrying),
        motor_(tree->joints(), -1),
        rows_(soft ? 6 : 3) {
    for (int j = 0; j < tree->joints(); ++j)
      if (!tree->links[j].coupled()) {
        motor_[j] = int(motor_limits_.size());
        motor_limits_.push_back(limits[j]);
      }
    motor_bias_.resize(motor_limits_.size());
    jacobian_.resize(rows_ * tree->fingers() * motor_limits_.size());
  }

  // damping: of every joint [N m s/rad]
  void look(const HandState& state, double damping) {
    const BodyRow& object = state.object();
    posture.trace(state[ANGLES].data());
    posture.support(point(state[GRAVITY].data()), carrying.data());
    if (damping > 0.0)
      for (int j = 0; j < tree->joints(); ++j) carrying[j] -= damping * state[RATES][j];
    bias = carrying;
    turn = Rotation::of_quaternion(object.quaternion);
    for (int i = 0; i < tree->fingers(); ++i) {
      tips[i] = posture.tip(i);
      touch[i] = object.position + turn * state.position(i);
      const Frame frame(state.normal(i));
      for (int a = 0; a < 3; ++a)
        for (int k = 0; k < 3; ++k) frames[9 * i + 3 * k + a] = frame[a][k];
    }
  }
  // The bias is `carrying` with the torques of springs, (M,) [N m].
  void set_bias(const std::vector<double>& springs) {
    for (std::size_t j = 0; j < bias.size(); ++j) bias[j] = carrying[j] + springs[j];
  }
  // Axis a of the contact frame of finger i, object frame.
  Point axis(int i, int a) const {
    return {frames[9 * i + a], frames[9 * i + 3 + a], frames[9 * i + 6 + a]};
  }

  // out (M,) = bias + torques of the fingers of a mask with forces (N, 3) [N], contact frames, and
  // torsion (N,) [N m].
  void torques_of(std::uint64_t mask, const double* forces, const double* torsion,
                  std::vector<double>& out) const {
    std::copy(bias.begin(), bias.end(), out.begin());
    each_finger(mask, [&](int i) {
      Point push{0.0, 0.0, 0.0};
      for (int k = 0; k < 3; ++k) push += forces[3 * i + k] * axis(i, k);
      posture.push(tree->tips[i].link, touch[i], turn * push, out.data());
      if (torsion[i] != 0.0)
        posture.twist(tree->tips[i].link, torsion[i] * (turn * axis(i, 0)), out.data());
    });
  }
  // True if the motors can give torques (M,) within `part` of their limits.
  bool can_give(const std::vector<double>& torques, double part) const {
    for (int j = 0; j < tree->joints(); ++j)
      if (!(std::abs(torques[j]) <= part * limits[j])) return false;
    return true;
  }
  // The largest share of `more` that the limits allow in addition to torques, both (M,).
  double share_within(const std::vector<double>& more, const std::vector<double>& torques) const {
    double share = 1.0;
    for (int j = 0; j < tree->joints(); ++j) {
      if (more[j] == 0.0) continue;
      const double room = limits[j] - std::copysign(torques[j], torques[j] * more[j]);
      share = std::min(share, std::max(room, 0.0) / std::abs(more[j]));
    }
    return share;
  }

  // (J,) limits of the joints that have motors [N m]
  std::span<const double> motor_limits() const { return motor_limits_; }
  // (N, 3 or 6, J) object frame: zero until `limited` fills it
  std::span<const double> jacobian() const { return jacobian_; }
  // These contacts with the motors' Jacobian and bias.
  Changes limited(Changes contacts) {
    const std::size_t joints = motor_limits_.size();
    std::fill(jacobian_.begin(), jacobian_.end(), 0.0);
    each_finger(contacts.contacts, [&](int i) {
      const auto add = [&](std::size_t row, int j, const Point& moves) {
        const Point there = turn.transposed(moves);
        for (int k = 0; k < 3; ++k)
          jacobian_[joints * (rows_ * i + row + k) + motor_[j]] += there[k];
      };
      const int link = tree->tips[i].link;
      posture.each_moving_joint(link, touch[i],
                                [&](int j, const Point& moves) { add(0, j, moves); });
      if (rows_ == 6)
        posture.each_turning_joint(link, [&](int j, const Point& turns) { add(3, j, turns); });
    });
    for (int j = 0; j < tree->joints(); ++j)
      if (motor_[j] >= 0) motor_bias_[motor_[j]] = bias[j];
    contacts.jacobian = jacobian_;
    contacts.torque_bias = motor_bias_;
    return contacts;
  }

 private:
  std::vector<int> motor_;  // (M,) index of a joint's motor; -1: coupled
  std::size_t rows_;
  std::vector<double> motor_limits_, motor_bias_, jacobian_;
};

}  // namespace grasp
