// What `ForceSolution` is made of: one record and what was said of it, with the force read off it. Plain CPython and numpy, as
// the control loop pays for every nanosecond here: the same in Python, or as a class of nanobind, takes four times as long.
#include <grasp/record.hpp>

#include "module.hpp"

#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#include <numpy/arrayobject.h>
#include <structmember.h>

namespace {

constexpr Py_ssize_t SUMMARY = sizeof(grasp::Summary) / sizeof(double);

struct Solution { PyObject_HEAD PyObject *record, *method, *initial, *objective_trace, *certificate, *limit_multipliers; };

constexpr PyObject* Solution::* FIELDS[] = {&Solution::record,          &Solution::method,      &Solution::initial,
                                            &Solution::objective_trace, &Solution::certificate, &Solution::limit_multipliers};
PyObject* nothing = nullptr;  // an empty array, read-only

PyArrayObject* array(PyObject* object) { return reinterpret_cast<PyArrayObject*>(object); }

// Refuses with the project's own error, which is found only when it is needed.
PyObject* refuse(const char* said) {
    nb::object kind = nb::module_::import_("grasp_env.errors").attr("InvalidInputError");
    PyErr_SetString(kind.ptr(), said);
    return nullptr;
}

bool is_record(PyObject* object) {
    if (!PyArray_Check(object)) return false;
    const PyArrayObject* a = array(object);
    if (PyArray_TYPE(a) != NPY_DOUBLE || PyArray_NDIM(a) != 1 || !PyArray_IS_C_CONTIGUOUS(a) || !PyArray_ISBEHAVED_RO(a))
        return false;
    if (PyArray_DIM(a, 0) < SUMMARY || (PyArray_DIM(a, 0) - SUMMARY) % 7) return false;
    const double* row = static_cast<const double*>(PyArray_DATA(const_cast<PyArrayObject*>(a)));
    const bool counted = row[1] >= 0.0 && row[2] >= 0.0 && row[1] + row[2] < 1e18;
    if (!(row[0] >= 0.0 && row[0] <= double(grasp::LIMITS_EXCEEDED) && counted)) return false;
    const int code = int(row[0]);
    return double(code) == row[0] && code != grasp::REFUSED;
}

PyObject* make(PyTypeObject* type, PyObject* arguments, PyObject* named) {
    PyObject *record, *method, *initial, *trace = nothing, *certificate = Py_None, *multipliers = nothing;
    PyObject** const slots[] = {&record, &method, &initial, &trace, &certificate, &multipliers};
    const Py_ssize_t many = PyTuple_Size(arguments);
    if (!named && many >= 3 && many <= 6) {  // the control loop's
        for (Py_ssize_t k = 0; k < many; ++k) *slots[k] = PyTuple_GetItem(arguments, k);
    } else {
        static const char* names[] = {"record", "method", "initial", "objective_trace", "certificate", "limit_multipliers",
                                      nullptr};
        if (!PyArg_ParseTupleAndKeywords(arguments, named, "OOO|OOO", const_cast<char**>(names), &record, &method, &initial,
                                         &trace, &certificate, &multipliers))
            return nullptr;
    }
    if (!is_record(record)) {
        try {
            return refuse(
                "a record must be a C-contiguous float64 array of 20 + 7N numbers, the first a code of `Status`: take a "
                "solver's");
        } catch (nb::python_error& error) {
            error.restore();
            return nullptr;
        }
    }
    Solution* made = reinterpret_cast<Solution*>(PyType_GenericAlloc(type, 0));
    if (!made) return nullptr;
    PyObject* given[] = {record, method, initial, trace, certificate, multipliers};
    for (int k = 0; k < 6; ++k) made->*FIELDS[k] = Py_NewRef(given[k]);
    return reinterpret_cast<PyObject*>(made);
}

void drop(PyObject* self) {
    PyTypeObject* type = Py_TYPE(self);
    for (const auto field : FIELDS) Py_CLEAR(reinterpret_cast<Solution*>(self)->*field);
    reinterpret_cast<freefunc>(PyType_GetSlot(type, Py_tp_free))(self);
    Py_DECREF(type);
}

// Numbers of the record as a read-only array that keeps it alive: the certificates belong to them, and the next solve may start
// there.
PyObject* view(PyObject* self, Py_ssize_t first, int axes, const npy_intp* shape) {
    PyArrayObject* record = array(reinterpret_cast<Solution*>(self)->record);
    PyArray_Descr* type = PyArray_DESCR(record);
    Py_INCREF(reinterpret_cast<PyObject*>(type));
    PyObject* made = PyArray_NewFromDescr(&PyArray_Type, type, axes, shape, nullptr,
                                          static_cast<double*>(PyArray_DATA(record)) + first, NPY_ARRAY_CARRAY_RO, nullptr);
    if (!made) return nullptr;
    if (PyArray_SetBaseObject(array(made), Py_NewRef(reinterpret_cast<PyObject*>(record))) < 0) Py_CLEAR(made);
    return made;
}
Py_ssize_t count(PyObject* self) { return (PyArray_DIM(array(reinterpret_cast<Solution*>(self)->record), 0) - SUMMARY) / 7; }

PyObject* n_contacts(PyObject* self, void*) { return PyLong_FromSsize_t(count(self)); }
PyObject* code(PyObject* self, void*) {
    return PyLong_FromLong(long(*static_cast<double*>(PyArray_DATA(array(reinterpret_cast<Solution*>(self)->record)))));
}
PyObject* forces(PyObject* self, Py_ssize_t rows_before) {
    const npy_intp shape[] = {count(self), 3};
    return view(self, SUMMARY + 3 * rows_before, 2, shape);
}
PyObject* force(PyObject* self, void*) { return forces(self, 0); }
PyObject* initial_force(PyObject* self, void*) { return forces(self, count(self)); }
PyObject* torsion(PyObject* self, void*) {
    const npy_intp many = count(self);
    return view(self, SUMMARY + 6 * many, 1, &many);
}

PyGetSetDef read[] = {
    {"n_contacts", n_contacts, nullptr, "N.", nullptr},
    {"code", code, nullptr, "How the solve ended, see `codes`.", nullptr},
    {"force", force, nullptr, "(N, 3) N: normal, o, t of each finger's force on the object, in that contact's frame.", nullptr},
    {"initial_force", initial_force, nullptr, "(N, 3) the start [N].", nullptr},
    {"torsion", torsion, nullptr,
     "(N,) N m: torsion of each finger on the object about its normal; zero unless the contact is soft.", nullptr},
    {},
};
PyMemberDef held[] = {
    {"_record", T_OBJECT, offsetof(Solution, record), READONLY, nullptr},
    {"method", T_OBJECT, offsetof(Solution, method), 0, nullptr},
    {"initial", T_OBJECT, offsetof(Solution, initial), 0, nullptr},
    {"objective_trace", T_OBJECT, offsetof(Solution, objective_trace), 0, nullptr},
    {"certificate", T_OBJECT, offsetof(Solution, certificate), 0, nullptr},
    {"limit_multipliers", T_OBJECT, offsetof(Solution, limit_multipliers), 0, nullptr},
    {},
};
PyType_Slot slots[] = {{Py_tp_new, reinterpret_cast<void*>(make)},
                       {Py_tp_dealloc, reinterpret_cast<void*>(drop)},
                       {Py_tp_getset, read},
                       {Py_tp_members, held},
                       {Py_tp_doc, const_cast<char*>("One record and what was said of it; see `grasp_env.force.ForceSolution`.")},
                       {}};
PyType_Spec spec{"grasp_env.core._core.Solution", sizeof(Solution), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE, slots};

}  // namespace

void bind_solution(nb::module_& m) {
    if (_import_array() < 0) throw nb::python_error();
    npy_intp none = 0;
    nothing = PyArray_SimpleNew(1, &none, NPY_DOUBLE);
    if (!nothing) throw nb::python_error();
    PyArray_CLEARFLAGS(array(nothing), NPY_ARRAY_WRITEABLE);
    m.attr("Solution") = nb::steal(PyType_FromSpec(&spec));
}
