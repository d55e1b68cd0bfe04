// Numbers of the core as numpy arrays that keep their owner alive.
#pragma once

#include <nanobind/ndarray.h>

#include <vector>

#include "module.hpp"

using View = nb::ndarray<nb::numpy, double, nb::c_contig>;

inline View view(nb::handle owner, std::vector<double>& numbers, std::initializer_list<size_t> shape) {
    return View(numbers.data(), shape, owner);
}
