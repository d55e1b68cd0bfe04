// _core_test: the insides of the core, for tests/core only; never part of a wheel.
#include <vector>

#include <grasp/version.hpp>

#include "module.hpp"

NB_MODULE(_core_test, m) {
    m.attr("version") = GRASP_VERSION;
    nb::set_leak_warnings(false);  // tests keep grasps and solvers to the end
#ifdef GRASP_SANITIZE
    // what the sanitizers must catch with the wrong arguments: the proof that they watch
    m.def("read", [](int size, int index) { return std::vector<double>(size, 1.0).data()[index]; });
    m.def("successor", [](int number) { return number + 1; });
#endif
    bind_phi(m);
    bind_linear6(m);
    bind_geometry(m);
    bind_insides(m);
    bind_optimizer(m);
    bind_program(m);
    bind_general(m);
    bind_grasping(m);
    bind_allocations(m);
    bind_hand(m);
}
