// Newton within limits in every layout.
#include <nanobind/stl/unique_ptr.h>

#include "allocations.hpp"
#include "arrays.hpp"

using namespace grasp;

namespace {

class AnyLimited {
public:
    explicit AnyLimited(std::unique_ptr<LimitedNewton> on) : on_(std::move(on)) {}
    // rows: (M, 7) a, b, share, lambda, contact
    static std::unique_ptr<AnyLimited> make(int lanes, int blocks, const Placement& p, double tolerance, int limit, const In& rows,
                                            const In& basis, bool elastic) {
        const size_t many = rows.shape(0);
        const double* from = numbers(rows, 7 * many);
        std::vector<double> normals, bounds, shares, weights;
        std::vector<int> contacts;
        for (size_t m = 0; m < many; ++m, from += 7) {
            normals.insert(normals.end(), from, from + 3);
            bounds.push_back(from[3]), shares.push_back(from[4]), weights.push_back(from[5]), contacts.push_back(int(from[6]));
        }
        const LimitRows given{int(many), normals.data(), bounds.data(), shares.data(), weights.data(), contacts.data()};
        return std::make_unique<AnyLimited>(instance_of<detail::LimitedAny, LimitedNewton>(
            lanes, blocks, p.contacts, Options{tolerance, limit}, given, numbers(basis, 39 * p.contacts.count), elastic));
    }

    nb::object solve(const In& wrench) { return solved({.wrench = numbers(wrench, 6)}); }
    nb::object follow(const In& wrench, const In& previous) {
        return solved({.wrench = numbers(wrench, 6), .start = Start::tangent, .force = numbers(previous, 3 * on_->contacts.count)});
    }
    nb::object descend(const In& wrench, const In& force) {
        return solved({.wrench = numbers(wrench, 6), .start = Start::given, .force = numbers(force, 3 * on_->contacts.count)});
    }
    // solves from the basis and from the force of the call before, taking turns
    long allocations_in(const In& wrenches, int calls) {
        const int many = int(wrenches.shape(0)), count = on_->contacts.count;
        std::vector<double> row(record_size(count)), before(record_size(count));
        const double* w = numbers(wrenches, 6 * many);
        on_->solve({.wrench = w}, before.data());
        return counted([&] {
            for (int k = 0; k < calls; ++k) {
                Call call{.wrench = w + 6 * (k % many)};
                if (k % 2) call.start = Start::tangent, call.force = Record(before.data(), count).force();
                on_->solve(call, row.data());
                std::swap(row, before);
            }
        });
    }

private:
    std::unique_ptr<LimitedNewton> on_;

    nb::object solved(const Call& call) {
        std::vector<double> row(record_size(on_->contacts.count));
        on_->solve(call, row.data());
        return array(row);
    }
};

}  // namespace

void bind_limits(nb::module_& m) {
    nb::class_<AnyLimited>(m, "AnyLimited")
        .def_static("make", &AnyLimited::make)
        .def("solve", &AnyLimited::solve)
        .def("follow", &AnyLimited::follow)
        .def("descend", &AnyLimited::descend)
        .def("allocations", &AnyLimited::allocations_in);
}
