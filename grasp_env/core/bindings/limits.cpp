// Newton on Phi within limits.
#include <nanobind/stl/unique_ptr.h>

#include <grasp/terms/force_limits.hpp>
#include <grasp/solvers.hpp>

#include "following.hpp"
#include "timing.hpp"

using namespace grasp;
using namespace grasp::generic;

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
    return newton.solve({.wrench = load.data(), .start = From::given, .force = start.data()}, row.data());
}

std::span<const double> span(const Numbers& numbers, Py_ssize_t count) { return {numbers.data(), size_t(count)}; }

// All finite limits as rows on force and torsion, (M, N, 4) with bounds and what each limit is (M,); returns M.
int limit_rows(nb::handle least, nb::handle most, nb::handle jacobian, nb::handle torques, nb::handle biases, nb::handle matrix,
               nb::handle bounds, nb::handle limited) {
    const Numbers low = in(least, -1), limit = in(torques, -1);
    const Py_ssize_t count = low.length(0), joints = limit.length(0), most_rows = 2 * (count + joints);
    const Numbers high = in(most, count), jac = in(jacobian, count, 4, joints), bias = in(biases, joints);
    const Numbers to = out(matrix, most_rows, count, 4), bound = out(bounds, most_rows), size = out(limited, most_rows);
    const ForceLimits limits{span(low, count), span(high, count), span(jac, 4 * count * joints), span(limit, joints),
                             span(bias, joints)};
    std::vector<double> row(4 * count);
    int rows = 0;
    limits.rows(int(count), 4, row, [&](std::span<const double> made, double b, double whole) {
        std::copy(made.begin(), made.end(), to.data() + 4 * count * rows);
        bound.data()[rows] = b, size.data()[rows++] = whole;
    });
    return rows;
}

// Rows (M, N, 3) on forces as those of one contact each, or False; see `LimitTable`.
bool contact_rows(nb::handle divisors, nb::handle lambdas, nb::handle matrix, nb::handle bounds, nb::handle limited,
                  nb::handle normals, nb::handle table) {
    const Numbers divisor = in(divisors, -1, 3), bound = in(bounds, -1);
    const Py_ssize_t count = divisor.length(0), many = bound.length(0);
    const Numbers lambda = in(lambdas, count), rows = in(matrix, many, count, 3), limit = in(limited, many);
    const Numbers normal = out(normals, many, 3), to = out(table, 5, many);
    LimitTable made;
    for (Py_ssize_t m = 0; m < many; ++m)
        if (!made.add(int(count), rows.data() + 3 * count * m, divisor.data(), lambda.data(), bound.data()[m], limit.data()[m]))
            return false;
    std::copy(made.normals.begin(), made.normals.end(), normal.data());
    double* next = to.data();
    for (const auto* each : {&made.bounds, &made.shares, &made.weights, &made.sizes})
        next = std::copy(each->begin(), each->end(), next);
    std::copy(made.owners.begin(), made.owners.end(), next);
    return true;
}

}  // namespace

void bind_limits(nb::module_& m) {
    m.def("limit_rows", &limit_rows, "least"_a, "most"_a, "jacobian"_a, "torques"_a, "biases"_a, "matrix"_a, "bounds"_a,
          "limited"_a,
          "Finite limits of normal forces (N,) and, with a Jacobian (N, 4, J), of torques (J,), as rows A f <= b on force and\n"
          "torsion: fills A (R, N, 4), b (R,) and what each limit is (R,), R = 2 (N + J), up to the number that it returns.");
    m.def(
        "contact_rows", &contact_rows, "divisor"_a, "lambdas"_a, "matrix"_a, "bounds"_a, "limited"_a, "normals"_a, "table"_a,
        "Rows (M, N, 3) on forces as those that `LimitedNewton` takes, of contacts with a divisor (N, 3) and lambda (N,): fills\n"
        "normals (M, 3) and a table (5, M) of bounds, shares, weights, what rows were divided by, and owners. False: one "
        "touches\n"
        "several contacts, or is beyond what solvers can bear.");
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
