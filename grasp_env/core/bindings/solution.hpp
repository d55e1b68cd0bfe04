// The base class of `ForceSolution`, for other files of this folder. Include it last: it brings
// numpy's C interface.
#pragma once

#include "module.hpp"

#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#include <numpy/arrayobject.h>

// Return a new object of a class derived from `core.Solution` for a row that a solver wrote; null:
// an exception is set.
PyObject* new_solution(PyObject* kind, PyObject* record, PyObject* names);
// True for `core.Solution` and classes derived from it.
bool is_solution_class(nb::handle kind);
// Return the row of a solution. Throws a TypeError for other objects.
double* row_of(nb::handle solution);
// Return the names of an object that is a solution.
nb::object names_of(nb::handle solution);
