// Batches of problems for layers of learning programs.
#include <grasp/layer/layer.hpp>

#include "buffers.hpp"

using namespace grasp;

namespace {

// An array of one row per problem, float64 and C-contiguous but for the first axis, which may have any step; None: none.
class BatchArray {
public:
    BatchArray(nb::handle object, std::initializer_list<Py_ssize_t> row, Py_ssize_t size) {
        if (object.is_none()) return;
        if (PyObject_GetBuffer(object.ptr(), &view_, PyBUF_STRIDES | PyBUF_FORMAT) != 0) throw nb::python_error();
        held_ = true;
        bool good = std::strcmp(view_.format, "d") == 0 && view_.ndim == int(row.size()) + 1 && view_.shape[0] == size;
        Py_ssize_t step = sizeof(double), axis = view_.ndim;
        for (auto wanted = std::rbegin(row); good && wanted != std::rend(row); ++wanted) {
            --axis;
            good = view_.shape[axis] == *wanted && (view_.strides[axis] == step || view_.shape[axis] == 1 || *wanted == 0);
            step *= *wanted;
        }
        if (!good || (size > 1 && view_.strides[0] % Py_ssize_t(sizeof(double)) != 0)) {
            PyBuffer_Release(&view_);
            held_ = false;
            throw nb::type_error("float64 arrays of one C-contiguous row per problem are needed, of other shapes");
        }
    }
    ~BatchArray() {
        if (held_) PyBuffer_Release(&view_);
    }
    BatchArray(const BatchArray&) = delete;
    BatchArray& operator=(const BatchArray&) = delete;

    Slices slices() const {
        if (!held_) return {};
        const Py_ssize_t step = view_.shape[0] > 1 ? view_.strides[0] / Py_ssize_t(sizeof(double)) : 0;
        return {static_cast<const double*>(view_.buf), step};
    }

private:
    Py_buffer view_;
    bool held_ = false;
};

constexpr int INPUTS = 13;  // without the start

Py_ssize_t length(nb::handle array, int axis) {
    return array.is_none() ? 0 : nb::cast<Py_ssize_t>(nb::object(array.attr("shape")[nb::int_(axis)]));
}

// positions, normals, friction, tangents, torsion, wrench, jacobian, torque limit and bias, min and max normal, force and barrier weight,
// start: (M, ...) each, or None
class Inputs {
public:
    ForceBatch batch;

    explicit Inputs(nb::tuple given) {
        if (given.size() != INPUTS && given.size() != INPUTS + 1) throw nb::type_error("13 arrays, and a start or none");
        const Py_ssize_t size = length(given[0], 0), n = length(given[0], 1), r = length(given[6], 2),
                         joints = length(given[6], 3);
        if (n < 1) throw nb::type_error("at least one contact");
        if (!given[6].is_none() && r != 3 && r != 6) throw nb::type_error("a jacobian has 3 or 6 rows for each contact");
        if (given[6].is_none() != given[7].is_none()) throw nb::type_error("a jacobian and torque limits go together");
        batch.size = size, batch.contacts = int(n), batch.joints = int(joints), batch.jacobian_rows = r == 6 ? 6 : 3;
        Slices* const to[] = {&batch.positions,      &batch.normals,    &batch.friction,   &batch.tangents,
                              &batch.torsion,        &batch.wrench,     &batch.jacobian,   &batch.torque_limit,
                              &batch.torque_bias,    &batch.min_normal, &batch.max_normal, &batch.force_weight,
                              &batch.barrier_weight, &batch.start};
        const std::initializer_list<Py_ssize_t> rows[] = {{n, 3},   {n, 3},   {n, 2}, {n, 3}, {n}, {6}, {n, r, joints},
                                                          {joints}, {joints}, {n},    {n},    {n}, {n}, {n, 3}};
        for (std::size_t k = 0; k < given.size(); ++k) {
            if (k < 3 && given[k].is_none()) throw nb::type_error("positions, normals and friction are needed");
            *to[k] = arrays_.emplace_back(std::make_unique<BatchArray>(given[k], rows[k], size))->slices();
        }
        if (!batch.wrench || !batch.force_weight || !batch.barrier_weight)
            throw nb::type_error("wrenches and weights are needed");
    }

private:
    std::vector<std::unique_ptr<BatchArray>> arrays_;
};

void solve(nb::tuple inputs, double tolerance, int limit, nb::handle state, nb::handle force, nb::handle torsion,
           nb::handle multipliers, nb::handle facts) {
    const Inputs given(inputs);
    const Py_ssize_t size = given.batch.size, n = given.batch.contacts;
    const Numbers states = out(state, size, layer_state_size(int(n))), forces = out(force, size, n, 3),
                  turns = out(torsion, size, n), prices = out(multipliers, size, 6), told = out(facts, size, LAYER_FACTS);
    nb::gil_scoped_release free;
    optimal_forces(given.batch, {tolerance, limit}, {forces.data(), turns.data(), prices.data(), told.data(), states.data()});
}

void differentiate(nb::tuple inputs, nb::handle state, nb::handle by_force, nb::handle by_torsion, nb::handle by_multipliers,
                   bool elastic, nb::tuple gradients) {
    const Inputs given(inputs);
    const ForceBatch& b = given.batch;
    const Py_ssize_t size = b.size, n = b.contacts, joints = b.joints;
    const Numbers states = in(state, size, layer_state_size(int(n)));
    std::vector<std::unique_ptr<Numbers>> held;
    const auto read = [&](nb::handle array, auto... sizes) -> const double* {
        return array.is_none() ? nullptr : held.emplace_back(std::make_unique<Numbers>(array, false, size, sizes...))->data();
    };
    const double *forces = read(by_force, n, 3), *turns = read(by_torsion, n), *prices = read(by_multipliers, 6);
    if (gradients.size() != INPUTS) throw nb::type_error("13 arrays of gradients");
    int next = 0;
    const auto write = [&](const Slices& of, auto... sizes) -> double* {
        const nb::handle array = gradients[next++];
        if (array.is_none()) return nullptr;
        if (!of) throw nb::type_error("a gradient by an input that is not given");
        double* data = held.emplace_back(std::make_unique<Numbers>(array, true, size, sizes...))->data();
        std::fill_n(data, (size * ... * Py_ssize_t(sizes)), 0.0);
        return data;
    };
    // in the order of the inputs
    const BatchGradients to{.positions = write(b.positions, n, 3),
                            .normals = write(b.normals, n, 3),
                            .friction = write(b.friction, n, 2),
                            .tangents = write(b.tangents, n, 3),
                            .torsion = write(b.torsion, n),
                            .wrench = write(b.wrench, 6),
                            .jacobian = write(b.jacobian, n, b.jacobian_rows, joints),
                            .torque_limit = write(b.torque_limit, joints),
                            .torque_bias = write(b.torque_bias, joints),
                            .min_normal = write(b.min_normal, n),
                            .max_normal = write(b.max_normal, n),
                            .force_weight = write(b.force_weight, n),
                            .barrier_weight = write(b.barrier_weight, n)};
    nb::gil_scoped_release free;
    optimal_forces_gradients(b, states.data(), forces, turns, prices, elastic, to);
}

}  // namespace

void bind_layer(nb::module_& m) {
    m.attr("LAYER_FACTS") = LAYER_FACTS;
    m.def("layer_state_size", &layer_state_size, "contacts"_a, "Numbers of a problem's state.");
    m.def("optimal_forces", &solve, "inputs"_a, "tolerance"_a, "limit"_a, "state"_a, "force"_a, "torsion"_a, "multipliers"_a,
          "facts"_a,
          "Optimal forces of M problems, see `ForceBatch` and `BatchForces`. inputs: positions, normals, friction (M, N, 2), "
          "tangents,\n"
          "torsional friction, wrench, jacobian, torque limit, torque bias, least and largest normal force, omega, lambda (M, "
          "N), start;\n"
          "each None or an array whose rows are C-contiguous; the first axis may have any step. Releases the GIL.");
    m.def("optimal_forces_gradients", &differentiate, "inputs"_a, "state"_a, "by_force"_a.none(), "by_torsion"_a.none(),
          "by_multipliers"_a.none(), "elastic"_a, "gradients"_a,
          "Gradients of a loss by the inputs, without the start, into arrays or None in their order. Releases the GIL.");
}
