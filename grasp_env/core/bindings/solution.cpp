// The base class of `ForceSolution`: a record, the names of its method and starts, and the force.
// Plain CPython and numpy: Python or a nanobind class take four times as long.
#include <grasp/record.hpp>

#include "buffers.hpp"
#include "solution.hpp"

#include <structmember.h>

namespace {

using grasp::SUMMARY;

struct Solution {
  PyObject_HEAD PyObject *record, *names, *objective_trace;
};

constexpr PyObject* Solution::* FIELDS[] = {&Solution::record, &Solution::names,
                                            &Solution::objective_trace};
PyObject* empty_array = nullptr;  // read-only
PyTypeObject* solution_type = nullptr;

PyArrayObject* array(PyObject* object) { return reinterpret_cast<PyArrayObject*>(object); }
double* row(PyObject* self) { return data_of<double>(reinterpret_cast<Solution*>(self)->record); }

// Raise the project's own error, imported only when needed.
PyObject* raise_invalid_input(const char* message) {
  nb::object kind = nb::module_::import_("grasp_env.errors").attr("InvalidInputError");
  PyErr_SetString(kind.ptr(), message);
  return nullptr;
}

bool is_record(PyObject* object) {
  if (!PyArray_Check(object)) return false;
  const PyArrayObject* a = array(object);
  if (PyArray_TYPE(a) != NPY_DOUBLE || PyArray_NDIM(a) != 1 || !PyArray_IS_C_CONTIGUOUS(a) ||
      !PyArray_ISBEHAVED_RO(a))
    return false;
  if (PyArray_DIM(a, 0) < SUMMARY) return false;
  const auto& s = *data_of<const grasp::Summary>(object);
  const double size = SUMMARY + 17.0 * s.contacts + s.joints + s.limits;
  for (double whole : {s.contacts, s.joints, s.limits, s.iterations, s.trials, s.start, s.code})
    if (!(whole >= 0.0 && whole < 1e18)) return false;
  for (double whole : {s.contacts, s.joints, s.limits, s.start, s.code})
    if (whole > 1e9 || whole != double(int(whole))) return false;
  const int code = int(s.code);
  if (size != double(PyArray_DIM(a, 0)) || s.start > double(grasp::Start::central)) return false;
  return code <= grasp::UNDECIDED && code != grasp::REFUSED && code != grasp::RANK_LOST;
}

PyObject* new_of(PyTypeObject* type, PyObject* record, PyObject* names, PyObject* trace) {
  Solution* solution = reinterpret_cast<Solution*>(PyType_GenericAlloc(type, 0));
  if (!solution) return nullptr;
  PyObject* values[] = {record, names, trace};
  for (int k = 0; k < 3; ++k) solution->*FIELDS[k] = Py_NewRef(values[k]);
  return reinterpret_cast<PyObject*>(solution);
}

PyObject* make(PyTypeObject* type, PyObject* arguments, PyObject* named) {
  PyObject *record, *names, *trace = empty_array;
  static const char* keywords[] = {"record", "names", "objective_trace", nullptr};
  if (!PyArg_ParseTupleAndKeywords(arguments, named, "OO|O", const_cast<char**>(keywords), &record,
                                   &names, &trace))
    return nullptr;
  if (!is_record(record)) {
    try {
      return raise_invalid_input(
          "expected the record of a ForceSolution: a C-contiguous float64 row whose header matches "
          "its length");
    } catch (nb::python_error& error) {
      error.restore();
      return nullptr;
    }
  }
  return new_of(type, record, names, trace);
}

void drop(PyObject* self) {
  PyTypeObject* type = Py_TYPE(self);
  for (const auto field : FIELDS) Py_CLEAR(reinterpret_cast<Solution*>(self)->*field);
  reinterpret_cast<freefunc>(PyType_GetSlot(type, Py_tp_free))(self);
  Py_DECREF(type);
}

// Numbers of the record as an array that keeps it alive; read-only, since certificates and the next
// solve rely on them.
PyObject* view(PyObject* self, Py_ssize_t first, int axes, const npy_intp* shape) {
  PyArrayObject* record = array(reinterpret_cast<Solution*>(self)->record);
  PyArray_Descr* type = PyArray_DESCR(record);
  Py_INCREF(reinterpret_cast<PyObject*>(type));
  PyObject* result = PyArray_NewFromDescr(&PyArray_Type, type, axes, shape, nullptr,
                                          row(self) + first, NPY_ARRAY_CARRAY_RO, nullptr);
  if (!result) return nullptr;
  if (PyArray_SetBaseObject(array(result), Py_NewRef(reinterpret_cast<PyObject*>(record))) < 0)
    Py_CLEAR(result);
  return result;
}
grasp::Record record(PyObject* self) { return grasp::Record(row(self)); }
Py_ssize_t count(PyObject* self) { return record(self).contacts(); }

PyObject* n_contacts(PyObject* self, void*) { return PyLong_FromSsize_t(count(self)); }
PyObject* code(PyObject* self, void*) { return PyLong_FromLong(long(*row(self))); }
int is_true(PyObject* self) { return record(self).has_force(); }
PyObject* has_force(PyObject* self, void*) { return PyBool_FromLong(record(self).has_force()); }
// Numbers of the record from `first` on.
PyObject* view(PyObject* self, const double* first, int axes, const npy_intp* shape) {
  return view(self, first - row(self), axes, shape);
}
PyObject* forces(PyObject* self, const double* first) {
  const npy_intp shape[] = {count(self), 3};
  return view(self, first, 2, shape);
}
PyObject* force(PyObject* self, void*) { return forces(self, record(self).force()); }
PyObject* initial_force(PyObject* self, void*) {
  return forces(self, record(self).initial_force());
}
PyObject* torsion(PyObject* self, void*) {
  const npy_intp many = count(self);
  return view(self, record(self).torsion(), 1, &many);
}

PyObject* frames(PyObject* self, void*) {
  const npy_intp shape[] = {count(self), 3, 3};
  return view(self, record(self).frames(), 3, shape);
}
PyObject* friction_used(PyObject* self, void*) {
  const npy_intp many = count(self);
  return view(self, record(self).friction_used(), 1, &many);
}
PyObject* torques(PyObject* self, void*) {
  const npy_intp many = npy_intp(record(self).summary().joints);
  return view(self, record(self).torques(), 1, &many);
}
PyObject* limit_multipliers(PyObject* self, void*) {
  const grasp::Summary& s = record(self).summary();
  const npy_intp many = int(s.code) == grasp::LIMITS_EXCEEDED ? 0 : npy_intp(s.limits);
  return view(self, record(self).limit_multipliers(), 1, &many);
}
PyObject* object_force(PyObject* self, void*) {
  const npy_intp shape[] = {count(self), 3};
  PyObject* result = PyArray_SimpleNew(2, shape, NPY_DOUBLE);
  if (!result) return nullptr;
  for (int i = 0; i < int(shape[0]); ++i)
    record(self).object_force(i, data_of<double>(result) + 3 * i);
  return result;
}
template <double grasp::Summary::* field> PyObject* number(PyObject* self, void*) {
  return PyFloat_FromDouble(record(self).summary().*field);
}
PyObject* gap(PyObject* self, void*) { return PyFloat_FromDouble(record(self).gap()); }
template <double grasp::Summary::* field> PyObject* whole(PyObject* self, void*) {
  return PyLong_FromDouble(record(self).summary().*field);
}
template <double grasp::Summary::* field> PyObject* truth(PyObject* self, void*) {
  return PyBool_FromLong(record(self).summary().*field != 0.0);
}
template <grasp::Vec6 grasp::Summary::* field> PyObject* six(PyObject* self, void*) {
  const npy_intp many = 6;
  const grasp::Summary& s = record(self).summary();
  return view(self, (s.*field).data() - &s.code, 1, &many);
}

using grasp::Summary;
constexpr PyGetSetDef property(const char* name, getter get, const char* doc) {
  return {name, get, nullptr, doc, nullptr};
}
PyGetSetDef read[] = {
    property("wrench", six<&Summary::wrench>,
             "(6,) external wrench that `force` balances [N, N m]."),
    property("wrench_with_preload", six<&Summary::wrench_with_preload>,
             "(6,) `wrench` plus what the preloads make, w + G s n [N, N m]."),
    property("multipliers", six<&Summary::multipliers>,
             "(6,) nu of balance: grad objective = G^T nu (+ multipliers of the limits), d "
             "objective / d wrench = -nu."),
    property("iterations", whole<&Summary::iterations>, "Accepted steps."),
    property("trials", whole<&Summary::trials>, "All steps tried, rejected ones included."),
    property(
        "objective", number<&Summary::objective>,
        "Phi of `force`; for `conic` the sum or maximum of the normal forces [N], or the norm of "
        "the joint torques [N m]; `limit_excess` if that is > 0."),
    property("lower_bound", number<&Summary::lower_bound>,
             "A dual bound: no balanced force has a smaller objective (-inf: none); or the given "
             "`optimum`."),
    property("equilibrium_residual", number<&Summary::residual>,
             "Largest |component| of G f + w [N], moments about the contacts' centre over the "
             "grasp's length."),
    property("cone_margin", number<&Summary::margin>,
             "Smallest mu * normal - |tangential| of the contacts [N], torsion included, in cone "
             "coordinates and within the problem's margin; > 0: strictly inside."),
    property("limit_excess", number<&Summary::limit_excess>,
             "Largest excess of a limit, as a fraction of it; 0: all are kept. See `elastic` of "
             "`optimize_force`."),
    property("optimality_gap", gap,
             "(objective - lower_bound) / lower_bound, certified; +inf without a positive bound."),
    property("start_replaced", truth<&Summary::replaced>,
             "True if the requested start was unusable and the solve began from another; see "
             "`initial`."),
    property("frames", frames,
             "(N, 3, 3) columns (n, o, t) of each contact, in the frame of the positions."),
    property("object_force", object_force,
             "(N, 3) N: `force` along the axes of the frame of the positions."),
    property("friction_used", friction_used,
             "(N,) share of the given friction that each force uses, torsion included."),
    property("torques", torques,
             "(J,) [N m] torques of the joints with torque limits, bias included; empty without "
             "such limits."),
    property("limit_multipliers", limit_multipliers,
             "(M,) >= 0 multipliers of the limits, in the order of `ForceOptimizer.limit_labels`; "
             "for INFEASIBLE those of\n"
             "the proof; otherwise empty."),
    property("n_contacts", n_contacts, "Number of contacts."),
    property("code", code, "Code of the solve, see `codes`."),
    property("has_force", has_force,
             "True if the solution holds a force; otherwise its force is zero."),
    property(
        "force", force,
        "(N, 3) N: normal, o, t of each finger's force on the object, in that contact's frame."),
    property("initial_force", initial_force, "(N, 3) start [N]."),
    property("torsion", torsion,
             "(N,) [N m] torsion of each finger on the object about its normal; zero for hard "
             "contacts."),
    {},
};
PyMemberDef held[] = {
    {"_record", T_OBJECT, offsetof(Solution, record), READONLY, nullptr},
    {"_names", T_OBJECT, offsetof(Solution, names), 0, nullptr},
    {"objective_trace", T_OBJECT, offsetof(Solution, objective_trace), 0, nullptr},
    {},
};
PyType_Slot slots[] = {
    {Py_tp_new, reinterpret_cast<void*>(make)},
    {Py_tp_dealloc, reinterpret_cast<void*>(drop)},
    {Py_tp_getset, read},
    {Py_tp_members, held},
    {Py_nb_bool, reinterpret_cast<void*>(is_true)},
    {Py_tp_doc, const_cast<char*>("The data of a solution; see `grasp_env.force.ForceSolution`.")},
    {}};
PyType_Spec spec{"grasp_env.core._core.Solution", sizeof(Solution), 0,
                 Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE, slots};

}  // namespace

PyObject* new_solution(PyObject* kind, PyObject* record, PyObject* names) {
  return new_of(reinterpret_cast<PyTypeObject*>(kind), record, names, empty_array);
}
bool is_solution_class(nb::handle kind) {
  return PyType_Check(kind.ptr()) &&
         PyType_IsSubtype(reinterpret_cast<PyTypeObject*>(kind.ptr()), solution_type);
}
double* row_of(nb::handle solution) {
  if (!PyObject_TypeCheck(solution.ptr(), solution_type))
    throw nb::type_error("expected a solution");
  return row(solution.ptr());
}
nb::object names_of(nb::handle solution) {
  return nb::borrow(reinterpret_cast<Solution*>(solution.ptr())->names);
}

void bind_solution(nb::module_& m) {
  if (_import_array() < 0) throw nb::python_error();
  Buffer::array_type = &PyArray_Type;
  npy_intp none = 0;
  empty_array = PyArray_SimpleNew(1, &none, NPY_DOUBLE);
  if (!empty_array) throw nb::python_error();
  PyArray_CLEARFLAGS(array(empty_array), NPY_ARRAY_WRITEABLE);
  nb::object type = nb::steal(PyType_FromSpec(&spec));
  if (!type) throw nb::python_error();
  solution_type = reinterpret_cast<PyTypeObject*>(type.ptr());
  m.attr("Solution") = type;
}
