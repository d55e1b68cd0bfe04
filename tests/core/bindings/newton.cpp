// Newton and the flows in every layout.
#include <nanobind/stl/unique_ptr.h>

#include "allocations.hpp"
#include "arrays.hpp"

using namespace grasp;

namespace {

class AnyNewton {
public:
    explicit AnyNewton(std::unique_ptr<Newton> on) : on_(std::move(on)) {}
    static std::unique_ptr<AnyNewton> make(int lanes, int blocks, const Placement& p, double tolerance, int limit) {
        return std::make_unique<AnyNewton>(
            instance_of<detail::NewtonAny, Newton>(lanes, blocks, p.contacts, Options{tolerance, limit}));
    }
    // rule: (5,) kind, first, grow, shrink, decrease
    static std::unique_ptr<AnyNewton> flow(int lanes, int blocks, const Placement& p, double tolerance, int limit, int form,
                                           const In& rule) {
        const double* r = numbers(rule, 5);
        return std::make_unique<AnyNewton>(instance_of<detail::FlowAny, Newton>(
            lanes, blocks, p.contacts, Options{tolerance, limit}, Form(form), StepRule{int(r[0]), r[1], r[2], r[3], r[4]}));
    }
    std::unique_ptr<AnyNewton> clone() const { return std::make_unique<AnyNewton>(on_->clone()); }

    nb::tuple make_basis() {
        std::vector<double> basis(13 * size());
        const double gap = on_->make_basis(false, nullptr, basis.data());
        return nb::make_tuple(gap, array(basis, {13, size()}));
    }
    void set_basis(const In& basis) { on_->set_basis(numbers(basis, 13 * size())); }
    nb::object solve(const In& wrench) { return solved({.wrench = numbers(wrench, 6)}); }
    nb::object follow(const In& wrench, const In& force, bool tangent) {
        return solved({.wrench = numbers(wrench, 6), .start = tangent ? Start::tangent : Start::pseudoinverse,
                       .force = numbers(force, size())});
    }
    nb::tuple descend(const In& wrench, const In& force, double optimum, int traced) {
        std::vector<double> trace(traced, -1.0);
        nb::object row = solved({.wrench = numbers(wrench, 6), .start = Start::given, .force = numbers(force, size()),
                                 .optimum = optimum, .trace = trace.data(), .traced = traced});
        return nb::make_tuple(row, array(trace));
    }
    nb::tuple internal_force() {
        std::vector<double> x(size());
        const bool found = on_->internal_force(x.data());
        return nb::make_tuple(found, array(x));
    }
    nb::tuple newton_step(const In& wrench, const In& x) {
        std::vector<double> step(size()), multipliers(6);
        const double decrement = on_->newton_step(numbers(wrench, 6), numbers(x, size()), step.data(), multipliers.data());
        return nb::make_tuple(decrement, array(step), array(multipliers));
    }
    nb::tuple repair(const In& wrench, const In& candidate) {
        std::vector<double> force(size());
        const bool found = on_->repair(numbers(wrench, 6), numbers(candidate, size()), force.data());
        return nb::make_tuple(found, array(force));
    }
    // of solves from the basis, from a previous force and from a given one, in turn
    long allocations_in(const In& wrenches, const In& forces, int calls) {
        const int many = int(wrenches.shape(0));
        std::vector<double> row(record_size(on_->contacts.count));
        const double *w = numbers(wrenches, 6 * many), *f = numbers(forces, many * size());
        return counted([&] {
            for (int k = 0; k < calls; ++k) {
                const int j = k % many, before = (k + 1) % many;
                if (k % 3 == 0) on_->solve({.wrench = w + 6 * j}, row.data());
                if (k % 3 == 1) on_->solve({.wrench = w + 6 * j, .start = Start::tangent, .force = f + size() * before}, row.data());
                if (k % 3 == 2) on_->solve({.wrench = w + 6 * j, .start = Start::given, .force = f + size() * j}, row.data());
            }
        });
    }

private:
    std::unique_ptr<Newton> on_;

    size_t size() const { return 3 * on_->contacts.count; }
    nb::object solved(const Call& call) {
        std::vector<double> row(record_size(on_->contacts.count));
        on_->solve(call, row.data());
        return array(row);
    }
};

}  // namespace

void bind_newton(nb::module_& m) {
    using N = AnyNewton;
    nb::class_<N>(m, "AnyNewton")
        .def_static("make", &N::make, "lanes"_a, "blocks"_a, "placement"_a, "tolerance"_a, "limit"_a)
        .def_static("flow", &N::flow, "lanes"_a, "blocks"_a, "placement"_a, "tolerance"_a, "limit"_a, "form"_a, "rule"_a)
        .def("clone", &N::clone).def("make_basis", &N::make_basis).def("set_basis", &N::set_basis).def("solve", &N::solve)
        .def("follow", &N::follow, "wrench"_a, "force"_a, "tangent"_a)
        .def("descend", &N::descend, "wrench"_a, "force"_a, "optimum"_a, "traced"_a)
        .def("internal_force", &N::internal_force).def("newton_step", &N::newton_step).def("repair", &N::repair)
        .def("allocations", &N::allocations_in, "wrenches"_a, "forces"_a, "calls"_a);
}
