// The search for contacts with which a hand holds an object.
#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/vector.h>

#include <grasp/grasp_search.hpp>

#include "buffers.hpp"

using namespace grasp;

namespace {

using Three = std::array<double, 3>;

void make_limb(Limb* limb, int link, const Three& start, const Three& end, double radius, bool tip) {
    new (limb) Limb{link, {point(start.data()), point(end.data())}, radius, tip};
}

std::shared_ptr<HandLimbs> make_hand(const std::shared_ptr<Tree>& tree, const std::vector<Limb>& limbs, nb::handle home) {
    for (const Limb& limb : limbs)
        if (limb.link < -1 || limb.link >= tree->joints()) throw nb::value_error("a limb is of a link, or of the palm: -1");
    return std::make_shared<HandLimbs>(tree, limbs, in(home, tree->joints()).data());
}

std::vector<Vec6> sixes(nb::handle rows) {
    const Numbers given = in(rows, -1, 6);
    std::vector<Vec6> out(given.length(0));
    for (std::size_t r = 0; r < out.size(); ++r) std::copy_n(given.data() + 6 * r, 6, out[r].begin());
    return out;
}

GraspSearch make(const std::shared_ptr<HandLimbs>& hand, const Surface& surface, double friction, double length, double space,
                 nb::handle loads, nb::handle directions) {
    return {hand, surface, {friction, length, sixes(loads), space}, sixes(directions)};
}

int fill(GraspSearch& search, int finger, nb::handle rays, const Three& margins, int most) {
    if (finger < 0 || finger >= int(search.pools.size())) throw nb::value_error("no such finger");
    std::vector<Ray> from;
    for (const Vec6& ray : sixes(rays)) from.push_back({point(ray.data()), point(ray.data() + 3)});
    return search.fill(finger, from, {margins[0], margins[1], margins[2]}, most);
}

int choose(GraspSearch& search, const std::vector<std::vector<int>>& picks, nb::handle forces, nb::handle points,
           nb::handle normals) {
    const std::size_t fingers = search.pools.size();
    for (const auto& row : picks)
        if (row.size() != fingers || std::any_of(row.begin(), row.end(), [](int k) { return k < 0; }))
            throw nb::value_error("picks: numbers >= 0, one per finger");
    for (const auto& pool : search.pools)
        if (pool.empty()) throw nb::value_error("a finger has no places");
    const Numbers f = out(forces, -1), p = out(points, f.length(0), fingers, 3), n = out(normals, f.length(0), fingers, 3);
    const auto found = search.choose(picks, int(f.length(0)));
    for (std::size_t r = 0; r < found.size(); ++r) {
        f.data()[r] = found[r].force;
        for (std::size_t i = 0; i < fingers; ++i) {
            const Place& place = search.pools[i][found[r].choice[i]];
            for (int k = 0; k < 3; ++k) {
                p.data()[3 * (fingers * r + i) + k] = place.point[k];
                n.data()[3 * (fingers * r + i) + k] = place.normal[k];
            }
        }
    }
    return int(found.size());
}

}  // namespace

void bind_grasping(nb::module_& m) {
    nb::class_<Limb>(m, "Limb", "A capsule that is fixed to a link.")
        .def("__init__", &make_limb, nb::kw_only(), "link"_a, "start"_a, "end"_a, "radius"_a, "tip"_a,
             "link: -1 for the palm; its axis [m] in the link's frame; tip: a fingertip's own sphere.");
    nb::class_<HandLimbs>(m, "HandLimbs", "The limbs of a hand, and its fingers one by one.")
        .def_static("make", &make_hand, "tree"_a, "limbs"_a, "home"_a, "home (M,) [rad]: where the inverse kinematics starts.")
        .def(
            "clearance",
            [](const HandLimbs& hand, const Surface& surface, nb::handle angles) {
                return hand.clearance(surface, in(angles, hand.tree->joints()).data());
            },
            "surface"_a, "angles"_a,
            "Least distances [m] at angles (M,): of the links, without fingertips, from an object; of links and tips from one\n"
            "another.")
        .def("palm_gap", &HandLimbs::palm_gap, "surface"_a, "Of the palm from an object [m].");
    nb::class_<GraspSearch>(m, "GraspSearch", "A search for contacts with which a hand holds an object.")
        .def_static("make", &make, "hand"_a, "surface"_a, nb::kw_only(), "friction"_a, "length"_a, "space"_a, "loads"_a,
                    "directions"_a,
                    "loads: (L, 6) that the contacts make, (force, moment / length) [N]; directions: (D, 6) to compare them in;\n"
                    "length, space between fingers [m].")
        .def("fill", &fill, "finger"_a, "rays"_a, "margins"_a, "most"_a,
             "Makes the pool of places of a finger anew, and returns their number.\n"
             "rays: (S, 6) where to begin inside the object [m], and what to add to the direction towards the finger.\n"
             "margins: [m] of flat surface, [rad] from joint limits, [m] of clearance.")
        .def("choose", &choose, "picks"_a, "forces"_a, "points"_a, "normals"_a,
             "The best choice of each round: the total normal force [N] that it needs in the worst case into (R,), points and\n"
             "normals into (R, N, 3); returns how many. picks: random numbers >= 0 per finger, of the choices to begin with.")
        .def(
            "misses",
            [](const GraspSearch& search, int finger) {
                const Misses& misses = search.misses.at(finger);
                return std::array<int, 3>{misses.edge, misses.far, misses.touching};
            },
            "finger"_a, "How many rays ended at an edge, out of reach, with a link at the object.");
}
