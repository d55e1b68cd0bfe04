// Included by every file of this folder: the functions that bind the parts, one per file.
#pragma once

#include <nanobind/nanobind.h>

namespace nb = nanobind;
using namespace nb::literals;

void bind_allocations(nb::module_& m);
void bind_elastic(nb::module_& m);
void bind_geometry(nb::module_& m);
void bind_hand(nb::module_& m);
void bind_nearest(nb::module_& m);
void bind_optimizer(nb::module_& m);
void bind_phi(nb::module_& m);
void bind_planner(nb::module_& m);
