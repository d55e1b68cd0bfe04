// Networks, learned layers, and the starts that are made of them, in every layout.
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
Layers layers_of(int width, const In& weights) {
    const int count = int(weights.size() / Layers::numbers(width));
    return Layers(count, width, singles(weights, size_t(count) * Layers::numbers(width)).data());
}

nb::object network(const std::vector<int>& sizes, const In& weights, const In& features) {
    Network made = network_of(sizes, weights);
    const std::vector<float> given = singles(features, sizes.front());
    const float* out = made(given.data());
    return array(std::vector<double>(out, out + sizes.back()));
}

// What layer k says (N, 3) of features (N, FEATURES).
nb::object perceptron(int width, const In& weights, int k, const In& features) {
    const int count = int(features.size()) / LAYER_FEATURES;
    const Cones<double, 0> cones(count);
    LayersOn<double, 0> on(cones, layers_of(width, weights));
    std::vector<float> out(3 * count);
    on.perceptron(k, count, singles(features, count * LAYER_FEATURES).data(), out.data());
    return array(std::vector<double>(out.begin(), out.end()));
}

// x after layers begin .. end - 1, its Phi and the multipliers.
nb::tuple refine(int lanes, const Placement& p, int width, const In& weights, const In& rest, double settled, int begin, int end,
                 const In& x) {
    return with_lanes(lanes, [&](auto lane) {
        using V = decltype(lane);
        Cones<V, 0> cones(p.contacts.count);
        cones.pack(p.contacts);
        System<V, 0> system(cones);
        LayersOn<V, 0> on(cones, layers_of(width, weights));
        auto there = cones.field(), at = cones.field();
        const size_t size = 3 * p.contacts.count;
        cones.load(numbers(rest, size), there), cones.load(numbers(x, size), at);
        Vec6 nu;
        const double value = on.refine(cones, system, there, settled, begin, end, at, nu);
        std::vector<double> out(size);
        cones.store(at, out.data());
        return nb::make_tuple(array(out), value, array(nu));
    });
}

class AnyLearned {
public:
    explicit AnyLearned(std::unique_ptr<Learned> on) : on_(std::move(on)) {}
    // sizes, weights: of the network, none where empty; width, layers: of the layers, none where empty; null_space in forces
    static std::unique_ptr<AnyLearned> make(int lanes, int blocks, const Placement& p, double tolerance, int limit,
                                            const In& basis, const std::vector<int>& sizes, const In& weights,
                                            const In& null_space, int width, const In& layers) {
        const size_t size = 3 * p.contacts.count;
        Model model;
        if (!sizes.empty()) {
            model.network = network_of(sizes, weights), model.normalisation = {0.05, 0.2, 0.5, 1.3, 0.4, 0.12};
            model.friction = 0.5;
            const double* columns = numbers(null_space, size * (size - 6));
            model.null_space.assign(columns, columns + size * (size - 6));
        }
        if (layers.size()) model.layers = layers_of(width, layers);
        model.trained.length = 0.05, model.largest = 20.0;
        if (!model.fits(p.contacts.count)) throw nb::value_error("a model of other contacts");
        return std::make_unique<AnyLearned>(instance_of<detail::LearnedAny, Learned>(
            lanes, blocks, p.contacts, Options{tolerance, limit}, numbers(basis, 13 * size), model));
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
    m.def("network", &network).def("perceptron", &perceptron).def("refine", &refine);
    m.def("network_numbers", [](const std::vector<int>& sizes) { return Network::numbers(sizes); });
    m.def("layer_numbers", &Layers::numbers);
    nb::class_<L>(m, "AnyLearned")
        .def_static("make", &L::make)
        .def("clone", &L::clone)
        .def("predict", &L::predict)
        .def("covers", &L::covers)
        .def("start", &L::start, "wrench"_a, "previous"_a = nb::none())
        .def("solve", &L::solve, "wrench"_a, "previous"_a = nb::none())
        .def("allocations", &L::allocations_in, "wrenches"_a, "forces"_a, "calls"_a);
}
