// Batches of problems for layers of learning programs.
#include <array>

#include <grasp/layer/layer.hpp>

#include "tensors.hpp"

using namespace grasp;

namespace {

constexpr int INPUTS = 13;  // without the start

// Problems with any leading dimensions, read where their numbers lie: positions, normals, friction, tangents, torsion, wrench, jacobian, torque
// limit and bias, min and max normal, force and barrier weight, and a start or none. Each is a tensor or an array with the leading
// dimensions of the batch or without any, float64 or float32, a number for all contacts or joints, or None.
class Problems {
public:
    ForceBatch batch;
    bool singles = true;  // whether no tensor is float64

    // Null where numbers do not lie so: Python converts them, or says what is wrong.
    static Problems* of(nb::tuple given, Py_ssize_t most_contacts, Py_ssize_t most_joints) {
        if (given.size() != INPUTS && given.size() != INPUTS + 1) throw nb::type_error("13 tensors, and a start or none");
        std::unique_ptr<Problems> made(new Problems(given));
        return made->take(most_contacts, most_joints) ? made.release() : nullptr;
    }
    Py_ssize_t size() const { return batch.size; }
    int contacts() const { return batch.contacts; }
    nb::tuple lead() const {
        nb::list made;
        for (int a = 0; a < axes_; ++a) made.append(lead_[a]);
        return nb::tuple(made);
    }

    void solve(Py_ssize_t from, Py_ssize_t to, double tolerance, int limit, nb::handle force, nb::handle torsion,
               nb::handle multipliers, nb::handle facts, nb::handle state) const {
        const Py_ssize_t n = contacts();
        const Run<double> forces(force, size(), 3 * n), turns(torsion, size(), n), prices(multipliers, size(), 6),
            told(facts, size(), LAYER_FACTS), states(state, size(), layer_state_size(contacts()));
        const ForceBatch chosen = part(from, to);
        nb::gil_scoped_release free;
        optimal_forces(chosen, {tolerance, limit}, {forces[from], turns[from], prices[from], told[from], states[from]});
    }
    // state: of `solve`; the derivatives of a loss by its answers, None: zero; gradients: arrays in the order of the inputs, or None
    void differentiate(Py_ssize_t from, Py_ssize_t to, nb::handle state, nb::handle by_force, nb::handle by_torsion,
                       nb::handle by_multipliers, bool elastic, nb::tuple gradients) const {
        const ForceBatch chosen = part(from, to);
        const Py_ssize_t n = contacts(), joints = batch.joints;
        if (gradients.size() != INPUTS) throw nb::type_error("13 arrays of gradients");
        const Run<const double> states(state, size(), layer_state_size(contacts())), forces(by_force, size(), 3 * n, true),
            turns(by_torsion, size(), n, true), prices(by_multipliers, size(), 6, true);
        int next = 0;
        const auto write = [&](const Slices& of, Py_ssize_t row) -> double* {
            const nb::handle array = gradients[next++];
            if (array.is_none()) return nullptr;
            if (!of) throw nb::type_error("a gradient by an input that is not given");
            double* data = Run<double>(array, size(), row)[from];
            std::fill_n(data, row * (to - from), 0.0);
            return data;
        };
        // in the order of the inputs; Python holds the arrays
        const BatchGradients made{.positions = write(batch.positions, 3 * n),
                                  .normals = write(batch.normals, 3 * n),
                                  .friction = write(batch.friction, 2 * n),
                                  .tangents = write(batch.tangents, 3 * n),
                                  .torsion = write(batch.torsion, n),
                                  .wrench = write(batch.wrench, 6),
                                  .jacobian = write(batch.jacobian, n * batch.jacobian_rows * joints),
                                  .torque_limit = write(batch.torque_limit, joints),
                                  .torque_bias = write(batch.torque_bias, joints),
                                  .min_normal = write(batch.min_normal, n),
                                  .max_normal = write(batch.max_normal, n),
                                  .force_weight = write(batch.force_weight, n),
                                  .barrier_weight = write(batch.barrier_weight, n)};
        nb::gil_scoped_release free;
        optimal_forces_gradients(chosen, states[from], forces[from], turns[from], prices[from], elastic, made);
    }

private:
    explicit Problems(nb::tuple given) : given_(given) {}

    ForceBatch part(Py_ssize_t from, Py_ssize_t to) const {
        if (from < 0 || to < from || to > size()) throw nb::value_error("start and stop are no part of the problems");
        return batch.part(from, to);
    }

    bool take(Py_ssize_t most_contacts, Py_ssize_t most_joints) {
        for (std::size_t k = 0; k < given_.size(); ++k)
            if (!tensors_[k].view(given_[k])) return false;
        Tensor &positions = tensors_[0], &friction = tensors_[2], &jacobian = tensors_[6];
        if (positions.axes < 2 || jacobian.given != tensors_[7].given || (tensors_[8].given && !jacobian.given) ||
            (jacobian.given && jacobian.axes < 3))
            return false;
        const Py_ssize_t n = positions.from_last(2), joints = jacobian.given ? jacobian.from_last(1) : 0,
                         rows = jacobian.given && jacobian.from_last(2) == 6 ? 6 : 3;
        if (n < 1 || n > most_contacts || joints > most_joints || (jacobian.given && joints < 1)) return false;
        batch.contacts = int(n), batch.joints = int(joints), batch.jacobian_rows = int(rows);
        struct Input {
            Slices* to;
            Tensor::Row row;
            bool needed = false, scalar = false;  // scalar: may be a number
        };
        const Input inputs[] = {{&batch.positions, {{n, 3}}, true},
                                {&batch.normals, {{n, 3}}, true},
                                {&batch.friction, {{n, 2}}, true, true},
                                {&batch.tangents, {{n, 3}}},
                                {&batch.torsion, {{n}}, false, true},
                                {&batch.wrench, {{6}}, true},
                                {&batch.jacobian, {{n, rows, joints}}},
                                {&batch.torque_limit, {{joints}}, false, true},
                                {&batch.torque_bias, {{joints}}, false, true},
                                {&batch.min_normal, {{n}}, false, true},
                                {&batch.max_normal, {{n}}, false, true},
                                {&batch.force_weight, {{n}}, true, true},
                                {&batch.barrier_weight, {{n}}, true, true},
                                {&batch.start, {{n, 3}}}};
        if (friction.given && !friction.ends_in({{n, 2}}) && friction.ends_in({{n}}) && !friction.repeat(2)) return false;
        Py_ssize_t size = 1;
        int axes = 0;  // of the leading dimensions
        for (std::size_t k = 0; k < given_.size(); ++k) {
            const Tensor& each = tensors_[k];
            const Input& input = inputs[k];
            if (!each.given && !input.needed) continue;
            if (!each.given || (each.number && !input.scalar) || !each.ends_in(input.row)) return false;
            singles = singles && (each.number || each.single);
            const int own = each.leading(input.row);
            if (own == 0) continue;
            if (axes == 0) std::copy_n(each.shape.begin(), axes = own, lead_.begin());
            else if (own != axes || !std::equal(lead_.begin(), lead_.begin() + own, each.shape.begin())) return false;
        }
        for (int a = 0; a < axes; ++a) size *= lead_[a];
        if (size < 1) return false;
        batch.size = size, axes_ = axes;
        for (std::size_t k = 0; k < given_.size(); ++k)
            if (tensors_[k].given) *inputs[k].to = tensors_[k].slices(inputs[k].row, size);
        return true;
    }

    nb::tuple given_;
    std::array<Tensor, INPUTS + 1> tensors_;
    std::array<Py_ssize_t, Tensor::MOST_AXES> lead_{};
    int axes_ = 0;
};

}  // namespace

void bind_layer(nb::module_& m) {
    m.attr("LAYER_FACTS") = LAYER_FACTS;
    m.def("layer_state_size", &layer_state_size, "contacts"_a, "Numbers of a problem's state.");
    nb::class_<Problems>(
        m, "ForceProblems",
        "Problems with any leading dimensions, read where their numbers lie: positions, normals, friction, tangents,\n"
        "torsional friction, wrench, jacobian, torque limit, torque bias, least and largest normal force, omega, lambda,\n"
        "start. Each is a tensor or an array on the CPU with the leading dimensions of the batch or without any,\n"
        "float64 or float32, a number for all contacts or joints, or None.")
        .def_static("of", &Problems::of, "given"_a, "most_contacts"_a, "most_joints"_a, nb::rv_policy::take_ownership,
                    nb::sig("def of(given: tuple, most_contacts: int, most_joints: int) -> ForceProblems | None"),
                    "None where they lie otherwise: convert them, or say what is wrong.")
        .def_prop_ro("lead", &Problems::lead, "Leading dimensions.")
        .def_prop_ro("size", &Problems::size, "Their product.")
        .def_prop_ro("contacts", &Problems::contacts)
        .def_prop_ro("joints", [](const Problems& made) { return made.batch.joints; })
        .def_prop_ro("jacobian_rows", [](const Problems& made) { return made.batch.jacobian_rows; })
        .def_ro("singles", &Problems::singles, "Whether no tensor is float64.")
        .def("solve", &Problems::solve, "start"_a, "stop"_a, "tolerance"_a, "limit"_a, "force"_a, "torsion"_a, "multipliers"_a,
             "facts"_a, "state"_a,
             "Optimal forces of the problems from start to stop into arrays of all of them, see `BatchForces`. Releases the GIL.")
        .def("differentiate", &Problems::differentiate, "start"_a, "stop"_a, "state"_a, "by_force"_a.none(),
             "by_torsion"_a.none(), "by_multipliers"_a.none(), "elastic"_a, "gradients"_a,
             "Gradients of a loss by the inputs, into arrays or None in their order. Releases the GIL.");
}
