// _core_test: the insides of the core, for tests/core only; never part of a wheel.
#include <nanobind/nanobind.h>

#include <vector>

#include <grasp/version.hpp>

namespace nb = nanobind;

NB_MODULE(_core_test, m) {
    m.attr("version") = GRASP_VERSION;
#ifdef GRASP_SANITIZE
    // what the sanitizers must catch with the wrong arguments: the proof that they watch
    m.def("read", [](int size, int index) { return std::vector<double>(size, 1.0).data()[index]; });
    m.def("successor", [](int number) { return number + 1; });
#endif
}
