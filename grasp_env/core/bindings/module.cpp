// The module: one function per file of this folder adds its part.
#include "module.hpp"

NB_MODULE(_core, m) {
  nb::set_leak_warnings(false);  // objects that a program keeps to its end are no leak
  m.doc() = "The compiled core; use `grasp_env.core`.";
  bind_build_info(m);
  bind_record(m);
  bind_solution(m);
  bind_contacts(m);
  bind_problem(m);
  bind_optimizer(m);
  bind_grasps(m);
  bind_layer(m);
  bind_flow(m);
  bind_limits(m);
  bind_learned(m);
  bind_phi(m);
  bind_surface(m);
  bind_tree(m);
  bind_grasping(m);
  bind_scene(m);
  bind_gather(m);
  bind_hand_controller(m);
  bind_simulated_hand(m);
  bind_contact_estimator(m);
}
