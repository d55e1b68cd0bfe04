// Newton and the flows in every layout.
#include "calls.hpp"

using namespace grasp;
using namespace grasp::generic;

namespace {

class AnyNewton : public Calls<Newton> {
public:
    using Calls::Calls;
    static std::unique_ptr<AnyNewton> make(int lanes, int blocks, const Placement& p, double tolerance, int limit) {
        return std::make_unique<AnyNewton>(
            instance_of<detail::NewtonAny, Newton>(lanes, blocks, p.contacts, Stop{tolerance, limit}));
    }
    // rule: (5,) kind, first, grow, shrink, decrease
    static std::unique_ptr<AnyNewton> flow(int lanes, int blocks, const Placement& p, double tolerance, int limit, int form,
                                           const In& rule) {
        const double* r = numbers(rule, 5);
        return std::make_unique<AnyNewton>(instance_of<detail::FlowAny, Newton>(
            lanes, blocks, p.contacts, Stop{tolerance, limit}, Form(form), StepRule{int(r[0]), r[1], r[2], r[3], r[4]}));
    }
    std::unique_ptr<AnyNewton> clone() const { return std::make_unique<AnyNewton>(on_->clone()); }

    nb::tuple make_basis() {
        std::vector<double> basis(13 * size());
        const double gap = on_->make_basis(false, nullptr, basis.data());
        return nb::make_tuple(gap, array(basis, {13, size()}));
    }
    void set_basis(const In& basis) { on_->set_basis(numbers(basis, 13 * size())); }
    nb::object follow(const In& wrench, const In& force, bool tangent) {
        return solved(from(tangent ? From::tangent : From::pseudoinverse, wrench, force));
    }
    nb::tuple descend(const In& wrench, const In& force, double optimum, int traced) {
        std::vector<double> trace(traced, -1.0);
        Call call = from(From::given, wrench, force);
        call.optimum = optimum, call.trace = trace.data(), call.traced = traced;
        nb::object row = solved(call);
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
                Call call{.wrench = w + 6 * j};
                if (k % 3 == 1) call.start = From::tangent, call.force = f + size() * before;
                if (k % 3 == 2) call.start = From::given, call.force = f + size() * j;
                on_->solve(call, row.data());
            }
        });
    }
};

}  // namespace

void bind_newton(nb::module_& m) {
    using N = AnyNewton;
    nb::class_<N>(m, "AnyNewton")
        .def_static("make", &N::make, "lanes"_a, "blocks"_a, "placement"_a, "tolerance"_a, "limit"_a)
        .def_static("flow", &N::flow, "lanes"_a, "blocks"_a, "placement"_a, "tolerance"_a, "limit"_a, "form"_a, "rule"_a)
        .def("clone", &N::clone)
        .def("make_basis", &N::make_basis)
        .def("set_basis", &N::set_basis)
        .def("solve", &N::solve)
        .def("follow", &N::follow, "wrench"_a, "force"_a, "tangent"_a)
        .def("descend", &N::descend, "wrench"_a, "force"_a, "optimum"_a, "traced"_a)
        .def("internal_force", &N::internal_force)
        .def("newton_step", &N::newton_step)
        .def("repair", &N::repair)
        .def("allocations", &N::allocations_in, "wrenches"_a, "forces"_a, "calls"_a);
}
