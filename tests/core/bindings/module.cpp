// _core_test: parts of the core that tests/core needs and users do not; never part of a wheel.
#include <vector>

#include <grasp/version.hpp>

#include "module.hpp"

NB_MODULE(_core_test, m) {
  m.attr("version") = GRASP_VERSION;
  nb::set_leak_warnings(false);  // tests keep grasps and solvers to the end
#ifdef GRASP_SANITIZE
  // the proof that the sanitizers watch: they must report these with the wrong arguments
  m.def("read", [](int size, int index) { return std::vector<double>(size, 1.0).data()[index]; });
  m.def("successor", [](int number) { return number + 1; });
#endif
  bind_allocations(m);
  bind_elastic(m);
  bind_geometry(m);
  bind_hand(m);
  bind_nearest(m);
  bind_optimizer(m);
  bind_phi(m);
  bind_planner(m);
}
