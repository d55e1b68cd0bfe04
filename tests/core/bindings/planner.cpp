// Distances of limbs and objects, and the linear program of the grasp search.
#include <grasp/planner/search.hpp>

#include "arrays.hpp"

using namespace grasp;

namespace {

Point three(const In& a) { return point(numbers(a, 3)); }
Vec6 six(const In& a) {
  Vec6 out;
  std::copy_n(numbers(a, 6), 6, out.begin());
  return out;
}

// efforts: (N, J, 3), see `Place`; none: (0,)
double least_normal_force(In points, In normals, double friction, double length, In load,
                          In efforts, double torsion) {
  const size_t count = points.size() / 3;
  std::vector<Place> places(count);
  std::vector<const Place*> chosen;
  for (size_t i = 0; i < count; ++i) {
    places[i].point = point(points.data() + 3 * i);
    places[i].normal = point(numbers(normals, 3 * count) + 3 * i);
    for (size_t j = 0; j < efforts.size() / (3 * count); ++j)
      places[i].efforts.push_back(point(efforts.data() + efforts.size() / count * i + 3 * j));
    chosen.push_back(&places[i]);
  }
  Vec6 y;
  return least_force(chosen, {friction, length, {}, 0.0, torsion}, six(load), y);
}

// Distance of two limbs, the second turned and then shifted.
double limb_gap(const Limb& a, const Limb& b, In turn, In shift, double enough) {
  const Solid moved = b.solid.moved(Rotation::from(numbers(turn, 9)), three(shift));
  return gap(Placed(a.solid), Placed(moved), enough);
}

double object_gap(const Surface& surface, const Limb& b, In turn, In shift, double enough) {
  const Solid moved = b.solid.moved(Rotation::from(numbers(turn, 9)), three(shift));
  return gap(Obstacle(surface), Placed(moved), enough);
}

}  // namespace

void bind_planner(nb::module_& m) {
  m.def(
      "segment_gap",
      [](In a, In b, In c, In d) { return gap({three(a), three(b)}, {three(c), three(d)}); }, "a"_a,
      "b"_a, "c"_a, "d"_a, "Of a-b and c-d.");
  m.def(
      "surface_gap",
      [](const Surface& surface, In a, In b) { return gap(surface, {three(a), three(b)}); },
      "surface"_a, "a"_a, "b"_a, "Of a-b; a `core.Surface`.");
  m.def("limb_gap", &limb_gap, "a"_a, "b"_a, "turn"_a, "shift"_a, "enough"_a = infinity,
        "The second turned, then shifted.");
  m.def("object_gap", &object_gap, "surface"_a, "b"_a, "turn"_a, "shift"_a, "enough"_a = infinity,
        "Of a `core.Surface`.");
  m.def("least_force", &least_normal_force, "points"_a, "normals"_a, "friction"_a, "length"_a,
        "load"_a, "efforts"_a, "torsion"_a, "inf: none.");
}
