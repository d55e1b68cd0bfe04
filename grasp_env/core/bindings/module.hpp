// Common header of this folder: nanobind, and the functions that bind the parts.
#pragma once

#include <nanobind/nanobind.h>

namespace nb = nanobind;
using namespace nb::literals;

void bind_build_info(nb::module_& m);
void bind_record(nb::module_& m);
void bind_contacts(nb::module_& m);
void bind_problem(nb::module_& m);
void bind_optimizer(nb::module_& m);
void bind_grasps(nb::module_& m);
void bind_layer(nb::module_& m);
void bind_flow(nb::module_& m);
void bind_limits(nb::module_& m);
void bind_learned(nb::module_& m);
void bind_solution(nb::module_& m);
void bind_phi(nb::module_& m);
void bind_surface(nb::module_& m);
void bind_tree(nb::module_& m);
void bind_grasping(nb::module_& m);
void bind_scene(nb::module_& m);
void bind_gather(nb::module_& m);
void bind_hand_controller(nb::module_& m);
void bind_simulated_hand(nb::module_& m);
void bind_contact_estimator(nb::module_& m);
