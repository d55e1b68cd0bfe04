// numpy in, numpy out: arguments are converted, results are copies.
#pragma once

#include <nanobind/ndarray.h>

#include <memory>

#include <grasp/conic/conic.hpp>

#include "module.hpp"

using In = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;

// The numbers of an argument that must have `size` of them.
inline const double* numbers(const In& a, size_t size) {
  if (a.size() != size) throw nb::value_error("an array of another size is needed");
  return a.data();
}

inline nb::object array(std::vector<double> values, std::initializer_list<size_t> shape) {
  auto* kept = new std::vector<double>(std::move(values));
  const nb::capsule owner(kept,
                          [](void* p) noexcept { delete static_cast<std::vector<double>*>(p); });
  return nb::cast(nb::ndarray<nb::numpy, double>(kept->data(), shape, owner));
}
template <class Numbers> nb::object array(const Numbers& values) {
  return array(std::vector<double>(values.begin(), values.end()), {values.size()});
}

// f(V{}) with V the register of so many lanes.
template <class F> auto with_lanes(int lanes, F&& f) {
  switch (lanes) {
    case 1:
      return f(grasp::Lanes<1>{});
    case 2:
      return f(grasp::Lanes<2>{});
    case 4:
      return f(grasp::Lanes<4>{});
    case 8:
      return f(grasp::Lanes<8>{});
  }
  throw nb::value_error("lanes: 1, 2, 4 or 8");
}

// grasp::Contacts under another name: _core registers the type itself.
struct Placement {
  grasp::Contacts contacts;
  grasp::Placing placed;
};
