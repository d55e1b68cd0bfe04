// `grasp::ForceOptimizer`. `solve` reads arrays in place and makes its solution without Python.
#include "optimizer.hpp"

#include <grasp/many/basis.hpp>

#include "buffers.hpp"
#include "problem.hpp"
#include "solution.hpp"
#include "timing.hpp"

namespace {

using grasp::Changes;
using grasp::Doubles;
using grasp::Record;
using grasp::Request;

// The numbers of an array that can be read in place; subclasses may hide some, as masked arrays do.
class ArrayArgument {
 public:
  explicit ArrayArgument(PyObject* object) : given_(object != Py_None) {
    if (!given_ || !PyArray_CheckExact(object)) return;
    PyArrayObject* array = reinterpret_cast<PyArrayObject*>(object);
    if (PyArray_TYPE(array) == NPY_DOUBLE && PyArray_ISCARRAY_RO(array)) array_ = array;
  }
  bool has(std::initializer_list<npy_intp> shape) const {
    return array_ && PyArray_NDIM(array_) == int(shape.size()) &&
           std::equal(shape.begin(), shape.end(), PyArray_DIMS(array_));
  }
  const double* data() const { return static_cast<double*>(PyArray_DATA(array_)); }
  Doubles numbers() const { return {data(), std::size_t(PyArray_SIZE(array_))}; }
  // Take the numbers if the argument is given. Return false if they cannot be read.
  bool take(std::initializer_list<npy_intp> shape, Doubles& to) const {
    if (!given_) return true;
    if (!has(shape)) return false;
    to = numbers();
    return true;
  }

 private:
  PyArrayObject* array_ = nullptr;
  bool given_;
};

// The class of C++, with the class and the names of its solutions in Python.
class ForceOptimizer : public grasp::ForceOptimizer {
 public:
  const int count, joints;

  ForceOptimizer(const grasp::Problem& problem, const grasp::Options& options, nb::object kind,
                 nb::object names)
      : grasp::ForceOptimizer(problem, options),
        count(problem.contacts.count),
        joints(int(problem.limits.torque_limit.size())),
        kind_(kind),
        names_(names),
        last_names_(names) {}

  nb::object solved(const Request& request) {
    const Record& record = solve(request);
    if (record.has_force() && last_names_.ptr() != names_.ptr()) last_names_ = names_;
    return solution(record, names_);
  }
  nb::object last() {
    const std::optional<Record> record = previous();
    return record ? solution(*record, last_names_) : nb::none();
  }
  bool take(nb::handle solution) {
    const bool taken = remember(Record(row_of(solution)));
    if (taken) last_names_ = names_of(solution);
    return taken;
  }
  nb::object solution(const nb::object& row) const { return solution(row, names_); }

  // Read wrench and changes in place. Return false if one cannot be read.
  bool read(nb::handle wrench, nb::handle changes, Request& request) {
    const ArrayArgument load(wrench.ptr());
    if (!load.has({6})) return false;
    request.wrench = load.data();
    return changes.is_none() || read(changes, request.now);
  }
  bool read(nb::handle changes, Changes& now) {
    enum { POSITIONS, NORMALS, FRICTION, JACOBIAN, TORQUE_BIAS, CONTACTS, MARGIN, ALL };
    if (!PyTuple_Check(changes.ptr()) || PyTuple_GET_SIZE(changes.ptr()) != ALL)
      throw nb::type_error(
          "expected positions, normals, friction, jacobian, torque_bias, contacts and margin");
    const auto item = [&](int which) { return PyTuple_GET_ITEM(changes.ptr(), which); };
    return ArrayArgument(item(POSITIONS)).take({count, 3}, now.positions) &&
           ArrayArgument(item(NORMALS)).take({count, 3}, now.normals) &&
           ArrayArgument(item(TORQUE_BIAS)).take({joints}, now.torque_bias) &&
           read_friction(item(FRICTION), now) && read_jacobian(item(JACOBIAN), now) &&
           read_contacts(item(CONTACTS), now) && read_margin(item(MARGIN), count, now.margin);
  }

 private:
  nb::object kind_, names_, last_names_;
  double friction_ = 0.0;

  nb::object solution(const Record& record, const nb::object& names) const {
    nb::object row = new_row(record.size());
    std::copy_n(&record.summary().code, record.size(), data_of<double>(row.ptr()));
    return solution(row, names);
  }
  nb::object solution(const nb::object& row, const nb::object& names) const {
    nb::object result = nb::steal(new_solution(kind_.ptr(), row.ptr(), names.ptr()));
    if (!result) throw nb::python_error();
    return result;
  }

  bool read_friction(PyObject* object, Changes& now) {
    if (object == Py_None) return true;
    if (PyFloat_CheckExact(object)) {
      friction_ = PyFloat_AsDouble(object);
      now.friction = {&friction_, 1};
      return true;
    }
    const ArrayArgument array(object);
    if (!array.has({count}) && !array.has({count, 2})) return false;
    now.friction = array.numbers();
    return true;
  }
  bool read_jacobian(PyObject* object, Changes& now) const {
    const ArrayArgument array(object);
    return array.take({count, 3, joints}, now.jacobian) ||
           array.take({count, 6, joints}, now.jacobian);
  }
  bool read_contacts(PyObject* object, Changes& now) const {
    if (object == Py_None) return true;
    if (!PyArray_CheckExact(object)) return false;
    PyArrayObject* which = reinterpret_cast<PyArrayObject*>(object);
    if (PyArray_TYPE(which) != NPY_BOOL || PyArray_NDIM(which) != 1 ||
        PyArray_DIM(which, 0) != count || count > 64)
      return false;
    now.contacts = 0;
    for (int i = 0; i < count; ++i)
      now.contacts |= std::uint64_t(*static_cast<npy_bool*>(PyArray_GETPTR1(which, i)) != 0) << i;
    return true;
  }
};

void make(ForceOptimizer* self, const OwnProblem& problem, const grasp::Options& options,
          nb::object kind, nb::object names) {
  if (!is_solution_class(kind))
    throw nb::type_error("kind must be `Solution` or a class derived from it");
  new (self) ForceOptimizer(problem.view(), options, kind, names);
}

nb::object solve(ForceOptimizer& on, nb::handle wrench, nb::handle changes,
                 const OwnRequest* request) {
  Request call{};
  if (request) call = request->request;
  if (!on.read(wrench, changes, call)) return nb::borrow(Py_NotImplemented);
  return on.solved(call);
}

nb::object solve_call(ForceOptimizer& on, nb::handle wrench, nb::handle changes) {
  return solve(on, wrench, changes, nullptr);
}

nb::object start(ForceOptimizer& on, nb::handle wrench, nb::handle changes,
                 const OwnRequest& request) {
  Request call = request.request;
  if (!on.read(wrench, changes, call)) return nb::borrow(Py_NotImplemented);
  nb::object row = new_row(on.size());
  on.start(call, data_of<double>(row.ptr()));
  return on.solution(row);
}

bool update(ForceOptimizer& on, nb::handle changes) {
  Changes now;
  if (!on.read(changes, now)) throw nb::type_error("expected C-contiguous float64 arrays");
  return on.update(now);
}

void solve_many(const ForceOptimizer& on, nb::handle wrenches, nb::handle rows) {
  const Numbers loads = in(wrenches, -1, 6);
  const Numbers to = out(rows, loads.length(0), on.size());
  grasp::ForceOptimizer own = on;  // copied while the GIL still protects it
  nb::gil_scoped_release free;
  own.solve_many(loads.numbers(), to.numbers());
}

void times(ForceOptimizer& on, nb::handle wrenches, int passes, nb::handle rows, nb::handle best) {
  time_calls(wrenches, passes, on.size(), rows, best, [&](const double* wrench, double* row) {
    Request call{};
    call.wrench = wrench;
    on.solve(call, row);
  });
}

nb::typed<nb::tuple, int, int, double> deepest(ForceOptimizer& on, nb::handle wrench,
                                               nb::handle force, nb::handle torsion,
                                               nb::handle twist) {
  const Numbers load = in(wrench, 6);
  const Numbers to = out(force, on.count, 3);
  const Numbers turn = out(torsion, on.count);
  const Numbers proof = out(twist, 6);
  const grasp::Deepest deepest =
      on.deepest(grasp::Wrench(load.data(), 6), to.numbers(), turn.numbers());
  std::ranges::copy(deepest.twist, proof.data());
  return nb::make_tuple(int(deepest.code), deepest.iterations, deepest.margin);
}

nb::typed<nb::tuple, int, int, bool, double, double> payload(
    ForceOptimizer& on, nb::handle direction, nb::handle wrench, double tolerance, nb::handle force,
    nb::handle torsion, nb::handle twist, nb::handle multipliers) {
  const Numbers along = in(direction, 6);
  const Numbers load = in(wrench, 6);
  const Numbers to = out(force, on.count, 3);
  const Numbers turn = out(torsion, on.count);
  const Numbers proof = out(twist, 6);
  const Numbers prices = out(multipliers, on.size() - grasp::record_size(on.count, on.joints, 0));
  const grasp::Payload payload =
      on.payload(grasp::Wrench(along.data(), 6), grasp::Wrench(load.data(), 6), to.numbers(),
                 turn.numbers(), prices.numbers(), tolerance);
  std::ranges::copy(payload.twist, proof.data());
  return nb::make_tuple(int(payload.code), payload.iterations, payload.unbounded, payload.load,
                        payload.bound);
}

void set_basis(ForceOptimizer& on, nb::handle basis) {
  on.set_basis(in(basis, 13, 3 * on.count).numbers());
}
double make_basis(ForceOptimizer& on, nb::handle basis, bool warm) {
  return on.make_basis(out(basis, 13, 3 * on.count).numbers(), warm);
}

void combine(nb::handle basis, nb::handle wrench, bool printed, nb::handle to) {
  const Numbers rows = in(basis, 13, -1);
  const Numbers load = in(wrench, 6);
  const Py_ssize_t size = rows.length(1);
  const Numbers sum = out(to, size);
  const grasp::Combination combination(load.data(), printed);
  std::fill(sum.data(), sum.data() + size, 0.0);
  for (int k = 0; k < 7; ++k)
    for (Py_ssize_t j = 0; j < size; ++j)
      sum.data()[j] += combination.weights[k] * rows.data()[size * combination.rows[k] + j];
}

}  // namespace

bool read_margin(PyObject* object, int count, std::optional<grasp::Margin>& to) {
  static PyObject* const friction_name = PyUnicode_InternFromString("friction");
  static PyObject* const preload_name = PyUnicode_InternFromString("preload");
  if (object == Py_None) return true;
  if (PyFloat_CheckExact(object)) {
    to = grasp::Margin{PyFloat_AsDouble(object)};
    return true;
  }
  const nb::object friction = nb::steal(PyObject_GetAttr(object, friction_name));
  const nb::object preload = nb::steal(PyObject_GetAttr(object, preload_name));
  PyErr_Clear();
  if (!friction || !preload || !PyFloat_CheckExact(friction.ptr())) return false;
  to = grasp::Margin{PyFloat_AsDouble(friction.ptr())};
  if (PyFloat_CheckExact(preload.ptr())) {
    to->preload = PyFloat_AsDouble(preload.ptr());
    return true;
  }
  const ArrayArgument array(preload.ptr());
  if (!array.has({count})) return false;
  to->preload = array.numbers();  // the margin keeps its array alive
  return true;
}

grasp::Margin margin_of(nb::handle margin, int count) {
  std::optional<grasp::Margin> read;
  if (!read_margin(margin.ptr(), count, read))
    throw nb::type_error("expected a margin with friction and preload");
  return read.value_or(grasp::Margin{});
}

const grasp::ForceOptimizer& optimizer_of(nb::handle optimizer) {
  return nb::cast<const ForceOptimizer&>(optimizer);
}

void bind_optimizer(nb::module_& m) {
  if (_import_array() < 0) throw nb::python_error();
  m.attr("ACCEPTED_GAP") = grasp::ACCEPTED_GAP;
  m.attr("CLEAR") = grasp::CLEAR;
  m.def("combine", &combine, "basis"_a, "wrench"_a, "printed"_a, "to"_a,
        "Combine a 12-basis with the optimum at rest (13, M) for a wrench, into (M,).\n"
        "printed: without the optimum at rest (Eqs. 33, 34).");
  nb::class_<ForceOptimizer>(m, "ForceOptimizer",
                             "`grasp::ForceOptimizer`; use `grasp_env.force.ForceOptimizer`.")
      .def("__init__", &make, "problem"_a, nb::arg("options").sig("...") = grasp::Options{},
           nb::arg("kind").sig("...") = m.attr("Solution"), "names"_a.none() = nb::none(),
           "kind: the class of solutions; names: what `Solution._names` returns.")
      .def("solve", &solve, "wrench"_a.none(), "changes"_a.none() = nb::none(),
           "request"_a.none() = nb::none(),
           "Return a solution, whose code says whether it holds a force; NotImplemented if wrench "
           "or changes are not\n"
           "C-contiguous float64 arrays of the right shapes. changes: (positions, normals, "
           "friction, jacobian, torque_bias,\n"
           "contacts, margin), None where nothing changes.")
      // without named arguments, which cost nanobind 50 ns
      .def("solve_call", &solve_call,
           nb::sig("def solve_call(self, wrench: object, changes: tuple | None, /) -> object"),
           "`solve` without a request.")
      .def("start", &start, "wrench"_a, "changes"_a.none(), "request"_a,
           "The same for the start alone: code `started`, and the start in `initial_force`.")
      .def("update", &update, "changes"_a,
           "Replace contacts and limits for later calls. Return False, with nothing changed, if "
           "they are impossible.")
      .def_prop_ro("previous", &ForceOptimizer::last, "The last solution with a force, or None.")
      .def("remember", &ForceOptimizer::take, "solution"_a,
           "Take a solution as the last one. Return False if it holds no force or has another "
           "number of contacts.")
      .def("forget", &ForceOptimizer::forget, "Forget the last solution.")
      .def("set_basis", &set_basis, "basis"_a,
           "Set the 12-basis with the optimum at rest, (13, 3N) cone coordinates.")
      .def("make_basis", &make_basis, "basis"_a, "warm"_a,
           "Compute that basis into `basis` and use it; warm: `basis` holds that of nearby "
           "contacts.\n"
           "Return the worst relative gap; inf: not converged, nan: no force closure.")
      .def(
          "payload", &payload, "direction"_a, "wrench"_a, "tolerance"_a, "force"_a, "torsion"_a,
          "twist"_a, "multipliers"_a,
          "Find the largest k for which forces hold wrench + k direction, (6,) each, with force "
          "(N, "
          "3), torsion (N,), twist (6,) and multipliers (M,). Return (code, iterations, unbounded, "
          "k, bound).")
      .def("deepest", &deepest, "wrench"_a, "force"_a, "torsion"_a, "twist"_a,
           "Find the force (N, 3) and torsion (N,) deepest inside cones and limits, or the twist "
           "(6,) that proves that\n"
           "none is inside. Return (code, iterations, margin).")
      .def("solve_many", &solve_many, "wrenches"_a, "rows"_a,
           "Solve (M, 6) wrenches into (M, size); releases the GIL.")
      .def("times", &times, "wrenches"_a, "passes"_a, "rows"_a, "best"_a,
           "Write the best times (M,) [s] of `passes` calls for each of (M, 6) wrenches, and the "
           "last rows.")
      .def_ro("count", &ForceOptimizer::count, "Number of contacts.")
      .def_prop_ro("size", &ForceOptimizer::size, "Number of values in a row.");
}
