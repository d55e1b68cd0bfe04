// Gaps of segments, and the linear program of the grasp search.
#include <grasp/grasp_search.hpp>

#include "arrays.hpp"

using namespace grasp;

namespace {

Point three(const In& a) { return point(numbers(a, 3)); }

double least_normal_force(In points, In normals, double friction, double length, In load) {
    const size_t count = points.size() / 3;
    std::vector<Place> places(count);
    std::vector<const Place*> chosen;
    for (size_t i = 0; i < count; ++i) {
        places[i].point = point(points.data() + 3 * i), places[i].normal = point(numbers(normals, 3 * count) + 3 * i);
        chosen.push_back(&places[i]);
    }
    Vec6 y;
    return least_force(chosen, {friction, length, {}, 0.0}, six(load), y);
}

}  // namespace

void bind_grasping(nb::module_& m) {
    m.def(
        "segment_gap", [](In a, In b, In c, In d) { return gap({three(a), three(b)}, {three(c), three(d)}); }, "a"_a, "b"_a,
        "c"_a, "d"_a, "Of a-b and c-d.");
    m.def(
        "surface_gap", [](const Surface& surface, In a, In b) { return gap(surface, {three(a), three(b)}); }, "surface"_a, "a"_a,
        "b"_a, "Of a-b; a `core.Surface`.");
    m.def("least_force", &least_normal_force, "points"_a, "normals"_a, "friction"_a, "length"_a, "load"_a,
          "inf: none was found.");
}
