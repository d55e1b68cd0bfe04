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
// with or without a start: tensors or arrays on the CPU, float64 or float32, whose leading
// dimensions broadcast; numbers for all contacts or joints; or None.
class Problems {
 public:
  using Range = std::pair<Py_ssize_t, Py_ssize_t>;  // the first problem, and the one after the last
  ForceBatch batch;
  bool float32 = true;  // no tensor with dimensions is float64

  // Return null for a type or a layout that cannot be read in place; the caller converts it or
  // reports an error.
  static Problems* of(nb::tuple given, Py_ssize_t most_contacts, Py_ssize_t most_joints) {
    if (given.size() != INPUTS && given.size() != INPUTS + 1)
      throw nb::type_error("expected 13 tensors, and optionally a start");
    std::unique_ptr<Problems> problems(new Problems(given));
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
  // state: from `solve`. losses: the derivatives of a loss with respect to force, torsion and
  // multipliers, None: zero. gradients: arrays in the order of the inputs, or None.
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
    optimal_forces_gradients(chosen, states[from], forces[from], turns[from], multipliers[from],
                             elastic, targets);
  }

 private:
  explicit Problems(nb::tuple given) : given_(given) {}

  ForceBatch part(Py_ssize_t from, Py_ssize_t to) const {
    if (from < 0 || to < from || to > size())
      throw nb::value_error("start and stop are no part of the problems");
    return batch.part(from, to);
  }

  bool take(Py_ssize_t most_contacts, Py_ssize_t most_joints) {
    const std::size_t many = given_.size();
    for (std::size_t k = 0; k < many; ++k)
      if (!tensors_[k].view(given_[k])) return false;
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
    rows_ = {{{n, 3},
              {n, 3},
              {n, 2},
              {n, 3},
              {n},
              {6},
              {n, motions, joints},
              {joints},
              {joints},
              {n},
              {n},
              {n},
              {n},
              {n, 3}}};

    Tensor& friction = tensors_[FRICTION];
    const bool one_each = !friction.ends_in(rows_[FRICTION]) && friction.ends_in({n});
    if (friction.given && one_each && !friction.repeat(2)) return false;
    for (std::size_t k = 0; k < many; ++k) {
      const Tensor& each = tensors_[k];
      const bool needed = k == POSITIONS || k == NORMALS || k == FRICTION || k == WRENCH ||
                          k == FORCE_WEIGHT || k == BARRIER_WEIGHT;
      const bool vectors = k == POSITIONS || k == NORMALS || k == TANGENTS || k == WRENCH ||
                           k == JACOBIAN || k == START;
      if (!each.given && !needed) continue;
      if (!each.given || (each.number && vectors) || !each.ends_in(rows_[k])) return false;
      float32 = float32 && (each.number || each.float32);
      if (!broadcast(each.shape, each.leading(rows_[k]))) return false;
    }
    batch.size = 1;
    for (int a = 0; a < leading_; ++a) batch.size *= lead_[a];
    if (batch.size < 1) return false;
    for (std::size_t k = 0; k < many; ++k) {
      Tensor& each = tensors_[k];
      if (!each.given) continue;
      if (each.leading(rows_[k]) > 0) each.expand(rows_[k], lead_, leading_);
      batch.*FORCE_INPUTS[k] = each.slices(rows_[k], batch.size);
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

  nb::tuple given_;  // keeps the inputs alive
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
                       "optionally a start. Each is a tensor or\n"
                       "an array on the CPU, float64 or float32, whose leading dimensions "
                       "broadcast; a number for all contacts or\n"
                       "joints; or None.")
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
      .def_prop_ro("joints", [](const Problems& made) { return made.batch.joints; })
      .def_prop_ro("jacobian_rows", [](const Problems& made) { return made.batch.jacobian_rows; })
      .def_ro("float32", &Problems::float32, "True if no tensor with dimensions is float64.")
      .def("solve", &Problems::solve, "range"_a, "stop"_a, "results"_a,
           "Write the optimal forces of a range of problems (first, last + 1) into arrays for all "
           "problems: force, torsion,\n"
           "multipliers, facts and state, see `BatchForces`. stop: relative gap, and largest "
           "number of steps. Releases the GIL.")
      .def(
          "differentiate", &Problems::differentiate, "range"_a, "state"_a, "losses"_a, "elastic"_a,
          "gradients"_a,
          "Write the gradients of a loss with respect to the inputs, into arrays or None, in the "
          "inputs' order. losses: its\n"
          "derivatives with respect to force, torsion and multipliers, or None. Releases the GIL.");
}
