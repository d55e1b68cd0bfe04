// The general program as real-time code has it.
#include <grasp/general/general.hpp>

#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "allocations.hpp"
#include "arrays.hpp"

using namespace grasp;

namespace {

// What `place` is given; the arrays are the caller's.
struct Problem {
    const Placement* placement;
    In divisor;  // (N,) of torsion
    In least, most, jacobian, torque, bias;  // `ForceLimits`: (N,), (N,), (N, 4, J), (J,), (J,)

    Placing in(General& general, bool soft, const double* internal = nullptr) const {
        const auto numbers = [](const In& a) { return std::span<const double>(a.data(), a.size()); };
        return general.place(placement->contacts, soft ? divisor.data() : nullptr,
                             {numbers(least), numbers(most), numbers(jacobian), numbers(torque), numbers(bias)}, 4, internal);
    }
};

class Made {
public:
    Made(int contacts, int limits, bool soft) : general(contacts, limits, soft) {}

    int place(const Problem& problem, bool soft, const In& internal) {
        return int(problem.in(general, soft, internal.size() ? internal.data() : nullptr));
    }
    nb::tuple conic(const In& wrench, bool largest, double tolerance, int limit) {
        return told([&](const Record& record) {
            general.conic(numbers(wrench, 6), largest ? Criterion::largest : Criterion::sum, {tolerance, limit}, record);
        });
    }
    nb::tuple phi(const In& wrench, int start, const In& force, const In& torsion, double tolerance, int limit) {
        const Call call{.wrench = numbers(wrench, 6), .start = From(start), .force = force.data(), .torsion = torsion.data()};
        return told([&](const Record& record) { general.phi(call, {tolerance, limit}, record); });
    }
    // from a record
    nb::tuple go_on(const In& before, const std::string& what, double tolerance, int limit) {
        return told([&](const Record& record) {
            std::copy_n(numbers(before, record_size(general.count())), before.size(), &record.summary().code);
            if (what == "phi") general.phi_from({tolerance, limit}, record);
            else if (what == "conic") general.conic_from({tolerance, limit}, record);
            else general.excess({tolerance, limit}, record);
        });
    }
    nb::tuple deepest(const In& wrench) {
        std::vector<double> force(3 * general.count()), torsion(general.count());
        const Deepest found = general.deepest(numbers(wrench, 6), 1e-7, force.data(), torsion.data());
        return nb::make_tuple(int(found.code), found.margin, array(found.twist), array(force), array(torsion));
    }
    nb::tuple misses(const In& wrench, const In& force, const In& torsion) {
        return nb::make_tuple(general.missed(numbers(wrench, 6), force.data(), torsion.data()),
                              general.slack(force.data(), torsion.data()));
    }
    // Contacts placed and solved for one after the other: how often that allocates, and how it ended.
    nb::tuple allocations(const std::vector<Problem>& problems, const In& wrenches, int rounds) {
        int most = 0, ended[8] = {};
        for (const Problem& problem : problems) most = std::max(most, problem.placement->contacts.count);
        std::vector<double> row(record_size(most)), force(3 * most), torsion(most);
        const int many = int(wrenches.shape(0));
        const long made = counted([&] {
            for (int k = 0; k < rounds; ++k) {
                const Problem& problem = problems[k % problems.size()];
                const double* w = wrenches.data() + 6 * (k % many);
                if (problem.in(general, true) != Placing::good) continue;
                const Record record(row.data(), general.count());
                const double tolerance = k % 3 ? 1e-6 : 1e-16;  // which asks for more digits than a double's
                ++ended[general.conic(w, k % 2 ? Criterion::largest : Criterion::sum, {tolerance, 1000}, record)];
                ++ended[general.excess({1e-6, 1000}, record)];
                record.summary().code = STALLED, record.summary().lower_bound = 0.0;
                general.conic_from({1e-6, 1000}, record);
                ++ended[general.phi({.wrench = w}, {tolerance, 1000}, record)];
                record.summary().code = STALLED, record.summary().lower_bound = 0.0;
                general.phi_from({1e-12, 1000}, record);
                general.deepest(w, 1e-7, force.data(), torsion.data());
            }
        });
        return nb::make_tuple(made, std::vector<int>(ended, ended + 8));
    }

private:
    General general;

    template <class F> nb::tuple told(F&& solve) {
        std::vector<double> row(record_size(general.count()));
        solve(Record(row.data(), general.count()));
        return nb::make_tuple(array(row), array(general.all_prices()), array(general.prices()));
    }
};

}  // namespace

void bind_general(nb::module_& m) {
    nb::class_<Problem>(m, "GeneralProblem")
        .def(
            "__init__",
            [](Problem* self, const Placement& placement, In divisor, In least, In most, In jacobian, In torque, In bias) {
                new (self) Problem{&placement, divisor, least, most, jacobian, torque, bias};
            },
            nb::keep_alive<1, 2>());
    nb::class_<Made>(m, "General")
        .def(nb::init<int, int, bool>(), "contacts"_a, "limits"_a, "soft"_a)
        .def("place", &Made::place, "problem"_a, "soft"_a, "internal"_a)
        .def("conic", &Made::conic, "wrench"_a, "largest"_a, "tolerance"_a, "limit"_a)
        .def("phi", &Made::phi, "wrench"_a, "start"_a, "force"_a, "torsion"_a, "tolerance"_a, "limit"_a)
        .def("go_on", &Made::go_on, "record"_a, "what"_a, "tolerance"_a, "limit"_a)
        .def("deepest", &Made::deepest, "wrench"_a)
        .def("misses", &Made::misses, "wrench"_a, "force"_a, "torsion"_a)
        .def("allocations", &Made::allocations, "problems"_a, "wrenches"_a, "rounds"_a);
}
