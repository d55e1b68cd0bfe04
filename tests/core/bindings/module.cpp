// _core_test: the insides of the core, for tests/core only; never part of a wheel.
#include <nanobind/nanobind.h>

#include <grasp/version.hpp>

namespace nb = nanobind;

NB_MODULE(_core_test, m) {
    m.attr("version") = GRASP_VERSION;
#ifdef GRASP_SANITIZE
    // what the sanitizers must catch: `make sanitize` proves on it that they watch
    m.def("read_out_of_bounds", [](int index) {
        const auto numbers = new double[4]{1.0, 2.0, 3.0, 4.0};
        const double read = numbers[index];
        delete[] numbers;
        return read;
    });
    m.def("overflow", [](int number) { return number + 1; });
#endif
}
