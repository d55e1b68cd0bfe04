// The search for contacts with which a hand holds an object.
#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <grasp/planner/search.hpp>

#include "buffers.hpp"

using namespace grasp;

namespace {

using Three = std::array<double, 3>;
using Nine = std::array<double, 9>;
using Row = std::array<double, 6>;
using Ends = std::array<int, 6>;

Limb make_line(int link, const Three& start, const Three& end, double radius, bool tip) {
  return {link, Solid::of(Segment{point(start.data()), point(end.data())}, radius), tip};
}

Limb make_solid(int link, const std::string& kind, const Three& half, const Three& center,
                const Nine& rotation, nb::handle corners, bool tip) {
  const Rotation frame = Rotation::from(rotation.data());
  const Numbers rows = in(corners, -1, 3);
  if (kind == "box" || kind == "cylinder")
    return {link,
            Solid::of(kind == "box" ? Solid::Core::box : Solid::Core::cylinder, point(half.data()),
                      0.0, point(center.data()), frame),
            tip};
  if (kind != "hull" || rows.length(0) < 4)
    throw nb::value_error("kind must be box, cylinder or hull; a hull needs corners");
  std::vector<Point> points;
  for (Py_ssize_t k = 0; k < rows.length(0); ++k) points.push_back(point(rows.data() + 3 * k));
  return {link,
          Solid::hull(std::make_shared<const std::vector<Point>>(std::move(points)),
                      point(center.data()), frame),
          tip};
}

using Pairs = std::vector<std::pair<int, int>>;

void check(const Tree& tree, int link) {
  if (link < -1 || link >= tree.joints())
    throw nb::value_error("a limb belongs to a link, or to the palm: -1");
}

std::shared_ptr<HandLimbs> make_hand(const std::shared_ptr<Tree>& tree,
                                     const std::vector<Limb>& limbs, nb::handle home,
                                     const Pairs& together) {
  for (const Limb& limb : limbs) check(*tree, limb.link);
  for (const auto& [a, b] : together) {
    check(*tree, a);
    check(*tree, b);
  }
  return std::make_shared<HandLimbs>(tree, limbs, IgnoredPairs(*tree, together),
                                     in(home, tree->joints()).data());
}

std::vector<std::tuple<int, int, double>> link_gaps(const HandLimbs& hand, nb::handle angles,
                                                    double enough) {
  const int joints = hand.tree->joints();
  const Numbers numbers = in(angles, joints);
  std::vector<double> there(numbers.data(), numbers.data() + joints);
  hand.tree->couple(there.data());
  Posture posture(hand.tree);
  posture.trace(there.data());
  std::vector<std::tuple<int, int, double>> out;
  std::vector<Placed> before;
  for (const Limb& limb : hand.all) {
    const Placed placed = limb.at(posture);
    for (std::size_t e = 0; e < before.size(); ++e) {
      const int other = hand.all[e].link;
      if (hand.together(limb.link, other)) continue;
      if (const double least = gap(placed, before[e], enough); least <= enough)
        out.emplace_back(std::min(limb.link, other), std::max(limb.link, other), least);
    }
    before.push_back(placed);
  }
  return out;
}

void beside(const HandLimbs& hand, int finger, nb::handle angles, nb::handle middles, double enough,
            nb::handle gaps) {
  check_index(finger, hand.fingers.size(), "no such finger");
  const int joints = hand.tree->joints();
  const Numbers postures = in(angles, -1, joints);
  const Numbers points = in(middles, postures.length(0), 3);
  const Numbers to = out(gaps, postures.length(0));
  Posture posture(hand.tree);
  for (Py_ssize_t k = 0; k < postures.length(0); ++k) {
    posture.trace(postures.data() + joints * k);
    to.data()[k] = hand.beside(finger, posture, point(points.data() + 3 * k), enough);
  }
}

std::vector<Vec6> sixes(nb::handle rows) {
  const Numbers numbers = in(rows, -1, 6);
  std::vector<Vec6> out(numbers.length(0));
  for (std::size_t r = 0; r < out.size(); ++r)
    std::copy_n(numbers.data() + 6 * r, 6, out[r].begin());
  return out;
}

GraspSearch make(const std::shared_ptr<HandLimbs>& hand, const Surface& surface, double friction,
                 double torsion, double length, double space, double start, const Three& gravity,
                 nb::handle loads, nb::handle directions) {
  return {hand,
          surface,
          {friction, length, sixes(loads), space, torsion, start, point(gravity.data())},
          sixes(directions)};
}

int fill(GraspSearch& search, int finger, nb::handle draws, const Row& spread,
         const std::array<double, 4>& margins, int most) {
  check_index(finger, search.groups.size(), "no such finger");
  std::vector<Ray> from;
  for (const Vec6& draw : sixes(draws)) {
    double ray[6];
    for (int k = 0; k < 6; ++k) ray[k] = (draw[k] - 0.5) * spread[k];
    from.push_back({point(ray), point(ray + 3), draw});
  }
  return search.fill(finger, from, {margins[0], margins[1], margins[2], margins[3]}, most);
}

int choose(GraspSearch& search, const std::vector<std::vector<int>>& picks, nb::handle forces,
           nb::handle points, nb::handle normals, nb::handle choices) {
  const std::size_t fingers = search.groups.size();
  for (const auto& row : picks)
    if (row.size() != fingers || std::ranges::any_of(row, [](int k) { return k < 0; }))
      throw nb::value_error("picks must be numbers >= 0, one per finger");
  for (const auto& places : search.groups)
    if (places.empty()) throw nb::value_error("a finger has no places");
  const Numbers f = out(forces, -1);
  const Numbers p = out(points, f.length(0), fingers, 3);
  const Numbers n = out(normals, f.length(0), fingers, 3);
  const Numbers c = out(choices, f.length(0), fingers);
  const auto chosen = search.choose(picks, int(f.length(0)));
  for (std::size_t r = 0; r < chosen.size(); ++r) {
    f.data()[r] = chosen[r].force;
    for (std::size_t i = 0; i < fingers; ++i) {
      const Place& place = search.groups[i][chosen[r].choice[i]];
      c.data()[fingers * r + i] = chosen[r].choice[i];
      for (int k = 0; k < 3; ++k) {
        p.data()[3 * (fingers * r + i) + k] = place.point[k];
        n.data()[3 * (fingers * r + i) + k] = place.normal[k];
      }
    }
  }
  return int(chosen.size());
}

int assemble(GraspSearch& search, const std::vector<int>& choice, double clearance,
             nb::handle angles, nb::handle start) {
  if (choice.size() != search.groups.size())
    throw nb::value_error("choice must be one place per finger");
  for (std::size_t i = 0; i < choice.size(); ++i)
    check_index(choice[i], search.groups[i].size(), "no such place");
  const Numbers there = out(angles, -1);
  return int(search.assemble(choice, clearance, there.data(), out(start, there.length(0)).data()));
}

}  // namespace

void bind_grasping(nb::module_& m) {
  nb::class_<Limb>(m, "Limb", "A convex shape fixed to a link; -1: the palm.")
      .def_static("line", &make_line, nb::kw_only(), "link"_a, "start"_a, "end"_a, "radius"_a,
                  "tip"_a,
                  "All points within a radius of a line [m], link frame; tip: part of a fingertip.")
      .def_static("solid", &make_solid, nb::kw_only(), "link"_a, "kind"_a, "half"_a, "center"_a,
                  "rotation"_a, "corners"_a, "tip"_a,
                  "kind: box, half its sides; cylinder about z, radius, radius and half its "
                  "height; hull, (K, 3) corners\n"
                  "relative to a point inside [m]. center [m] and rotation (9,), link frame.");
  nb::class_<HandLimbs>(m, "HandLimbs", "The limbs of a hand, and its fingers as separate trees.")
      .def_static("make", &make_hand, "tree"_a, "limbs"_a, "home"_a, "together"_a = Pairs{},
                  "home (M,) [rad]: start of the inverse kinematics; together: pairs of links that "
                  "may touch, -1: the palm.")
      .def(
          "moved",
          [](const HandLimbs& hand, const Nine& turn, const Three& shift, nb::handle home) {
            return std::make_shared<HandLimbs>(hand.moved(Rotation::from(turn.data()),
                                                          point(shift.data()),
                                                          in(home, hand.tree->joints()).data()));
          },
          "turn"_a, "shift"_a, "home"_a,
          "Return the same hand with its palm rotated (9,), then shifted [m], and with another "
          "rest posture (M,).")
      .def(
          "clearance",
          [](const HandLimbs& hand, const Surface& surface, nb::handle angles, double enough) {
            return hand.clearance(Obstacle(surface), in(angles, hand.tree->joints()).data(),
                                  enough);
          },
          "surface"_a, "angles"_a, "enough"_a = infinity,
          "Return the smallest distances [m] at angles (M,), at most `enough`: of the links, "
          "without the tips' spheres, from\n"
          "an object; of links and tips from one another.")
      .def("link_gaps", &link_gaps, "angles"_a, "enough"_a,
           "Return the pairs of limbs of different links, not of one joint, at most `enough` apart "
           "[m]:\n"
           "(link, link, distance). Coupled joints follow their drivers.")
      .def("beside", &beside, "finger"_a, "angles"_a, "middles"_a, "enough"_a, "gaps"_a,
           "Write (K,) distances, at most `enough` [m], of the rest of a finger and the palm in "
           "postures (K, M) from balls\n"
           "about `middles` (K, 3) that touch its tip.")
      .def_prop_ro(
          "free",
          [](const HandLimbs& hand) {
            std::vector<bool> out;
            for (const Finger& finger : hand.fingers) out.push_back(finger.free);
            return out;
          },
          "For each finger, True if its tip can go anywhere nearby.")
      .def(
          "palm_gap",
          [](const HandLimbs& hand, const Surface& surface) {
            return hand.palm_gap(Obstacle(surface));
          },
          "surface"_a, "Return the distance of the palm from an object [m].");
  nb::class_<GraspSearch>(m, "GraspSearch",
                          "A search for contacts with which a hand holds an object.")
      .def_static("make", &make, "hand"_a, "surface"_a, nb::kw_only(), "friction"_a, "torsion"_a,
                  "length"_a, "space"_a, "start"_a, "gravity"_a, "loads"_a, "directions"_a,
                  "The members of `grasp::Demand`, see planner/place.hpp, with loads (L, 6); "
                  "directions: (D, 6) to compare places.")
      .def("fill", &fill, "finger"_a, "draws"_a, "spread"_a, "margins"_a, "most"_a,
           "Find places of a finger anew and return their number.\n"
           "draws: (S, 6) in [0, 1); (draws - 1/2) * spread (6,) gives the start inside the object "
           "[m] and the offset of the\n"
           "direction towards the finger.\n"
           "margins: [m] of flat surface, [rad] from joint limits, [m] of clearance, [m] largest "
           "distance of a mesh's pieces.")
      .def("choose", &choose, "picks"_a, "forces"_a, "points"_a, "normals"_a, "choices"_a,
           "Find the best choice of each round: write its total normal force [N] in the worst case "
           "into (R,), points and\n"
           "normals into (R, N, 3), places into (R, N). Return the number of rounds. picks: random "
           "numbers >= 0 per finger\n"
           "for the initial choices.")
      .def(
          "misses",
          [](const GraspSearch& search, int finger) {
            const Misses& misses = search.misses.at(finger);
            return Ends{misses.edge,     misses.far,   misses.limit,
                        misses.touching, misses.start, misses.weak};
          },
          "finger"_a,
          "Return the number of rays that failed: at an edge, out of reach, near a joint limit, "
          "with a link at the object,\n"
          "without room to start, with too little push along the normal.")
      .def("assemble", &assemble, "choice"_a, "clearance"_a, "angles"_a, "start"_a,
           "Write the angles (M,) of the whole hand at a choice of places, and before it closes, "
           "as far as they exist. Return\n"
           "0, or the fault: 1 a link nearer to the object than `clearance` [m], 2 links touch, 3 "
           "no start, 4 and 5 as 1 and 2\n"
           "at the start, 6 fingers of one motor do not touch together.");
}
