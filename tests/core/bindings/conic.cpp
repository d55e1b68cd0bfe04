// The least sum of normal forces in every layout.
#include <nanobind/stl/unique_ptr.h>

#include "allocations.hpp"
#include "arrays.hpp"

using namespace grasp;
using namespace grasp::generic;

namespace {

class AnyConic {
public:
    explicit AnyConic(std::unique_ptr<Conic> on) : on_(std::move(on)) {}
    static std::unique_ptr<AnyConic> make(int lanes, int blocks, const Placement& p, double tolerance, int limit,
                                          const In& interior) {
        return std::make_unique<AnyConic>(instance_of<detail::ConicAny, Conic>(lanes, blocks, p.contacts, Stop{tolerance, limit},
                                                                               numbers(interior, 3 * p.contacts.count)));
    }
    std::unique_ptr<AnyConic> clone() const { return std::make_unique<AnyConic>(on_->clone()); }

    nb::object solve(const In& wrench) {
        std::vector<double> row(record_size(on_->contacts.count));
        on_->solve(numbers(wrench, 6), row.data());
        return array(row);
    }
    long allocations_in(const In& wrenches, int calls) {
        const int many = int(wrenches.shape(0));
        std::vector<double> row(record_size(on_->contacts.count));
        const double* w = numbers(wrenches, 6 * many);
        return counted([&] {
            for (int k = 0; k < calls; ++k) on_->solve(w + 6 * (k % many), row.data());
        });
    }

private:
    std::unique_ptr<Conic> on_;
};

}  // namespace

void bind_conic(nb::module_& m) {
    nb::class_<AnyConic>(m, "AnyConic")
        .def_static("make", &AnyConic::make, "lanes"_a, "blocks"_a, "placement"_a, "tolerance"_a, "limit"_a, "interior"_a)
        .def("clone", &AnyConic::clone)
        .def("solve", &AnyConic::solve)
        .def("allocations", &AnyConic::allocations_in, "wrenches"_a, "calls"_a);
}
