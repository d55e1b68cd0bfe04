// The limbs of a whole hand: distances from an object and from one another.
#pragma once
#include <grasp/planner/places.hpp>

namespace grasp {

// The limbs of a hand, and its fingers as separate trees.
struct HandLimbs {
  std::shared_ptr<const Tree> tree;
  std::vector<Limb> all;
  IgnoredPairs together;
  std::vector<double> home;  // (M,) [rad]
  std::vector<Finger> fingers;

  HandLimbs(std::shared_ptr<const Tree> hand, std::vector<Limb> limbs, IgnoredPairs pairs,
            const double* rest)
      : tree(std::move(hand)),
        all(std::move(limbs)),
        together(std::move(pairs)),
        home(rest, rest + tree->joints()) {
    const std::vector<int> fingers_per_motor = tree->fingers_per_motor(tree->all_fingers());
    for (int i = 0; i < tree->fingers(); ++i)
      fingers.emplace_back(*tree, i, all, rest, fingers_per_motor);
  }

  // The same hand with its palm rotated, then shifted [m], and another rest posture.
  HandLimbs moved(const Rotation& turn, const Point& shift, const double* rest) const {
    auto hand = std::make_shared<Tree>(*tree);
    for (Link& link : hand->links)
      if (link.parent < 0) {
        link.offset = shift + turn * link.offset;
        link.rotation = turn * link.rotation;
      }
    std::vector<Limb> limbs = all;
    for (Limb& limb : limbs)
      if (limb.link < 0) limb.solid = limb.solid.moved(turn, shift);
    return {hand, std::move(limbs), together, rest};
  }

  // Smallest distances [m]: of the links, without the tips' spheres, from the object; of links and
  // tips from one another. Above `enough`, a lower bound.
  std::pair<double, double> clearance(const Obstacle& object, const double* angles,
                                      double enough = infinity) const {
    Posture posture(tree);
    posture.trace(angles);
    double away = enough, apart = enough;
    std::vector<Placed> there;
    there.reserve(all.size());
    for (const Limb& limb : all) {
      const Placed placed = limb.at(posture);
      if (!limb.is_sphere_of_tip()) {
        const double least = gap(object, placed, away);
        if (!limb.tip || least < TIP_CLEARANCE) away = std::min(away, least);
      }
      for (std::size_t e = 0; e < there.size(); ++e)
        if (!together(limb.link, all[e].link))
          apart = std::min(apart, gap(placed, there[e], apart));
      there.push_back(placed);
    }
    return {away, apart};
  }
  // Distance of the rest of a finger and the palm from a ball about `middle` that touches the tip;
  // at most `enough` [m].
  double beside(int finger, const Posture& posture, const Point& middle, double enough) const {
    const double radius = length(posture.tip(finger) - middle) - tree->tips[finger].radius;
    const Solid ball = Solid::of(Segment{middle, middle}, std::max(radius, 0.0));
    double least = enough;
    for (std::size_t c = 0; c < all.size(); ++c)
      if ((all[c].link < 0 || fingers[finger].carries(int(c))) && !all[c].is_sphere_of_tip())
        least = std::min(least, gap(Placed(ball), all[c].at(posture), least));
    return least;
  }
  double palm_gap(const Obstacle& object) const {
    double least = infinity;
    for (const Limb& limb : all)
      if (limb.link < 0) least = std::min(least, gap(object, Placed(limb.solid), least));
    return least;
  }
};

}  // namespace grasp
