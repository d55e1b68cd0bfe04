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
    const Numbers any = in(tangents, -1, 3), along = any.length(0) ? in(tangents, count, 3) : in(tangents, 0, 3);
    const Numbers f = out(frames, count, 3, 3), g = out(matrix, 6, size), c = out(cone_matrix, 6, size);
    const Numbers t = out(torsion_matrix, 6, count), middle = out(centre, 3), map = out(frame, 6, 6);
    std::vector<double> rows;
    const double *soft = kinds.data(), *per_mu = kinds.data() + 4 * count;
    for (int i = 0; i < count; ++i) {
        const Frame axes(point(n.data() + 3 * i), along.length(0) ? along.data() + 3 * i : nullptr);
        for (int a = 0; a < 3; ++a) {
            const Vec6 made = unit_wrench(point(p.data() + 3 * i), axes[a]);
            for (int r = 0; r < 3; ++r) f.data()[9 * i + 3 * r + a] = made[r];
            set_column(g.data(), size, 3 * i + a, made);
            set_column(c.data(), size, 3 * i + a, (1.0 / per_mu[count * a + i]) * made);
        }
    }
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
    const Packed6 s = gram(rows.data(), columns);
    Ldl6 factor;
    factor.factor(s);
    return rank_bound(s, factor) > CLEAR_RANK ? unit.length : -unit.length;
}

// Whether all numbers of a C-contiguous float64 array are finite.
bool all_finite(nb::handle array) {
    Py_buffer view;
    if (PyObject_GetBuffer(array.ptr(), &view, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) != 0) throw nb::python_error();
    const bool good = std::strcmp(view.format, "d") == 0;
    double total = 0.0;
    if (good)
        for (Py_ssize_t k = 0; k < view.len / 8; ++k) total += 0.0 * static_cast<const double*>(view.buf)[k];
    PyBuffer_Release(&view);
    if (!good) throw nb::type_error("a C-contiguous float64 array is needed");
    return total == 0.0;
}

// (N, 3) normals in place: those that miss unit length by more than rounding are divided by it. Returns the first that misses it
// by more than UNIT_TOLERANCE, -1: none.
int normalise(nb::handle normals) {
    const Numbers n = out(normals, -1, 3);
    int first = -1;
    for (int i = int(n.length(0)) - 1; i >= 0; --i) {
        const Point given = point(n.data() + 3 * i), made = normalised(given);
        if (!(std::abs(length(given) - 1.0) <= UNIT_TOLERANCE)) first = i;
        for (int a = 0; a < 3; ++a) n.data()[3 * i + a] = made[a];
    }
    return first;
}

// (N, 2) friction along o and t, 0: none, into (N, 3) scale of cone coordinates
void scales(nb::handle friction, nb::handle scale) {
    const Numbers mu = in(friction, -1, 2), made = out(scale, mu.length(0), 3);
    for (Py_ssize_t i = 0; i < mu.length(0); ++i) {
        const Point one = cone_scale(mu.data()[2 * i], mu.data()[2 * i + 1]);
        for (int a = 0; a < 3; ++a) made.data()[3 * i + a] = one[a];
    }
}

Contacts make(nb::handle positions, nb::handle normals, nb::handle scale, nb::handle weights, nb::handle tangents) {
    const Numbers p = in(positions, -1, 3);
    const int count = int(p.length(0));
    const Numbers n = in(normals, count, 3), s = in(scale, count, 3), w = in(weights, count, 2), along = in(tangents, -1, 3);
    return Contacts::checked(count, p.data(), n.data(), s.data(), w.data(),
                             along.length(0) ? in(tangents, count, 3).data() : nullptr);
}

}  // namespace

void bind_contacts(nb::module_& m) {
    m.attr("TANGENT_SWITCH") = TANGENT_SWITCH, m.attr("ROUNDING") = ROUNDING;
    m.attr("LARGEST") = LARGEST, m.attr("NOTHING") = NOTHING;
    m.def("all_finite", &all_finite, "array"_a, "Whether all numbers of a C-contiguous float64 array are finite.");
    m.def("normalise", &normalise, "normals"_a,
          "Gives (N, 3) directions unit length in place; returns the first that misses it by more than 1e-6, -1: none.");
    m.def("cone_scale", &scales, "friction"_a, "scale"_a,
          "Fills (N, 3), cone coordinates = scale * force, of friction (N, 2) along o and t; 0: the normal force alone.");
    m.def("grasp_arrays", &grasp_arrays, "positions"_a, "normals"_a, "models"_a, "tangents"_a, "frames"_a, "matrix"_a,
          "cone_matrix"_a, "torsion_matrix"_a, "centre"_a, "frame"_a,
          "Fills the arrays of a `Grasp` from `frames` on; returns its length [m], negative where its rank may not be 6.");
    nb::class_<Contacts>(m, "Contacts", "Hard contacts: what they transmit and weigh, and where they are.")
        .def_static("make", &make, "positions"_a, "normals"_a, "scale"_a, "weights"_a, "tangents"_a,
                    "(N, 3) positions [m] and inward unit normals, (N, 3) scale of cone coordinates, (N, 2) omega and lambda,\n"
                    "(N, 3) tangents or (0, 3). ValueError where the rank of G is not 6.")
        .def_ro("count", &Contacts::count, "N.");
}
