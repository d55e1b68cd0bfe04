// Newton with soft contacts in every layout.
#include <nanobind/stl/unique_ptr.h>

#include "allocations.hpp"
#include "arrays.hpp"

using namespace grasp;

namespace {

class AnySoft {
public:
    explicit AnySoft(std::unique_ptr<SoftNewton> on) : on_(std::move(on)) {}
    static std::unique_ptr<AnySoft> make(int lanes, int blocks, const Placement& p, double tolerance, int limit, const In& divisor,
                                         const In& basis) {
        return std::make_unique<AnySoft>(instance_of<detail::SoftAny, SoftNewton>(
            lanes, blocks, p.contacts, Options{tolerance, limit}, numbers(divisor, p.contacts.count),
            numbers(basis, 39 * p.contacts.count)));
    }

    nb::object solve(const In& wrench) { return solved({.wrench = numbers(wrench, 6)}); }
    nb::object follow(const In& wrench, const In& force, const In& torsion) { return from(Start::tangent, wrench, force, torsion); }
    nb::object descend(const In& wrench, const In& force, const In& torsion) { return from(Start::given, wrench, force, torsion); }
    // solves from the basis and from the record of the call before, taking turns
    long allocations_in(const In& wrenches, int calls) {
        const int many = int(wrenches.shape(0)), count = on_->contacts.count;
        std::vector<double> row(record_size(count)), before(record_size(count));
        const double* w = numbers(wrenches, 6 * many);
        on_->solve({.wrench = w}, before.data());
        return counted([&] {
            for (int k = 0; k < calls; ++k) {
                Call call{.wrench = w + 6 * (k % many)};
                const Record known(before.data(), count);
                if (k % 2) call.start = Start::tangent, call.force = known.force(), call.torsion = known.torsion();
                on_->solve(call, row.data());
                std::swap(row, before);
            }
        });
    }

private:
    std::unique_ptr<SoftNewton> on_;

    nb::object from(Start start, const In& wrench, const In& force, const In& torsion) {
        const int count = on_->contacts.count;
        return solved({.wrench = numbers(wrench, 6), .start = start, .force = numbers(force, 3 * count), .torsion = numbers(torsion, count)});
    }
    nb::object solved(const Call& call) {
        std::vector<double> row(record_size(on_->contacts.count));
        on_->solve(call, row.data());
        return array(row);
    }
};

}  // namespace

void bind_soft(nb::module_& m) {
    nb::class_<AnySoft>(m, "AnySoft")
        .def_static("make", &AnySoft::make)
        .def("solve", &AnySoft::solve)
        .def("follow", &AnySoft::follow)
        .def("descend", &AnySoft::descend)
        .def("allocations", &AnySoft::allocations_in);
}
