// Problems on many grasps.
#include <grasp/grasps.hpp>

#include "buffers.hpp"

using namespace grasp;

namespace {

template <void (*solve)(const Grasps&, const Options&, const Many&)>
void solve_grasps(nb::handle positions, nb::handle normals, nb::handle scales, nb::handle tangents, nb::handle weights,
                  nb::handle first, double tolerance, int limit, nb::handle wrenches, nb::handle records) {
    const Numbers p = in(positions, -1, -1, 3);
    const Py_ssize_t grasps = p.length(0), count = p.length(1);
    const Numbers n = in(normals, grasps, count, 3), s = in(scales, grasps, count, 3);
    const Buffer t(tangents);
    if (!tangents.is_none() && !t.has(grasps, count, 3)) throw nb::type_error("tangents: of all contacts, or None");
    const Numbers price = in(weights, count, 2), begin = in(first, grasps + 1), loads = in(wrenches, -1, 6);
    const Py_ssize_t many = loads.length(0);
    const Numbers rows = out(records, many, record_size(int(count)));
    bool rises = begin.data()[0] == 0.0 && begin.data()[grasps] == double(many);
    for (Py_ssize_t u = 0; u < grasps; ++u) {
        const double from = begin.data()[u], until = begin.data()[u + 1];
        rises = rises && from == std::floor(from) && from <= until;
    }
    if (!rises) throw nb::value_error("first: rising from 0 to the number of wrenches");
    const double* along = t.has(grasps, count, 3) ? t.data() : nullptr;
    const Grasps given{int(count), grasps, p.data(), n.data(), s.data(), along, price.data(), begin.data()};
    nb::gil_scoped_release free;
    solve(given, {tolerance, limit}, {many, loads.data(), rows.data()});
}

template <void (*solve)(const Grasps&, const Options&, const Many&)>
void bind(nb::module_& m, const char* name, const char* doc) {
    m.def(name, &solve_grasps<solve>, "positions"_a, "normals"_a, "scales"_a, "tangents"_a.none(), "weights"_a, "first"_a,
          "tolerance"_a, "limit"_a, "wrenches"_a, "records"_a, doc);
}

}  // namespace

void bind_grasps(nb::module_& m) {
    bind<newton_grasps>(
        m, "newton_grasps",
        "Newton from an internal force of each of U grasps (U, N, 3), tangents or None, weights (N, 2); wrenches first[u] to "
        "first[u + 1] - 1\nare those of grasp u; REFUSED: it has no force closure. Into (M, record_size(N)); releases the GIL.");
    bind<conic_grasps>(m, "conic_grasps", "The same, least sum of normal forces; weights are those of the internal forces.");
}
