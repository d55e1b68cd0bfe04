// The least sum of normal forces.
#include <nanobind/stl/unique_ptr.h>

#include <grasp/solvers.hpp>

#include "buffers.hpp"
#include "timing.hpp"

using namespace grasp;

namespace {

std::unique_ptr<Conic> make(const Contacts& contacts, double tolerance, int limit, nb::handle interior) {
    return Conic::make(contacts, {tolerance, limit}, in(interior, 3 * contacts.count).data());
}

// As that of Newton; an interior point has no use for a previous solution.
int solve(Conic& conic, nb::handle wrench, nb::handle, nb::handle record) {
    const Buffer load(wrench);
    const Numbers row = out(record, record_size(conic.contacts.count));
    return load.has(6) ? conic.solve(load.data(), row.data()) : int(REFUSED);
}

void solve_many(const Conic& conic, nb::handle wrenches, nb::handle records) {
    const int size = record_size(conic.contacts.count);
    const Numbers loads = in(wrenches, -1, 6);
    const Py_ssize_t many = loads.length(0);
    const Numbers rows = out(records, many, size);
    const auto own = conic.clone();  // before others may use it
    nb::gil_scoped_release free;
    for (Py_ssize_t k = 0; k < many; ++k) own->solve(loads.data() + 6 * k, rows.data() + size * k);
}

void times(Conic& conic, nb::handle wrenches, int passes, nb::handle records, nb::handle best) {
    time_calls(wrenches, passes, record_size(conic.contacts.count), records, best,
               [&](const double* wrench, double* row) { conic.solve(wrench, row); });
}

}  // namespace

void bind_conic(nb::module_& m) {
    nb::class_<Conic>(m, "Conic", "The least sum of normal forces on the hard contacts of one grasp.")
        .def_static("make", &make, "contacts"_a, "tolerance"_a, "limit"_a, "interior"_a,
                    "interior: (3N,) an internal force strictly inside the cones, cone coordinates.")
        .def("solve", &solve, "wrench"_a.none(), "previous"_a.none(), "record"_a,
             "Into a record; returns the code. previous: not read.")
        .def("solve_many", &solve_many, "wrenches"_a, "records"_a, "(M, 6) into (M, 20 + 7N); releases the GIL.")
        .def("times", &times, "wrenches"_a, "passes"_a, "records"_a, "best"_a, "Best seconds of `passes` calls each, into (M,).");
}
