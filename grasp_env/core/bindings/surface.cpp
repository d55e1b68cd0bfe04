// Surfaces of objects.
#include <nanobind/stl/string.h>

#include <grasp/hand/surface.hpp>

#include "buffers.hpp"
#include "views.hpp"

using namespace grasp;

namespace {

Surface make(const std::string& kind, nb::handle numbers, nb::handle triangles, nb::handle normals) {
    const Numbers size = in(numbers, 3), corners = in(triangles, -1, 3, 3), outward = in(normals, corners.length(0), 3);
    const double* n = size.data();
    if (kind == "cuboid") return {Cuboid{point(n)}};
    if (kind == "cylinder") return {Cylinder{n[0], n[1]}};
    if (kind == "sphere") return {Capsule{n[0], 0.0}};
    if (kind == "capsule") return {Capsule{n[0], n[1]}};
    if (kind != "mesh" || corners.length(0) == 0)
        throw nb::value_error("cuboid, cylinder, sphere, capsule or mesh; a mesh with faces");
    Mesh mesh;
    for (Py_ssize_t f = 0; f < corners.length(0); ++f) {
        const double* at = corners.data() + 9 * f;
        mesh.faces.push_back({point(at), point(at + 3) - point(at), point(at + 6) - point(at), point(outward.data() + 3 * f)});
    }
    auto each = std::make_shared<std::vector<Point>>();
    for (const Face& face : mesh.faces)
        for (const Point& corner : {face.corner, face.corner + face.b, face.corner + face.c})
            if (std::none_of(each->begin(), each->end(), [&](const Point& known) { return length(known - corner) < 1e-12; }))
                each->push_back(corner);
    mesh.corners = std::move(each);
    return {mesh};
}

nb::typed<nb::tuple, nb::ndarray<>, nb::ndarray<>, double> nearest(const Surface& surface, nb::handle center) {
    const Nearest found = surface.nearest(point(in(center, 3).data()));
    return nb::make_tuple(array_of(found.point), array_of(found.inward), found.distance);
}

}  // namespace

void bind_surface(nb::module_& m) {
    nb::class_<Surface>(m, "Surface", "A convex surface, body frame; the axis of cylinders and capsules is y.")
        .def_static(
            "make", &make, "kind"_a, "numbers"_a, "triangles"_a, "normals"_a,
            "numbers (3,) [m]: cuboid, half its sides; cylinder, radius and half its height; sphere, radius; capsule, radius\n"
            "and half its axis. Of a mesh (F, 3, 3) corners [m], from outside counterclockwise, and (F, 3) OUTWARD normals.")
        .def("nearest", &nearest, "center"_a,
             "The nearest point [m], (3,), the INWARD unit normal there and the distance [m], below 0 inside. Where several\n"
             "points are as near, one of them; on edges the normal is the direction to them.");
}
