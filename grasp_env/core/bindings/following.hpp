// The control loop's call of every Newton: from the 12-basis, or from the force and torsion of a previous record. REFUSED where
// the wrench is no (6,) float64 array of finite numbers, the previous record is of other contacts, or there is no basis.
#pragma once

#include <grasp/solvers.hpp>

#include "buffers.hpp"

template <class Solver> int follow(Solver& newton, nb::handle wrench, nb::handle previous, nb::handle record) {
    const int count = newton.contacts.count, size = grasp::record_size(count);
    const Buffer load(wrench);
    const Numbers row = out(record, size);
    if (!load.has(6)) return grasp::REFUSED;
    if (previous.is_none()) return newton.solve({.wrench = load.data()}, row.data());
    const Buffer before(previous);
    if (!before.has(size)) return grasp::REFUSED;
    const grasp::Record known(before.data(), count);
    return newton.solve(
        {.wrench = load.data(), .start = grasp::From::tangent, .force = known.force(), .torsion = known.torsion()}, row.data());
}

inline constexpr const char* SOLVE_MANY =
    "(M, 6) into (M, record_size(N)), each as `solve` without a previous record or with its row of `previous`; releases the GIL.";
template <class Solver> void solve_many(const Solver& solver, nb::handle wrenches, nb::handle previous, nb::handle records) {
    const int size = grasp::record_size(solver.contacts.count);
    const Numbers loads = in(wrenches, -1, 6);
    const Py_ssize_t many = loads.length(0);
    const Numbers rows = out(records, many, size);
    const bool follows = !previous.is_none();
    const Numbers before = follows ? in(previous, many, size) : in(records, many, size);
    const auto own = solver.clone();  // before others may use it
    nb::gil_scoped_release free;
    own->solve_many({many, loads.data(), rows.data(), follows ? before.data() : nullptr});
}
