// A place on an object that a finger can touch, and its requirements.
#pragma once
#include <grasp/planner/clearance.hpp>

namespace grasp {

// Margins that a place must keep.
struct Margins {
  double flat;       // [m] of flat surface around it
  double joints;     // [rad] from the joint limits
  double clearance;  // [m] between the links and the object
  double pieces;     // [m] largest distance of a mesh's convex pieces from the mesh at the tip
};

// Requirements on a grasp. Wrenches are (force, moment / length) [N].
struct Demand {
  double friction;
  double length;            // [m]
  std::vector<Vec6> loads;  // wrenches that the contacts must make; 0 is inside their convex hull
  double space;             // between fingers [m]
  double torsion = 0.0;     // moment about the normal over normal force, soft contacts [m]
  double start = 0.0;       // [m] between tip and object before the fingers close
  Point gravity{0.0, 0.0, 0.0};  // [m/s^2]
};

// [m] clearance of the rest of a fingertip, which moves with its sphere
inline constexpr double TIP_CLEARANCE = 1e-3;
inline constexpr double PI = 3.14159265358979323846;
// [N] that weighs as much as a joint at its torque limit
inline constexpr double FORCE_AT_LIMIT = 30.0;

// A start inside the object [m], and an offset of the direction towards the finger. Meshes, and
// fingers that only close, use the six random numbers in [0, 1) instead.
struct Ray {
  Point start, aside;
  Vec6 draws;
};

struct Place {
  Point point, normal;          // [m], inward
  std::vector<Placed> limbs;    // of the finger at this place
  std::vector<double> replies;  // see `search.hpp`
  // of the finger's joints at this place, and before closing if known [rad]
  std::vector<double> angles, start;
  // for joints that may reach their limit: fraction of the remaining torque that 1 N uses, times
  // `FORCE_AT_LIMIT`
  std::vector<Point> efforts;

  // Cost of a force [N]: 1 per newton along the normal, or more by the most loaded joint.
  double cost(const Point& force) const {
    double most = 1.0;
    for (const Point& effort : efforts) most = std::max(most, std::abs(dot(effort, force)));
    return most;
  }
};

// Numbers of rays that failed: at an edge, out of reach, near a joint limit, with a link at the
// object, without room to start, or with too little push.
struct Misses {
  int edge = 0, far = 0, limit = 0, touching = 0, start = 0, weak = 0;
};

}  // namespace grasp
