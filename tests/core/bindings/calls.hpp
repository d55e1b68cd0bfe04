// What tests call of a Newton of any kind, whatever its layout.
#pragma once

#include <nanobind/stl/optional.h>
#include <nanobind/stl/unique_ptr.h>

#include "allocations.hpp"
#include "arrays.hpp"

template <class Solver> class Calls {
public:
    explicit Calls(std::unique_ptr<Solver> on) : on_(std::move(on)) {}

    nb::object solve(const In& wrench) { return solved({.wrench = numbers(wrench, 6)}); }
    nb::object follow(const In& wrench, const In& force, const std::optional<In>& torsion) {
        return solved(from(grasp::From::tangent, wrench, force, torsion));
    }
    nb::object descend(const In& wrench, const In& force, const std::optional<In>& torsion) {
        return solved(from(grasp::From::given, wrench, force, torsion));
    }
    // of solves from the basis and from the record of the call before, taking turns
    long allocations_in(const In& wrenches, int calls) {
        const int many = int(wrenches.shape(0)), count = on_->contacts.count;
        std::vector<double> row(grasp::record_size(count)), before(row);
        const double* w = numbers(wrenches, 6 * many);
        on_->solve({.wrench = w}, before.data());
        return counted([&] {
            for (int k = 0; k < calls; ++k) {
                grasp::Call call{.wrench = w + 6 * (k % many)};
                const grasp::Record known(before.data(), count);
                if (k % 2) call.start = grasp::From::tangent, call.force = known.force(), call.torsion = known.torsion();
                on_->solve(call, row.data());
                std::swap(row, before);
            }
        });
    }

protected:
    std::unique_ptr<Solver> on_;

    size_t size() const { return 3 * on_->contacts.count; }
    grasp::Call from(grasp::From start, const In& wrench, const In& force, const std::optional<In>& torsion = {}) const {
        return {.wrench = numbers(wrench, 6),
                .start = start,
                .force = numbers(force, size()),
                .torsion = torsion ? numbers(*torsion, size() / 3) : nullptr};
    }
    nb::object solved(const grasp::Call& call) {
        std::vector<double> row(grasp::record_size(on_->contacts.count));
        on_->solve(call, row.data());
        return array(row);
    }
};

// `Calls` as a class of Python.
template <class Solver, class... Arguments>
void bind_calls(nb::module_& m, const char* name, std::unique_ptr<Calls<Solver>> (*make)(Arguments...)) {
    using C = Calls<Solver>;
    nb::class_<C>(m, name)
        .def_static("make", make)
        .def("solve", &C::solve)
        .def("follow", &C::follow, "wrench"_a, "force"_a, "torsion"_a = nb::none())
        .def("descend", &C::descend, "wrench"_a, "force"_a, "torsion"_a = nb::none())
        .def("allocations", &C::allocations_in);
}
