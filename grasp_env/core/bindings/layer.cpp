// Batches of problems for layers of learning programs.
#include <grasp/layer/layer.hpp>

#include <nanobind/stl/pair.h>

#include "buffers.hpp"
#include "tensors.hpp"

using namespace grasp;

namespace {

constexpr int INPUTS = int(std::size(FORCE_GRADIENTS));  // without the start
enum Place {
  POSITIONS,
  NORMALS,
  FRICTION,
  TANGENTS,
  TORSION,
  WRENCH,
  JACOBIAN,
  TORQUE_LIMIT,
  TORQUE_BIAS,
  MIN_NORMAL,
  MAX_NORMAL,
  FORCE_WEIGHT,
  BARRIER_WEIGHT,
  START
};

// Problems with any leading dimensions, read in place. The inputs have the order of `FORCE_INPUTS`,
// with or without a start.
class Problems {
 public:
  using Range = std::pair<Py_ssize_t, Py_ssize_t>;  // the first problem, and the one after the last
  ForceBatch batch;
  bool float32 = true;  // no tensor with dimensions is float64

  static Problems* of(nb::tuple inputs, Py_ssize_t most_contacts, Py_ssize_t most_joints) {
    if (inputs.size() != INPUTS && inputs.size() != INPUTS + 1)
      throw nb::type_error("expected 13 tensors, and optionally a start");
    std::unique_ptr<Problems> problems(new Problems(inputs));
    return problems->take(most_contacts, most_joints) ? problems.release() : nullptr;
  }
  Py_ssize_t size() const { return batch.size; }
  int contacts() const { return batch.contacts; }
  nb::tuple lead() const {
    nb::list lengths;
    for (int a = 0; a < leading_; ++a) lengths.append(lead_[a]);
    return nb::tuple(lengths);
  }

  // results: force, torsion, multipliers, facts, state
  void solve(Range range, std::pair<double, int> stop, nb::tuple results) const {
    const Py_ssize_t n = contacts();
    const auto [from, to] = range;
    if (results.size() != 5)
      throw nb::type_error("expected force, torsion, multipliers, facts and state");
    const NumberRows forces(results[0], true, size(), 3 * n);
    const NumberRows turns(results[1], true, size(), n);
    const NumberRows multipliers(results[2], true, size(), 6);
    const NumberRows facts(results[3], true, size(), LAYER_FACTS);
    const NumberRows states(results[4], true, size(), layer_state_size(contacts()));
    const ForceBatch chosen = part(from, to);
    nb::gil_scoped_release free;
    optimal_forces(chosen, {stop.first, stop.second},
                   {forces[from], turns[from], multipliers[from], facts[from], states[from]});
  }
  void differentiate(Range range, nb::handle state, nb::tuple losses, bool elastic,
                     nb::tuple gradients) const {
    const auto [from, to] = range;
    const ForceBatch chosen = part(from, to);
    if (losses.size() != 3)
      throw nb::type_error("expected losses by force, torsion and multipliers");
    const Py_ssize_t n = contacts();
    if (gradients.size() != INPUTS) throw nb::type_error("expected 13 arrays of gradients");
    const NumberRows states(state, false, size(), layer_state_size(contacts()));
    const NumberRows forces(losses[0], false, size(), 3 * n, true);
    const NumberRows turns(losses[1], false, size(), n, true);
    const NumberRows multipliers(losses[2], false, size(), 6, true);
    BatchGradients targets{};
    for (int k = 0; k < INPUTS; ++k) {
      if (gradients[k].is_none()) continue;
      if (!(batch.*FORCE_INPUTS[k]))
        throw nb::type_error("a gradient is requested for an input that is not given");
      const Py_ssize_t row = rows_[k].count();
      double* const data = targets.*FORCE_GRADIENTS[k] =
                               NumberRows(gradients[k], true, size(), row)[from];
      std::fill_n(data, row * (to - from), 0.0);  // the tuple holds the array
    }
    nb::gil_scoped_release free;
    optimal_forces_gradients(chosen, states[from], {forces[from], turns[from], multipliers[from]},
                             elastic, targets);
  }

 private:
  explicit Problems(nb::tuple inputs) : inputs_(inputs) {}

  ForceBatch part(Py_ssize_t from, Py_ssize_t to) const {
    if (from < 0 || to < from || to > size())
      throw nb::value_error("start and stop are no part of the problems");
    return batch.part(from, to);
  }

  bool take(Py_ssize_t most_contacts, Py_ssize_t most_joints) {
    const std::size_t many = inputs_.size();
    for (std::size_t k = 0; k < many; ++k)
      if (!tensors_[k].view(inputs_[k])) return false;
    const Tensor& positions = tensors_[POSITIONS];
    const Tensor& jacobian = tensors_[JACOBIAN];
    if (positions.dimensions < 2 || jacobian.given != tensors_[TORQUE_LIMIT].given ||
        (tensors_[TORQUE_BIAS].given && !jacobian.given) ||
        (jacobian.given && jacobian.dimensions < 3))
      return false;
    const Py_ssize_t n = positions.from_last(2);
    const Py_ssize_t joints = jacobian.given ? jacobian.from_last(1) : 0;
    const Py_ssize_t motions = jacobian.given && jacobian.from_last(2) == 6 ? 6 : 3;
    if (n < 1 || n > most_contacts || joints > most_joints || (jacobian.given && joints < 1))
      return false;
    batch.contacts = int(n);
    batch.joints = int(joints);
    batch.jacobian_rows = int(motions);
    using Row = Tensor::Row;
    rows_ = {
        Row(n, 3),   Row(n, 3),   Row(n, 2), Row(n, 3), Row(n), Row(6), Row(n, motions, joints),
        Row(joints), Row(joints), Row(n),    Row(n),    Row(n), Row(n), Row(n, 3)};

    Tensor& friction = tensors_[FRICTION];
    const bool one_each = !friction.ends_in(rows_[FRICTION]) && friction.ends_in({n});
    if (friction.given && one_each && !friction.repeat(2)) return false;
    for (std::size_t k = 0; k < many; ++k) {
      const Tensor& tensor = tensors_[k];
      const bool needed = k == POSITIONS || k == NORMALS || k == FRICTION || k == WRENCH ||
                          k == FORCE_WEIGHT || k == BARRIER_WEIGHT;
      const bool vectors = k == POSITIONS || k == NORMALS || k == TANGENTS || k == WRENCH ||
                           k == JACOBIAN || k == START;
      if (!tensor.given && !needed) continue;
      if (!tensor.given || (tensor.number && vectors) || !tensor.ends_in(rows_[k])) return false;
      float32 = float32 && (tensor.number || tensor.float32);
      if (!broadcast(tensor.shape, tensor.leading(rows_[k]))) return false;
    }
    batch.size = 1;
    for (int a = 0; a < leading_; ++a) batch.size *= lead_[a];
    if (batch.size < 1) return false;
    for (std::size_t k = 0; k < many; ++k) {
      Tensor& tensor = tensors_[k];
      if (!tensor.given) continue;
      if (tensor.leading(rows_[k]) > 0) tensor.expand(rows_[k], lead_, leading_);
      batch.*FORCE_INPUTS[k] = tensor.slices(rows_[k], batch.size);
    }
    return true;
  }
  // Broadcast the leading dimensions so far with these. Return false if they do not fit.
  bool broadcast(const Tensor::Lengths& shape, int leading) {
    if (leading + 3 > Tensor::MOST_DIMENSIONS) return false;
    if (leading > leading_) {
      std::copy_backward(lead_.begin(), lead_.begin() + leading_, lead_.begin() + leading);
      std::fill_n(lead_.begin(), leading - leading_, 1);
      leading_ = leading;
    }
    for (int a = 0; a < leading; ++a) {
      Py_ssize_t& length = lead_[leading_ - leading + a];
      if (length == 1)
        length = shape[a];
      else if (shape[a] != 1 && shape[a] != length)
        return false;
    }
    return true;
  }

  nb::tuple inputs_;  // keeps them alive
  std::array<Tensor, INPUTS + 1> tensors_;
  std::array<Tensor::Row, INPUTS + 1> rows_;
  Tensor::Lengths lead_{};
  int leading_ = 0;
};

}  // namespace

void bind_layer(nb::module_& m) {
  m.attr("LAYER_FACTS") = LAYER_FACTS;
  m.def("layer_state_size", &layer_state_size, "contacts"_a,
        "Return the number of values in a problem's state.");
  nb::class_<Problems>(m, "ForceProblems",
                       "Problems with any leading dimensions, read in place.\n"
                       "\n"
                       "The inputs are positions, normals, friction, tangents, torsional friction, "
                       "wrench, jacobian, torque limit,\n"
                       "torque bias, smallest and largest normal force, omega, lambda, and "
                       "optionally a start: float64 or float32\n"
                       "tensors or arrays on the CPU, whose leading dimensions broadcast; numbers "
                       "for all contacts or joints; or None.")
      .def_static(
          "of", &Problems::of, "given"_a, "most_contacts"_a, "most_joints"_a,
          nb::rv_policy::take_ownership,
          nb::sig(
              "def of(given: tuple, most_contacts: int, most_joints: int) -> ForceProblems | None"),
          "Return None for a type or a layout that cannot be read in place: convert it, or report "
          "an error.")
      .def_prop_ro("lead", &Problems::lead, "Leading dimensions.")
      .def_prop_ro("size", &Problems::size, "Product of the leading dimensions.")
      .def_prop_ro("contacts", &Problems::contacts)
      .def_prop_ro("joints", [](const Problems& problems) { return problems.batch.joints; })
      .def_prop_ro("jacobian_rows",
                   [](const Problems& problems) { return problems.batch.jacobian_rows; })
      .def_ro("float32", &Problems::float32, "True if no tensor with dimensions is float64.")
      .def("solve", &Problems::solve, "range"_a, "stop"_a, "results"_a,
           "Write the optimal forces of the problems first to last, range (first, last + 1), into "
           "arrays for all problems:\n"
           "force, torsion, multipliers, facts and state, see `BatchForces`. stop: relative gap, "
           "most steps. Releases the GIL.")
      .def("differentiate", &Problems::differentiate, "range"_a, "state"_a, "losses"_a, "elastic"_a,
           "gradients"_a,
           "Write the gradients of a loss by the inputs into arrays, in their order, or None. "
           "losses: its derivatives by force,\n"
           "torsion and multipliers; None: zero. Releases the GIL.");
}
