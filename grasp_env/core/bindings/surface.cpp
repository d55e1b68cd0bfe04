// Surfaces of objects.
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <grasp/hand/surface.hpp>

#include "buffers.hpp"
#include "views.hpp"

using namespace grasp;

namespace {

Surface make(const std::string& kind, nb::handle numbers) {
  const Numbers size = in(numbers, 3);
  const double* n = size.data();
  if (kind == "cuboid") return {Cuboid{point(n)}};
  if (kind == "cylinder") return {Cylinder{n[0], n[1]}};
  if (kind == "sphere") return {Capsule{n[0], 0.0}};
  if (kind == "capsule") return {Capsule{n[0], n[1]}};
  throw nb::value_error("kind must be cuboid, cylinder, sphere or capsule");
}

std::vector<Point> points(nb::handle rows) {
  const Numbers numbers = in(rows, -1, 3);
  std::vector<Point> out(numbers.length(0));
  for (std::size_t k = 0; k < out.size(); ++k) {
    out[k] = point(numbers.data() + 3 * k);
    if (!(dot(out[k], out[k]) < infinity)) throw nb::value_error("corners must be finite");
  }
  return out;
}

Surface mesh(nb::handle corners, nb::handle faces, const std::vector<nb::object>& pieces) {
  const Numbers numbers = in(faces, -1, 3);
  std::vector<Mesh::Corners> triples(numbers.length(0));
  for (std::size_t f = 0; f < triples.size(); ++f)
    for (int k = 0; k < 3; ++k) {
      const double number = numbers.data()[3 * f + k];
      triples[f][k] = number >= 0.0 && number < 1e9 ? int(number) : -1;
    }
  std::vector<Piece> parts;
  for (const nb::object& piece : pieces) {
    std::vector<Point> around = points(piece);
    Point middle{};
    for (const Point& corner : around) middle += corner;
    if (around.empty()) throw nb::value_error("a piece has corners");
    middle = middle / double(around.size());
    for (Point& corner : around) corner -= middle;
    parts.push_back({middle, std::make_shared<const std::vector<Point>>(std::move(around))});
  }
  try {
    return {
        Faces{std::make_shared<const Mesh>(points(corners), std::move(triples), std::move(parts))}};
  } catch (const std::invalid_argument& error) {
    throw nb::value_error(error.what());
  }
}

nb::typed<nb::tuple, nb::ndarray<>, nb::ndarray<>, double> nearest(const Surface& surface,
                                                                   nb::handle center) {
  const Nearest nearest = surface.nearest(point(in(center, 3).data()));
  return nb::make_tuple(array_of(nearest.point), array_of(nearest.inward), nearest.distance);
}

}  // namespace

void bind_surface(nb::module_& m) {
  nb::class_<Surface>(m, "Surface",
                      "A surface, body frame; the axis of cylinders and capsules is y.")
      .def_static("make", &make, "kind"_a, "numbers"_a,
                  "numbers (3,) [m]: cuboid, half its sides; cylinder, radius and half its height; "
                  "sphere, radius;\n"
                  "capsule, radius and half the length of its axis.")
      .def_static("mesh", &mesh, "corners"_a, "faces"_a, "pieces"_a,
                  "A closed mesh: corners (V, 3) [m] and their indices (F, 3) as float64, "
                  "counterclockwise from outside;\n"
                  "pieces: corners (K, 3) [m] of convex pieces whose union is the solid.")
      .def("nearest", &nearest, "center"_a,
           "Return the nearest point (3,) [m], or one of them, the INWARD unit normal there and "
           "the distance [m],\n"
           "negative inside. On edges the normal is the direction to the point.");
}
