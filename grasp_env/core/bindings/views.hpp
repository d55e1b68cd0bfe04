// Numbers of the core as numpy arrays.
#pragma once

#include <nanobind/ndarray.h>

#include <vector>

#include <grasp/geometry.hpp>

#include "module.hpp"

using View = nb::ndarray<nb::numpy, double, nb::c_contig>;

// That keep their owner alive.
inline View view(nb::handle owner, std::vector<double>& numbers, std::initializer_list<size_t> shape) {
    return View(numbers.data(), shape, owner);
}

// A new array (3,).
inline nb::object array_of(const grasp::Point& p) { return nb::cast(View(const_cast<double*>(&p.u), {3}), nb::rv_policy::copy); }
