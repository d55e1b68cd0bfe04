// What every file of this folder includes, and the functions that bind the parts: one per file.
#pragma once

#include <nanobind/nanobind.h>

namespace nb = nanobind;
using namespace nb::literals;

void bind_phi(nb::module_& m);
void bind_linear6(nb::module_& m);
void bind_geometry(nb::module_& m);
void bind_insides(nb::module_& m);
void bind_optimizer(nb::module_& m);
void bind_program(nb::module_& m);
void bind_general(nb::module_& m);
void bind_grasping(nb::module_& m);
void bind_allocations(nb::module_& m);
void bind_hand(nb::module_& m);
