// Numbers of the core as numpy arrays.
#pragma once

#include <nanobind/ndarray.h>

#include <vector>

#include <grasp/contacts/geometry.hpp>

#include "module.hpp"

using View = nb::ndarray<nb::numpy, double, nb::c_contig>;

// Views that keep their owner alive.
inline View view(nb::handle owner, std::vector<double>& numbers,
                 std::initializer_list<size_t> shape) {
  return View(numbers.data(), shape, owner);
}

using ReadOnly = nb::ndarray<nb::numpy, const double, nb::c_contig>;
inline ReadOnly view(nb::handle owner, const double* numbers, std::initializer_list<size_t> shape) {
  return ReadOnly(numbers, shape, owner);
}
// A new read-only array.
inline ReadOnly array_of(std::vector<double> numbers, std::initializer_list<size_t> shape) {
  auto* values = new std::vector<double>(std::move(numbers));
  return ReadOnly(values->data(), shape, nb::capsule(values, [](void* p) noexcept {
                    delete static_cast<std::vector<double>*>(p);
                  }));
}

// A new array (3,).
inline nb::object array_of(const grasp::Point& p) {
  return nb::cast(View(const_cast<double*>(&p.u), {3}), nb::rv_policy::copy);
}
