// Contacts that move from call to call.
#include <nanobind/stl/unique_ptr.h>

#include <grasp/hand/pipeline.hpp>

#include "buffers.hpp"
#include "rule.hpp"
#include "views.hpp"

using namespace grasp;

namespace {

std::unique_ptr<Pipeline> make(const Contacts& nominal, double tolerance, int limit, nb::handle basis, nb::handle frames,
                               bool remembers, nb::handle reference, nb::handle flows) {
    const int count = nominal.count, size = 3 * count;
    const StepRule rule = flows.is_none() ? StepRule{} : rule_of(flows);
    return Pipeline::make(nominal, {tolerance, limit}, in(basis, 13, size).data(), in(frames, count, 3, 3).data(), remembers,
                          in(reference, size, size - 6).data(), flows.is_none() ? nullptr : &rule);
}

// The arguments of a call, each where it lies as the core reads it.
struct Given {
    int count;
    Buffer points, normals, wrench, adjust;
    bool adjusts;

    Given(Pipeline& pipeline, nb::handle p, nb::handle n, nb::handle w, nb::handle a)
        : count(pipeline.contacts().count), points(p), normals(n), wrench(w), adjust(a), adjusts(!a.is_none()) {}
    bool readable() const {
        return points.has(count, 3) && normals.has(count, 3) && wrench.has(6) && (!adjusts || adjust.has(3 * count - 6));
    }
    Load load() const { return {points.data(), normals.data(), wrench.data(), adjusts ? adjust.data() : nullptr}; }
};

int solve(Pipeline& pipeline, nb::handle points, nb::handle normals, nb::handle wrench, nb::handle adjust, nb::handle record) {
    const Given given(pipeline, points, normals, wrench, adjust);
    const Numbers row = out(record, record_size(given.count));
    return given.readable() ? pipeline.solve(given.load(), row.data()) : int(REFUSED);
}

int carry(Pipeline& pipeline, nb::handle points, nb::handle normals, nb::handle wrench, nb::handle force) {
    const int count = pipeline.contacts().count;
    const Numbers p = in(points, count, 3), n = in(normals, count, 3), w = in(wrench, 6);
    return pipeline.carry({p.data(), n.data(), w.data()}, out(force, count, 3).data());
}

int carry_from(Pipeline& pipeline, nb::handle points, nb::handle normals, nb::handle wrench, nb::handle then, nb::handle frames,
               nb::handle force) {
    const int count = pipeline.contacts().count;
    const Numbers p = in(points, count, 3), n = in(normals, count, 3), w = in(wrench, 6);
    const double* from = in(then, count, 3).data();
    return pipeline.carry_from({p.data(), n.data(), w.data()}, from, in(frames, count, 3, 3).data(), out(force, count, 3).data());
}

nb::typed<nb::dict, nb::str, nb::ndarray<>> arrays(nb::handle self) {
    auto& pipeline = nb::cast<Pipeline&>(self);
    auto& held = pipeline.held();
    const size_t count = pipeline.contacts().count, size = 3 * count;
    nb::dict named;
    named["x"] = view(self, held.x, {size});
    named["frames"] = view(self, held.frames, {count, 3, 3});
    named["cone_matrix"] = view(self, held.cone_matrix, {6, size});
    named["basis"] = view(self, held.basis, {13, size});
    named["basis_frames"] = view(self, held.basis_frames, {count, 3, 3});
    return named;
}

}  // namespace

void bind_pipeline(nb::module_& m) {
    nb::class_<Pipeline>(m, "Pipeline", "Contacts in, certified force out, for contacts that move from call to call.")
        .def_static("make", &make, "nominal"_a, "tolerance"_a, "limit"_a, "basis"_a, "frames"_a, "remembers"_a, "reference"_a,
                    "flows"_a = nb::none(), "flows: the step rule (5,) of the reduced flow; None: Newton.")
        .def("reset", &Pipeline::reset, "Forgets all calls.")
        .def("forget", &Pipeline::forget, "Forgets the last optimum.")
        .def(
            "set_basis",
            [](Pipeline& p, nb::handle basis, nb::handle frames) {
                const int count = p.contacts().count;
                p.set_basis(in(basis, 13, 3 * count).data(), in(frames, count, 3, 3).data());
            },
            "basis"_a, "frames"_a, "Takes another 12-basis (13, 3N) with the frames (N, 3, 3) it is written in.")
        .def("solve", &solve, "points"_a.none(), "normals"_a.none(), "wrench"_a.none(), "adjust"_a.none(), "record"_a,
             "Current contacts (N, 3), wrench (6,), adjust (3N - 6,) or None into a record; returns the code.")
        .def("carry", &carry, "points"_a, "normals"_a, "wrench"_a, "force"_a,
             "The last optimum carried to the current contacts and wrench, (N, 3); 0: carried, 1: repaired, 2: clipped.")
        .def("carry_from", &carry_from, "points"_a, "normals"_a, "wrench"_a, "then"_a, "frames"_a, "force"_a,
             "The same of forces (N, 3) [N] in frames (N, 3, 3) of contacts nearby.")
        .def("arrays", &arrays, "Views of what is held, by name: overwritten in place.");
}
