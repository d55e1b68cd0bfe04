// Distances of a hand's links from an object and from one another.
#pragma once
#include <grasp/planner/convex.hpp>
#include <grasp/hand/tree.hpp>

namespace grasp {

// An object, world frame: its surface, and convex solids whose union it is.
struct Obstacle {
  Surface surface;
  std::vector<Solid> solids;

  explicit Obstacle(Surface shape) : surface(std::move(shape)), solids(Solid::of(surface)) {}
};

// Distance of a placed limb from the object [m]; above `enough`, a lower bound.
inline double gap(const Obstacle& object, const Placed& limb, double enough = infinity) {
  const double radius = limb.solid->radius;
  if (limb.solid->is_line() && !object.surface.mesh())
    return gap(object.surface, limb.axis, enough + radius) - radius;
  double least = infinity;
  for (const Solid& solid : object.solids)
    least = std::min(least, gap(Placed(solid), limb, std::min(enough, least)));
  return least;
}
// True if a limb is closer to the object than `distance` [m].
inline bool is_closer(const Obstacle& object, const Placed& limb, double distance) {
  if (limb.solid->is_line() && !object.surface.mesh())
    return gap(object, limb, distance) < distance;
  return std::any_of(object.solids.begin(), object.solids.end(),
                     [&](const Solid& solid) { return is_closer(Placed(solid), limb, distance); });
}

// A solid that is fixed to a link.
struct Limb {
  int link;     // -1: the palm
  Solid solid;  // link frame
  bool tip;     // part of a fingertip, which may touch

  bool is_sphere_of_tip() const { return tip && solid.is_line(); }
  Placed at(const Posture& posture) const {
    return link < 0 ? Placed(solid) : Placed(solid, posture.origins[link], posture.frames[link]);
  }
};

// Pairs of links whose distance is not checked: of one joint, or always touching.
class IgnoredPairs {
 public:
  explicit IgnoredPairs(const Tree& tree, const std::vector<std::pair<int, int>>& pairs = {})
      : count_(tree.joints() + 1), pairs_(count_ * count_, 0) {
    for (int j = -1; j < tree.joints(); ++j) add(j, j);
    for (int j = 0; j < tree.joints(); ++j) add(j, tree.links[j].parent);
    for (const auto& [a, b] : pairs) add(a, b);
  }
  // a, b: links; -1: the palm
  bool operator()(int a, int b) const { return pairs_[count_ * (a + 1) + b + 1]; }

 private:
  int count_;
  std::vector<char> pairs_;

  void add(int a, int b) {
    pairs_[count_ * (a + 1) + b + 1] = pairs_[count_ * (b + 1) + a + 1] = 1;
  }
};

}  // namespace grasp
