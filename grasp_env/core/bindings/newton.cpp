// Newton on Phi and the starts.
#include <nanobind/stl/unique_ptr.h>

#include <grasp/solvers.hpp>

#include "following.hpp"
#include "timing.hpp"

using namespace grasp;
using namespace grasp::generic;

namespace {

std::unique_ptr<Newton> make(const Contacts& contacts, double tolerance, int limit) {
    return Newton::make(contacts, {tolerance, limit});
}

// From a given force, with what studies ask for.
int descend(Newton& newton, nb::handle wrench, nb::handle force, double optimum, nb::handle trace, nb::handle record) {
    const int count = newton.contacts.count;
    const Numbers load = in(wrench, 6), start = in(force, count, 3), values = out(trace, -1);
    const Numbers row = out(record, record_size(count));
    const Call call{.wrench = load.data(),
                    .start = From::given,
                    .force = start.data(),
                    .optimum = optimum,
                    .trace = values.data(),
                    .traced = int(values.length(0))};
    return newton.solve(call, row.data());
}

// Newton from given forces (M, N, 3) on contacts in one place with M scales (M, N, 3) of cone coordinates; releases the GIL.
void solve_scaled(const Contacts& contacts, nb::handle scales, nb::handle wrenches, nb::handle forces, double tolerance,
                  int limit, nb::handle records) {
    const int count = contacts.count, size = record_size(count);
    const Numbers loads = in(wrenches, -1, 6);
    const Py_ssize_t many = loads.length(0);
    const Numbers factors = in(scales, many, count, 3), starts = in(forces, many, count, 3), rows = out(records, many, size);
    nb::gil_scoped_release free;
    Contacts scaled = contacts;
    for (Py_ssize_t k = 0; k < many; ++k) {
        if (!scaled.rescale(factors.data() + 3 * count * k)) {
            Record(rows.data() + size * k, count).summary().code = REFUSED;
            continue;
        }
        const Call call{.wrench = loads.data() + 6 * k, .start = From::given, .force = starts.data() + 3 * count * k};
        Newton::make(scaled, {tolerance, limit})->solve(call, rows.data() + size * k);
    }
}

double fill_basis(Newton& newton, nb::handle basis, bool warm, nb::handle interior) {
    const int size = 3 * newton.contacts.count;
    const Numbers rows = out(basis, 13, size);
    if (interior.is_none()) return newton.make_basis(warm, nullptr, rows.data());
    return newton.make_basis(warm, in(interior, size).data(), rows.data());
}

bool internal_force(Newton& newton, nb::handle x) { return newton.internal_force(out(x, 3 * newton.contacts.count).data()); }

// the combination of a 12-basis (13, M), into (M,)
void combine(nb::handle basis, nb::handle wrench, bool printed, nb::handle to) {
    const Numbers rows = in(basis, 13, -1), load = in(wrench, 6);
    const Py_ssize_t size = rows.length(1);
    const Numbers sum = out(to, size);
    const Combination made(load.data(), printed);
    std::fill(sum.data(), sum.data() + size, 0.0);
    for (int k = 0; k < 7; ++k)
        for (Py_ssize_t j = 0; j < size; ++j) sum.data()[j] += made.weights[k] * rows.data()[size * made.rows[k] + j];
}

bool carry(Newton& newton, nb::handle wrench, nb::handle previous, bool tangent, nb::handle force) {
    const int count = newton.contacts.count;
    return newton.carry(in(wrench, 6).data(), in(previous, count, 3).data(), tangent ? From::tangent : From::pseudoinverse,
                        out(force, count, 3).data());
}

bool repair(Newton& newton, nb::handle wrench, nb::handle candidate, nb::handle force) {
    const int count = newton.contacts.count;
    return newton.repair(in(wrench, 6).data(), in(candidate, count, 3).data(), out(force, count, 3).data());
}

nb::typed<nb::tuple, double, double> interval(Newton& newton, nb::handle point, nb::handle ray) {
    const int size = 3 * newton.contacts.count;
    const Interval found = newton.inside(in(point, size).data(), in(ray, size).data());
    return nb::make_tuple(found.low, found.high);
}

double newton_step(Newton& newton, nb::handle wrench, nb::handle x, nb::handle step, nb::handle multipliers) {
    const int size = 3 * newton.contacts.count;
    return newton.newton_step(in(wrench, 6).data(), in(x, size).data(), out(step, size).data(), out(multipliers, 6).data());
}

double segment(Newton& newton, nb::handle safe, nb::handle x) {
    const int size = 3 * newton.contacts.count;
    return newton.segment(in(safe, size).data(), out(x, size).data());
}

void set_basis(Newton& newton, nb::handle basis) { newton.set_basis(in(basis, 13, 3 * newton.contacts.count).data()); }

}  // namespace

void bind_newton(nb::module_& m) {
    m.attr("ACCEPTED_GAP") = ACCEPTED_GAP;
    m.def("combine", &combine, "basis"_a, "wrench"_a, "printed"_a, "to"_a,
          "The combination of a 12-basis with its rest (13, M) for a wrench, into (M,); `printed`: without the rest "
          "(Eqs. 33, 34).");
    m.def(
        "solve_scaled", &solve_scaled, "contacts"_a, "scales"_a, "wrenches"_a, "forces"_a, "tolerance"_a, "limit"_a, "records"_a,
        "Newton from given forces (M, N, 3) on contacts with M scales (M, N, 3) of cone coordinates, into (M, record_size(N)).");
    nb::class_<Newton>(m, "Newton",
                       "Newton on Phi and the starts, on the hard contacts of one grasp; x is in cone coordinates [N].")
        .def_static("make", &make, "contacts"_a, "tolerance"_a, "limit"_a)
        .def("set_basis", &set_basis, "basis"_a, "Takes the 12-basis with the rest force, (13, 3N) in cone coordinates.")
        .def("make_basis", &fill_basis, "basis"_a, "warm"_a = false, "interior"_a = nb::none(),
             "Fills the 12-basis, (13, 3N); returns the worst relative gap, inf: none.\n"
             "warm: it holds that of nearby contacts.\n"
             "interior: (3N,) an internal force strictly inside the cones; None: it is searched.")
        .def("internal_force", &internal_force, "x"_a, "Fills x (3N,) with an internal force strictly inside; False: none found.")
        .def("solve", &follow<Newton>, "wrench"_a.none(), "previous"_a.none(), "record"_a,
             "From the 12-basis, or from the force of a previous record carried over, into a record; returns the code.")
        .def("descend", &descend, "wrench"_a, "force"_a, "optimum"_a, "trace"_a, "record"_a,
             "From a force (N, 3); optimum: a known min Phi or nan; trace: (T,) receives Phi of iterates 0..T-1.")
        .def("solve_many", &solve_many<Newton>, "wrenches"_a, "previous"_a.none(), "records"_a, SOLVE_MANY)
        .def("times", &newton_times<Newton>, "wrenches"_a, "passes"_a, "records"_a, "best"_a,
             "Best seconds of `passes` calls each, into (M,).")
        .def("carry", &carry, "wrench"_a, "previous"_a, "tangent"_a, "force"_a,
             "A previous optimum (N, 3) carried to this wrench, by the tangent correction or by G^+; False: not finite.")
        .def("repair", &repair, "wrench"_a, "candidate"_a, "force"_a,
             "The force of least Phi on the way from the combination to a candidate (N, 3), balanced; False: not finite.")
        .def("inside", &interval, "point"_a, "ray"_a,
             "(low, high) of the k with point + k ray strictly inside; none: low >= high.")
        .def("newton_step", &newton_step, "wrench"_a, "x"_a, "step"_a, "multipliers"_a,
             "The Newton step at x (3N,); returns the squared decrement, negative where there is none.")
        .def("segment", &segment, "safe"_a, "x"_a, "x (3N,) = the least Phi on the segment from `safe` to it; returns how far.");
}
