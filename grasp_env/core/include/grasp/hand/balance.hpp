// The wrench that a grasp has to balance at a control tick.
#pragma once
#include <grasp/hand/snapshot.hpp>

namespace grasp {

// Target pose and motion of the object, world frame.
struct Target {
  BodyRow body;
  Point linear_acceleration{}, angular_acceleration{};  // [m/s^2], [rad/s^2]
  static constexpr int SIZE = 19;
};
static_assert(sizeof(Target) == Target::SIZE * sizeof(double));

// Error of the object against its target [m], [rad], [m/s], [rad/s], world frame.
struct PoseError {
  Point position, orientation, linear, angular;

  PoseError(const Snapshot& seen, const Target& target)
      : position(seen.position - target.body.position),
        orientation((seen.rotation * Rotation::of_quaternion(target.body.quaternion).transposed())
                        .vector()),
        linear(seen.linear - target.body.linear),
        angular(seen.angular - target.body.angular) {}
};

// The controller's model of the object, and the gains of its pose feedback.
struct Body {
  double mass = 0.0;  // [kg]
  Rotation inertia;   // (3, 3) [kg m^2] about its centre, object frame
  double position_gain = 0.0, position_damping = 0.0;  // [N/m], [N s/m]
  double rotation_gain = 0.0, rotation_damping = 0.0;  // [1/s^2], [1/s]: times the inertia

  // Weight - inertial wrench of the target motion + pose feedback [N, N m], object frame; gravity
  // [m/s^2], world.
  Vec6 wrench(const Snapshot& seen, const Target& target, const Point& gravity) const {
    const PoseError error(seen, target);
    const Point pull = position_gain * error.position + position_damping * error.linear;
    const Point force = seen.to_object(mass * (gravity - target.linear_acceleration) + pull);
    const Point twist = rotation_gain * error.orientation + rotation_damping * error.angular -
                        target.angular_acceleration;
    const Point turn = seen.to_object(target.body.angular);
    const Point moment = inertia * seen.to_object(twist) - cross(turn, inertia * turn);
    return {force.u, force.o, force.t, moment.u, moment.o, moment.t};
  }
};

}  // namespace grasp
