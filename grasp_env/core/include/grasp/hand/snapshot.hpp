// The state of a scene after a step of a simulator.
//
// The geometry follows from the current poses, spherical tips and the object's surface: an engine's
// contact points belong to the start of the step, and exist only for fingers that touch. Only the
// forces come from the engine.
#pragma once
#include <cstdint>
#include <span>
#include <grasp/hand/surface.hpp>
#include <grasp/hand/tree.hpp>

namespace grasp {

// A contact of the hand with the object, world frame.
struct ContactRow {
  double link;  // of the hand; -1: the palm
  Point place;  // [m]
  Point force;  // ON the object [N]
};

// One reading as flat numbers: angles (M,) [rad], rates (M,) [rad/s], a `BodyRow`, `ContactRow`s.
class Reading {
 public:
  static constexpr int BODY = sizeof(BodyRow) / sizeof(double),
                       CONTACT = sizeof(ContactRow) / sizeof(double);
  static constexpr int size(int joints, int contacts) {
    return 2 * joints + BODY + CONTACT * contacts;
  }

  Reading(const double* numbers, std::size_t count, int joints)
      : numbers_(numbers), joints_(joints), contacts_((int(count) - 2 * joints - BODY) / CONTACT) {}
  const double* angles() const { return numbers_; }
  const double* rates() const { return numbers_ + joints_; }
  const BodyRow& body() const { return *reinterpret_cast<const BodyRow*>(numbers_ + 2 * joints_); }
  std::span<const ContactRow> contacts() const {
    return {reinterpret_cast<const ContactRow*>(numbers_ + 2 * joints_ + BODY),
            std::size_t(contacts_)};
  }

 private:
  const double* numbers_;
  int joints_, contacts_;
};

// A hand, an object, and their state; N tips, M joints. Assignment allocates nothing.
class Snapshot {
 public:
  static constexpr double LOST_DISTANCE = 10.0;  // [m]; an object farther away has left the hand
  // [m] from the tip's contact point; farther contacts are the link's
  static constexpr double STRAY_DISTANCE = 5e-3;

  // the object's centre [m], its velocity [m/s], [rad/s], world
  Point position{}, linear{}, angular{};
  Rotation rotation;                  // object frame to world frame
  double stray = 0.0;                 // total force of other parts of the hand on the object [N]
  std::vector<double> angles, rates;  // (M,) [rad], [rad/s]
  // (N,) surface point nearest to each tip [m], inward unit normal there, object frame
  std::vector<Point> points, normals;
  // (N,) point of each tip nearest to the object, centre of the tip [m], world
  std::vector<Point> touch, tips;
  // (N,) distance of tip and object [m], tangential speed of the tip on the object [m/s]
  std::vector<double> gaps, slip;
  std::vector<Point> sliding;    // (N,) tangential velocity [m/s], object frame
  std::vector<double> touching;  // (N,) 1 if the tip carried force in the last step
  std::vector<Point> forces;     // (N,) measured force of each tip ON the object [N], object frame
  std::vector<double> gravity_torques;  // (M,) torques that carry the hand's links [N m]
  Posture posture;

  explicit Snapshot(const std::shared_ptr<const Tree>& tree)
      : angles(tree->joints()),
        rates(angles),
        points(tree->fingers()),
        normals(points),
        touch(points),
        tips(points),
        gaps(tree->fingers()),
        slip(gaps),
        sliding(points),
        touching(gaps),
        forces(points),
        gravity_torques(angles),
        posture(tree) {}

  // gravity: [m/s^2], world. Return false, with nothing changed, if numbers are not finite or the
  // object is far away.
  bool read(const Tree& tree, const Surface& surface, const Point& gravity,
            const Reading& reading) {
    const BodyRow& body = reading.body();
    double total = 0.0;
    for (int j = 0; j < 2 * tree.joints(); ++j) total += std::abs(reading.angles()[j]);
    for (const Point& a : {body.linear, body.angular, point(body.quaternion)}) total += dot(a, a);
    total += std::abs(body.quaternion[3]);
    for (const ContactRow& row : reading.contacts())
      total += dot(row.force, row.force) + dot(row.place, row.place);
    if (!(total < infinity && near(body.position))) return false;
    std::copy(reading.angles(), reading.angles() + tree.joints(), angles.begin());
    std::copy(reading.rates(), reading.rates() + tree.joints(), rates.begin());
    position = body.position;
    linear = body.linear;
    angular = body.angular;
    rotation = Rotation::of_quaternion(body.quaternion);
    place(tree, surface, gravity);
    measure(tree, reading.contacts());
    return true;
  }

  // Move the joints and the object on by a time each [s] at their velocities; forces stay. Without
  // this a delay removes damping: forces that press on a turned object as it was turn it further.
  void advance(const Tree& tree, const Surface& surface, const Point& gravity, double joint_time,
               double time) {
    for (int j = 0; j < tree.joints(); ++j)
      angles[j] = std::min(std::max(angles[j] + joint_time * rates[j], tree.links[j].lower),
                           tree.links[j].upper);
    position += time * linear;
    const double rate = length(angular);
    if (rate * time > 1e-12)
      rotation = Rotation{}.turned((1.0 / rate) * angular, rate * time) * rotation;
    place(tree, surface, gravity);
  }

  Point to_object(const Point& world) const { return rotation.transposed(world); }
  // Velocity of a point that moves with the object [m/s], world frame.
  Point object_velocity(const Point& world) const {
    return linear + cross(angular, world - position);
  }
  // Bits of the tips that touch.
  std::uint64_t mask() const {
    std::uint64_t out = 0;
    for (std::size_t i = 0; i < touching.size(); ++i) out |= std::uint64_t(touching[i] > 0.0) << i;
    return out;
  }

 private:
  static bool near(const Point& a) {
    return std::abs(a.u) < LOST_DISTANCE && std::abs(a.o) < LOST_DISTANCE &&
           std::abs(a.t) < LOST_DISTANCE;
  }

  void place(const Tree& tree, const Surface& surface, const Point& gravity) {
    posture.trace(angles.data());
    posture.support(gravity, gravity_torques.data());
    for (int i = 0; i < tree.fingers(); ++i) {
      const Tip& tip = tree.tips[i];
      tips[i] = posture.tip(i);
      const Nearest nearest = surface.nearest(to_object(tips[i] - position));
      points[i] = nearest.point;
      normals[i] = nearest.inward;
      gaps[i] = nearest.distance - tip.radius;
      const Point inward = rotation * nearest.inward;
      touch[i] = tips[i] + tip.radius * inward;
      const Point slides =
          posture.velocity(tip.link, touch[i], rates.data()) - object_velocity(touch[i]);
      sliding[i] = to_object(slides - dot(slides, inward) * inward);
      slip[i] = length(sliding[i]);
    }
  }

  void measure(const Tree& tree, std::span<const ContactRow> contacts) {
    stray = 0.0;
    std::fill(touching.begin(), touching.end(), 0.0);
    std::fill(forces.begin(), forces.end(), Point{0.0, 0.0, 0.0});
    for (const ContactRow& row : contacts) {
      const int finger = tree.finger_at(int(row.link));
      if (finger < 0 || length(row.place - touch[finger]) > STRAY_DISTANCE) {
        stray += length(row.force);
        continue;
      }
      if (length(row.force) > 0.0) touching[finger] = 1.0;
      forces[finger] += to_object(row.force);
    }
  }
};

// A hand and an object in a simulator, as last read.
struct Scene {
  std::shared_ptr<const Tree> tree;
  Surface surface;
  Point gravity;  // [m/s^2], world
  double mass;    // [kg] of the object
  Snapshot now;

  Scene(std::shared_ptr<const Tree> hand, Surface surface, const Point& gravity, double mass)
      : tree(std::move(hand)),
        surface(std::move(surface)),
        gravity(gravity),
        mass(mass),
        now(tree) {}
  bool read(const double* numbers, std::size_t count) {
    return now.read(*tree, surface, gravity, {numbers, count, tree->joints()});
  }
};

}  // namespace grasp
