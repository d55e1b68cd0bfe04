// Contact geometry: the arrays of a `Grasp`, and the contacts that solvers are made for.
#include <grasp/contacts.hpp>

#include "buffers.hpp"

using namespace grasp;

namespace {

// Fills the arrays of a `Grasp`; returns its length [m], negative where its rank may not be 6. models: (7, N) as
// `ContactModels.packed` has them: gamma, three rows of scale, three of divisor.
double grasp_arrays(nb::handle positions, nb::handle normals, nb::handle models, nb::handle tangents, nb::handle frames,
                    nb::handle matrix, nb::handle cone_matrix, nb::handle torsion_matrix, nb::handle centre, nb::handle frame) {
    const Numbers p = in(positions, -1, 3);
    const int count = int(p.length(0)), size = 3 * count;
    const Numbers n = in(normals, count, 3), kinds = in(models, 7, count);
    const Numbers along = in(tangents, -1, 3);
    const Numbers f = out(frames, count, 3, 3), g = out(matrix, 6, size), c = out(cone_matrix, 6, size);
    const Numbers t = out(torsion_matrix, 6, count), middle = out(centre, 3), map = out(frame, 6, 6);
    std::vector<double> divisor(size), rows;
    const double* soft = kinds.data();
    for (int i = 0; i < count; ++i)
        for (int a = 0; a < 3; ++a) divisor[3 * i + a] = kinds.data()[(4 + a) * count + i];
    write_geometry(count, p.data(), n.data(), along.length(0) ? along.data() : nullptr, divisor.data(),
                   {f.data(), g.data(), c.data()});
    const UnitFrame unit(p.data(), count);
    unit.write(map.data());
    for (int a = 0; a < 3; ++a) middle.data()[a] = unit.centre[a];
    int columns = size;
    for (int i = 0; i < count; ++i) columns += soft[i] > 0.0;
    rows.assign(6 * columns, 0.0);
    int next = size;
    for (int i = 0; i < count; ++i) {
        for (int a = 0; a < 3; ++a) {
            if (kinds.data()[(1 + a) * count + i] > 0.0)
                set_column(rows.data(), columns, 3 * i + a, unit.of(column(g.data(), size, 3 * i + a).data()));
            t.data()[count * a + i] = 0.0, t.data()[count * (3 + a) + i] = soft[i] > 0.0 ? n.data()[3 * i + a] : 0.0;
        }
        if (soft[i] > 0.0) set_column(rows.data(), columns, next++, unit.of(column(t.data(), count, i).data()));
    }
    return clearly_full_rank(rows.data(), columns) ? unit.length : -unit.length;
}

Contacts make(nb::handle positions, nb::handle normals, nb::handle scale, nb::handle weights, nb::handle tangents) {
    const Numbers p = in(positions, -1, 3);
    const int count = int(p.length(0));
    const Numbers n = in(normals, count, 3), s = in(scale, count, 3), w = in(weights, count, 2), along = in(tangents, -1, 3);
    Contacts contacts(count, s.data(), w.data(), along.length(0) ? in(tangents, count, 3).data() : nullptr);
    const Placed placed = contacts.place(p.data(), n.data());
    if (placed == Placed::refused) throw nb::value_error("positions must be finite and normals of unit length");
    if (placed == Placed::rank_lost) throw nb::value_error("rank(G) < 6");
    return contacts;
}

}  // namespace

void bind_contacts(nb::module_& m) {
    m.attr("TANGENT_SWITCH") = TANGENT_SWITCH, m.attr("UNIT_TOLERANCE") = UNIT_TOLERANCE, m.attr("ROUNDING") = ROUNDING;
    m.attr("LARGEST") = LARGEST, m.attr("NOTHING") = NOTHING;
    m.def("grasp_arrays", &grasp_arrays, "positions"_a, "normals"_a, "models"_a, "tangents"_a, "frames"_a, "matrix"_a,
          "cone_matrix"_a, "torsion_matrix"_a, "centre"_a, "frame"_a,
          "Fills the arrays of a `Grasp` from `frames` on; returns its length [m], negative where its rank may not be 6.");
    nb::class_<Contacts>(m, "Contacts", "Hard contacts: what they transmit and weigh, and where they are.")
        .def_static("make", &make, "positions"_a, "normals"_a, "scale"_a, "weights"_a, "tangents"_a,
                    "(N, 3) positions [m] and inward unit normals, (N, 3) scale of cone coordinates, (N, 2) omega and lambda,\n"
                    "(N, 3) tangents or (0, 3). ValueError where the rank of G is not 6.")
        .def_ro("count", &Contacts::count, "N.");
}
