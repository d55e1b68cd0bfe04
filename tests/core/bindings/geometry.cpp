// Contact frames, contacts in their place and their inverses.
#include <nanobind/stl/optional.h>

#include "arrays.hpp"

using namespace grasp;

namespace {

nb::object frame(In normal, std::optional<In> along) {
  const Frame axes(point(numbers(normal, 3)), along ? numbers(*along, 3) : nullptr);
  std::vector<double> out(9);
  for (int a = 0; a < 3; ++a)
    for (int r = 0; r < 3; ++r) out[3 * r + a] = axes[a][r];
  return array(out, {3, 3});
}

Placement place(In positions, In normals, In scale, In weights, std::optional<In> torsion) {
  const int count = int(positions.size() / 3);
  const size_t size = 3 * count;
  Contacts contacts(count, numbers(scale, size), numbers(weights, 2 * count), nullptr,
                    torsion ? numbers(*torsion, count) : nullptr);
  const Placing placed = contacts.place(numbers(positions, size), numbers(normals, size));
  return {contacts, placed};
}

nb::dict arrays_of(const Placement& p) {
  const Contacts& c = p.contacts;
  const size_t count = c.count;
  const size_t size = 3 * count;
  nb::dict out;
  std::vector<double> orthonormal;
  c.orthonormal(orthonormal);
  out["frames"] = array(c.frames, {count, 3, 3});
  out["divisor"] = array(c.divisor, {count, 3});
  out["matrix"] = array(c.matrix, {6, size});
  out["rows"] = array(c.rows, {6, size});
  out["inverse"] = array(c.inverse, {size, 6});
  out["orthonormal"] = array(orthonormal, {6, size});
  return out;
}

}  // namespace

void bind_geometry(nb::module_& m) {
  m.def("frame", &frame, "normal"_a, "along"_a = nb::none(), "(3, 3) columns (n, o, t).");
  nb::class_<Placement>(m, "Placement")
      .def_prop_ro(
          "verdict", [](const Placement& p) { return int(p.placed); },
          "0: good, 1: refused, 2: rank lost, 3: needs torsion.")
      .def_prop_ro("arrays", &arrays_of);
  m.def("place", &place, "positions"_a, "normals"_a, "scale"_a, "weights"_a,
        "torsion"_a = nb::none());
}
