// Contacts that move, in every layout.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/unique_ptr.h>

#include <grasp/hand/pipeline.hpp>

#include "allocations.hpp"
#include "arrays.hpp"

using namespace grasp;

namespace {

class AnyPipeline {
public:
    explicit AnyPipeline(std::unique_ptr<Pipeline> on) : on_(std::move(on)) {}
    static std::unique_ptr<AnyPipeline> make(int lanes, int blocks, const Placement& p, double tolerance, int limit,
                                             const In& basis, const In& frames, bool remembers, const In& reference, bool flows) {
        const size_t size = 3 * p.contacts.count;
        const StepRule rule;
        return std::make_unique<AnyPipeline>(instance_of<detail::PipelineAny, Pipeline>(
            lanes, blocks, p.contacts, Stop{tolerance, limit}, numbers(basis, 13 * size), numbers(frames, 3 * size), remembers,
            numbers(reference, size * (size - 6)), flows ? &rule : nullptr));
    }

    nb::object solve(const In& points, const In& normals, const In& wrench, const std::optional<In>& adjust) {
        std::vector<double> row(record_size(count()));
        on_->solve(load(points, normals, wrench, adjust), row.data());
        return array(row);
    }
    nb::tuple carry(const In& points, const In& normals, const In& wrench) {
        std::vector<double> force(3 * count());
        const Carried how = on_->carry(load(points, normals, wrench, {}), force.data());
        return nb::make_tuple(int(how), array(force));
    }
    nb::object last() const { return array(on_->held().x); }
    nb::object basis() const { return array(on_->held().basis, {13, size_t(3 * count())}); }
    void reset() { on_->reset(); }
    void forget() { on_->forget(); }

    // (M, 3N) points and normals, (M, 6) wrenches, (M, 3N - 6) adjust: solve, adjusted every third call, then carried on
    long allocations_in(const In& points, const In& normals, const In& wrenches, const In& adjust, int calls) {
        const int many = int(wrenches.shape(0)), size = 3 * count();
        std::vector<double> row(record_size(count())), force(size);
        const double *p = numbers(points, many * size), *n = numbers(normals, many * size);
        const double *w = numbers(wrenches, 6 * many), *a = numbers(adjust, many * (size - 6));
        return counted([&] {
            for (int k = 0; k < calls; ++k) {
                const int j = k % many, next = (k + 1) % many;
                on_->solve({p + size * j, n + size * j, w + 6 * j, k % 3 == 2 ? a + (size - 6) * j : nullptr}, row.data());
                on_->carry({p + size * next, n + size * next, w + 6 * next}, force.data());
            }
        });
    }

private:
    std::unique_ptr<Pipeline> on_;

    int count() const { return on_->contacts().count; }
    Load load(const In& points, const In& normals, const In& wrench, const std::optional<In>& adjust) const {
        const size_t size = 3 * count();
        return {numbers(points, size), numbers(normals, size), numbers(wrench, 6), adjust ? numbers(*adjust, size - 6) : nullptr};
    }
};

}  // namespace

void bind_pipeline(nb::module_& m) {
    using P = AnyPipeline;
    nb::class_<P>(m, "AnyPipeline")
        .def_static("make", &P::make, "lanes"_a, "blocks"_a, "placement"_a, "tolerance"_a, "limit"_a, "basis"_a, "frames"_a,
                    "remembers"_a, "reference"_a, "flows"_a = false)
        .def("solve", &P::solve, "points"_a, "normals"_a, "wrench"_a, "adjust"_a = nb::none())
        .def("carry", &P::carry)
        .def_prop_ro("last", &P::last)
        .def_prop_ro("basis", &P::basis)
        .def("reset", &P::reset)
        .def("forget", &P::forget)
        .def("allocations", &P::allocations_in, "points"_a, "normals"_a, "wrenches"_a, "adjust"_a, "calls"_a);
}
