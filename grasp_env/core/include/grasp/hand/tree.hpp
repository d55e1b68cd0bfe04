// A hand as a tree of links, each moved by a joint: their positions and motion, and the torques of
// forces on them.
#pragma once
#include <array>
#include <algorithm>
#include <memory>
#include <numeric>
#include <span>
#include <grasp/hand/rotation.hpp>

namespace grasp {

struct Link {
  int parent;                         // link that carries it, with a smaller index; -1: the palm
  Point offset;                       // of its joint in the parent's frame [m]
  Rotation rotation;                  // of its frame at angle 0 relative to the parent's
  Point axis;                         // of its joint, unit vector in its own frame
  double mass;                        // [kg]
  Point center;                       // of mass, in its own frame [m]
  double lower, upper, torque_limit;  // [rad], [rad], [N m]; for a sliding joint [m], [m], [N]
  bool sliding = false;               // moves along its axis
  int driver = -1;  // joint that it is coupled to, itself free: angle = ratio * its angle + shift
  double ratio = 1.0, shift = 0.0;
  // xx, xy, xz, yy, yz, zz about the centre of mass [kg m^2], in its own frame
  std::array<double, 6> inertia{};

  bool coupled() const { return driver >= 0; }
};

// The sphere with which a finger touches.
struct Tip {
  int link;
  Point center;   // [m], the link's frame
  double radius;  // [m]
};

struct Tree {
  std::vector<Link> links;  // M; joint j moves link j
  std::vector<Tip> tips;    // N

  int joints() const { return int(links.size()); }
  int fingers() const { return int(tips.size()); }
  // Why the tree is invalid, or null.
  const char* fault() const {
    for (int j = 0; j < joints(); ++j) {
      const Link& link = links[j];
      if (link.parent >= j || link.parent < -1) return "parents must come before their links";
      if (link.driver >= joints() || (link.coupled() && links[link.driver].coupled()))
        return "a joint must be coupled to one that is not coupled itself";
    }
    for (const Tip& tip : tips)
      if (tip.link < 0 || tip.link >= joints()) return "a tip must be on a link";
    return nullptr;
  }
  // Set the coupled joints of angles (M,) from their drivers.
  void couple(double* angles) const {
    for (int j = 0; j < joints(); ++j)
      if (const Link& link = links[j]; link.coupled())
        angles[j] = link.ratio * angles[link.driver] + link.shift;
  }
  // The joint whose motor moves a joint.
  int mover(int joint) const { return links[joint].coupled() ? links[joint].driver : joint; }
  // The joints whose motors move a fingertip, ascending; drivers may be in another finger.
  std::vector<int> movers(int finger) const {
    std::vector<int> out;
    for (int j = tips[finger].link; j >= 0; j = links[j].parent) out.push_back(mover(j));
    std::sort(out.begin(), out.end());
    out.erase(std::unique(out.begin(), out.end()), out.end());
    return out;
  }
  // Number of these fingers that the motor of each joint moves, (M,).
  std::vector<int> fingers_per_motor(const std::vector<int>& fingers) const {
    std::vector<int> out(joints());
    for (int i : fingers)
      for (int j : movers(i)) ++out[j];
    return out;
  }
  std::vector<int> all_fingers() const {
    std::vector<int> out(fingers());
    std::iota(out.begin(), out.end(), 0);
    return out;
  }
  // The finger whose tip is on a link; -1: none.
  int finger_at(int link) const {
    for (int i = fingers() - 1; i >= 0; --i)
      if (tips[i].link == link) return i;
    return -1;
  }

  // The tree of one finger: its own joints, whose indices are written to `joints`. Of those coupled
  // to a joint of another finger, the first becomes free, with that joint's limits and motor, and
  // the others follow it.
  Tree chain(int finger, std::vector<int>& joints) const {
    joints.clear();
    for (int j = tips[finger].link; j >= 0; j = links[j].parent) joints.insert(joints.begin(), j);
    Tree out{{}, {tips[finger]}};
    for (int j : joints) {
      out.links.push_back(links[j]);
      Link& link = out.links.back();
      link.parent = int(out.links.size()) - 2;
      if (!link.coupled()) continue;
      const auto driver = std::find(joints.begin(), joints.end(), link.driver);
      const auto first = std::find_if(joints.begin(), joints.end(),
                                      [&](int k) { return links[k].driver == link.driver; });
      if (driver == joints.end() && *first == j) {
        const Link& motor = links[link.driver];
        const auto [low, high] = std::minmax({link.ratio * motor.lower, link.ratio * motor.upper});
        link.lower = low + link.shift;
        link.upper = high + link.shift;
        link.torque_limit = motor.torque_limit / std::abs(link.ratio);
        link.driver = -1;
      } else if (driver == joints.end()) {
        link.driver = int(first - joints.begin());
        link.ratio /= links[*first].ratio;
        link.shift -= link.ratio * links[*first].shift;
      } else {
        link.driver = int(driver - joints.begin());
      }
    }
    out.tips[0].link = int(joints.size()) - 1;
    return out;
  }
};

// Positions of all links, world frame.
class Posture {
 public:
  std::vector<Rotation> frames;      // link frame to world frame
  std::vector<Point> origins, axes;  // of the joints [m], unit

  explicit Posture(std::shared_ptr<const Tree> tree)
      : frames(tree->joints()),
        origins(tree->joints()),
        axes(tree->joints()),
        tree_(std::move(tree)) {}

  // angles: (M,) [rad]
  void trace(const double* angles) {
    for (int j = 0; j < tree_->joints(); ++j) {
      const Link& link = tree_->links[j];
      const bool carried = link.parent >= 0;
      const Rotation rest = carried ? frames[link.parent] * link.rotation : link.rotation;
      origins[j] = at(link.parent, link.offset);
      axes[j] = rest * link.axis;
      if (link.sliding) {
        origins[j] += angles[j] * axes[j];
        frames[j] = rest;
      } else
        frames[j] = rest.turned(link.axis, angles[j]);
    }
  }

  // World position of a point in a link's frame; -1: the palm's frame, which is the world's.
  Point at(int link, const Point& local) const {
    return link < 0 ? local : origins[link] + frames[link] * local;
  }
  Point tip(int finger) const { return at(tree_->tips[finger].link, tree_->tips[finger].center); }

  // Call f(j, velocity of a point of the link per speed of joint j); a coupled joint counts for its
  // driver.
  template <class F> void each_moving_joint(int link, const Point& place, F&& f) const {
    for (int j = link; j >= 0; j = tree_->links[j].parent) {
      const Link& joint = tree_->links[j];
      const Point moves = joint.sliding ? axes[j] : cross(axes[j], place - origins[j]);
      if (joint.coupled())
        f(joint.driver, joint.ratio * moves);
      else
        f(j, moves);
    }
  }
  // Call f(j, angular velocity of the link per speed of joint j), world frame.
  template <class F> void each_turning_joint(int link, F&& f) const {
    for (int j = link; j >= 0; j = tree_->links[j].parent) {
      const Link& joint = tree_->links[j];
      if (!joint.sliding) f(tree_->mover(j), joint.coupled() ? joint.ratio * axes[j] : axes[j]);
    }
  }
  // Write the Jacobian (3, M) of a point.
  void jacobian(int link, const Point& place, double* out) const {
    const int count = tree_->joints();
    std::fill(out, out + 3 * count, 0.0);
    each_moving_joint(link, place, [&](int j, const Point& moves) {
      for (int k = 0; k < 3; ++k) out[count * k + j] += moves[k];
    });
  }
  // Velocity [m/s] of a point fixed to the link; rates: (M,) [rad/s].
  Point velocity(int link, const Point& place, const double* rates) const {
    Point out{0.0, 0.0, 0.0};
    each_moving_joint(link, place, [&](int j, const Point& moves) { out += rates[j] * moves; });
    return out;
  }
  // torques (M,) += J^T force, as the link pushes at that point.
  void push(int link, const Point& place, const Point& force, double* torques) const {
    each_moving_joint(link, place,
                      [&](int j, const Point& moves) { torques[j] += dot(moves, force); });
  }
  // torques (M,) += those of a moment [N m] of the link.
  void twist(int link, const Point& moment, double* torques) const {
    each_turning_joint(link, [&](int j, const Point& turns) { torques[j] += dot(turns, moment); });
  }
  // torques (M,) that carry the weight of all links [N m]; gravity [m/s^2].
  void support(const Point& gravity, double* torques) const {
    std::fill_n(torques, tree_->joints(), 0.0);
    for (int j = 0; j < tree_->joints(); ++j) {
      const Link& link = tree_->links[j];
      push(j, at(j, link.center), -link.mass * gravity, torques);
    }
  }
  // At angles (M,): positions of the links, Jacobian (N, 3, M) of the points (N, 3) where the tips
  // touch, supporting torques.
  void statics(const double* angles, std::span<const double> points, const Point& gravity,
               std::span<double> jacobian, std::span<double> torques) {
    const int count = tree_->joints();
    trace(angles);
    for (int i = 0; i < tree_->fingers(); ++i)
      this->jacobian(tree_->tips[i].link, point(&points[3 * i]), &jacobian[3 * count * i]);
    support(gravity, torques.data());
  }

  // Write the mass matrix (M, M) [kg m^2]: kinetic energy = 1/2 rates^T out rates. Rows and columns
  // of coupled joints are zero.
  void mass_matrix(double* out) const {
    const int count = tree_->joints();
    std::vector<Point> moves(count);
    std::vector<Point> turns(count);
    std::fill(out, out + count * count, 0.0);
    for (int l = 0; l < count; ++l) {
      const Link& link = tree_->links[l];
      std::fill(moves.begin(), moves.end(), Point{0.0, 0.0, 0.0});
      std::fill(turns.begin(), turns.end(), Point{0.0, 0.0, 0.0});
      each_moving_joint(l, at(l, link.center), [&](int j, const Point& a) { moves[j] += a; });
      each_turning_joint(l, [&](int j, const Point& a) { turns[j] += frames[l].transposed(a); });
      const Sym3<double> inertia = inertia_of(link);
      for (int j = 0; j < count; ++j)
        for (int k = 0; k < count; ++k)
          out[count * j + k] +=
              link.mass * dot(moves[j], moves[k]) + dot(turns[j], inertia * turns[k]);
    }
  }
  // Write the momentum (M,) [N m s], the mass matrix times the rates (M,) [rad/s], without
  // allocating. A coupled joint counts for its driver.
  void momentum(const double* rates, double* out) const {
    std::fill_n(out, tree_->joints(), 0.0);
    for (int l = 0; l < tree_->joints(); ++l) {
      const Link& link = tree_->links[l];
      const Point center = at(l, link.center);
      Point turning{0.0, 0.0, 0.0};
      each_turning_joint(l, [&](int j, const Point& a) { turning += rates[j] * a; });
      push(l, center, link.mass * velocity(l, center, rates), out);
      twist(l, frames[l] * (inertia_of(link) * frames[l].transposed(turning)), out);
    }
  }

 private:
  std::shared_ptr<const Tree> tree_;

  // About the centre of mass, in the link's frame.
  static Sym3<double> inertia_of(const Link& link) {
    const auto& i = link.inertia;
    return {i[0], i[1], i[2], i[3], i[4], i[5]};
  }
};

}  // namespace grasp
