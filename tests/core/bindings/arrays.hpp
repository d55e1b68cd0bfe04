// numpy in, numpy out. Speed is no matter here: arguments are converted, results are copies.
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
    const nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<double>*>(p); });
    return nb::cast(nb::ndarray<nb::numpy, double>(kept->data(), shape, owner));
}
template <class Numbers> nb::object array(const Numbers& values) {
    return array(std::vector<double>(values.begin(), values.end()), {values.size()});
}

// f(V{}) with V the register of so many lanes.
template <class F> auto with_lanes(int lanes, F&& f) {
    switch (lanes) {
        case 1: return f(grasp::Lanes<1>{});
        case 2: return f(grasp::Lanes<2>{});
        case 4: return f(grasp::Lanes<4>{});
        case 8: return f(grasp::Lanes<8>{});
    }
    throw nb::value_error("lanes: 1, 2, 4 or 8");
}

// The layouts that the tests compare: lanes, and registers where their number is fixed (0: as many as needed). Plain numbers, a register
// that contacts do not fill, and what the core chooses for few contacts; it takes the others itself. A solver takes long to compile: under
// the sanitizers there is one.
#ifdef GRASP_SANITIZE
inline constexpr int LAYOUTS[][2] = {{8, 0}};
#else
inline constexpr int LAYOUTS[][2] = {{1, 0}, {8, 0}, {4, 1}};
#endif

template <template <class, int> class Made, class Base, class... Arguments>
std::unique_ptr<Base> instance_of(int lanes, int blocks, const Arguments&... arguments) {
    using grasp::Lanes;
    const int layout = 10 * lanes + blocks;
    if (layout == 80) return std::make_unique<Made<Lanes<8>, 0>>(arguments...);
#ifndef GRASP_SANITIZE
    if (layout == 10) return std::make_unique<Made<Lanes<1>, 0>>(arguments...);
    if (layout == 41) return std::make_unique<Made<Lanes<4>, 1>>(arguments...);
#endif
    throw nb::value_error("a layout of LAYOUTS is needed");
}

// grasp::Contacts under a name of this module's own: _core registers the type itself.
struct Placement {
    grasp::Contacts contacts;
    grasp::Placing placed;
};
