// Networks, and the starts that they predict, in every layout.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include "allocations.hpp"
#include "arrays.hpp"

using namespace grasp;
using namespace grasp::generic;

namespace {

std::vector<float> singles(const In& a, size_t size) {
    const double* from = numbers(a, size);
    return {from, from + size};
}
Network network_of(const std::vector<int>& sizes, const In& weights) {
    return Network(sizes, singles(weights, Network::numbers(sizes)).data());
}

nb::object network(const std::vector<int>& sizes, const In& weights, const In& features) {
    Network made = network_of(sizes, weights);
    const std::vector<float> given = singles(features, sizes.front());
    const float* out = made(given.data());
    return array(std::vector<double>(out, out + sizes.back()));
}

class AnyLearned {
public:
    explicit AnyLearned(std::unique_ptr<Learned> on) : on_(std::move(on)) {}
    // sizes, weights: of the network; null_space in forces
    static std::unique_ptr<AnyLearned> make(int lanes, int blocks, const Placement& p, double tolerance, int limit,
                                            const In& basis, const std::vector<int>& sizes, const In& weights,
                                            const In& null_space) {
        const size_t size = 3 * p.contacts.count;
        Model model;
        model.network = network_of(sizes, weights), model.normalisation = {0.05, 0.2, 0.5, 1.3, 0.4, 0.12};
        model.friction = 0.5;
        const double* columns = numbers(null_space, size * (size - 6));
        model.null_space.assign(columns, columns + size * (size - 6));
        model.largest = 20.0;
        if (!model.fits(p.contacts.count)) throw nb::value_error("a model of other contacts");
        return std::make_unique<AnyLearned>(instance_of<detail::LearnedAny, Learned>(
            lanes, blocks, p.contacts, Stop{tolerance, limit}, numbers(basis, 13 * size), model));
    }
    std::unique_ptr<AnyLearned> clone() const { return std::make_unique<AnyLearned>(on_->clone()); }

    nb::object start(const In& wrench, const std::optional<In>& previous) {
        std::vector<double> row(record_size(on_->contacts.count));
        on_->start(numbers(wrench, 6), previous ? numbers(*previous, size()) : nullptr, row.data());
        return array(row);
    }
    nb::object solve(const In& wrench, const std::optional<In>& previous) {
        std::vector<double> row(record_size(on_->contacts.count));
        on_->solve(numbers(wrench, 6), previous ? numbers(*previous, size()) : nullptr, row.data());
        return array(row);
    }
    nb::tuple predict(const In& wrench) {
        std::vector<double> force(size());
        const bool good = on_->predict(numbers(wrench, 6), force.data());
        return nb::make_tuple(good, array(force));
    }
    bool covers(const In& wrench) const { return on_->covers(numbers(wrench, 6)); }
    bool replaced() const { return on_->replaced(); }
    // of starts and solves, with a previous force every other time
    long allocations_in(const In& wrenches, const In& forces, int calls) {
        const int many = int(wrenches.shape(0));
        std::vector<double> row(record_size(on_->contacts.count));
        const double *w = numbers(wrenches, 6 * many), *f = numbers(forces, many * size());
        return counted([&] {
            for (int k = 0; k < calls; ++k) {
                const double* before = k % 4 < 2 ? f + size() * (k % many) : nullptr;
                if (k % 2) on_->solve(w + 6 * (k % many), before, row.data());
                else on_->start(w + 6 * (k % many), before, row.data());
            }
        });
    }

private:
    std::unique_ptr<Learned> on_;

    size_t size() const { return 3 * on_->contacts.count; }
};

}  // namespace

void bind_learned(nb::module_& m) {
    using L = AnyLearned;
    m.def("network", &network);
    m.def("network_numbers", [](const std::vector<int>& sizes) { return Network::numbers(sizes); });
    nb::class_<L>(m, "AnyLearned")
        .def_static("make", &L::make)
        .def("clone", &L::clone)
        .def("predict", &L::predict)
        .def("covers", &L::covers)
        .def_prop_ro("replaced", &L::replaced)
        .def("start", &L::start, "wrench"_a, "previous"_a = nb::none())
        .def("solve", &L::solve, "wrench"_a, "previous"_a = nb::none())
        .def("allocations", &L::allocations_in, "wrenches"_a, "forces"_a, "calls"_a);
}
