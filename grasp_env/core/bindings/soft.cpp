// Newton on Phi with soft contacts.
#include <nanobind/stl/unique_ptr.h>

#include <grasp/solvers.hpp>

#include "following.hpp"
#include "timing.hpp"

using namespace grasp;
using namespace grasp::generic;

namespace {

std::unique_ptr<SoftNewton> make(const Contacts& contacts, double tolerance, int limit, nb::handle divisor, nb::handle basis) {
    return SoftNewton::make(contacts, {tolerance, limit}, in(divisor, contacts.count).data(),
                            in(basis, 13, 3 * contacts.count).data());
}

// From a given force, with what studies ask for.
int descend(SoftNewton& newton, nb::handle wrench, nb::handle force, nb::handle torsion, double optimum, nb::handle trace,
            nb::handle record) {
    const int count = newton.contacts.count;
    const Numbers load = in(wrench, 6), start = in(force, count, 3), turn = in(torsion, count), values = out(trace, -1);
    const Numbers row = out(record, record_size(count));
    return newton.solve({.wrench = load.data(),
                         .start = From::given,
                         .force = start.data(),
                         .torsion = turn.data(),
                         .optimum = optimum,
                         .trace = values.data(),
                         .traced = int(values.length(0))},
                        row.data());
}

}  // namespace

void bind_soft(nb::module_& m) {
    nb::class_<SoftNewton>(m, "SoftNewton", "Newton on Phi with soft contacts.")
        .def_static("make", &make, "contacts"_a, "tolerance"_a, "limit"_a, "divisor"_a, "basis"_a,
                    "Torsion in units of its limit / torsion (N,), inf where a contact is not soft; the 12-basis without "
                    "torsion (13, 3N).")
        .def("solve", &follow<SoftNewton>, "wrench"_a.none(), "previous"_a.none(), "record"_a,
             "From the 12-basis, or from force and torsion of a previous record, into a record; returns the code.")
        .def("descend", &descend, "wrench"_a, "force"_a, "torsion"_a, "optimum"_a, "trace"_a, "record"_a,
             "From a balanced force (N, 3) inside the cones with torsions (N,) within their limits.")
        .def("solve_many", &solve_many<SoftNewton>, "wrenches"_a, "previous"_a.none(), "records"_a, SOLVE_MANY)
        .def("times", &newton_times<SoftNewton>, "wrenches"_a, "passes"_a, "records"_a, "best"_a,
             "Best seconds of `passes` calls each, into (M,).");
}
