// The general program.
#include <nanobind/stl/unique_ptr.h>

#include <grasp/general/program.hpp>

#include "buffers.hpp"
#include "timing.hpp"

using namespace grasp;

namespace {

std::unique_ptr<Program> make(nb::handle frame, nb::handle balance, nb::handle rows, nb::handle bound, nb::handle divisor,
                              nb::handle shares, bool elastic) {
    const Numbers d = in(divisor, -1, 4), b = in(bound, -1);
    if (std::max(d.length(0), b.length(0)) > 1'000'000) throw nb::type_error("at most 1,000,000 contacts and limits");
    const int count = int(d.length(0)), limits = int(b.length(0));
    int soft = 0;
    for (int i = 0; i < count; ++i) soft += d.data()[4 * i + 3] < infinity;
    if (soft > limits) throw nb::value_error("each soft contact needs a row of its torsion");
    return std::make_unique<Program>(Given{count, limits, in(frame, 6, 6).data(), in(balance, 6, count, 4).data(),
                                           in(rows, limits, count, 4).data(), b.data(), d.data(), in(shares, limits).data(),
                                           elastic});
}

Criterion criterion_of(bool largest) { return largest ? Criterion::largest : Criterion::sum; }

int least_force(Program& program, nb::handle wrench, bool largest, double tolerance, int limit, nb::handle record,
                nb::handle prices) {
    const Buffer load(wrench);
    const Numbers row = out(record, record_size(program.count)), each = out(prices, program.limits);
    if (!load.has(6)) return REFUSED;
    return program.least(load.data(), criterion_of(largest), {tolerance, limit}, Record(row.data(), program.count), each.data());
}

int least_excess(Program& program, nb::handle wrench, int limit, nb::handle record, nb::handle prices) {
    const Numbers load = in(wrench, 6), row = out(record, record_size(program.count)), each = out(prices, program.limits);
    return program.least(load.data(), Criterion::excess, {EXCESS_WITHIN, limit}, Record(row.data(), program.count), each.data());
}

nb::tuple deepest_force(Program& program, nb::handle wrench, double tolerance, nb::handle z, nb::handle twist) {
    const Numbers load = in(wrench, 6), to = out(z, program.count, 4), proof = out(twist, 6);
    const Deepest found = program.deepest(load.data(), tolerance, to.data());
    std::copy(found.twist.begin(), found.twist.end(), proof.data());
    return nb::make_tuple(int(found.code), found.iterations, found.margin);
}

// From z, with what studies ask for.
int least_phi(Program& program, nb::handle wrench, nb::handle weights, nb::handle row_weights, nb::handle z, double optimum,
              nb::handle trace, double tolerance, int limit, nb::handle record, nb::handle prices) {
    const Numbers load = in(wrench, 6), values = out(trace, -1);
    const Call call{
        .wrench = load.data(), .start = From::given, .optimum = optimum, .trace = values.data(), .traced = int(values.length(0))};
    return program.least_phi(call, in(weights, program.count, 2).data(), in(row_weights, program.limits).data(),
                             in(z, program.count, 4).data(), {tolerance, limit},
                             Record(out(record, record_size(program.count)).data(), program.count),
                             out(prices, program.limits).data());
}

}  // namespace

void bind_program(nb::module_& m) {
    m.attr("CLEAR") = CLEAR;
    nb::class_<Program>(m, "Program",
                        "Any contacts, further limits: the least sum or maximum of normal forces, the deepest force, Phi.")
        .def_static("make", &make, "frame"_a, "balance"_a, "rows"_a, "bound"_a, "divisor"_a, "shares"_a, "elastic"_a,
                    "See `Given` in program.hpp.")
        .def("least_force", &least_force, "wrench"_a.none(), "largest"_a, "tolerance"_a, "limit"_a, "record"_a, "prices"_a,
             "Into a record and the limits' prices (M,); returns the code. INFEASIBLE: the record's multipliers are the proof.")
        .def("least_excess", &least_excess, "wrench"_a, "limit"_a, "record"_a, "prices"_a,
             "The balanced force in the cones that exceeds limits least, of an elastic program; returns LIMITS_EXCEEDED where "
             "it is found.")
        .def("least_phi", &least_phi, "wrench"_a, "weights"_a, "row_weights"_a, "z"_a, "optimum"_a, "trace"_a, "tolerance"_a,
             "limit"_a, "record"_a, "prices"_a,
             "The least Phi from z (N, 4), balanced and strictly inside; optimum: nan or a known minimum.")
        .def("deepest", &deepest_force, "wrench"_a, "tolerance"_a, "z"_a, "twist"_a,
             "The deepest force into z (N, 4), the separating twist into (6,); returns (code, iterations, margin).");
}
