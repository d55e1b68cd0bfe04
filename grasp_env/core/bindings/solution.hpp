// The base class of `ForceSolution`, and numpy's C interface; include it last.
#pragma once

#include "module.hpp"

#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#include <numpy/arrayobject.h>

// A new array of one axis, and the numbers of an array.
static inline nb::object new_row(npy_intp length, int type = NPY_DOUBLE) {
  nb::object row = nb::steal(PyArray_SimpleNew(1, &length, type));
  if (!row) throw nb::python_error();
  return row;
}
template <class T> static T* data_of(PyObject* array) {
  return static_cast<T*>(PyArray_DATA(reinterpret_cast<PyArrayObject*>(array)));
}

// Return a new solution of class `kind` with the row that a solver wrote; null: an exception is
// set.
PyObject* new_solution(PyObject* kind, PyObject* record, PyObject* names);
// True for `core.Solution` and classes derived from it.
bool is_solution_class(nb::handle kind);
// The row of a solution; throws a TypeError for other objects.
double* row_of(nb::handle solution);
// The names of a solution.
nb::object names_of(nb::handle solution);
