// The least sum of normal forces.
#include <nanobind/stl/unique_ptr.h>

#include <grasp/solvers.hpp>

#include "following.hpp"
#include "timing.hpp"

using namespace grasp;
using namespace grasp::generic;

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
        .def("solve_many", &solve_many<Conic>, "wrenches"_a, "previous"_a.none(), "records"_a, SOLVE_MANY)
        .def("times", &times, "wrenches"_a, "passes"_a, "records"_a, "best"_a, "Best seconds of `passes` calls each, into (M,).");
}
