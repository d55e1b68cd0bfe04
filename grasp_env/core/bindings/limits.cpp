// Newton on Phi within limits.
#include <nanobind/stl/unique_ptr.h>

#include <grasp/solvers.hpp>

#include "following.hpp"
#include "timing.hpp"

using namespace grasp;

namespace {

std::unique_ptr<LimitedNewton> make(const Contacts& contacts, double tolerance, int limit, nb::handle normals, nb::handle bounds,
                                    nb::handle shares, nb::handle weights, nb::handle owners, nb::handle basis, bool elastic) {
    const Numbers rows = in(normals, -1, 3);
    const Py_ssize_t many = rows.length(0);
    const Numbers bound = in(bounds, many), share = in(shares, many), weight = in(weights, many), owner = in(owners, many);
    std::vector<int> contact(many);
    for (Py_ssize_t m = 0; m < many; ++m) {
        const double i = owner.data()[m];
        if (!(i >= 0.0 && i < contacts.count)) throw nb::value_error("a row of no contact");
        contact[m] = int(i);
    }
    const LimitRows given{int(many), rows.data(), bound.data(), share.data(), weight.data(), contact.data()};
    return LimitedNewton::make(contacts, {tolerance, limit}, given, in(basis, 13, 3 * contacts.count).data(), elastic);
}

int descend(LimitedNewton& newton, nb::handle wrench, nb::handle force, nb::handle record) {
    const int count = newton.contacts.count;
    const Numbers load = in(wrench, 6), start = in(force, count, 3), row = out(record, record_size(count));
    return newton.solve({.wrench = load.data(), .start = Start::given, .force = start.data()}, row.data());
}

}  // namespace

void bind_limits(nb::module_& m) {
    nb::class_<LimitedNewton>(m, "LimitedNewton", "Newton on Phi within limits a . x <= b on the force of one contact each.")
        .def_static("make", &make, "contacts"_a, "tolerance"_a, "limit"_a, "normals"_a, "bounds"_a, "shares"_a, "weights"_a,
                    "owners"_a, "basis"_a, "elastic"_a,
                    "Rows a (M, 3) of length one or zero, b (M,), by how much b grows with all of its limit (M,), lambda (M,),\n"
                    "which contact (M,); the 12-basis without limits (13, 3N).\n"
                    "elastic: where no force keeps them, the one that exceeds them least.")
        .def("solve", &follow<LimitedNewton>, "wrench"_a.none(), "previous"_a.none(), "record"_a,
             "From the 12-basis, or from the force of a previous record, into a record; returns the code.")
        .def("descend", &descend, "wrench"_a, "force"_a, "record"_a, "From a balanced force (N, 3) inside the cones.")
        .def("solve_many", &solve_many<LimitedNewton>, "wrenches"_a, "previous"_a.none(), "records"_a, SOLVE_MANY)
        .def("times", &newton_times<LimitedNewton>, "wrenches"_a, "passes"_a, "records"_a, "best"_a,
             "Best seconds of `passes` calls each, into (M,).");
}
