// Frames, contacts and their inverses, internal forces.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include "allocations.hpp"
#include "arrays.hpp"

using namespace grasp;

namespace {

nb::object frame(In normal, std::optional<In> along) {
    const Frame made(point(numbers(normal, 3)), along ? numbers(*along, 3) : nullptr);
    std::vector<double> out(9);
    const Point* axes = &made.n;
    for (int a = 0; a < 3; ++a)
        for (int r = 0; r < 3; ++r) out[3 * r + a] = axes[a][r];
    return array(out, {3, 3});
}

Placement place(In positions, In normals, In scale, In weights, std::optional<In> tangents, std::optional<In> torsion) {
    const int count = int(positions.size() / 3);
    const size_t size = 3 * count;
    Contacts contacts(count, numbers(scale, size), numbers(weights, 2 * count), tangents ? numbers(*tangents, size) : nullptr,
                      torsion ? numbers(*torsion, count) : nullptr);
    const Placing placed = contacts.place(numbers(positions, size), numbers(normals, size));
    return {contacts, placed};
}
int move(Placement& p, In positions, In normals) {
    const size_t size = 3 * p.contacts.count;
    return int(p.placed = p.contacts.place(numbers(positions, size), numbers(normals, size)));
}

Placement from(In positions, In normals, In friction, In torsion) {
    const auto all = [](const In& a) { return std::span(a.data(), a.size()); };
    const Contacts contacts = Contacts::from(all(positions), all(normals), all(friction), {}, {}, all(torsion));
    return {contacts, contacts.placing};
}

// Those of `all` with these numbers, not placed yet.
void choose(Placement& p, const Placement& all, const std::vector<int>& chosen) {
    p.contacts.select(all.contacts, chosen);
    p.placed = p.contacts.placing;
}

// Of placing some contacts of `all` after others, again and again.
long allocations_of(const Placement& all, const std::vector<std::vector<int>>& parts, int calls) {
    Contacts part = all.contacts;
    std::vector<double> positions(all.contacts.positions.size()), normals(positions.size());
    return counted([&] {
        for (int k = 0; k < calls; ++k) {
            const auto& chosen = parts[k % parts.size()];
            part.select(all.contacts, chosen);
            for (size_t i = 0; i < chosen.size(); ++i) {
                std::copy_n(&all.contacts.positions[3 * chosen[i]], 3, &positions[3 * i]);
                std::copy_n(&all.contacts.normals[3 * chosen[i]], 3, &normals[3 * i]);
            }
            part.place(positions.data(), normals.data());
        }
    });
}

nb::dict arrays_of(const Placement& p) {
    const Contacts& c = p.contacts;
    const size_t count = c.count, size = 3 * count;
    nb::dict out;
    out["positions"] = array(c.positions, {count, 3}), out["normals"] = array(c.normals, {count, 3});
    out["scale"] = array(c.scale, {count, 3}), out["omega"] = array(c.omega), out["lambda"] = array(c.lambda),
    out["torsion"] = array(c.torsion);
    out["frames"] = array(c.frames, {count, 3, 3});
    out["matrix"] = array(c.matrix, {6, size}), out["cone_matrix"] = array(c.cone_matrix, {6, size});
    std::vector<double> orthonormal;
    c.orthonormal(orthonormal);
    out["rows"] = array(c.rows, {6, size}), out["force_rows"] = array(c.force_rows, {6, size});
    out["orthonormal"] = array(orthonormal, {6, size});
    out["inverse"] = array(c.inverse, {size, 6}), out["divisor"] = array(c.divisor, {count, 3});
    return out;
}

nb::tuple interval(In point, In ray) {
    const Vec3<double> p{point.data()[0], point.data()[1], point.data()[2]}, r{ray.data()[0], ray.data()[1], ray.data()[2]};
    const Interval found = inside(p, r);
    return nb::make_tuple(found.low, found.high);
}

}  // namespace

void bind_geometry(nb::module_& m) {
    m.def("frame", &frame, "normal"_a, "along"_a = nb::none(), "(3, 3) columns (n, o, t).");
    m.def("inside", &interval, "point"_a, "ray"_a, "(low, high) of one cone.");
    nb::class_<Placement>(m, "Placement")
        .def_prop_ro(
            "verdict", [](const Placement& p) { return int(p.placed); }, "0: good, 1: refused, 2: rank lost, 3: needs torsion.")
        .def_prop_ro("clear", [](const Placement& p) { return p.contacts.clear; })
        .def_prop_ro("arrays", &arrays_of)
        .def("place", &move, "positions"_a, "normals"_a)
        .def(
            "set_friction", [](Placement& p, In friction) { p.contacts.set_friction({friction.data(), friction.size()}); },
            "friction"_a)
        .def("select", &choose, "all"_a, "chosen"_a)
        .def("allocations", &allocations_of, "parts"_a, "calls"_a);
    m.def("contacts_from", &from, "positions"_a, "normals"_a, "friction"_a, "torsion"_a,
          "ValueError unless solvers can be made.");
    m.def("place", &place, "positions"_a, "normals"_a, "scale"_a, "weights"_a, "tangents"_a = nb::none(),
          "torsion"_a = nb::none());
}
